"""The watchdog on a clock that only the test moves: when the field goes, that it stays away, repeated zero()."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from flowrec.core import Action, Currents, RigError
from flowrec.run import RunControl, Signals, Watchdog
from flowrec.run.control import RAMP_PATIENCE_S, Interrupted
from flowrec.run.watchdog import ZERO_PATIENCE_S
from tests.conftest import until


class Driver:
    """Coils that note what they are told, and a clock that stands still."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.log: list[tuple[str, float]] = []
        self.in_apply: Callable[[], None] = lambda: None
        self.in_zero: Callable[[], None] = lambda: None

    def clock(self) -> float:
        return self.now_s

    def apply(self, currents: Currents) -> None:
        self.log.append(("apply", currents.amplitude_mt))
        self.in_apply()

    def zero(self) -> None:
        self.in_zero()
        self.log.append(("zero", 0.0))


def field(amplitude_mt: float) -> Currents:
    return Currents(0, 1.0, 0.0, amplitude_mt, 0.0, np.zeros(3), False)


def guarded(driver: Driver, **more: object) -> Watchdog:
    """A watchdog whose thread the test is: it has begun, and `look` is called by hand."""
    watchdog = Watchdog(driver, 0.5, clock=driver.clock, **more)  # type: ignore[arg-type]
    watchdog._thread = threading.current_thread()
    return watchdog


def test_a_loop_that_hangs_loses_its_field_after_the_stated_time_and_not_before() -> None:
    driver, told = Driver(), []
    watchdog = guarded(driver, tripped=told.append)
    watchdog.apply(field(4.0))
    for _ in range(5):
        driver.now_s += 0.45
        assert watchdog.check() == pytest.approx(0.05)
        watchdog.tick_ended()
    driver.now_s += 0.499
    watchdog.check()
    assert ("zero", 0.0) not in driver.log
    assert not watchdog.reason
    driver.now_s += 0.002
    watchdog.check()
    assert driver.log == [("apply", 4.0), ("zero", 0.0)]
    assert watchdog.hung
    assert watchdog.off
    assert told == ["guard: no tick for 0.5 s"]
    driver.now_s += 60.0
    watchdog.check()
    assert len(driver.log) == 2


def test_without_a_field_no_tick_is_missed_and_the_time_begins_with_the_field() -> None:
    driver = Driver()
    watchdog = guarded(driver)
    watchdog.apply(field(0.0))
    driver.now_s += 20.0  # the first tick of an installation compiles
    watchdog.check()
    watchdog.apply(field(1.0))
    assert watchdog.check() == pytest.approx(0.5)
    driver.now_s += 0.4
    watchdog.apply(field(0.0))
    driver.now_s += 20.0
    watchdog.check()
    assert not watchdog.reason


def test_a_tick_that_ends_late_brings_no_field_back_and_a_command_under_way_is_followed_by_a_zero() -> None:
    driver = Driver()
    watchdog = guarded(driver)

    def trip() -> None:
        watchdog.trip("enough")
        watchdog.check()  # zero() while the driver is still at work on the command

    driver.in_apply = trip
    watchdog.apply(field(4.0))
    watchdog.check()
    assert driver.log == [("apply", 4.0), ("zero", 0.0), ("zero", 0.0)]
    driver.in_apply = lambda: None
    watchdog.apply(field(4.0))
    watchdog.apply(field(0.0))
    assert driver.log[3:] == [("apply", 0.0)]


def test_a_zero_that_raises_is_repeated_until_it_works_and_a_person_is_told() -> None:
    driver, alarms, refusals = Driver(), [], iter([True] * 4)

    def refuse() -> None:
        driver.log.append(("refused", 0.0))
        if next(refusals, False):
            raise OSError("no answer")

    driver.in_zero = refuse
    watchdog = guarded(driver, alarm=alarms.append)
    watchdog.trip("enough")
    for _ in range(4):
        assert watchdog.check() <= 0.02
        assert not watchdog.off
    watchdog.check()
    assert watchdog.off
    assert watchdog.failures == 4
    assert [event for event, _ in driver.log] == ["refused"] * 5 + ["zero"]
    until(lambda: len(alarms) == 2)
    assert "no answer" in alarms[0]
    assert "after 4 failures" in alarms[1]


def refusing_driver() -> Driver:
    """A driver whose zero() takes a tenth of a second and fails."""
    driver = Driver()

    def refuse() -> None:
        driver.now_s += 0.1
        raise OSError("no answer")

    driver.in_zero = refuse
    return driver


def test_a_zero_that_never_works_is_an_error_that_names_it_and_it_is_still_repeated() -> None:
    driver = refusing_driver()
    watchdog = Watchdog(driver, clock=driver.clock)
    with watchdog.running(), pytest.raises(RigError, match=r"\d+ times: no answer.*by hand"):
        watchdog.field_off()
    assert driver.now_s > 100.0 + ZERO_PATIENCE_S
    driver.in_zero = lambda: None
    until(lambda: watchdog.off)
    assert driver.log == [("zero", 0.0)]


def test_a_driver_that_also_fails_when_it_is_left_does_not_hide_that_the_coils_may_carry_a_field() -> None:
    driver = refusing_driver()
    watchdog = Watchdog(driver, clock=driver.clock)
    run = ExitStack()
    run.enter_context(watchdog.running())
    run.callback(driver.zero)  # as drivers do when they are closed
    run.callback(watchdog.field_off)
    with pytest.raises(RigError, match=r"no answer.*by hand"):
        run.close()
    driver.in_zero = lambda: None
    until(lambda: watchdog.off)


