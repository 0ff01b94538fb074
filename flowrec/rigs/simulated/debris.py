"""Particles other than the robot: some drift with the flow, some lie still. They are what a tracker must not follow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip
from flowrec.rigs.simulated.swimmer import bilinear
from flowrec.system.numba_setup import compiled


@compiled
def _drift(
    points: NDArray[np.float64],
    radii: NDArray[np.float64],
    vx: NDArray[np.float32],
    vy: NDArray[np.float32],
    clearance: NDArray[np.float32],
    um_per_px: float,
    dt: float,
    lost: NDArray[np.bool_],
) -> None:
    """Carry points (n, 2) in um on by dt in two steps; `lost` where one has left the chip."""
    height, width = vx.shape
    for n in range(points.shape[0]):
        for _ in range(2):
            i, j = points[n, 0] / um_per_px, points[n, 1] / um_per_px
            points[n, 0] += 0.5 * dt * bilinear(vx, i, j)
            points[n, 1] += 0.5 * dt * bilinear(vy, i, j)
        i, j = points[n, 0] / um_per_px, points[n, 1] / um_per_px
        lost[n] = not (-0.5 <= i <= width - 0.5 and -0.5 <= j <= height - 0.5) or bilinear(clearance, i, j) < 0.0


class Debris:
    """`points_um` (n, 2), `radii_um` (n,) and `darkness` (n,) from 0 to 1; the last `still` of them never move."""

    def __init__(
        self,
        chip: Chip,
        count: int,
        robot_radius_um: float,
        velocity_um_s: NDArray[np.float32],
        clearance_um: NDArray[np.float32],
        seed: int,
    ) -> None:
        self._rng = np.random.default_rng([seed, 2])
        self.still = count // 6
        total = count + self.still
        self.radii_um = robot_radius_um * self._rng.uniform(0.3, 0.7, total)
        self.darkness = self._rng.uniform(0.15, 0.45, total)
        # Room for the largest of them: a particle half in a wall would give the drawing away.
        rows, columns = np.nonzero(chip.mask & (clearance_um > 0.7 * robot_radius_um))
        if not len(rows):
            rows, columns = np.nonzero(chip.mask)
        chosen = self._rng.integers(0, len(rows), total)
        places = np.stack((columns[chosen], rows[chosen]), -1) + self._rng.uniform(-0.5, 0.5, (total, 2))
        self.points_um = places * chip.um_per_px
        self._chip = chip
        self._inlets = [o for o in chip.openings if o.kind == "inlet"]
        self._vx = np.ascontiguousarray(velocity_um_s[..., 0])
        self._vy = np.ascontiguousarray(velocity_um_s[..., 1])
        self._clearance = clearance_um
        self._lost = np.zeros(count, np.bool_)

    def drift(self, dt_s: float) -> None:
        """Carry all on by dt; whatever has left comes in again at an inlet."""
        moving = len(self.points_um) - self.still
        _drift(
            self.points_um[:moving],
            self.radii_um,
            self._vx,
            self._vy,
            self._clearance,
            self._chip.um_per_px,
            dt_s,
            self._lost,
        )
        for n in np.flatnonzero(self._lost).tolist():
            inlet = self._inlets[int(self._rng.integers(len(self._inlets)))]
            # More come in where the inflow is faster: the mean of three uniform draws is near a parabola.
            along = inlet.first + (inlet.width_px - 1) * float(self._rng.random(3).mean())
            height, width = self._chip.mask.shape
            place = {
                "left": (0.0, along),
                "right": (width - 1.0, along),
                "top": (along, 0.0),
                "bottom": (along, height - 1.0),
            }[inlet.side]
            self.points_um[n] = np.array(place) * self._chip.um_per_px
