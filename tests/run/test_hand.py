"""Steering by hand: who steers, what ends it, that no field outlives it, and that a replay has the same samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import Currents, Hand, OperatorEvent, Tick, seconds
from flowrec.run import RunControl, Watchdog, obey
from flowrec.run.hand import SILENCE_S, HandSteering
from flowrec.stages import load_config
from flowrec.store import Session, SessionReader
from flowrec.verbs import record as verb
from flowrec.verbs import replay_session
from flowrec.verbs.check import check
from flowrec.verbs.compare import compare
from flowrec.verbs.interactive import Unattended
from tests.conftest import until
from tests.rewritten import rewrite
from tests.short_missions import SMALL


class Clock:
    """A clock that only the test moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Coils:
    """A rig that notes what it is told; `between` is called while a command is on its way."""

    def __init__(self) -> None:
        self.log: list[float | str] = []
        self.between: Callable[[], None] = lambda: None

    def apply(self, currents: Currents) -> None:
        between, self.between = self.between, lambda: None
        between()
        self.log.append(currents.amplitude_mt)

    def rest(self) -> None:
        self.log.append("rest")

    def zero(self) -> None:
        self.log.append("zero")


def field(amplitude_mt: float) -> Currents:
    return Currents(0, 1.0, 0.0, amplitude_mt, 0.0, np.ones(3), False)


def held(message: Hand | None) -> tuple[float, float] | str | None:
    """The share of a sample, or why steering has ended."""
    return None if message is None else tuple(message.share.tolist()) if message.held else message.why


def test_a_tick_takes_the_latest_sample_and_the_end_once() -> None:
    clock = Clock()
    hand = HandSteering(clock)
    assert hand.message(1) is None
    assert hand.steer("a", 1, 0.1, 0.2, "gamepad") == ""
    assert hand.steer("a", 1, 0.3, -0.4, "gamepad") == ""
    clock.now_s += 0.01
    taken = hand.message(2)
    assert taken is not None
    assert (taken.stamp_ns, taken.share.tolist(), taken.by) == (2, [0.3, -0.4], "gamepad")
    assert taken.age_s == pytest.approx(0.01)
    hand.let_go("a", "released")
    assert [held(hand.message(3)), held(hand.message(4))] == ["released", None]


def test_without_samples_steering_ends_in_time_and_goes_on_with_another_press_only() -> None:
    clock, rested = Clock(), list[float]()
    hand = HandSteering(clock)
    with hand.connection(lambda: rested.append(clock.now_s), lambda: None):
        hand.steer("a", 1, 1.0, 0.0, "keys")
        clock.now_s += 0.999 * SILENCE_S
        assert hand.check() is not None
        assert held(hand.message(1)) == (1.0, 0.0)
        clock.now_s += 0.002 * SILENCE_S
        assert hand.check() is None and rested == [clock.now_s]  # by the thread, without any tick
        assert "let go of the button" in hand.steer("a", 1, 1.0, 0.0, "keys")
        assert held(hand.message(2)) == "no sample for 0.15 s"
        assert held(hand.message(3)) is None
        assert hand.steer("a", 2, 1.0, 0.0, "keys") == ""
        hand.let_go("a", "released")
        assert hand.steer("b", 1, 1.0, 0.0, "keys") == ""
        hand.let_go("b", "released")
        assert "let go" in hand.steer("a", 2, 1.0, 0.0, "keys"), "also after another page has steered"


def test_the_thread_ends_steering_while_no_tick_comes() -> None:
    hand, rested = HandSteering(), list[str]()
    with hand.connection(lambda: rested.append("rest"), lambda: None):
        hand.steer("a", 1, 1.0, 0.0, "keys")
        until(lambda: rested)


def test_between_two_presses_there_is_a_tick_without_a_field() -> None:
    hand = HandSteering(Clock())
    hand.steer("a", 1, 1.0, 0.0, "keys")
    hand.let_go("a", "released")
    hand.steer("a", 2, 0.0, 1.0, "keys")
    assert [held(hand.message(n)) for n in (1, 2)] == ["released", (0.0, 1.0)]


