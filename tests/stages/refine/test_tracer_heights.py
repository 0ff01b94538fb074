"""Observations of tracers at unknown heights: a straight duct, whose flow a number of beads tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Observations
from flowrec.physics import ChipSettings, FlowSolver, load_chip, sample
from flowrec.stages.refine import Assimilate, Refiner
from flowrec.stages.refine.causes import HEIGHT_S, Observed
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.noise import MOST_OBSERVATIONS, groups
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.tracer_heights import LEAST_PX, MEAN, MOST, SCATTER, VARIES_SHARE, at_mean_height

SOLVER = FlowSolver()
DUCT = replace(load_chip(ChipSettings(name="straight")), depth_um=150.0)
ASSUMED = SOLVER.solve(DUCT)


def of_beads(
    count: int, seed: int, *, each: int = 12, factor: float = 1.4, cut: int = 0, flat: float = 0.0
) -> Observations:
    """What beads show of `factor` times the assumed flow, at heights that are spread evenly over the depth.

    A bead passes `each` stretches in the time in which the mean of the flow over the depth does, one that flows faster
    more. Its way is lost and found again as another one up to `cut` times. The profile is `flat` from 0,
    of plates, to 1.
    """
    rng = np.random.default_rng(seed)
    c = flat + (1.0 - flat) * 1.5 * (1.0 - rng.uniform(-1.0, 1.0, count) ** 2)
    body = np.repeat(np.arange(count), np.rint(each * c).astype(int))
    body = body[rng.permutation(len(body))]  # in the order of their times
    parts = [rng.choice(len(body), min(cut, len(body)), replace=False)] if cut else []
    way = body * (cut + 1) + sum((np.arange(len(body)) > part).astype(int) for part in np.ravel(parts))
    rows, columns = np.nonzero(DUCT.mask)
    middle = np.abs(rows - rows.mean()) < 0.25 * np.ptp(rows)
    chosen = rng.choice(np.flatnonzero(middle), len(body))
    places = np.stack((columns[chosen], rows[chosen]), -1) * DUCT.um_per_px
    flow = factor * c[body, None] * sample(ASSUMED, places) + 2.0 * rng.standard_normal((len(body), 2))
    n = len(body)
    return Observations(
        0, places, flow, np.full(n, 2.0), None, np.arange(n) * 0.1, None, way.astype(float), np.zeros(n)
    )


def shares(found: Observations) -> list[float]:
    """The observed flow over the assumed one, of each observation."""
    there = sample(ASSUMED, found.position_um)
    return ((found.flow_um_s * there).sum(axis=1) / (there**2).sum(axis=1)).tolist()


@pytest.mark.parametrize("cut", [0, 2])
@pytest.mark.parametrize("count", [10, 60, 300])
def test_the_mean_over_beads_is_the_flow_however_many_they_are_and_however_often_they_are_lost(
    count: int, cut: int
) -> None:
    ratios: list[float] = []
    for seed in range(2400 // count):
        ratios += shares(at_mean_height(of_beads(count, seed, each=30, cut=cut), ASSUMED, DUCT))
    assert np.mean(ratios) == pytest.approx(1.4, rel=0.02)
    assert np.std(ratios) / np.mean(ratios) == pytest.approx(SCATTER / MEAN, rel=0.15)


@pytest.mark.parametrize("flat", [0.0, 0.5, 1.0])
def test_where_no_depth_is_stated_the_scatter_of_the_tracers_tells_how_flat_the_profile_is(flat: float) -> None:
    chip = replace(DUCT, depth_um=None)
    ratios = [
        each
        for seed in range(20)
        for each in shares(at_mean_height(of_beads(60, seed, each=30, flat=flat), ASSUMED, chip))
    ]
    assert np.mean(ratios) == pytest.approx(1.4, rel=0.03)


def test_what_the_robot_observed_is_left_as_it_is_and_some_of_the_tracers_are_used() -> None:
    beads = of_beads(200, 1, each=10)
    own = beads.only(slice(0, 7))
    robot = replace(own, rolled_um_s=own.flow_um_s, radius_um=50.0, tracer=None, entered=None)
    joined = robot.with_tracers(replace(beads, stamp_ns=robot.stamp_ns + 5))
    assert joined.stamp_ns == robot.stamp_ns, "by it the next observation of the robot is due"
    assert joined.radius_um == 50.0 and not joined.rolled_um_s[7:].any() and (joined.tracer[:7] == -1.0).all()
    found = at_mean_height(joined, ASSUMED, DUCT)
    assert found.only(slice(0, 7)).flow_um_s.tolist() == robot.flow_um_s.tolist()
    assert found.std_um_s[:7].tolist() == robot.std_um_s.tolist()
    assert len(found.std_um_s) == 7 + MOST
    chosen = [int(np.flatnonzero(joined.time_s == at_s)[0]) for at_s in found.time_s[7:]]
    np.testing.assert_allclose(found.flow_um_s[7:], joined.flow_um_s[chosen] / MEAN)
    varied = VARIES_SHARE * np.hypot(*found.flow_um_s[7:].T)
    np.testing.assert_allclose(found.std_um_s[7:], np.hypot(joined.std_um_s[chosen] / MEAN, varied))
    assert np.histogram(found.time_s[7:], 6, (0.0, beads.time_s[-1]))[0] == pytest.approx(MOST / 6, abs=1), (
        "at all times"
    )
    assert at_mean_height(robot, ASSUMED, DUCT) is robot and robot.with_tracers(None) is robot


def test_where_observations_are_averaged_along_the_way_of_the_robot_each_tracer_stays_by_itself() -> None:
    beads = at_mean_height(of_beads(200, 1), ASSUMED, DUCT)
    way = of_beads(1, 2, each=400).only(slice(0, 170))
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
    beads = of_beads(5, 1, each=30)
    moved = replace(beads, position_um=np.where(beads.tracer[:, None] == 2.0, edge, beads.position_um))
    assert set(at_mean_height(moved, ASSUMED, DUCT).tracer) == set(beads.tracer) - {2.0}


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
    assert 0.5 * SCATTER / np.sqrt(30) < np.mean(bars) < 2.5 * SCATTER / np.sqrt(30)


def test_observations_of_a_bead_share_the_error_of_its_height_for_some_seconds_and_the_robot_has_none() -> None:
    beads = of_beads(2, 1).only(slice(0, 4))
    operator = observation_operator(
        replace(beads, tracer=np.array([-1.0, -1.0, 5.0, 5.0]), time_s=np.array([0.0, 1.0, 2.0, 2.0 + HEIGHT_S])),
        DUCT.mask,
        DUCT.um_per_px,
        ASSUMED.wall_px,
    )
    settings = Assimilate()
    model = flow_model(settings, settings.model, DUCT, SOLVER)
    effects = {each.name: each for each in Observed.of(model, operator).effects(model.base, None)}
    kernel = effects["height"].kernel[::2, ::2]  # along x, in which the duct lies
    assert not kernel[:2].any() and not kernel[:, :2].any()
    assert kernel[2, 3] == pytest.approx(np.exp(-1.0) * np.sqrt(kernel[2, 2] * kernel[3, 3])) and kernel[2, 3] > 0.0
    assert not effects["carry"].columns[:, 4:].any(), "a bead is no sphere of the robot's size"
