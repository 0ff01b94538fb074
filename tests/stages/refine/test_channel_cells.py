"""Cells along the channels against flows whose resistance really differs."""

from dataclasses import replace

import numpy as np

from flowrec.stages.refine.channel_cells import MOST, channel_cells, resistance_modes


def test_the_weights_of_the_cells_are_shares_and_each_cell_lies_in_one_place(twin):
    chip = twin().chip
    cells = channel_cells(chip).toarray()
    assert 4 < len(cells) <= MOST
    np.testing.assert_allclose(cells.sum(axis=0), 1.0)
    rows, columns = np.nonzero(chip.mask)
    for weight in cells:
        centre = np.average(columns, weights=weight), np.average(rows, weights=weight)
        spread = np.sqrt(np.average((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2, weights=weight))
        assert spread < 0.35 * np.hypot(*chip.mask.shape)


def test_the_same_share_everywhere_changes_no_flow_that_its_inlet_prescribes_with_outlets_alike(twin):
    case = twin(assumed=(100.0, 0.0, 0.0))
    expansion = replace(case.solver, convection=False).sensitivities(case.chip)
    modes = resistance_modes(expansion, channel_cells(case.chip))
    assert np.abs(modes.sum(axis=0)).max() < 0.02 * np.abs(modes).max(axis=(1, 2)).sum()


def test_more_resistance_in_a_branch_is_less_flow_there_and_as_much_more_in_the_others(twin):
    case = twin()
    # The pixels of the upper branch resist: 12 mu / (rho H^2) of a depth as a friction of their own.
    rows, columns = np.nonzero(case.chip.mask)
    upper = (rows < 16) & (columns > 30) & (columns < 50)
    friction = np.zeros(case.chip.mask.shape)
    friction[rows[upper], columns[upper]] = 2e-5
    solver = replace(case.solver, convection=False)
    exact = (
        solver.solve(replace(case.chip, friction_per_um2=friction)).velocity_um_s
        - solver.solve(case.chip).velocity_um_s
    )[case.chip.mask]
    cells = channel_cells(case.chip)
    modes = resistance_modes(solver.sensitivities(case.chip), cells)
    inside = cells.toarray()[:, upper].sum(axis=1) / cells.toarray().sum(axis=1)
    mode = np.tensordot(np.where(inside > 0.5, inside, 0.0), modes, axes=1)
    scale = float((mode * exact).sum() / (mode**2).sum())
    assert scale > 0.0
    away = ~upper
    left = exact[away] - scale * mode[away]
    assert np.sqrt((left**2).sum() / (exact[away] ** 2).sum()) < 0.3