def test_ctrl_c_while_zero_is_at_work_comes_after_it() -> None:
    driver, main = Driver(), threading.get_ident()

    def slow() -> None:
        for _ in range(2):
            signal.pthread_kill(main, signal.SIGINT)
            time.sleep(0.015)

    driver.in_zero = slow
    watchdog = Watchdog(driver)
    with watchdog.running():
        try:
            watchdog.field_off()
        except KeyboardInterrupt:
            driver.log.append(("left", 0.0))
        with contextlib.suppress(KeyboardInterrupt):
            until(lambda: len(driver.log) == 2)
    assert driver.log == [("zero", 0.0), ("left", 0.0)]


def test_the_loop_is_left_in_the_blocks_it_has_marked_and_nowhere_else() -> None:
    driver = Driver()
    control = RunControl(driver.clock)
    control.ticking = True
    control.stop("enough")
    with control.interruptible:
        assert not control.must_interrupt  # there is time for a ramp
    driver.now_s += 5.1
    control.interrupt()
    with control.interrupted_when_overdue():
        assert control.stuck
        with control.interruptible:
            control.interrupt()
        pytest.fail("the loop was not left")
    control.interrupt()
    assert control.unless_stopped(control.interrupt, "otherwise") == "otherwise"
    with pytest.raises(Interrupted), control.interruptible:
        control.interrupt()
    control.interruptible.__enter__()
    with pytest.raises(Interrupted):
        control.interrupt()
    control.interrupt()  # nothing raises again before the block is left


def test_a_stop_that_is_late_takes_the_field_away_after_0_8_s_and_leaves_the_loop_after_1_1_s() -> None:
    driver = Driver()
    control = RunControl(driver.clock)
    control.ticking = True
    control.stop("enough")
    told = control.next_event(1, held=False)
    assert told is not None and told.action == "stop"
    driver.now_s += 0.79
    assert control.next_event(2, held=False) is None
    driver.now_s += 0.02
    told = control.next_event(3, held=False)
    assert told is not None and told.action == "zero"
    with control.interruptible:
        driver.now_s += 0.28
        assert not control.must_interrupt
        driver.now_s += 0.02
        assert control.must_interrupt


def test_who_leaves_no_time_for_a_ramp_has_the_field_off_at_the_next_tick() -> None:
    driver = Driver()
    control = RunControl(driver.clock)
    control.ticking = True
    control.stop("enough")
    driver.now_s += 0.01
    for wait_s in (0.01, 5.0):  # also a second time, after which it is no less late
        control.skip_ramp()
        driver.now_s += wait_s
        assert control._late_s() > RAMP_PATIENCE_S
    told = control.next_event(1, held=False)
    assert told is not None and told.action == Action.ZERO


def test_a_late_zero_keeps_the_reason_of_the_guard() -> None:
    driver = Driver()
    control = RunControl(driver.clock)
    control.stop("stopped by SIGINT: Ctrl-C")
    control.stop("guard: no tick for 0.5 s", zero=True)
    driver.now_s += RAMP_PATIENCE_S + 0.1
    event = control.next_event(7, held=False)
    assert event is not None
    assert (event.action, event.text) == ("zero", "guard: no tick for 0.5 s")
    assert control.overdue


def test_a_field_that_must_go_at_once_waits_behind_no_note_or_mark() -> None:
    control = RunControl()
    for number in range(3):
        control.request(Action.NOTE, f"note {number}")
    control.mark()
    control.stop("guard: no tick", zero=True)
    taken = [event.action for event in iter(lambda: control.next_event(0, held=False), None) if event is not None]
    assert taken == [Action.ZERO, Action.NOTE, Action.NOTE, Action.NOTE, Action.MARK]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no Ctrl-Z")
@pytest.mark.parametrize("off", [True, False])
def test_ctrl_z_stops_no_process_whose_field_is_not_off(off: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "kill", lambda *told: sent.append(told))
    tripped: list[str] = []
    coils = SimpleNamespace(trip=tripped.append, wait_off=lambda _timeout_s: off)
    Signals(RunControl(), coils)._handle(signal.SIGTSTP)  # type: ignore[arg-type]
    assert sent == [(os.getpid(), signal.SIGSTOP)] * off and len(tripped) == 1


def test_whoever_insists_has_the_process_ended_after_3_s_where_the_main_thread_does_not_end_the_run() -> None:
    now_s, ended, looks = [100.0], threading.Event(), [0]

    class Stubborn:
        """A control whose run goes on whatever it is told."""

        stuck = False

        @property
        def must_interrupt(self) -> bool:
            looks[0] += 1
            return False

        def skip_ramp(self) -> None: ...

    class Watched(Signals):
        def _end_process(self) -> None:
            ended.set()
            self._over = True

    driver = Driver()
    watchdog = guarded(driver)
    before = signal.signal(signal.SIGQUIT, lambda *_: None)
    try:
        with Watched(cast(RunControl, Stubborn()), watchdog, clock=lambda: now_s[0]).handle():
            signal.raise_signal(signal.SIGQUIT)
            until(lambda: watchdog.reason)
            seen = looks[0]
            until(lambda: looks[0] > seen)  # it has been taken
            now_s[0] += 2.9
            seen = looks[0]
            until(lambda: looks[0] > seen + 2)
            assert not ended.is_set()
            now_s[0] += 0.2
            until(ended.is_set)
    finally:
        signal.signal(signal.SIGQUIT, before)
