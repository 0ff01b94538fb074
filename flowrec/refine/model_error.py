"""What the best parameters would leave: the error of the grid, from the difference to a grid twice as coarse."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.flow.response import FlowResponse, fluid_image
from flowrec.refine.sight import Floats


@dataclass(frozen=True, slots=True)
class ModelError:
    share: float = 0.4
    share_std: float = 0.06
    left_share: float = 0.2  # of the difference, around each pixel
    speed_share: float = 0.003  # of speed around
    coarse_share: float = 0.03  # of speed, where there is no coarser grid

    def of(self, chip: Chip, solver: FlowSolver, response: FlowResponse) -> GridError:
        n = len(response.base)
        speed = around(chip, response.base)
        modes = None
        if solver.k > 1:
            try:
                fine, coarse = (replace(solver, k=k, convection=False).response(chip) for k in (solver.k, solver.k // 2))
                modes = fine.modes[: fine.openings] - coarse.modes[: fine.openings]
                base = fine.base - coarse.base
            except FlowError:
                pass
        if modes is None:
            return GridError(0.0, 0.0, np.zeros((n, 2)), np.zeros((0, n, 2)), self.coarse_share * speed)
        left = np.hypot(self.left_share * around(chip, base), self.speed_share * speed)
        return GridError(self.share, self.share_std, base, modes, left)


@dataclass(frozen=True, slots=True, eq=False)
class GridError:
    share: float
    std: float
    base: Floats  # (n, 2)
    modes: Floats  # (openings, n, 2)
    left_std: Floats  # (n,)


def around(chip: Chip, velocity: Floats) -> Floats:
    """(n,) root mean square speed in the 5 x 5 pixels around each fluid pixel."""
    square = fluid_image(chip.mask, (velocity**2).sum(axis=1))
    share = uniform_filter(chip.mask.astype(np.float64), 5, mode="nearest")
    mean = uniform_filter(square, 5, mode="nearest") / np.maximum(share, 0.04)
    return np.asarray(np.sqrt(np.maximum(mean, 0.0)[chip.mask]))