def test_one_page_steers_at_a_time_and_the_other_is_told() -> None:
    hand = HandSteering(Clock())
    assert hand.steer("a", 1, 1.0, 0.0, "keys") == ""
    assert hand.steer("b", 1, 0.0, 1.0, "gamepad") == "another page steers by hand"
    hand.let_go("b", "released")
    assert held(hand.message(1)) == (1.0, 0.0)
    hand.let_go("a", "released")
    assert hand.steer("b", 2, 0.0, 1.0, "gamepad") == ""


@pytest.mark.parametrize(("x", "y"), [(math.nan, 0.0), (0.0, math.inf), (0.8, 0.8), (-2.0, 0.0)])
def test_numbers_that_are_no_share_of_a_speed_end_steering(x: float, y: float) -> None:
    control = RunControl()
    sample = {"command": "hand", "page": "a", "press": 1, "held": True, "x": 1.0, "y": 0.0, "by": "gamepad"}
    assert obey(control, sample) == ""
    assert "at most 1" in obey(control, {**sample, "x": x, "y": y})
    assert held(control.hand.message(1)) == "a sample with impossible numbers"
    assert obey(control, {**sample, "press": 2, "by": "wheel"})
    assert "not understood" in obey(control, {"command": "hand", "page": "a"})
    assert held(control.hand.message(2)) is None
    assert obey(control, {**sample, "press": 3}) == ""
    assert obey(control, {"command": "hand", "page": "a", "held": False, "why": "x" * 1000}) == ""
    ended = control.hand.message(3)
    assert ended is not None and len(ended.why) == 100
    control.stop("enough")
    assert "the run ends" in obey(control, {**sample, "press": 4})


@pytest.mark.parametrize("when", ["before the tick's command", "while it is on its way"])
def test_a_command_of_a_tick_that_had_the_sample_brings_no_field_back(when: str) -> None:
    coils = Coils()
    watchdog, hand = Watchdog(coils), HandSteering(Clock())  # type: ignore[arg-type]
    with hand.connection(watchdog.rest, watchdog.go_on):
        hand.steer("a", 1, 1.0, 0.0, "keys")
        assert held(hand.message(1)) == (1.0, 0.0)  # and the tick computes
        if when.startswith("before"):
            hand.let_go("a", "released")
        else:
            coils.between = lambda: hand.let_go("a", "released")
        watchdog.apply(field(4.0))
        assert coils.log[-1] == 0.0, coils.log
        assert "rest" in coils.log
        watchdog.apply(field(4.0))
        assert coils.log[-1] == 0.0, "also the next one, until a tick has taken the end in"
        assert held(hand.message(2)) == "released"
        watchdog.apply(field(3.0))
        assert coils.log[-1] == 3.0


class Steered(RunControl):
    """A person who does things at certain times of the session, on whose clock samples are waited for."""

    def __init__(self, script: list[tuple[float, float, Callable[[RunControl], object]]]) -> None:
        super().__init__()
        self.script, self.now_s = script, 0.0
        self.hand = HandSteering(lambda: self.now_s)

    def next_event(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
        before_s, self.now_s = self.now_s, seconds(stamp_ns)
        for from_s, until_s, act in self.script:
            if from_s <= self.now_s < until_s or before_s < from_s <= self.now_s:
                act(self)
        return super().next_event(stamp_ns, held)


def sample(press: int, x: float, y: float) -> Callable[[RunControl], object]:
    return lambda run: run.hand.steer("page", press, x, y, "gamepad")


ONCE = 0.0  # the end of what is done at one moment
SETS = [*SMALL, "mission.phases=navigate", "mission.goal=[3140.0,1220.0]"]


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Tick]]:
    """Steered back and let go; resumed, and pressed against a wall until the samples stop; resumed, and on to the goal.

    A stream that is back lets no robot go that a hand has taken.
    """
    path = tmp_path_factory.mktemp("hand") / "hand.mcap"
    script = [
        (1.0, 1.5, sample(1, -0.6, 0.0)),
        (1.3, ONCE, lambda run: run.toggle_hold()),  # has no effect while the hand steers
        (1.5, ONCE, lambda run: run.hand.let_go("page", "released")),
        (1.7, ONCE, lambda run: run.request("resume", "stream pump is back")),
        (2.0, ONCE, lambda run: run.toggle_hold()),
        (2.4, 3.4, sample(2, 0.0, 1.0)),
        (4.0, ONCE, lambda run: run.toggle_hold()),
    ]
    recorded = verb.record(load_config(None, SETS), path, control=Unattended(Steered(script)))
    assert recorded.report.outcome == "reached", recorded.report.note
    assert recorded.report.contacts == 0, "the wall barrier holds for a hand, too"
    return path, list(SessionReader(path).ticks(with_frames=False))


