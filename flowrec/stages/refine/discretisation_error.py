"""Discretisation error of the flow, by Richardson extrapolation from a grid twice as coarse.

Each refinement of the grid changes the flow by a similar field that is smaller by a constant factor (Richardson,
1911). So the difference D between the grid in use and one twice as coarse is proportional to the remaining error: a
fraction of D is added to the flow, and what the fraction does not explain is a local standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Floats, FlowError, Range
from flowrec.physics import Chip, FlowSolver, Sensitivities, fluid_image


@dataclass(frozen=True, slots=True, eq=False)
class GridError:
    """D of a chip's flow and of its modes, compact (..., n, 2) um/s, and what they do not explain."""

    fraction: float  # of D that is added
    fraction_std: float
    base: Floats  # (n, 2)
    modes: Floats  # (openings, n, 2), or (0, n, 2) where there is no coarser grid
    local_std: Floats  # (n,) um/s


@dataclass(frozen=True, slots=True)
class ModelError:
    """Settings, fitted at k = 2 against truths on the solver's own grid of k = 4 (tests/perf/grid).

    They hold for pixel walls as they are. Another wall treatment, or another k, needs a new fit.
    """

    # fraction of the difference D between two grids that is added to the flow: 0.11 over 12 drawn vessels
    share: Annotated[float, Range(0.0, 10.0)] = 0.11
    # standard deviation of the fraction: 0.03 from chip to chip, more from one solver to another
    share_std: Annotated[float, Range(0.0, 10.0)] = 0.15
    # standard deviation of the error that remains, as a fraction of D around a pixel; 0.17 on those vessels
    left_share: Annotated[float, Range(0.0, 10.0)] = 0.2
    # standard deviation of it as a fraction of the speed around a pixel, where both grids agree by chance
    speed_share: Annotated[float, Range(1e-6, 10.0)] = 0.003
    # standard deviation of the whole error as a fraction of the speed around a pixel, where there is no coarser grid (k
    # = 1)
    coarse_share: Annotated[float, Range(1e-6, 10.0)] = 0.02

    def of(self, chip: Chip, solver: FlowSolver, expansion: Sensitivities) -> GridError:
        """Error of the flow of `expansion` and of its modes. D is that of Stokes flow: inertia hardly changes it."""
        speed = local_rms(chip.mask, expansion.base)
        if solver.k > 1:
            try:
                fine, coarse = (
                    replace(solver, k=k, convection=False).sensitivities(chip) for k in (solver.k, solver.k // 2)
                )
            except FlowError:
                pass  # an opening is too narrow for the coarse grid
            else:
                base = fine.base - coarse.base
                modes = fine.modes[: fine.openings] - coarse.modes[: fine.openings]
                std = np.hypot(self.left_share * local_rms(chip.mask, base), self.speed_share * speed)
                return GridError(self.share, self.share_std, base, modes, std)
        nothing = np.zeros_like(expansion.base)
        return GridError(0.0, 0.0, nothing, np.zeros((0, *nothing.shape)), self.coarse_share * speed)


def local_rms(mask: NDArray[np.bool_], velocity: Floats) -> Floats:
    """Root mean square (n,) of a compact velocity (n, 2) in the 5 x 5 pixels around each fluid pixel.

    Beside a wall the flow is slow, but the error of the grid there is proportional to the speed in the channel.
    """
    square = fluid_image(mask, (velocity**2).sum(axis=1))
    fluid = scipy.ndimage.uniform_filter(mask.astype(np.float64), 5, mode="nearest")
    mean = scipy.ndimage.uniform_filter(square, 5, mode="nearest") / np.maximum(fluid, 0.04)
    return np.asarray(np.sqrt(np.maximum(mean, 0.0)[mask]))
