"""A goal and a speed limit that a person sets while a mission runs, worked out by hand, second by second."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowrec.core import Mission, OperatorEvent, Route
from flowrec.physics import Chip
from flowrec.stages.pipeline import _goal_fault
from tests.stages.control.test_mission import GOAL, ROBOT, World, field, route

AWAY = (800.0, 500.0)
FARTHER = (900.0, 700.0)


def navigating(**settings: object) -> World:
    """A robot on its way to GOAL, 1000 um in 4 s, from the third second on."""
    world = World(phases=("navigate",), **settings)
    world.tick()
    assert world.tick(assumed=field(1)).wanted == "route"
    assert world.tick(route=answer(2, GOAL)).phase == "navigate"
    return world


def answer(request: int, goal: tuple[float, float], arrival_s: float = 4.0) -> Route:
    """A route that leads to a goal."""
    points, times = [[0.0, 500.0], list(goal)], np.array([0.0, arrival_s])
    return Route(0, request, "time_field", True, "", np.array(points), times, goal_um=np.array(goal))


def goal_of(mission: Mission) -> tuple[float, ...]:
    return tuple(mission.goal_um.tolist())


@pytest.mark.parametrize("waiting", [True, False])
def test_a_goal_before_the_way_is_planned_is_the_one_that_is_planned(waiting: bool) -> None:
    world = World(phases=("navigate",))
    world.tick()
    if not waiting:
        assert goal_of(world.tick(goal=AWAY)) == AWAY
    first = world.tick(assumed=field(1))
    if waiting:  # the plan to the goal before is under way
        assert (first.wanted, goal_of(world.tick(goal=AWAY))) == ("route", AWAY)
        again = world.tick(route=answer(2, GOAL))
        assert (again.phase, again.wanted, again.request, goal_of(again)) == ("plan", "route", 3, AWAY)
    done = world.tick(route=answer(world.mission.request, AWAY))  # type: ignore[union-attr]
    assert (done.phase, goal_of(done), done.former_goal_um.size) == ("navigate", AWAY, 0)
    assert world.tick(at=GOAL).phase == "navigate"
    assert world.tick(at=AWAY).outcome == "reached"


@pytest.mark.parametrize("known", [True, False])
def test_a_goal_that_no_plan_leads_to_gives_way_to_the_former_one(known: bool) -> None:
    world = World(phases=("navigate",))
    world.tick()
    world.tick(goal=AWAY)
    world.tick(assumed=field(1))
    back = world.tick(route=route(2, reachable=False))
    assert (back.phase, back.wanted, back.request, goal_of(back)) == ("plan", "route", 3, GOAL)
    assert back.note == "goal 800, 500 um refused: too narrow"
    end = world.tick(route=route(3, reachable=known))
    assert (end.phase, end.outcome) == (("navigate", "") if known else ("done", "unreachable"))


def test_of_several_goals_that_no_plan_leads_to_the_mission_goes_back_to_the_one_before_all_of_them() -> None:
    world = World(phases=("navigate",))
    world.tick()
    world.tick(goal=AWAY)
    world.tick(goal=FARTHER)
    ordered = world.tick(assumed=field(1))
    assert goal_of(ordered) == FARTHER
    assert goal_of(world.tick(route=route(ordered.request, reachable=False))) == GOAL


def test_on_the_way_the_robot_goes_on_until_a_route_leads_to_the_new_goal() -> None:
    world = navigating()
    asked = world.tick(goal=AWAY, progress=1.0)
    assert (asked.phase, asked.wanted, asked.request, goal_of(asked)) == ("navigate", "route", 3, AWAY)
    # The route begins 2 s further on, at three quarters of 4 s and 1000 um.
    np.testing.assert_allclose(asked.start_um, [750.0, 500.0])
    assert (asked.goal_from_s, asked.former_goal_um.tolist()) == (3.0, list(GOAL))
    assert not world.tick(at=GOAL, progress=2.0).finished  # the former goal is none any more
    assert not world.tick(at=AWAY, progress=2.0).finished  # and no route leads to the new one yet
    taken = world.tick(route=answer(3, AWAY, 6.0), progress=2.5)
    assert (taken.wanted, taken.former_goal_um.size, taken.phase) == ("", 0, "navigate")
    assert taken.routine_orders == 1
    assert world.tick(at=AWAY).outcome == "reached"


def test_a_goal_that_no_route_leads_to_leaves_goal_and_route_as_they_are() -> None:
    world = navigating()
    world.tick(goal=AWAY)
    kept = replace(answer(3, GOAL), reason="no channel leads from start to goal")
    back = world.tick(route=kept, progress=1.0)
    assert (back.phase, back.wanted, goal_of(back)) == ("navigate", "", GOAL)
    assert back.note == "goal 800, 500 um refused: no channel leads from start to goal"
    assert world.tick(at=GOAL).outcome == "reached"


@pytest.mark.parametrize("phase", ["start", "navigate"])
def test_a_goal_in_a_wall_is_refused_at_once_and_nothing_is_ordered(phase: str) -> None:
    world = navigating() if phase == "navigate" else World()
    before = world.tick()
    after = world.tick(goal=AWAY, fault="it is in a wall")
    assert (goal_of(after), after.note) == (GOAL, "goal there refused: it is in a wall")
    assert (after.request, after.former_goal_um.size, after.goal_set_ns) == (before.request, 0, None)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("at_px", "inside"), [(-0.4, True), (-0.6, False)])
@pytest.mark.parametrize("far", [False, True])
def test_a_goal_may_lie_up_to_the_edges_of_the_outermost_pixels(
    axis: int, at_px: float, inside: bool, far: bool
) -> None:
    chip = Chip("field", np.ones((30, 50), bool), 20.0, (), 1.0, 1000.0)
    place_um = np.array([300.0, 300.0])
    place_um[axis] = 20.0 * ((49.0, 29.0)[axis] - at_px if far else at_px)
    event = OperatorEvent(7, "goal", "there", place_um)
    scene = SimpleNamespace(chip=chip, clearance_um=np.full((30, 50), 100.0, np.float32))
    fault = _goal_fault(scene, SimpleNamespace(operator=event, stamp_ns=7))  # type: ignore[arg-type]
    assert fault == ("" if inside else "it is outside the chip")
    assert _goal_fault(scene, SimpleNamespace(operator=event, stamp_ns=8)) == "", "of an earlier tick"  # type: ignore[arg-type]


def test_the_latest_of_several_goals_wins_and_an_answer_to_an_earlier_one_is_never_taken_for_it() -> None:
    world = navigating()
    world.tick(goal=AWAY, progress=0.5)
    clicked = world.tick(goal=FARTHER, progress=0.6)
    assert (clicked.request, goal_of(clicked)) == (3, FARTHER)  # one order at a time
    late = world.tick(route=answer(3, AWAY), progress=0.7)
    assert (late.wanted, late.request, goal_of(late)) == ("route", 4, FARTHER)
    assert late.former_goal_um.tolist() == list(AWAY)  # there the route leads that the robot follows meanwhile
    assert not world.tick(at=AWAY, progress=0.8).finished
    # The answer to the earlier goal may as well be that there is no way: that says nothing about this one.
    world.tick(goal=GOAL, progress=0.9)
    again = world.tick(route=replace(answer(4, AWAY), reason="too narrow"), progress=0.9)
    assert (again.wanted, again.request, goal_of(again)) == ("route", 5, GOAL)
    # And where no way leads on, the goal is that of the route that the robot follows.
    assert goal_of(world.tick(route=replace(answer(5, AWAY), reason="too narrow"), progress=1.0)) == AWAY


def test_a_goal_in_the_very_second_of_an_answer_is_not_answered_by_it() -> None:
    world = navigating()
    world.tick(goal=AWAY)
    both = world.tick(goal=FARTHER, route=answer(3, AWAY))
    assert (both.request, both.wanted, goal_of(both)) == (4, "route", FARTHER)


def test_a_refinement_under_way_is_waited_for_and_then_the_new_goal_is_planned_for() -> None:
    world = navigating()
    assert world.mission is not None
    world.mission = replace(world.mission, wanted="refine", request=3, requested_ns=round(2.5e9))
    assert world.tick(goal=AWAY).wanted == "refine"
    assert world.tick().request == 3
    planned = world.tick(refined=field(3))
    assert (planned.wanted, planned.request) == ("route", 4)


def test_a_held_robot_takes_a_goal_and_plans_for_it_when_it_goes_on() -> None:
    world = navigating()
    world.tick(operator="pause")
    held = world.tick(goal=AWAY)
    assert (held.held_since_ns is not None, goal_of(held), held.wanted) == (True, AWAY, "")
    assert world.tick() is held
    world.tick(operator="resume")
    assert world.tick().wanted == "route"


def test_a_robot_out_of_sight_takes_a_goal_and_plans_for_it_when_it_is_seen_again() -> None:
    world = navigating()
    unseen = world.tick(seen=False, goal=AWAY)
    assert (goal_of(unseen), unseen.wanted) == (AWAY, "")
    assert world.tick(seen=False).wanted == ""
    assert world.tick().wanted == "route"


def test_a_route_that_comes_after_the_robot_has_passed_its_beginning_is_planned_anew_from_the_robot() -> None:
    world = navigating(lead_s=0.5)
    world.tick(goal=AWAY, progress=1.0)
    passed = world.tick(at=(400.0, 500.0), route=answer(3, AWAY), progress=1.6)
    assert (passed.phase, passed.wanted, passed.request) == ("plan", "route", 4)
    assert passed.start_um.tolist() == [400.0, 500.0]
    assert world.tick(route=answer(4, AWAY)).former_goal_um.size == 0


def test_a_hundred_clicks_end_no_run_and_a_disturbance_still_does() -> None:
    world = navigating(orders_limit=3, navigate_limit_s=1e5)
    for k in range(100):
        goal = AWAY if k % 2 else FARTHER
        world.tick(goal=goal)
        assert world.tick(route=answer(3 + k, goal)).wanted == ""
    assert not world.mission.finished  # type: ignore[union-attr]
    for k in range(2):
        blown = world.tick(at=(500.0, 500.0), error_um=301.0)
        if k == 0:
            assert blown.phase == "plan"
            world.tick(route=answer(103, goal))
    assert blown.outcome == "gave up"


def test_the_time_limits_are_those_of_the_latest_goal() -> None:
    world = navigating(navigate_limit_s=10.0)
    for _ in range(9):
        assert not world.tick(progress=3.0, error_um=80.0).finished
    world.tick(goal=AWAY, progress=3.0)
    taken = world.tick(route=answer(3, AWAY, 20.0), progress=3.0)
    # Ten seconds late, which is forgotten; the way to the new goal begins at 4 s along the route.
    for _ in range(10):
        assert not world.tick(progress=4.0).finished
    assert taken.goal_from_s == 4.0
    world.tick(progress=4.0)
    assert world.tick(progress=4.0).outcome == "timeout"


def test_a_lower_speed_limit_plans_anew_and_so_does_taking_it_away() -> None:
    world = navigating()
    slow = world.tick(operator="speed", limit_um_s=200.0)
    assert (slow.phase, slow.wanted, slow.planned_um_s, slow.speed_limit_um_s) == ("plan", "route", 200.0, 200.0)
    assert slow.routine_orders == 1
    assert world.tick(route=answer(3, GOAL)).phase == "navigate"
    assert world.tick().wanted == ""
    fast = world.tick(operator="speed")
    assert (fast.phase, fast.planned_um_s, fast.speed_limit_um_s) == ("plan", ROBOT.speed_limit_um_s, None)
    assert world.tick(route=answer(4, GOAL)).phase == "navigate"
    assert world.tick(operator="speed", limit_um_s=590.0).phase == "navigate"  # nothing that matters


def test_a_robot_that_becomes_faster_by_itself_keeps_its_way_whatever_a_person_has_set_before() -> None:
    world = navigating()
    world.tick(operator="speed", limit_um_s=590.0)
    world.robot = ROBOT.limited_to(0.5 * 24.0)  # it steps out
    assert world.tick().wanted == "route"
    assert world.tick(route=answer(3, GOAL)).phase == "navigate"
    world.robot = ROBOT
    assert (world.tick().phase, world.tick().wanted) == ("navigate", "")


def test_a_limit_during_an_order_counts_when_it_is_answered() -> None:
    world = navigating()
    world.tick(operator="speed", limit_um_s=200.0)
    world.tick(operator="speed", limit_um_s=400.0)
    anew = world.tick(route=answer(3, GOAL))
    assert (anew.phase, anew.wanted, anew.request, anew.planned_um_s) == ("plan", "route", 4, 400.0)
    # Nor does the answer to an earlier limit end the run: that there is no way says nothing about no limit.
    world.tick(operator="speed")
    assert world.tick(route=route(4, reachable=False)).request == 5
    assert world.tick(route=answer(5, GOAL)).phase == "navigate"


def test_a_limit_that_leaves_no_route_holds_the_robot_until_a_person_changes_that() -> None:
    world = navigating()
    world.tick(operator="speed", limit_um_s=20.0)
    held = world.tick(route=route(3, reachable=False))
    assert (held.finished, held.held_since_ns is not None, held.wanted) == (False, True, "")
    assert held.note == "no route at 20 um/s: too narrow; set another speed limit or goal, then go on"
    world.tick(operator="speed")
    world.tick(operator="resume")
    anew = world.tick()
    assert (anew.phase, anew.wanted, anew.planned_um_s) == ("plan", "route", 600.0)
    assert world.tick(route=answer(anew.request, GOAL)).phase == "navigate"


def test_a_robot_without_a_limit_that_finds_no_route_ends_as_before() -> None:
    world = navigating()
    world.tick(error_um=301.0, at=(500.0, 500.0))
    assert world.tick(route=route(3, reachable=False)).outcome == "unreachable"


def test_a_robot_waits_at_its_goal_for_another_one_if_it_is_told_to() -> None:
    world = navigating(wait_at_goal_s=5.0, navigate_limit_s=3.0)
    there = world.tick(at=GOAL, progress=4.0)
    assert (there.finished, there.note) == (False, "at the goal: waits 5 s for another one")
    for _ in range(4):
        assert world.tick(at=GOAL, progress=4.0) is there
    asked = world.tick(at=GOAL, goal=AWAY, progress=4.0)
    assert (asked.wanted, asked.arrived_s, asked.goal_from_s) == ("route", None, 4.0)
    world.tick(at=GOAL, route=answer(3, AWAY, 8.0), progress=4.0)
    again = world.tick(at=AWAY, progress=8.0)
    assert again.arrived_s is not None
    for _ in range(4):
        assert not world.tick(at=AWAY, progress=8.0).finished
    assert world.tick(at=AWAY, progress=8.0).outcome == "reached"


@pytest.mark.parametrize(("told", "outcome"), [("stop", "reached"), ("zero", "stopped")])
def test_a_stop_while_the_robot_waits_at_its_goal_ends_a_mission_that_has_reached_it(told: str, outcome: str) -> None:
    world = navigating(wait_at_goal_s=100.0)
    world.tick(at=GOAL)
    assert world.tick(at=GOAL, operator=told).outcome == outcome


def test_a_robot_that_is_only_observed_takes_neither() -> None:
    world = World(phases=("observe",))
    world.tick()
    assert world.tick(goal=AWAY).note == "goal refused: the robot is only observed"
    after = world.tick(operator="speed", limit_um_s=20.0)
    assert after.note == "speed refused: the robot is only observed"
    assert (after.speed_limit_um_s, after.goal_set_ns) == (None, None)


def test_a_survey_that_a_person_slows_is_not_cut_short_as_stuck() -> None:
    world = World()
    world.tick()
    world.tick(assumed=field(1))
    assert world.tick(route=answer(2, GOAL)).phase == "survey"
    world.tick(operator="speed", limit_um_s=20.0)
    for _ in range(50):
        assert world.tick(progress=1.0, error_um=80.0).phase == "survey"


ACTIONS = st.sampled_from(["goal", "goal", "wall", "limit", "no limit", "pause", "resume", "unseen", "", "", ""])
SECONDS = st.tuples(ACTIONS, st.sampled_from([AWAY, FARTHER, GOAL, (100.0, 900.0)]), st.booleans(), st.booleans())


@settings(max_examples=100, deadline=None)
@given(st.lists(SECONDS, max_size=40))
def test_whatever_a_person_does_one_order_is_under_way_and_only_a_planned_goal_is_reached(
    script: list[tuple[str, tuple[float, float], bool, bool]],
) -> None:
    world = navigating(navigate_limit_s=1e5, patience=1e3)
    mission, followed, ordered_for = world.mission, GOAL, GOAL
    assert mission is not None
    for action, place, answers, reachable in script:
        results = {}
        if mission.wanted and answers:
            if reachable:
                results["route"], followed = answer(mission.request, ordered_for), ordered_for
            elif mission.phase == "navigate":  # the worker hands the present route back
                results["route"] = replace(answer(mission.request, followed), reason="too narrow")
            else:
                results["route"] = route(mission.request, reachable=False)
        before = mission
        mission = world.tick(
            at=place if action == "" else (0.0, 500.0),
            seen=action != "unseen",
            goal=place if action in ("goal", "wall") else None,
            fault="it is in a wall" if action == "wall" else "",
            operator={"limit": "speed", "no limit": "speed"}.get(
                action, action if action in ("pause", "resume") else ""
            ),
            limit_um_s=200.0 if action == "limit" else None,
            **results,
        )
        if mission.request != before.request:
            assert mission.request == before.request + 1
            assert not before.wanted or answers or before.request == world.results["route"].request  # type: ignore[attr-defined]
            ordered_for = goal_of(mission)  # type: ignore[assignment]
        if mission.finished:
            # Only where a plan has told that no way is left to a goal that was reached by a plan before.
            assert mission.outcome in ("reached", "unreachable")
            if mission.outcome == "reached":
                assert goal_of(mission) == followed == place
            return
        assert np.isfinite(mission.goal_um).all()
        assert mission.phase in ("navigate", "plan")
        if mission.phase == "navigate" and not len(mission.former_goal_um):
            assert goal_of(mission) == followed