def steers(tick: Tick) -> bool:
    return tick.hand is not None and tick.hand.held and tick.hand.stamp_ns == tick.stamp_ns


def test_the_demand_is_that_of_the_hand_while_it_steers_and_else_there_is_no_field(
    steered: tuple[Path, list[Tick]],
) -> None:
    path, ticks = steered
    with Session(path) as session:
        limit_um_s = session.config.robot.speed_limit_um_s
    by_hand = [tick for tick in ticks if tick.mission is not None and tick.mission.by_hand]
    steering = [tick for tick in by_hand if steers(tick)]
    assert len(steering) == pytest.approx(45, abs=8)
    assert sum(map(steers, ticks)) == len(steering)
    shares = []
    for tick in by_hand:
        assert tick.demand is not None and tick.currents is not None and tick.hand is not None
        if not steers(tick):
            assert tick.currents.amplitude_mt == 0.0
            assert not tick.demand.velocity_um_s.any()
        elif tick.hand.share[0]:
            shares.append(tick.demand.velocity_um_s / limit_um_s)
            assert tick.currents.amplitude_mt > 0.0
    np.testing.assert_allclose(np.median(shares, axis=0), [-0.6, 0.0], atol=1e-9)
    # From the last sample on, in the second case, for as long as samples are waited for.
    ends = [now.stamp_ns for last, now in pairwise(ticks) if steers(last) and not steers(now)]
    assert [round(seconds(ns), 1) for ns in ends] == pytest.approx([1.5, 3.4 + SILENCE_S], abs=0.06)


def test_people_are_told_who_steers_why_it_ended_and_what_goes_on(steered: tuple[Path, list[Tick]]) -> None:
    _, ticks = steered
    text = "; ".join(tick.event.text for last, tick in pairwise([Tick(), *ticks]) if tick.event is not last.event)  # type: ignore[union-attr]
    said = ["steered by hand (gamepad)", "the hand has let go (released)", "goes on after"]
    said += ["steered by hand (gamepad)", "the hand has let go (no sample for 0.15 s)", "goes on after"]
    at = 0
    for words in said:
        at = text.index(words, at) + len(words)
    assert text.count("goes on after") == 2
    assert "held by the operator" not in text


def test_a_replay_has_the_same_commands_by_the_recorded_samples_from_any_tick(steered: tuple[Path, list[Tick]]) -> None:
    path, _ = steered
    assert replay_session(path, verify=True).identical
    for from_s in (1.2, 3.0):  # while the first and the second press steer
        assert replay_session(path, verify=True, from_s=from_s).identical, from_s


def test_check_and_compare_know_the_samples(steered: tuple[Path, list[Tick]], tmp_path: Path) -> None:
    def edit(channel: Any, _: Any, wire: Any) -> bool:
        if channel.topic != "/operator/hand":
            return False
        wire.age_s += 0.5
        return True

    path, _ = steered
    assert check(path).exit_status == 0
    assert rewrite(path, tmp_path / "other.mcap", edit) > 40
    assert compare(path, tmp_path / "other.mcap").as_json()["different"] == ["/operator/hand"]


def test_a_robot_that_is_only_watched_is_not_steered(tmp_path: Path) -> None:
    path = tmp_path / "observed.mcap"
    config = load_config(None, [*SMALL, "mission.phases=observe"])
    control = Unattended(Steered([(0.2, 0.8, sample(1, 1.0, 0.0))]))
    verb.record(config, path, control=control, duration_s=1.0)
    ticks = list(SessionReader(path).ticks(with_frames=False))
    assert any(map(steers, ticks))
    assert all(tick.currents is None or tick.currents.amplitude_mt == 0.0 for tick in ticks)
    assert not any(tick.mission is not None and tick.mission.by_hand for tick in ticks)
