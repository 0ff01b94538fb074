"""The linear model of a chip's flow: velocity = base + z columns, and the error that no column explains.

The columns are the boundary values and the fluid (prior.py), the fraction of the grid's error (discretisation_error.py)
and a wrong resistance and wrong walls of each cell of the channels (channel_cells.py). All of it depends on the chip
alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.core import Floats
from flowrec.physics import Chip, FlowSolver, Sensitivities, chip_key, compute_cached, median_width_um
from flowrec.stages.refine.channel_cells import cell_widening, channel_cells, resistance_modes
from flowrec.stages.refine.discretisation_error import ModelError
from flowrec.stages.refine.prior import Prior, PriorSettings, at_rest, law_widths


@dataclass(frozen=True, slots=True, eq=False)
class FlowModel:
    """Velocities are compact, (..., n, 2) um/s on the fluid pixels of the chip's mask in raster order."""

    chip: Chip
    expansion: Sensitivities
    prior: Prior
    known: Floats  # (p, n, 2) per prior standard deviation: boundary values, fluid, fraction of the grid's error
    resistance: Floats  # (cells, n, 2) per relative change of the resistance of each cell
    cells: Any  # (cells, n) sparse weights of the cells
    widening: Floats  # (cells,) relative change of the width of each cell per pixel by which both walls are off
    channel_px: float  # median width of the channels
    base: Floats  # (n, 2)
    error_std: Floats  # (n,) of each component: stated error of the grid, of which no unknown is a part


def flow_model(settings: PriorSettings, error: ModelError, chip: Chip, solver: FlowSolver) -> FlowModel:
    """The model of a chip, from the cache if possible.

    Raises
    ------
    FlowError
        If the chip's own flow can not be computed, or is at rest.
    """

    def compute() -> FlowModel:
        if not chip.boundary_values.any():  # before a factorisation of what may be a whole image
            raise at_rest(chip)
        law = bool(law_widths(settings, chip))
        expansion = solver.sensitivities(chip, settings.depth_std_share > 0.0, settings.inlet_shape_std > 0.0, law)
        pressure = expansion.pressure(np.zeros(len(expansion.modes)), expansion.start())
        prior = Prior.of(settings, chip, float(np.ptp(pressure)))
        grid = error.of(chip, solver, expansion)
        modes = expansion.modes.copy()
        modes[: len(grid.modes)] += grid.fraction * grid.modes
        known = np.concatenate([np.tensordot(prior.effect, modes, axes=1), grid.fraction_std * grid.base[None]])
        base = expansion.base + grid.fraction * grid.base
        cells = channel_cells(chip)
        # Above rounding errors, also where an observation has a std of 0.
        std = np.maximum(grid.local_std, 1e-3 * grid.local_std.max() + 1e-9)
        modes = resistance_modes(expansion, cells)
        widening, width_px = cell_widening(chip, cells), median_width_um(chip) / chip.um_per_px
        return FlowModel(chip, expansion, prior, known, modes, cells, widening, width_px, base, std)

    key = ("flow model", settings, error, solver, chip_key(chip))
    model: FlowModel = compute_cached(key, compute)
    return model
