"""A goal and a speed limit from outside: recorded, bounded, and decided by the mission."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flowrec.core import Action, UsageError
from flowrec.run import RunControl
from flowrec.run.control import LONGEST_TEXT

TICK_NS = 20_000_000


def taken(control: RunControl, ticks: int, begin: int = 0) -> list[tuple[int, str, str]]:
    """The events of so many ticks, with the number of the tick."""
    events = [(tick, control.next_event(tick * TICK_NS, False)) for tick in range(begin, begin + ticks)]
    return [(tick, event.action, event.text) for tick, event in events if event is not None]


def test_of_many_goals_and_limits_that_wait_the_latest_is_recorded_once() -> None:
    control = RunControl()
    for k in range(100_000):
        control.set_goal(k, 2.0 * k)
        control.limit_speed(1.0 + k)
    control.request(Action.MARK, "1")
    assert taken(control, 100) == [(0, "mark", "1"), (1, "goal", "99999, 199998 um"), (11, "speed", "100000 um/s")]
    control.set_goal(2310.25, 840.5)
    event = control.next_event(10**10, False)
    assert event is not None
    np.testing.assert_array_equal(event.goal_um, [2310.25, 840.5])
    assert event.speed_limit_um_s is None


def test_a_person_who_drags_is_recorded_five_times_a_second_and_delays_nothing_else() -> None:
    control = RunControl()
    seen: list[tuple[int, str, str]] = []
    for tick in range(100):
        control.set_goal(tick, tick)
        if tick == 50:
            control.request(Action.NOTE, "now")
        seen += taken(control, 1, tick)
    assert [tick for tick, action, _ in seen if action == "goal"] == [0, 10, 20, 30, 40, 51, 61, 71, 81, 91]
    assert [tick for tick, action, _ in seen if action == "note"] == [50]


def test_what_is_no_place_and_no_speed_is_refused_before_it_is_recorded() -> None:
    control = RunControl()
    for x, y in ((math.nan, 0.0), (0.0, math.inf), (-2e9, 0.0)):
        with pytest.raises(UsageError, match="goal"):
            control.set_goal(x, y)
    for speed in (0.0, -1.0, math.nan, math.inf, 1e7):
        with pytest.raises(UsageError, match="speed limit"):
            control.limit_speed(speed)
    control.limit_speed(None)
    assert taken(control, 5) == [(0, "speed", "no limit")]


def test_a_run_that_ends_takes_no_goal_and_the_queue_of_other_events_is_bounded() -> None:
    control = RunControl()
    assert all(control.request(Action.NOTE, "x" * 10_000) for _ in range(100))
    assert not control.request(Action.NOTE, "one more")
    control.set_goal(1.0, 2.0)
    control.stop("enough")
    seen = taken(control, 200)
    assert [action for _, action, _ in seen] == ["note"] * 100 + ["stop"]
    assert {len(text) for _, action, text in seen if action == "note"} == {LONGEST_TEXT}
