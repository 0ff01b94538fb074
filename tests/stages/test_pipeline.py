"""One tick: which stage is given what."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import flowrec
from flowrec.core import Action, Applied, Hand, OperatorEvent, Outcome, Phase, Tick, Truth
from flowrec.physics import ROLLING_BY_DRAG, ChipSettings, clearance_um, load_chip, sample
from flowrec.stages import Inputs, assemble, step
from flowrec.stages.inputs import with_inputs
from flowrec.stages.pipeline import _goal_fault


@pytest.fixture(scope="module")
def navigation(session, tmp_path_factory):
    """The stages of a mission, with an observer that uses no map and knows of no lag, and its ticks on the way to the
    goal.
    """
    again = tmp_path_factory.mktemp("navigation") / "s.mcap"
    flowrec.replay(session, out=again, frames=True, observer="kalman", sets=["refine.correct_lag=false"])
    recorded = flowrec.open(again)
    ticks = [tick for tick in recorded.ticks() if tick.mission and tick.mission.phase == Phase.NAVIGATE]
    return assemble(recorded.config, recorded.chip), ticks


def after(pipeline, last, ticks):
    """The tick after `last` and the images and applied fields of recorded ticks."""
    for now in ticks:
        last = step(pipeline, last, Inputs(now.stamp_ns, now.frame, now.applied))
    return last


@pytest.mark.slow("flies two missions")
def test_mission_and_controller_place_the_robot_by_the_registration_that_was_found_and_observations_keep_the_stated(
    navigation,
):
    pipeline, ticks = navigation
    last = ticks[3]

    def stepped(registration):
        refined = replace(last.field, registration=registration)
        return after(pipeline, replace(last, refined=refined), ticks[4:5])

    plain = stepped(None)
    assert not plain.mission.finished
    goal, seen = plain.mission.goal_um, plain.estimate.position_um
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    at_goal = stepped(np.column_stack((quarter, goal - quarter @ seen)))
    assert at_goal.mission.outcome == Outcome.REACHED
    for name in ("track", "estimate", "observations"):
        assert getattr(at_goal, name).same_as(getattr(plain, name)), name

    beside = np.array([0.0, 40.0])
    moved = stepped(np.column_stack((np.eye(2), beside)))
    assert moved.demand.error_um == pytest.approx(float(np.hypot(*(seen + beside - moved.demand.reference_um))))
    assert moved.demand.velocity_um_s[1] < plain.demand.velocity_um_s[1]  # back to the route


@pytest.mark.slow("flies two missions")
def test_what_a_refinement_found_of_the_robot_corrects_observer_and_coils_and_no_observation(navigation):
    pipeline, ticks = navigation

    def flown(change, std=0.01, pipeline=pipeline):
        """The mission from a tick on, over some frames, with a map that found that much of the robot."""
        found = replace(ticks[3].field, parameter_names="depth_um; um_per_rev_share")
        found = replace(found, parameters=np.array([90.0, change]), parameter_std=np.array([9.0, std]))
        return after(pipeline, replace(ticks[3], refined=found), ticks[4:30])

    plain, corrected = flown(0.0), flown(-0.2)
    # A robot that rolls less is carried more along its course: the motion that was seen is the sum of both.
    less = corrected.estimate.rolled_um_s - plain.estimate.rolled_um_s
    assert np.allclose(less, -0.2 * plain.estimate.rolled_um_s, atol=0.02 * np.hypot(*plain.estimate.rolled_um_s))
    assert (corrected.estimate.flow_um_s - plain.estimate.flow_um_s) @ less < -0.7 * less @ less
    turns = [tick.currents.frequency_hz / np.hypot(*tick.demand.velocity_um_s) for tick in (plain, corrected)]
    assert turns[1] == pytest.approx(turns[0] / 0.8, rel=1e-3)
    # What the next refinement is given is of the robot as it is stated: adopting a map twice corrects nothing twice.
    assert len(plain.observations.position_um) > len(ticks[3].observations.position_um)
    assert corrected.observations.same_as(plain.observations)

    assert flown(-0.02, std=0.02).estimate.same_as(plain.estimate), "no more than its error"
    stated = replace(pipeline, refiner=replace(pipeline.refiner, correct_robot=False))
    assert flown(-0.2, pipeline=stated).estimate.same_as(plain.estimate)


@pytest.mark.slow("flies two missions")
def test_beside_walls_observer_and_coils_take_the_um_per_revolution_that_was_found_there_and_the_mission_that_of_all(
    navigation,
):
    pipeline, ticks = navigation
    able = []

    class Watched:
        """The mission, which notes the speed limit of the robot that it is given."""

        observes, check_axes = pipeline.mission.observes, False

        def update(self, *given):
            able.append(given[8].speed_limit_um_s)
            return pipeline.mission.update(*given)

    def flown(by_drag, std=0.001, pipeline=pipeline, registration=None):
        names = ("um_per_rev_share", *ROLLING_BY_DRAG)
        found = replace(ticks[3].field, parameter_names="; ".join(names), parameters=np.array([0.0, 0.0, by_drag]))
        found = replace(found, registration=registration)
        last = replace(ticks[3], refined=replace(found, parameter_std=np.array([0.1, 0.0, std])))
        return after(replace(pipeline, mission=Watched()), last, ticks[4:30])

    plain, slower = flown(0.0), flown(-0.2)
    rolled, rolls = (np.hypot(*tick.estimate.rolled_um_s) for tick in (plain, slower))
    drag = (1.0 - rolls / rolled) / 0.2  # what the stages take for the drag where the robot is
    chip, x_um, y_um = pipeline.chip, *plain.estimate.position_um
    near = pipeline.clearance_um[round(y_um / chip.um_per_px), round(x_um / chip.um_per_px)]
    s = pipeline.robot.radius_um / near
    of_one_wall = 1.0 / (1.0 - 9.0 / 16.0 * s + s**3 / 8.0) - 1.0
    assert 0.9 * of_one_wall < drag < 2.1 * of_one_wall
    turns = [tick.currents.frequency_hz / np.hypot(*tick.demand.velocity_um_s) for tick in (plain, slower)]
    assert turns[1] == pytest.approx(turns[0] / (1.0 - 0.2 * drag), rel=0.02)
    robot = pipeline.robot
    highest_hz = robot.max_speed_um_s / robot.um_per_rev
    assert plain.currents.frequency_hz < 0.9 * highest_hz, "or there is nothing to limit"
    assert flown(-0.9).currents.frequency_hz <= highest_hz * (1.0 + 1e-9), "a higher one may make it step out"
    assert np.ptp(able) < 1e-9, "a robot beside a wall is no slower robot: the mission would plan anew at each wall"
    assert slower.observations.same_as(plain.observations)
    assert flown(-0.2, std=0.2).estimate.same_as(plain.estimate), "no more than its error"
    unsure = np.hypot(*flown(-0.6, std=0.1).estimate.rolled_um_s)
    assert 1.0 - unsure / rolled == pytest.approx(0.45 * drag, rel=0.05), "half way to what is known of rollers"
    for no_drag in (0.2, -1.5):
        assert flown(no_drag).estimate.same_as(plain.estimate), "walls neither push a robot nor stop it"
    stated = replace(pipeline, refiner=replace(pipeline.refiner, correct_robot=False))
    assert flown(-0.2, pipeline=stated).estimate.same_as(flown(0.0, pipeline=stated).estimate)
    widest = np.unravel_index(pipeline.clearance_um.argmax(), pipeline.clearance_um.shape)[::-1]
    there = flown(-0.2, registration=np.column_stack((1e-3 * np.eye(2), chip.um_per_px * np.array(widest))))
    assert np.hypot(*there.estimate.rolled_um_s) > 1.02 * rolls, "a place is that on the chip, as it was found to lie"


def test_the_course_that_a_refinement_found_turns_observer_and_coils_and_no_observation(navigation):
    pipeline, ticks = navigation

    def flown(heading_deg, std=1.0, pipeline=pipeline):
        found = replace(ticks[3].field, parameter_names="heading_deg", parameters=np.array([heading_deg]))
        last = replace(ticks[3], refined=replace(found, parameter_std=np.array([std])))
        return after(pipeline, last, ticks[4:30])

    given_turns = []

    class Watched:
        """The health monitor, which notes the revolutions that it is given."""

        def watch(self, *given):
            given_turns.append(given[5].turns)
            return pipeline.health.watch(*given)

    flown(10.0, pipeline=replace(pipeline, health=Watched()))
    c, s = np.cos(np.deg2rad(10.0)), np.sin(np.deg2rad(10.0))
    turned = [np.array([[c, -s], [s, c]]) @ tick.applied.turns for tick in ticks[4:30]]
    assert np.allclose(given_turns, turned) and np.abs(turned).max() > 0.0

    plain, corrected = flown(0.0), flown(10.0)
    before, now = (tick.estimate.rolled_um_s for tick in (plain, corrected))
    assert np.arctan2(before[0] * now[1] - before[1] * now[0], before @ now) == pytest.approx(
        np.deg2rad(10.0), abs=0.01
    )
    assert np.hypot(*now) == pytest.approx(np.hypot(*before), rel=0.01)
    away = [
        np.angle(np.exp(1j * (tick.currents.heading_rad - np.arctan2(*tick.demand.velocity_um_s[::-1]))), deg=True)
        for tick in (plain, corrected)
    ]
    assert away == pytest.approx([0.0, -10.0], abs=1e-6)
    assert corrected.observations.same_as(plain.observations)
    assert flown(10.0, std=6.0).estimate.same_as(plain.estimate), "not significant"
    stated = replace(pipeline, refiner=replace(pipeline.refiner, correct_heading=False))
    assert flown(10.0, pipeline=stated).estimate.same_as(plain.estimate)


@pytest.mark.slow("flies two missions")
def test_beside_walls_observer_and_coils_know_that_the_flow_carries_a_sphere_more_slowly_and_observations_stay_raw(
    navigation,
):
    stated, ticks = navigation
    pipeline = replace(stated, refiner=replace(stated.refiner, correct_lag=True))

    def flown(share, pipeline=pipeline, count=26):
        found = replace(ticks[3].field, parameter_names="sphere_share", parameters=np.array([share]))
        last = replace(ticks[3], refined=replace(found, parameter_std=np.array([0.4])))
        return after(pipeline, last, ticks[4 : 4 + count])

    plain, lagging = flown(0.0), flown(1.0)
    chip, field, at_um = pipeline.chip, ticks[3].field, plain.estimate.position_um
    near = pipeline.clearance_um[tuple(np.rint(at_um / chip.um_per_px).astype(int)[::-1])]
    wide = chip.um_per_px * float(pipeline.widths.at(at_um[None] / chip.um_per_px)[0])
    radius, far, flow = pipeline.robot.radius_um, wide - near, sample(field, at_um)
    held = 5.0 / 16.0 * (far - near) * ((radius / near) ** 3 / far - (radius / far) ** 3 / near)
    beside = 0.5 * radius * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    laplacian = (sample(field, at_um + beside).sum(axis=0) - 4.0 * flow) / (0.5 * radius) ** 2
    slip = radius**2 / 6.0 * laplacian - held * flow
    size = np.hypot(*slip)
    assert size > 0.03 * np.hypot(*flow) and slip @ flow < 0.0, "or there is nothing to see"
    more = lagging.estimate.flow_um_s - plain.estimate.flow_um_s
    assert np.hypot(*(more + slip)) < 0.35 * size, "the filter follows with a delay"
    heading, hz = lagging.currents.heading_rad, lagging.currents.frequency_hz
    ordered = pipeline.robot.um_per_rev * hz * np.array([np.cos(heading), np.sin(heading)])
    assert np.hypot(*(lagging.demand.velocity_um_s - ordered - slip)) < 0.3 * size
    assert lagging.observations.same_as(plain.observations)
    assert flown(1.0, stated).estimate.same_as(plain.estimate)

    now = ticks[30]
    hand = Hand(now.stamp_ns, True, np.array([0.6, 0.0]), 0.01, "keys")
    steered = [
        step(pipeline, tick, Inputs(now.stamp_ns, now.frame, now.applied, hand=hand)) for tick in (plain, lagging)
    ]
    assert all(tick.mission.by_hand for tick in steered)
    assert steered[1].currents.heading_rad == steered[0].currents.heading_rad == 0.0, "a hand is not corrected"


def test_an_observer_that_corrects_the_map_reads_it_where_the_registration_puts_the_robot(navigation):
    pipeline, ticks = navigation
    pipeline = replace(pipeline, observer=replace(pipeline.observer, method="kalman_map"))
    across = np.column_stack((np.eye(2), [0.0, 80.0]))  # to a place of another speed

    def flow_um_s(registration, correct_robot):
        refiner = replace(pipeline.refiner, correct_robot=correct_robot)
        last = replace(ticks[3], refined=replace(ticks[3].field, registration=registration), estimate=None)
        return after(replace(pipeline, refiner=refiner), last, ticks[4:5]).estimate

    there, stated = flow_um_s(across, True), flow_um_s(None, True)
    expected = sample(ticks[3].field, there.position_um + np.array([0.0, 80.0]))
    assert np.allclose(there.flow_um_s, expected, atol=1.0)
    assert np.hypot(*(there.flow_um_s - stated.flow_um_s)) > 20.0
    assert flow_um_s(across, False).same_as(stated)


def test_a_goal_may_lie_up_to_the_edge_of_the_first_and_the_last_pixel_of_a_chip():
    chip = load_chip(ChipSettings())
    stages = SimpleNamespace(chip=chip, clearance_um=clearance_um(chip.mask, chip.um_per_px))
    row = int(np.flatnonzero(chip.mask[:, 0] & chip.mask[:, -1]).mean())

    def fault(column):
        goal_um = chip.um_per_px * np.array([column, row])
        return _goal_fault(stages, SimpleNamespace(operator=OperatorEvent(7, Action.GOAL, "", goal_um), stamp_ns=7))

    last = chip.mask.shape[1] - 1
    assert [fault(column) for column in (-0.4, last + 0.4)] == ["", ""]
    assert [fault(column) for column in (-0.6, last + 0.6)] == ["it is outside the chip"] * 2


def test_a_truth_that_is_not_new_on_a_tick_is_not_on_it_and_what_the_coils_did_stays_known():
    here = np.zeros(2)
    applied = Applied(0, 1.0, 0.0, 4.0, np.zeros(3), here)
    last = Tick(0, applied=applied, truth=Truth(0, here, here, 40.0, 0))
    now = with_inputs(last, Inputs(33, None, None))
    assert now.truth is None and now.applied is applied and now.stamp_ns == 33
