"""The rasters that a search for the least cost reads: free pixels, clearance, flow and speed, on any resolution.

Channels are often only a few pixels wide, and against a flow nearly as fast as the robot half a pixel from the wall
decides. The rasters are bilinear between the pixel centres; `finer` evaluates the same functions on more points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flowrec.core import Bools, Floats, compiled

Points = Floats  # (n, 2), or (2,) of one
Raster = Floats  # (h, w)
Mask = Bools  # (h, w)
# The 8 neighbours of a pixel, by the angle; the opposite of number k is number k + 4.
NEIGHBOUR_X = np.array([1, 1, 0, -1, -1, -1, 0, 1], np.int64)
NEIGHBOUR_Y = np.array([0, 1, 1, 1, 0, -1, -1, -1], np.int64)


class CostRasters(NamedTuple):
    """Rasters (h, w) in pixels and seconds, C-contiguous; a named tuple, so that kernels take it as one argument."""

    free: Mask  # where the robot's centre may be
    clearance: Raster  # px
    need: float  # px, the clearance that the robot needs
    vx: Raster  # px/s
    vy: Raster  # px/s
    speed: Raster  # px/s of the robot through the fluid, less what a possible error of the flow takes
    idle: float = -1.0  # px/s; positive: the cost is energy, not time (`kernels.step_energy`)

    def finer(self, k: int) -> CostRasters:
        """Resample with k points per pixel; pixel (j, i) becomes point (k j, k i). Values are in new pixels."""
        if k == 1:
            return self
        free = self.free
        cells = free[:-1, :-1] | free[:-1, 1:] | free[1:, :-1] | free[1:, 1:]  # with a free corner
        clearance = _interpolate_cells(self.clearance, cells, k, -1.0 / k)
        allowed = _joined_neighbours(free, k) | (clearance >= self.need - 1e-9)
        vx, vy, speed = (k * _interpolate_cells(raster, cells, k, 0.0) for raster in (self.vx, self.vy, self.speed))
        return CostRasters(allowed, k * clearance, self.need * k, vx, vy, speed, self.idle * k)


@compiled
def interpolate_raster(raster: Raster, k: int) -> Raster:
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
def _interpolate_cells(raster: Raster, cells: Mask, k: int, elsewhere: float) -> Raster:
    """`interpolated` within some cells (h - 1, w - 1) between pixel centres only; a constant elsewhere."""
    h, w = raster.shape
    fine = np.full(((h - 1) * k + 1, (w - 1) * k + 1), elsewhere)
    for j in range(h - 1):
        for i in range(w - 1):
            if not cells[j, i]:
                continue
            for n in range(k + 1):
                b = n / k
                for m in range(k + 1):
                    a = m / k
                    fine[j * k + n, i * k + m] = (
                        (1.0 - a) * (1.0 - b) * raster[j, i]
                        + a * (1.0 - b) * raster[j, i + 1]
                        + (1.0 - a) * b * raster[j + 1, i]
                        + a * b * raster[j + 1, i + 1]
                    )
    return fine


@compiled
def _joined_neighbours(free: Mask, k: int) -> Mask:
    """The points on the straight lines between free neighbours, of a raster (h, w) with k points per pixel.

    Neighbours are joined although the bilinear clearance dips between them on the ridge of an oblique channel.
    """
    h, w = free.shape
    joined = np.zeros(((h - 1) * k + 1, (w - 1) * k + 1), np.bool_)
    for j in range(h):
        for i in range(w):
            for c in range(4):
                a = i + NEIGHBOUR_X[c]
                b = j + NEIGHBOUR_Y[c]
                if free[j, i] and 0 <= a < w and b < h and free[b, a]:
                    for n in range(k + 1):
                        joined[j * k + n * NEIGHBOUR_Y[c], i * k + n * NEIGHBOUR_X[c]] = True
    return joined
