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


def test_the_next_stretch_is_ordered_once_before_the_end_of_the_present_one_and_begins_there() -> None:
    world = surveying(lead_s=2.0)
    assert world.tick(at=(700.0, 500.0), progress=7.0).wanted == ""
    ordered = world.tick(at=(800.0, 500.0), progress=8.1)
    assert (ordered.wanted, ordered.phase, ordered.request, ordered.routine_orders) == ("survey_route", "survey", 3, 1)
    np.testing.assert_array_equal(ordered.start_um, [1000.0, 500.0])
    for progress in (9.0, 10.0, 10.0):
        assert world.tick(at=(1000.0, 500.0), progress=progress) is ordered, (
            "at the end it waits, and orders nothing else"
        )
    went_on = world.tick(at=(1000.0, 500.0), progress=10.0, route=stretch(3, 1000.0, 400.0))
    assert (went_on.phase, went_on.wanted) == ("survey", "")
    assert went_on.since_ns == ordered.since_ns, "the reference goes on along the longer way"


def test_a_survey_that_has_enough_ends_at_its_end_and_not_where_its_way_passes_that_before() -> None:
    world = surveying(lead_s=2.0)
    world.tick(at=(900.0, 500.0), progress=9.0)
    world.tick(at=(950.0, 500.0), progress=9.5, route=stretch(3, 1000.0, 400.0, 700.0))
    assert world.tick(at=(980.0, 500.0), progress=10.0).wanted == ""
    assert world.tick(at=(700.0, 500.0), progress=13.0).phase == "survey", "its end, passed on the way"
    ordered = world.tick(at=(500.0, 500.0), progress=17.5)
    assert (ordered.wanted, ordered.routine_orders) == ("survey_route", 2)
    enough = stretch(4, 1000.0, 400.0, 700.0, more=False)
    assert world.tick(at=(500.0, 500.0), progress=17.6, route=enough).phase == "survey"
    assert world.tick(at=(600.0, 500.0), progress=18.0).wanted == "", "nothing more is ordered"
    assert world.tick(at=(690.0, 500.0), progress=19.0).wanted == "refine"
    world = surveying(lead_s=2.0)
    world.tick(at=(900.0, 500.0), progress=9.0)
    world.tick(at=(950.0, 500.0), progress=9.5, route=stretch(3, 1000.0, 400.0, 700.0, more=False))
    assert world.tick(at=(700.0, 500.0), progress=13.0).phase == "survey", "its end, passed on the way"
    assert world.tick(at=(690.0, 500.0), progress=19.0).wanted == "refine"


def test_an_older_survey_of_one_stretch_orders_nothing_more() -> None:
    world = surveying()
    world.tick(route=stretch(2, 1000.0, more=False))
    assert world.tick(at=(900.0, 500.0), progress=9.9).wanted == ""
    assert world.tick(at=(990.0, 500.0), progress=9.9).wanted == "refine"


def test_the_time_limit_of_a_survey_waits_for_the_order_under_way_so_that_there_are_never_two() -> None:
    world = surveying(survey_limit_s=9.0)
    assert world.tick(at=(800.0, 500.0), progress=8.5).wanted == "survey_route"
    for _ in range(10):
        assert world.tick(at=(990.0, 500.0), progress=10.0).wanted == "survey_route"
    assert world.tick(at=(990.0, 500.0), progress=10.0, route=stretch(3, 1000.0, 400.0)).wanted == ""
    late = world.tick(at=(900.0, 500.0), progress=11.0)
    assert (late.wanted, late.note) == ("refine", "survey cut short by its time limit")


def test_a_survey_ends_when_something_holds_the_robot_up_and_not_when_it_is_slow_or_waits() -> None:
    world = surveying(stuck_s=0.5)
    for _ in range(5):
        assert world.tick(at=(200.0, 500.0), progress=1.0, error_um=10.0).phase == "survey", "it waits at its place"
    held_up = world.tick(at=(200.0, 500.0), progress=1.0, error_um=200.0)
    assert (held_up.wanted, held_up.note) == ("refine", "survey cut short: something is in the way")
    slow = surveying(stuck_s=0.5)
    for passed_s in (0.8, 1.6, 2.4, 3.2, 4.0, 4.8):
        assert slow.tick(at=(200.0, 500.0), progress=passed_s, error_um=200.0).phase == "survey"


def test_a_stretch_that_arrives_under_a_hold_or_out_of_sight_is_taken_up_afterwards() -> None:
    for away in ({"operator": "pause"}, {"seen": False, "lost": 1}):
        world = surveying()
        world.tick(at=(850.0, 500.0), progress=8.5)
        world.tick(at=(850.0, 500.0), progress=8.5, **away)  # type: ignore[arg-type]
        seen = "operator" in away
        arrived = world.tick(at=(850.0, 500.0), progress=8.5, seen=seen, lost=2, route=stretch(3, 1000.0, 400.0))
        assert arrived.wanted == "survey_route", "nothing goes on now"
        back = world.tick(at=(850.0, 500.0), progress=8.5, operator="resume" if seen else "")
        again = world.tick(at=(850.0, 500.0), progress=8.5)
        assert (again.phase, again.wanted, again.finished) == ("survey", "", False), back.note


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


