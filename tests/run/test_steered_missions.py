"""Whole missions whose goal and speed limit a person changes: what is recorded replays exactly, from any tick."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import MCAP, OperatorEvent, Output, Tick, seconds
from flowrec.run import RunControl
from flowrec.stages import load_config
from flowrec.store import SessionReader
from flowrec.verbs import Change, refly, replay_session
from flowrec.verbs import record as verb
from flowrec.verbs.interactive import Unattended
from tests.short_missions import SMALL

Script = tuple[tuple[float, Callable[[RunControl], object]], ...]

AHEAD, BEHIND, WALL = (4178.0, 3256.0), (2264.0, 3272.0), (3200.0, 2500.0)


class Steered(RunControl):
    """A person who does things at certain times of the session."""

    def __init__(self, script: Script) -> None:
        super().__init__()
        self.left = list(script)

    def next_event(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
        while self.left and seconds(stamp_ns) >= self.left[0][0]:
            self.left.pop(0)[1](self)
        return super().next_event(stamp_ns, held)


def flown(path: Path, script: Script, *sets: str) -> list[Tick]:
    """The ticks of a mission that somebody steers."""
    config = load_config(None, [*SMALL, "mission.phases=navigate", "refine.place_robot=false", *sets])
    recorded = verb.record(config, path, control=Unattended(Steered(script)))
    assert recorded.report.outcome == "reached", recorded.report.note
    assert recorded.report.contacts == 0
    return list(SessionReader(path).ticks(with_frames=False))


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Tick]]:
    """Goals before the plan, during it, on the way, two at once, in a wall, when held, when arrived; and two limits."""
    path = tmp_path_factory.mktemp("steered") / "steered.mcap"
    script: Script = (
        (0.2, lambda run: run.set_goal(*AHEAD)),
        (0.6, lambda run: run.set_goal(*BEHIND)),
        (2.0, lambda run: run.set_goal(*AHEAD)),
        (2.3, lambda run: run.set_goal(2933.0, 3397.0)),
        (2.6, lambda run: run.set_goal(*WALL)),
        (3.4, lambda run: run.toggle_hold()),
        (3.5, lambda run: run.set_goal(*AHEAD)),
        (3.7, lambda run: run.toggle_hold()),
        (4.6, lambda run: run.limit_speed(300.0)),
        (5.6, lambda run: run.limit_speed(None)),
        (9.0, lambda run: run.set_goal(AHEAD[0] + 300.0, AHEAD[1] - 100.0)),
    )
    return path, flown(path, script, "mission.wait_at_goal_s=2")


def changes(ticks: list[Tick], name: str) -> list[Tick]:
    """The ticks with a new message."""
    return [now for last, now in pairwise([Tick(), *ticks]) if getattr(now, name) is not getattr(last, name)]


def test_each_goal_and_limit_is_one_event_and_said_in_words(steered: tuple[Path, list[Tick]]) -> None:
    _, ticks = steered
    events = [tick.operator for tick in changes(ticks, "operator")]
    assert [event.action for event in events if event] == [
        *("goal", "goal", "goal", "goal", "goal"),
        *("pause", "goal", "resume", "speed", "speed", "goal"),
    ]
    assert next(event.goal_um.tolist() for event in events if event and event.action == "goal") == list(AHEAD)
    text = "; ".join(tick.event.text for tick in changes(ticks, "event") if tick.event is not None)
    for words in (
        "operator: goal set to 4178, 3256 um",
        "operator: goal 3200, 2500 um refused: it is in a wall",
        "operator: speed limited to 300 um/s",
        "operator: speed limit taken away",
    ):
        assert words in text


def test_no_tick_follows_a_route_to_another_goal_than_the_mission_has_or_had_just_before(
    steered: tuple[Path, list[Tick]],
) -> None:
    _, ticks = steered
    for tick in ticks:
        mission, route = tick.mission, tick.route
        assert mission is not None
        if mission.phase != "navigate" or mission.wanted or mission.held_since_ns is not None:
            continue
        assert route is not None
        assert route.goal_um.tolist() == mission.goal_um.tolist() or len(mission.former_goal_um)
    last = ticks[-1].mission
    assert last is not None
    np.testing.assert_array_equal(last.goal_um, [AHEAD[0] + 300.0, AHEAD[1] - 100.0])


def test_a_speed_limit_holds_from_its_very_tick_until_it_is_taken_away(steered: tuple[Path, list[Tick]]) -> None:
    _, ticks = steered
    limited = [tick for tick in ticks if tick.mission is not None and tick.mission.speed_limit_um_s is not None]
    speeds = [math.hypot(*tick.demand.velocity_um_s) for tick in limited if tick.demand is not None]
    assert len(speeds) > 20
    assert max(speeds) <= 300.0 + 1e-9
    assert limited[0].operator is not None
    assert limited[0].stamp_ns == limited[0].operator.stamp_ns
    others = [
        math.hypot(*tick.demand.velocity_um_s) for tick in ticks if tick not in limited and tick.demand is not None
    ]
    assert max(others) > 400.0


def test_a_new_goal_does_not_make_the_reference_jump(steered: tuple[Path, list[Tick]]) -> None:
    _, ticks = steered
    for last, now in pairwise(ticks):
        if last.mission is None or now.mission is None or now.mission.phase != last.mission.phase:
            continue
        if now.mission.phase == "navigate" and now.route is not last.route and now.mission.held_since_ns is None:
            assert last.demand is not None
            assert now.demand is not None
            assert math.dist(now.demand.reference_um, last.demand.reference_um) < 60.0


@pytest.mark.slow("replays a mission in more than fifteen segments")
def test_it_replays_identically_from_every_tick_at_which_something_was_set_ordered_or_adopted(
    steered: tuple[Path, list[Tick]],
) -> None:
    path, ticks = steered
    stamps = [tick.stamp_ns for tick in ticks]
    kinds = {
        tick.stamp_ns
        for name in ("operator", "route", "mission")
        for tick in changes(ticks, name)
        if tick is not ticks[0]
    }
    after = {stamps[stamps.index(stamp) + 1] for stamp in kinds if stamp != stamps[-1]}
    starts = [None, *sorted(after)]
    assert len(starts) > 15
    ends = [stamp - 1 for stamp in sorted(after)] + [stamps[-1]]
    # The last segment first: what a stage hides would otherwise be as the segment before has left it.
    for start, end in reversed(list(zip(starts, ends, strict=True))):
        done = replay_session(path, verify=True, segment_ns=(start, end))
        assert done.identical, (seconds(start or 0), done.lines())


@pytest.mark.slow("replays with another planner and flies again")
def test_another_planner_and_a_flight_in_the_simulator_go_to_the_goals_that_were_set(
    steered: tuple[Path, list[Tick]],
) -> None:
    path, ticks = steered
    done = replay_session(path, Change(plan="astar_time"))
    assert done.replayed.mission is not None
    assert ticks[-1].mission is not None
    np.testing.assert_array_equal(done.replayed.mission.goal_um, ticks[-1].mission.goal_um)
    assert {route.method for route in (done.replayed.route,) if route is not None} == {"astar_time"}
    out = path.with_name("reflown.mcap")
    rows = {key: (was, now) for key, was, now in refly(done, Output(out, MCAP))}
    assert rows["reflown_outcome"] == ("reached", "reached")
    flight = SessionReader(out)
    mission = flight.tick_before(flight.last_ns + 1).mission
    assert mission is not None
    np.testing.assert_array_equal(mission.goal_um, ticks[-1].mission.goal_um)
