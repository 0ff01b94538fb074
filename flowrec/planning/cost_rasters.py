"""What a search looks at: where the robot may be, how the water flows there and how fast it swims, on pixels or finer.

Channels are often only a few pixels wide, and against a flow nearly as fast as the robot half a pixel from the wall
decides. The rasters stay what they are, bilinear between the pixel centres; a finer terrain only looks more closely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.system.numba_setup import compiled

Points = NDArray[np.float64]
Raster = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Rasters (h, w) in pixels and seconds, float64 and C-contiguous."""

    free: Mask  # where the robot's centre may be
    clearance: Raster
    need: float  # clearance that is asked for
    vx: Raster
    vy: Raster
    speed: Raster  # of the robot through the fluid, what is left of it after a possible error of the flow
    idle: float = -1.0  # positive: energy counts, not time, see zermelo.step_energy

    def finer(self, k: int) -> Terrain:
        """The same with k pixels per pixel side; the centres of the old ones are every k-th of the new ones."""
        if k == 1:
            return self
        free, clearance, vx, vy, speed = _look_closer(
            self.free, self.clearance, self.need, self.vx, self.vy, self.speed, k
        )
        return Terrain(free, clearance, self.need * k, vx, vy, speed, self.idle * k)


@compiled
def interpolated(raster: Raster, k: int) -> Raster:
    """A raster (h, w) with k - 1 points between any two, bilinear: ((h - 1) k + 1, (w - 1) k + 1)."""
    h, w = raster.shape
    fine = np.empty(((h - 1) * k + 1, (w - 1) * k + 1))
    for j in range(h):
        for i in range(w - 1):
            for m in range(k):
                fine[j * k, i * k + m] = ((k - m) * raster[j, i] + m * raster[j, i + 1]) / k
        fine[j * k, (w - 1) * k] = raster[j, w - 1]
    for j in range(h - 1):
        for n in range(1, k):
            for i in range(fine.shape[1]):
                fine[j * k + n, i] = ((k - n) * fine[j * k, i] + n * fine[j * k + k, i]) / k
    return fine


@compiled
def _look_closer(
    free: Mask, clearance: Raster, need: float, vx: Raster, vy: Raster, speed: Raster, k: int
) -> tuple[Mask, Raster, Raster, Raster, Raster]:
    h, w = free.shape
    shape = ((h - 1) * k + 1, (w - 1) * k + 1)
    open_ = np.zeros(shape, np.bool_)
    room = np.full(shape, -1.0)
    along_x = np.zeros(shape)
    along_y = np.zeros(shape)
    swim = np.zeros(shape)
    for j in range(h - 1):
        for i in range(w - 1):
            if not (free[j, i] or free[j, i + 1] or free[j + 1, i] or free[j + 1, i + 1]):
                continue
            for n in range(k + 1):
                b = n / k
                for m in range(k + 1):
                    a = m / k
                    p = (1.0 - a) * (1.0 - b)
                    q = a * (1.0 - b)
                    r = (1.0 - a) * b
                    s = a * b
                    c = i * k + m
                    d = j * k + n
                    here = (
                        p * clearance[j, i]
                        + q * clearance[j, i + 1]
                        + r * clearance[j + 1, i]
                        + s * clearance[j + 1, i + 1]
                    )
                    room[d, c] = k * here
                    along_x[d, c] = k * (p * vx[j, i] + q * vx[j, i + 1] + r * vx[j + 1, i] + s * vx[j + 1, i + 1])
                    along_y[d, c] = k * (p * vy[j, i] + q * vy[j, i + 1] + r * vy[j + 1, i] + s * vy[j + 1, i + 1])
                    swim[d, c] = k * (
                        p * speed[j, i] + q * speed[j, i + 1] + r * speed[j + 1, i] + s * speed[j + 1, i + 1]
                    )
                    if here >= need - 1e-9:
                        open_[d, c] = True
            # Pixels that touch are joined, though on the ridge of an oblique channel the bilinear clearance dips.
            for n in range(k + 1):
                if free[j, i] and free[j + 1, i + 1]:
                    open_[j * k + n, i * k + n] = True
                if free[j, i + 1] and free[j + 1, i]:
                    open_[j * k + n, (i + 1) * k - n] = True
                if free[j, i] and free[j, i + 1]:
                    open_[j * k, i * k + n] = True
                if free[j, i] and free[j + 1, i]:
                    open_[j * k + n, i * k] = True
                if free[j + 1, i] and free[j + 1, i + 1]:
                    open_[(j + 1) * k, i * k + n] = True
                if free[j, i + 1] and free[j + 1, i + 1]:
                    open_[j * k + n, (i + 1) * k] = True
    return open_, room, along_x, along_y, swim