def test_a_robot_that_is_stuck_on_the_way_gets_a_new_route_and_one_that_is_slow_does_not() -> None:
    for error_um, wanted in ((140.0, "route"), (110.0, "")):
        world = navigating(stuck_s=0.5, reassimilate_observations=0)
        for _ in range(8):
            mission = world.tick(at=(300.0, 500.0), progress=1.0, error_um=error_um)
        assert mission.wanted == wanted
        assert mission.finished is False
        assert mission.note == ("stuck 140 um off the route: planning anew" if wanted else "")
    world = navigating(stuck_s=0.5, reassimilate_observations=0)
    assert world.mission is not None
    x_um, y_um = world.mission.start_um
    for _ in range(8):
        mission = world.tick(at=(x_um + 60.0, y_um), progress=1.0, error_um=140.0)
    assert mission.outcome == "gave up"
    assert "where its route begins" in mission.note


def test_on_the_way_the_map_is_refined_again_after_some_observations_and_then_the_route_is_asked_for_anew() -> None:
    world = navigating()
    assert world.tick(seen_flow=observed(4.0, 4.5, 4.9, 5.5, 6.0)).wanted == "", "two are newer than the map"
    ordered = world.tick(progress=1.0, seen_flow=observed(5.5, 6.0, 6.5))
    assert (ordered.phase, ordered.wanted, ordered.request, ordered.routine_orders) == ("navigate", "refine", 5, 1)
    assert world.tick(progress=1.0, seen_flow=observed(5.5, 6.0, 6.5, 7.0)) is ordered
    refined = replace(field(5), stamp_ns=9_000_000_000)
    asked = world.tick(progress=1.5, refined=refined, seen_flow=observed(5.5, 6.0, 6.5, 7.0))
    assert (asked.phase, asked.wanted, asked.request, asked.routine_orders) == ("navigate", "route", 6, 2)
    np.testing.assert_allclose(asked.start_um, [500.0, 500.0])  # half a second ahead of the reference
    kept = world.tick(
        progress=1.6, route=replace(route(6), reason="route kept"), seen_flow=observed(5.5, 6.0, 6.5, 7.0)
    )
    assert (kept.phase, kept.wanted, kept.since_ns) == ("navigate", "", ordered.since_ns)
    assert world.tick(progress=1.7, seen_flow=observed(5.5, 6.0, 6.5, 7.0, 9.1)).wanted == ""


def test_neither_near_the_goal_nor_without_a_refinement_in_the_mission_is_the_map_refined_again() -> None:
    many = observed(6.0, 6.1, 6.2, 6.3)
    assert navigating().tick(progress=3.5, seen_flow=many).wanted == ""
    assert navigating(reassimilate_observations=0).tick(progress=1.0, seen_flow=many).wanted == ""
    world = World(phases=("navigate",), reassimilate_observations=1)
    world.tick(assumed=field(0))
    world.tick()
    world.tick(route=route(1))
    assert world.tick(progress=1.0, seen_flow=many).wanted == ""


def test_an_order_on_the_way_suspends_neither_the_goal_nor_the_limits_and_a_new_plan_waits_for_it() -> None:
    seen_flow = observed(6.0, 6.1, 6.2)
    world = navigating()
    assert world.tick(progress=1.0, seen_flow=seen_flow).wanted == "refine"
    assert world.tick(at=(300.0, 900.0), error_um=400.0).wanted == "refine", "one order at a time"
    refined = replace(field(5), stamp_ns=9_000_000_000)
    blown = world.tick(at=(300.0, 900.0), error_um=400.0, refined=refined)
    assert (blown.phase, blown.wanted) == ("plan", "route")
    np.testing.assert_array_equal(blown.start_um, [300.0, 900.0])
    world = navigating()
    world.tick(progress=1.0, seen_flow=seen_flow)
    assert world.tick(at=GOAL).outcome == "reached"
    world = navigating(patience=1.0)
    world.tick(progress=1.0, seen_flow=seen_flow)
    assert [world.tick().outcome for _ in range(15)][-1] == "timeout"


def test_routine_orders_do_not_count_as_routes_that_the_robot_was_blown_off() -> None:
    world = navigating(orders_limit=5)
    world.tick(progress=1.0, seen_flow=observed(6.0, 6.1, 6.2))
    world.tick(progress=1.0, refined=replace(field(5), stamp_ns=9_000_000_000))
    world.tick(progress=1.0, route=route(6))
    assert world.tick(error_um=400.0).wanted == "route", "the fifth order but for two of routine"
    world.tick(route=route(7))
    assert world.tick(error_um=400.0).outcome == "gave up"
