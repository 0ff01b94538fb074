"""Observations of tracers at unknown heights: a straight duct, whose flow a number of beads tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Observations
from flowrec.physics import ChipSettings, FlowSolver, load_chip, sample
from flowrec.stages.refine import Assimilate, Refiner
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.noise import MOST_OBSERVATIONS, groups
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.tracer_heights import ENTERED, EVEN, LEAST_PX, MOST, MOST_EACH, at_mean_height

SOLVER = FlowSolver()
DUCT = replace(load_chip(ChipSettings(name="straight")), depth_um=150.0)
ASSUMED = SOLVER.solve(DUCT)


def of_beads(count: int, seed: int, *, each: int = 3, entered: bool = False, factor: float = 1.4) -> Observations:
    """What beads show of `factor` times the assumed flow, at heights that are spread evenly, or by the flux."""
    rng = np.random.default_rng(seed)
    heights = rng.uniform(-1.0, 1.0, 40 * count)
    heights = heights[rng.random(len(heights)) < 1.0 - heights**2] if entered else heights
    c = np.repeat(1.5 * (1.0 - heights[:count] ** 2), each)
    rows, columns = np.nonzero(DUCT.mask)
    middle = np.abs(rows - rows.mean()) < 0.25 * np.ptp(rows)
    chosen = rng.choice(np.flatnonzero(middle), count * each)
    places = np.stack((columns[chosen], rows[chosen]), -1) * DUCT.um_per_px
    flow = factor * c[:, None] * sample(ASSUMED, places) + 2.0 * rng.standard_normal((count * each, 2))
    n = count * each
    return Observations(
        0, places, flow, np.full(n, 2.0), None, np.arange(n) * 0.1, None,
        np.repeat(np.arange(count, dtype=float), each), np.full(n, float(entered)),
    )  # fmt: skip


@pytest.mark.parametrize(("entered", "mean"), [(False, EVEN[0]), (True, ENTERED[0])])
def test_the_mean_over_beads_is_the_flow(entered: bool, mean: float) -> None:
    ratios = []
    for seed in range(12):
        found = at_mean_height(of_beads(60, seed, each=1, entered=entered), ASSUMED, DUCT)
        there = sample(ASSUMED, found.position_um)
        ratios += ((found.flow_um_s * there).sum(axis=1) / (there**2).sum(axis=1)).tolist()
    assert np.mean(ratios) == pytest.approx(1.4, rel=0.04)
    spread = (ENTERED if entered else EVEN)[1] / mean
    assert np.std(ratios) / np.mean(ratios) == pytest.approx(spread, rel=0.15)


@pytest.mark.parametrize("entered", [False, True])
@pytest.mark.parametrize("flat", [False, True])
def test_where_no_depth_is_stated_the_scatter_of_the_tracers_tells_how_flat_the_profile_is(
    entered: bool, flat: bool
) -> None:
    chip = replace(DUCT, depth_um=None)
    ratios = []
    for seed in range(12):
        beads = of_beads(60, seed, each=1, entered=entered)
        if flat:
            beads = replace(beads, flow_um_s=1.4 * sample(ASSUMED, beads.position_um))
        found = at_mean_height(beads, ASSUMED, chip)
        there = sample(ASSUMED, found.position_um)
        ratios += ((found.flow_um_s * there).sum(axis=1) / (there**2).sum(axis=1)).tolist()
    assert np.mean(ratios) == pytest.approx(1.4, rel=0.05)


def test_what_the_robot_observed_is_left_as_it_is_and_few_of_each_tracer_are_used() -> None:
    beads = of_beads(200, 1, each=10)
    own = beads.only(slice(0, 7))
    robot = replace(own, rolled_um_s=own.flow_um_s, radius_um=50.0, tracer=None, entered=None)
    joined = robot.with_tracers(beads)
    assert joined.radius_um == 50.0 and not joined.rolled_um_s[7:].any() and (joined.tracer[:7] == -1.0).all()
    found = at_mean_height(joined, ASSUMED, DUCT)
    assert found.only(slice(0, 7)).flow_um_s.tolist() == robot.flow_um_s.tolist()
    assert found.std_um_s[:7].tolist() == robot.std_um_s.tolist()
    assert len(found.std_um_s) == 7 + MOST and found.tracer.max() == 199.0, "the latest"
    short = np.flatnonzero((beads.tracer < 150.0) | (np.arange(2000) % 10 == 0))  # of the last 50 one stretch each
    assert at_mean_height(beads.only(short), ASSUMED, DUCT).tracer.max() < 150.0, "the longest"
    few = at_mean_height(of_beads(3, 1, each=40), ASSUMED, DUCT)
    assert np.bincount(few.tracer.astype(int)).tolist() == [MOST_EACH] * 3
    assert at_mean_height(robot, ASSUMED, DUCT) is robot and robot.with_tracers(None) is robot


def test_where_observations_are_averaged_along_the_way_of_the_robot_each_tracer_stays_by_itself() -> None:
    beads = at_mean_height(of_beads(200, 1), ASSUMED, DUCT)
    way = of_beads(1, 2, each=170)
    robot = replace(way, rolled_um_s=way.flow_um_s, radius_um=50.0, tracer=None, entered=None)
    joined = robot.with_tracers(beads)
    group = groups(observation_operator(joined, DUCT.mask, DUCT.um_per_px, None))
    assert np.bincount(group)[-MOST:].tolist() == [1] * MOST
    assert group.max() + 1 == MOST_OBSERVATIONS and (np.diff(group) >= 0).all()
    assert set(np.bincount(group[:170])) == {2, 3}
    alone = groups(observation_operator(robot, DUCT.mask, DUCT.um_per_px, None))
    assert alone.tolist() == (np.arange(170) * MOST_OBSERVATIONS // 170).tolist()


def test_a_tracer_beside_a_wall_that_may_be_off_is_not_used() -> None:
    rows, columns = np.nonzero(DUCT.mask)
    edge = np.array([columns.mean(), rows.min() + 0.4 * LEAST_PX]) * DUCT.um_per_px
    beads = of_beads(5, 1)
    moved = replace(beads, position_um=np.where(beads.tracer[:, None] == 2.0, edge, beads.position_um))
    assert set(at_mean_height(moved, ASSUMED, DUCT).tracer) == {0.0, 1.0, 3.0, 4.0}


def refined(observations: Observations) -> tuple[float, float]:
    """Refined over assumed flow in the middle of the duct, and its bar."""
    field = Refiner(adopt="always").refine(ASSUMED, observations, DUCT, SOLVER)
    row, column = (int(each.mean()) for each in np.nonzero(DUCT.mask))
    there = ASSUMED.velocity_um_s[row, column, 0]
    return float(field.velocity_um_s[row, column, 0] / there), float(field.std_um_s[row, column, 0] / there)


@pytest.mark.slow("five refinements: a cheaper one beside it sees a height for each observation")
def test_beads_tell_the_flow_of_a_duct_within_bars_that_their_heights_leave() -> None:
    pulls, bars = [], []
    for seed in range(5):
        found, bar = refined(of_beads(30, seed, factor=1.2))
        pulls.append((found - 1.2) / bar)
        bars.append(bar / 1.2)
    assert np.abs(pulls).max() < 3.0
    assert 0.5 * EVEN[1] / np.sqrt(30) < np.mean(bars) < 2.5 * EVEN[1] / np.sqrt(30)


def test_all_observations_of_a_bead_share_the_error_of_its_height_and_the_robot_has_none() -> None:
    beads = of_beads(2, 1, each=2)
    operator = observation_operator(
        replace(beads, tracer=np.array([-1.0, -1.0, 5.0, 5.0])), DUCT.mask, DUCT.um_per_px, ASSUMED.wall_px
    )
    settings = Assimilate()
    model = flow_model(settings, settings.model, DUCT, SOLVER)
    effects = {each.name: each for each in Observed.of(model, operator).effects(model.base, None)}
    kernel = effects["height"].kernel[::2, ::2]  # along x, in which the duct lies
    assert not kernel[:2].any() and not kernel[:, :2].any()
    assert kernel[2, 3] == pytest.approx(np.sqrt(kernel[2, 2] * kernel[3, 3])) and kernel[2, 3] > 0.0
    assert not effects["carry"].columns[:, 4:].any(), "a bead is no sphere of the robot's size"
