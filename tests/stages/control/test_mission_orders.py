"""Orders on the way of a mission: the stretches of its survey, further refinements and routes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Tick
from flowrec.stages.control.events import event_of
from tests.stages.control.test_mission import GOAL, World, field, navigating, observed, route, stretch, surveying


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


def test_a_hold_is_told_at_its_end_with_how_long_it_lasted() -> None:
    world = navigating()
    ticks = []
    for operator in ("pause", "", "", "resume"):
        mission = world.tick(operator=operator)
        ticks.append(Tick(mission.stamp_ns if operator else ticks[-1].stamp_ns + 10**9, mission=mission))
    told = event_of(ticks[-2], ticks[-1])
    assert told is not None and told.text == "goes on after 3.0 s"


def test_a_refined_flow_is_said_to_predict_better_only_by_more_than_twice_the_error_of_that() -> None:
    scored = replace(field(3), log_score=-1.0, log_score_before=-1.1, log_score_error=0.04)
    for refined, how in ((scored, "better"), (replace(scored, log_score_error=0.06), "no worse")):
        told = event_of(Tick(0), Tick(1, refined=refined))
        assert told is not None and f"predicts held-back observations {how} than the map before" in told.text
