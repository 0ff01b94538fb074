"""The mission state machine: order of phases, waiting for work, and every way to end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Applied, Demand, Estimate, FlowField, Mission, Observations, OperatorEvent, Route, Track
from flowrec.physics import Robot
from flowrec.stages.control.mission import MissionStateMachine

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0)
GOAL = (1000.0, 500.0)


def field(request: int) -> FlowField:
    return FlowField(0, request, "fvm", 20.0, np.zeros((4, 4, 2)), np.zeros((4, 4)), None, [1.0], 1.0, 1000.0, "")


def observed(*times_s: float) -> Observations:
    count = len(times_s)
    return Observations(0, np.zeros((count, 2)), np.zeros((count, 2)), np.ones(count), None, np.array(times_s))


def stretch(request: int, *ends_um: float, more: bool = True) -> Route:
    """A survey along y = 500 um at 100 um/s."""
    points = [[0.0, 500.0], *([x_um, 500.0] for x_um in ends_um)]
    times = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.array(points)[:, 0])))]) / 100.0
    return Route(0, request, "survey", True, "", points, times, more=more)


def surveying(**settings) -> World:  # type: ignore[no-untyped-def]
    """A robot on the first stretch, of 10 s, from the third second on."""
    world = World(**settings)
    world.tick()
    world.tick(assumed=field(1))
    assert world.tick(route=stretch(2, 1000.0)).phase == "survey"
    return world


def navigating(**settings) -> World:  # type: ignore[no-untyped-def]
    """On a way of 4 s to the goal, with a map of 5 s."""
    world = World(**{"reassimilate_observations": 3, "lead_s": 0.5} | settings)
    world.tick()
    world.tick(assumed=field(1))
    world.tick(route=stretch(2, 100.0, more=False))
    world.tick(at=(100.0, 500.0), progress=1.0)
    world.tick(refined=replace(field(3), stamp_ns=5_000_000_000))
    assert world.tick(route=route(4)).phase == "navigate"
    return world


def waiting_for_the_field(**settings) -> World:  # type: ignore[no-untyped-def]
    """A robot that is held at its start by other means, with the flow solved."""
    world = World(phases=("navigate",), **settings)
    world.tick()
    world.tick(assumed=field(1))
    return world


def route(request: int, reachable: bool = True) -> Route:
    points = [[0.0, 500.0], GOAL] if reachable else np.zeros((0, 2))
    return Route(
        0, request, "astar_time", reachable, "" if reachable else "too narrow", points, [0.0, 4.0][: len(points)]
    )


class World:
    """Updates a state machine, second by second, with a robot at a place and results as they are handed over."""

    def __init__(self, **settings) -> None:  # type: ignore[no-untyped-def]
        self.machine = MissionStateMachine(start=(0.0, 500.0), goal=GOAL, **settings)
        self.mission: Mission | None = None
        self.robot = ROBOT
        self.time_s = 0.0
        self.results: dict[str, object] = {"assumed": None, "refined": None, "route": None}
        self.seen_ns: int | None = None
        self.absent_ns: int | None = None

    def tick(  # type: ignore[no-untyped-def]
        self,
        at=(0.0, 500.0),
        seen=True,
        error_um=0.0,
        operator="",
        lost=0,
        absent=None,
        progress=0.0,
        seen_flow=None,
        goal=None,
        limit_um_s=None,
        fault="",
        **results,
    ) -> Mission:
        self.results |= results
        stamp = round(self.time_s * 1e9)
        self.seen_ns = stamp if seen else self.seen_ns
        track = Track(stamp, seen, at, 0.9, lost, 5.0, np.zeros(4), self.seen_ns)
        estimate = Estimate(stamp, at, np.zeros(2), np.eye(4), math.nan, at, seen)
        demand = Demand(stamp, np.zeros(2), at, progress, error_um, False, np.zeros((0, 2)))
        event = OperatorEvent(stamp, operator, "", speed_limit_um_s=limit_um_s) if operator else None
        event = OperatorEvent(stamp, "goal", "there", np.array(goal)) if goal is not None else event
        self.absent_ns = stamp if absent else self.absent_ns
        since_ns = self.seen_ns if not seen else stamp
        applied = Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2), since_ns, self.absent_ns)
        self.mission = self.machine.update(
            self.mission,
            track,
            estimate,
            *self.results.values(),
            event,
            demand,
            self.robot,  # type: ignore[arg-type]
            applied if self.absent_ns is not None else None,
            observations=seen_flow,
            goal_fault=fault,
        )
        self.time_s += 1.0
        return self.mission


def test_a_whole_mission_goes_through_its_phases_and_waits_for_each_result() -> None:
    world = World()
    assert (world.tick().phase, world.tick().wanted) == ("start", "solve")
    assert world.tick(assumed=field(1)).wanted == "survey_route"
    assert world.tick().request == 2
    assert world.tick(route=route(2)).phase == "survey"
    assert world.tick(at=GOAL).wanted == "refine"
    assert world.tick(refined=field(3)).wanted == "route"
    assert world.tick(route=route(3)).phase == "plan"  # an answer to another order is none
    assert world.tick(route=route(4)).phase == "navigate"
    assert world.tick(at=(500.0, 500.0)).phase == "navigate"
    done = world.tick(at=GOAL)
    assert done.finished
    assert done.outcome == "reached"
    assert world.tick() is done


def test_the_previous_message_itself_is_returned_while_nothing_changes() -> None:
    world = World()
    first = world.tick()
    assert world.tick() is first


def test_an_unreachable_goal_ends_the_run_before_anything_is_risked() -> None:
    world = World(phases=("navigate",))
    world.tick()
    assert world.tick(assumed=field(1)).wanted == "route"
    done = world.tick(route=route(2, reachable=False))
    assert (done.outcome, done.note) == ("unreachable", "too narrow")


def test_a_field_of_an_earlier_session_needs_no_solving() -> None:
    world = World(phases=("navigate",))
    assert world.tick(assumed=field(0)).wanted == ""
    assert world.tick().wanted == "route"


def test_the_operator_stops_everything() -> None:
    world = World()
    world.tick()
    assert world.tick(operator="mark").outcome == ""
    assert world.tick(operator="stop").outcome == "stopped"


def test_a_robot_never_seen_is_not_found_and_one_lost_for_long_is_lost() -> None:
    world = World()
    outcomes = [world.tick(seen=False).outcome for _ in range(6)]
    assert outcomes[-1] == "not found"
    world = World(phases=("navigate",))
    world.tick(assumed=field(0))
    world.tick()
    world.tick(route=route(1))
    assert world.tick(seen=False, lost=10).outcome == ""
    assert world.tick(seen=False, lost=90).outcome == "", "so many frames, and no more, are allowed"
    assert world.tick(seen=False, lost=91).outcome == "lost"


def test_nothing_is_begun_with_a_robot_out_of_sight() -> None:
    world = World(phases=("navigate",))
    world.tick(assumed=field(0))
    world.tick()
    assert world.tick(seen=False, lost=1, route=route(1)).phase == "plan"
    assert world.tick().phase == "navigate"


def test_blown_off_its_route_the_robot_plans_anew_from_where_it_is_until_it_is_no_use() -> None:
    world = World(phases=("navigate",), orders_limit=4)
    world.tick(assumed=field(0))
    world.tick()
    for request in (1, 2, 3):
        assert world.tick(route=route(request)).phase == "navigate"
        ordered = world.tick(at=(300.0, 800.0), error_um=400.0)
        assert ordered.wanted == "route"
        np.testing.assert_array_equal(ordered.start_um, [300.0, 800.0])
    world.tick(route=route(4))
    assert world.tick(error_um=400.0).outcome == "gave up"


def test_a_robot_that_turns_out_slower_than_planned_gets_a_new_route_or_the_reason_why_there_is_none() -> None:
    world = World(phases=("navigate",))
    world.tick(assumed=field(0))
    world.tick()
    world.tick(route=route(1))
    world.robot = ROBOT.limited_to(0.96 * 24.0)
    assert world.tick().phase == "navigate", "a little slower is no other plan"
    world.robot = ROBOT.limited_to(0.7 * 24.0)
    ordered = world.tick(at=(300.0, 800.0))
    assert ordered.wanted == "route" and "the robot reaches 420 um/s and not 600" in ordered.note
    np.testing.assert_array_equal(ordered.start_um, [300.0, 800.0])
    assert world.tick(route=route(2)).phase == "navigate"
    assert world.tick().phase == "navigate", "planned with that speed already"
    world.robot = ROBOT.limited_to(0.5 * 24.0)
    world.tick()
    refused = world.tick(route=route(3, reachable=False))
    assert (refused.outcome, refused.note) == ("unreachable", "too narrow")


def test_while_the_robot_is_held_at_its_start_the_flow_is_solved_and_nothing_else_begins() -> None:
    world = World(phases=("navigate",), hold_start_s=2.5)
    assert world.tick().wanted == "solve"
    for _ in range(2):
        held = world.tick(assumed=field(1))
        assert (held.phase, held.request) == ("start", 1)
    assert world.tick().wanted == "route"


def test_a_robot_that_is_stuck_does_not_wait_for_ever() -> None:
    world = World(phases=("navigate",), patience=2.0)
    world.tick(assumed=field(0))
    world.tick()
    world.tick(route=route(1))
    outcomes = [world.tick().outcome for _ in range(15)]
    assert outcomes[-1] == "timeout"
    assert outcomes.index("timeout") == 13  # 2 x 4 s and 5 s


def test_a_mission_message_is_new_whenever_it_is_another_object() -> None:
    world = World()
    first = world.tick()
    second = world.tick(assumed=field(1))
    assert second.stamp_ns > first.stamp_ns
    assert replace(second, stamp_ns=first.stamp_ns).request == 2


def test_under_a_hold_nothing_goes_on_and_no_limit_of_time_runs() -> None:
    world = World(phases=("navigate",), patience=2.0)
    world.tick(assumed=field(0))
    world.tick()
    assert world.tick(operator="pause").wanted == "route"  # noted; the work goes on
    assert world.tick(route=route(1)).phase == "plan"
    world.tick(operator="resume")
    assert world.tick().phase == "navigate"
    for _ in range(5):
        world.tick()
    held = world.tick(operator="pause")
    assert held.held_since_ns is not None
    assert world.tick(operator="pause") is held
    for _ in range(30):
        assert world.tick(at=GOAL) is held  # not even the end is reached
    assert world.tick(operator="resume").held_since_ns is None
    outcomes = [world.tick().outcome for _ in range(10)]
    assert outcomes.index("timeout") == 7  # of 2 x 4 s and 5 s the first 6 had passed


def test_the_time_of_every_hold_is_taken_off_the_limits_and_not_that_of_the_last_alone() -> None:
    world = World(phases=("navigate",), patience=2.0)
    world.tick(assumed=field(0))
    world.tick()
    world.tick(route=route(1))
    for hold_s in (20, 3):
        world.tick(operator="pause")
        for _ in range(hold_s - 1):
            world.tick()
        world.tick(operator="resume")
    assert world.mission is not None and world.mission.held_ns == 23 * 10**9
    outcomes = [world.tick().outcome for _ in range(15)]
    assert outcomes.index("timeout") == 11  # of 2 x 4 s and 5 s two had passed


def test_a_robot_that_is_not_found_may_be_looked_for_as_long_as_the_holds_last_besides() -> None:
    world = World(find_limit_s=5.0)
    for hold_s in (20, 6):
        world.tick(seen=False, operator="pause")
        for _ in range(hold_s - 1):
            assert not world.tick(seen=False).finished
        assert not world.tick(seen=False, operator="resume").finished
    outcomes = [world.tick(seen=False).outcome for _ in range(8)]
    assert outcomes.index("not found") == 4  # two of the five seconds had passed


HERE = {"at": (200.0, 500.0), "progress": 1.0}


@pytest.mark.parametrize(
    ("begin", "where"),
    [
        (lambda: surveying(survey_limit_s=9.0), HERE),
        (lambda: surveying(stuck_s=2.0), HERE | {"error_um": 200.0}),
        (lambda: navigating(patience=2.0, reassimilate_observations=0), HERE),
        (lambda: navigating(stuck_s=2.0, reassimilate_observations=0), HERE | {"error_um": 140.0}),
        (lambda: navigating(wait_at_goal_s=7.0), {"at": GOAL, "progress": 4.0}),
        (lambda: waiting_for_the_field(hold_start_s=8.0), {}),
    ],
    ids=["survey", "stuck survey", "way", "stuck on the way", "wait at the goal", "let go"],
)
def test_a_hold_delays_whatever_time_would_bring_by_as_long_as_it_lasts(
    begin: Callable[[], World], where: dict[str, object]
) -> None:
    def seconds_to_the_next_order(hold_s: int) -> int:
        world = begin()
        world.tick(**where)
        if hold_s:
            world.tick(**where, operator="pause")
            for _ in range(hold_s - 1):
                world.tick(**where)
        before = world.tick(**where, operator="resume")
        for passed_s in range(50):
            now = world.tick(**where)
            if (now.phase, now.wanted, now.outcome) != (before.phase, before.wanted, before.outcome):
                return passed_s
        raise AssertionError("time brings nothing")

    assert {seconds_to_the_next_order(hold_s) for hold_s in (0, 2, 30)} == {seconds_to_the_next_order(1)}


def test_a_held_robot_that_is_carried_off_is_swept_until_it_is_back() -> None:
    world = World(phases=("navigate",))
    world.tick(assumed=field(0))
    world.tick()
    world.tick(route=route(1))
    world.tick(operator="pause")
    radius_um = ROBOT.radius_um
    assert not world.tick(error_um=1.9 * radius_um).swept
    assert world.tick(error_um=2.1 * radius_um).swept
    assert world.tick(error_um=1.1 * radius_um).swept
    assert not world.tick(error_um=0.9 * radius_um).swept
    assert world.tick(operator="zero").outcome == "stopped"
    assert world.mission.held_since_ns is None


def test_a_stop_on_the_very_first_frame_is_heard() -> None:
    assert World().tick(operator="stop").outcome == "stopped"


def test_a_robot_that_is_only_watched_is_neither_sought_nor_lost_and_the_last_frame_orders_the_refinement() -> None:
    world = World(phases=("observe",), find_limit_s=1.0, lost_limit_frames=2)
    first = world.tick(seen=False)
    assert (first.phase, first.wanted) == ("observe", "solve")
    assert np.isnan([*first.start_um, *first.goal_um]).all()
    watched = world.tick(assumed=field(1))
    assert (watched.phase, watched.wanted) == ("observe", "")
    for _ in range(9):
        assert world.tick(seen=False, lost=100) is watched
    assert world.tick(operator="pause") is watched
    assert world.tick(operator="end").wanted == "refine"
    assert not world.tick(refined=field(1)).finished  # an answer to another order is none
    done = world.tick(refined=field(2))
    assert (done.finished, done.outcome) == (True, "observe complete")


def test_frames_that_end_before_the_flow_is_solved_are_remembered_and_a_stop_ends_an_observation_at_once() -> None:
    world = World(phases=("observe",))
    world.tick()
    assert world.tick(operator="end").wanted == "solve"
    assert world.tick(assumed=field(1)).wanted == "refine"
    assert world.tick(operator="stop").outcome == "stopped"


def test_a_robot_that_was_never_seen_until_the_frames_end_is_not_found() -> None:
    world = World(phases=("observe",))
    world.tick(seen=False)
    world.tick(seen=False, assumed=field(1))
    assert world.tick(seen=False, operator="end").outcome == "not found"


def test_while_the_camera_is_absent_the_field_is_off_and_the_robot_is_not_lost_before_it_could_be_found() -> None:
    machine = MissionStateMachine(start=(0.0, 500.0), goal=GOAL, find_limit_s=3.0, lost_limit_frames=5)
    world = World()
    world.machine = machine
    world.tick()
    world.tick(assumed=field(1))
    world.tick()
    assert world.tick(route=route(2)).phase == "survey"
    for _ in range(60):
        blind = world.tick(seen=False, lost=50, absent=True)
        assert blind.field_off and "the camera is absent" in blind.blind and not blind.finished
    assert not world.tick(seen=False, lost=51).finished, "it has just come back"
    back = world.tick(seen=True)
    assert (back.field_off, back.blind_since_ns, back.phase) == (False, None, "survey")
    for _ in range(3):
        world.tick(seen=False, lost=50, absent=True)
    for _ in range(4):
        ended = world.tick(seen=False, lost=60)
    assert ended.outcome == "lost"
