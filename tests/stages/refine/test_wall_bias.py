"""Walls that all lie the same distance off: the chip, the first order of its flow, and what is found."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core.errors import FlowError
from flowrec.core.messages import Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.flow.sampling import sample
from flowrec.physics.flow.solver import FlowSolver
from flowrec.physics.flow.wall_offset import with_levels, with_wall_offset
from flowrec.stages.refine import Assimilate, Refiner
from flowrec.stages.refine.findings import findings
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.wall_bias import OFFSETS_PX, nearest_offset, wall_mode

WIDTH_PX, SPEED_UM_S = 12, 100.0


def channel(walls: str = "smooth") -> Chip:
    mask = np.zeros((30, 60), bool)
    mask[9 : 9 + WIDTH_PX] = True
    openings = (Opening("left", 9, 20, "inlet", SPEED_UM_S), Opening("right", 9, 20, "outlet", 0.0))
    return Chip("channel", mask, 10.0, openings, 1.0, 1000.0, walls=walls)


def across_um_s(chip: Chip, k: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the pixels in the middle column from the channel's axis, px, and the speed there."""
    field = FlowSolver(k).solve(chip)
    return np.arange(30) - 14.5, field.velocity_um_s[:, 30, 0]


@pytest.mark.parametrize("walls", ["smooth", "pixel"])
@pytest.mark.parametrize("offset_px", [-1.5, -1.0, -0.5, 0.5, 1.0, 1.5])
def test_walls_moved_by_an_offset_carry_the_same_flow_rate_in_the_parabola_of_the_wider_channel(walls, offset_px):
    chip = with_wall_offset(channel(walls), offset_px)
    y, speed = across_um_s(chip)
    half = 0.5 * WIDTH_PX + offset_px
    expected = 1.5 * SPEED_UM_S * WIDTH_PX / (2.0 * half) * np.maximum(1.0 - (y / half) ** 2, 0.0)
    assert np.abs(speed - expected).max() < 0.005 * SPEED_UM_S
    assert chip.boundary_values[0] * chip.openings[0].width_px == pytest.approx(SPEED_UM_S * WIDTH_PX)
    assert with_wall_offset(chip, -offset_px).mask.tobytes() == channel().mask.tobytes()


def test_an_offset_that_closes_an_opening_is_refused_with_its_size():
    with pytest.raises(FlowError, match="-6 px"):
        with_wall_offset(channel("pixel"), -6.0)


def test_the_first_order_of_the_flow_is_the_derivative_of_the_parabola_at_the_same_flow_rate():
    chip = channel()
    mode = np.zeros((*chip.mask.shape, 2))
    mode[chip.mask] = wall_mode(chip, FlowSolver(2))
    y, half = np.arange(30) - 14.5, 0.5 * WIDTH_PX
    expected = 1.5 * SPEED_UM_S / half * (3.0 * (y / half) ** 2 - 1.0)
    inside = np.abs(y) < half - 1.0  # beside the wall the second order counts
    assert np.allclose(mode[inside, 30, 0], expected[inside], atol=0.01 * SPEED_UM_S)


def test_offsets_are_tried_at_steps_and_never_beyond_the_largest():
    assert [nearest_offset(found) for found in (0.1, -0.3, 0.8, 7.0)] == [0.0, -0.5, 1.0, 2.0]


def test_walls_that_an_image_has_shown_are_not_tried_elsewhere():
    chip = channel()
    level_px = np.clip(0.5 * WIDTH_PX - np.abs(np.arange(30) - 14.5), -2.5, 2.5)
    shown = with_levels(chip, np.repeat(level_px[:, None], 60, axis=1))
    drawn, grey = (len(list(Assimilate().preparations(each, FlowSolver(2)))) for each in (chip, shown))
    assert grey == drawn - 1 - len(OFFSETS_PX)


@pytest.mark.slow("solves the flow of three vessels between other walls")
def test_a_threshold_that_is_off_by_a_fraction_of_a_pixel_is_found_with_the_flow_through_the_true_walls():
    chip, solver = channel(), FlowSolver(2)
    true = solver.solve(with_wall_offset(chip, 0.7))
    y = np.tile(np.linspace(-45.0, 45.0, 13), 5)
    places = np.column_stack([np.repeat(np.linspace(150.0, 450.0, 5), 13), 145.0 + y])
    std = np.full(len(places), 2.0)
    flow = sample(true, places) + 2.0 * np.random.default_rng(2).standard_normal(places.shape)
    refined = Refiner().refine(solver.solve(chip), Observations(0, places, flow, std), chip, solver)
    assert "too narrow on each side" in refined.note
    off = (refined.velocity_um_s - true.velocity_um_s)[chip.mask]
    assert np.sqrt((off**2).sum() / (true.velocity_um_s[chip.mask] ** 2).sum()) < 0.02
    assert (np.abs(off) < 2.0 * refined.std_um_s[chip.mask]).mean() > 0.9
    # It is said where the odds are three or more.
    seen = observation_operator(Observations(0, places, flow, std), chip.mask, chip.um_per_px, refined.wall_px)
    off_alike = Assimilate().hypotheses(seen, chip, solver).best
    as_drawn = replace(off_alike, observed=replace(off_alike.observed, wall_mode=None))
    for share in (0.6, 0.7, 0.8, 0.95):
        words = findings([off_alike, as_drawn], np.array([share, 1.0 - share])).words
        assert any("mask" in word for word in words) == (share > 0.75)
    # Of walls that are as drawn nothing is said.
    drawn = solver.solve(chip)
    flow = sample(drawn, places) + 2.0 * np.random.default_rng(2).standard_normal(places.shape)
    same = Refiner().refine(drawn, replace(Observations(0, places, flow, std)), chip, solver)
    assert "mask" not in same.note


def test_walls_off_everywhere_do_not_explain_a_closed_branch_by_calling_its_observations_outliers(twin):
    case = twin(noise=0.02, every=2)
    mask = case.chip.mask.copy()
    mask[8:13, 30:50] = False  # debris closes most of the upper branch
    flow = sample(case.solver.solve(replace(case.chip, mask=mask)), case.observations.position_um)
    seen = replace(case.observations, flow_um_s=flow)
    refined = Refiner().refine(case.assumed, seen, case.chip, case.solver)
    assert "the mask" not in refined.note and "outliers" not in refined.note
