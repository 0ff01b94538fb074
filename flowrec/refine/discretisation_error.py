"""What the best parameters would leave: the error of the grid, from the difference to a grid twice as coarse.

Refining a grid twice moves the flow by a similar field each time, smaller by a constant factor (Richardson, 1911).
So the difference D between the grid in use and one twice as coarse tells in which direction the rest lies, and a share
of it is added to the flow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.flow.sampling import fluid_image
from flowrec.flow.sensitivities import Sensitivities
from flowrec.ranges import Range
from flowrec.refine.observation_operator import Floats


@dataclass(frozen=True, slots=True)
class ModelError:
    """Settings, fitted by `flowrec bench grid` at k = 2 against truths on the solver's own grid of k = 4.

    They hold for pixel walls as they are; another closure at the walls, or another k, wants them fitted anew. Towards
    an infinitely fine grid of the same staircase the share would be 0.3 / (1 - 0.3).
    """

    # of D that is added: 0.32 over 24 crops of real vessels, 0.37 over 12 drawn ones
    share: Annotated[float, Range(0.0, 10.0)] = 0.30
    # one standard deviation of it: 0.04 from chip to chip, more from one solver to another
    share_std: Annotated[float, Range(0.0, 10.0)] = 0.15
    # of D around a pixel: one standard deviation of what is left there; 0.09 to 0.10 there
    left_share: Annotated[float, Range(0.0, 10.0)] = 0.12
    # of the speed around a pixel: the same, where both grids agree by chance
    speed_share: Annotated[float, Range(1e-6, 10.0)] = 0.003
    # of the speed around a pixel: all of it, where there is no coarser grid (k = 1)
    coarse_share: Annotated[float, Range(1e-6, 10.0)] = 0.02

    def of(self, chip: Chip, solver: FlowSolver, response: Sensitivities) -> GridError:
        """Of the flow at `response`, and of its modes. D is that of Stokes flow: inertia hardly changes it."""
        speed = around(chip.mask, response.base)
        if solver.k > 1:
            try:
                fine, coarse = (
                    replace(solver, k=k, convection=False).sensitivities(chip) for k in (solver.k, solver.k // 2)
                )
            except FlowError:
                pass  # an opening too narrow for the coarse grid
            else:
                base = fine.base - coarse.base
                modes = fine.modes[: fine.openings] - coarse.modes[: fine.openings]
                left = np.hypot(self.left_share * around(chip.mask, base), self.speed_share * speed)
                return GridError(self.share, self.share_std, base, modes, left)
        nothing = np.zeros_like(response.base)
        return GridError(0.0, 0.0, nothing, np.zeros((0, *nothing.shape)), self.coarse_share * speed)


@dataclass(frozen=True, slots=True, eq=False)
class GridError:
    """D of a chip's flow and of its modes, compact (..., n, 2) um/s, and what they do not explain."""

    share: float
    share_std: float
    base: Floats  # (n, 2)
    modes: Floats  # (openings, n, 2), or none
    left_std: Floats  # (n,)


def around(mask: NDArray[np.bool_], velocity: Floats) -> Floats:
    """Root mean square (n,) of a compact velocity (n, 2) in the 5 x 5 pixels around each fluid pixel.

    Beside a wall the flow is slow, but what the grid gets wrong there goes with the speed in the channel.
    """
    square = fluid_image(mask, (velocity**2).sum(axis=1))
    share = uniform_filter(mask.astype(np.float64), 5, mode="nearest")
    mean = uniform_filter(square, 5, mode="nearest") / np.maximum(share, 0.04)
    return np.asarray(np.sqrt(np.maximum(mean, 0.0)[mask]))
