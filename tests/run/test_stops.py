"""`flowrec record --realtime` stopped in every way: the order of what its driver is told, its file, its exit status.

No assertion is on wall time: `python -m tests.perf.stops` measures.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import signal
import sys
import threading
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any, cast

import pytest

from flowrec.core import OperatorEvent
from flowrec.run import RunControl, Signals, Watchdog
from flowrec.stages import load_config
from flowrec.store import SessionReader
from flowrec.verbs import Change, replay_session
from flowrec.verbs import record as verb
from tests.conftest import run, until
from tests.perf.stop_trial import LoggedRig
from tests.perf.stops import KINDS, Ended, Kind, stop
from tests.short_missions import SMALL

PROCESS = pytest.mark.slow("a process that records in real time, for a fault that differs little from one beside it")
PATIENT = "safety.guard_timeout_s=20"  # where the guard's timer has no part


def ended(kind: Kind | str, tmp_path: Path, *sets: str) -> Ended:
    """A run stopped; its field is off and stays off, before the run returns and before the process is gone."""
    done = stop(KINDS[kind] if isinstance(kind, str) else kind, tmp_path, *sets)
    assert done.off_s is not None, done.stderr
    told = [event for event, _ in done.after_cause()]
    assert "zero" in told, done.stderr
    assert "returns" not in told[: told.index("zero")]
    return done


def outcome(done: Ended) -> tuple[str, str]:
    """How the file says it ended; it replays identically."""
    reader = SessionReader(done.path)
    assert replay_session(done.path, Change(), verify=True).comparison.identical
    return reader.outcome["outcome"], reader.outcome["note"]


def events(done: Ended) -> list[tuple[str, str]]:
    found = SessionReader(done.path).messages("operator")
    return [(event.action, event.text) for event in found if isinstance(event, OperatorEvent)]


def test_a_signal_takes_the_field_down_its_ramp_and_the_file_is_whole(tmp_path: Path) -> None:
    done = ended("SIGINT", tmp_path, PATIENT)
    sent = [amplitude_mt for event, amplitude_mt in done.after_cause() if event == "apply"]
    assert sent == sorted(sent, reverse=True)
    assert len(sent) > 3
    assert sent[-1] == 0.0
    assert done.status == 0
    assert outcome(done)[0] == "stopped"
    assert [action for action, _ in events(done)] == ["stop"]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2"])
def test_each_signal_ends_the_run_by_its_ramp_or_takes_the_field_away_at_once(name: str) -> None:
    """The others than those that are sent to processes below differ from them by their row in a table only."""
    told: list[str] = []
    number, ends = getattr(signal, name), name in ("SIGINT", "SIGTERM", "SIGHUP")
    control = SimpleNamespace(
        stop=lambda reason, **_: told.append(f"ramp: {reason}"),
        skip_ramp=lambda: told.append("no ramp"),
        must_interrupt=False,
        stuck=False,
    )
    watchdog = SimpleNamespace(trip=lambda reason: told.append(f"off: {reason}"), timeout_s=None)
    before = signal.signal(number, lambda *_: None)  # nohup ignores SIGHUP
    try:
        with Signals(cast(RunControl, control), cast(Watchdog, watchdog)).handle():
            signal.raise_signal(number)
            until(lambda: len(told) == (1 if ends else 2))
    finally:
        signal.signal(number, before)
    assert told[0].startswith("ramp: stopped by" if ends else "off: operator: zero field") and name in told[0]
    assert told[1:] == ([] if ends else ["no ramp"])


def test_no_signal_is_lost_where_their_handling_begins_and_ends() -> None:
    """SIGTERM at each line of `Signals.handle` and before and after it: raised as before, or a request to stop."""
    raised = 0

    def stopped_at(line: int) -> tuple[bool, bool]:
        """Whether the lines were that many, and whether the signal that came with this one was noticed."""
        control, count = RunControl(), itertools.count()

        def at_line(_frame: FrameType, event: str, _argument: object) -> Any:
            if event == "line" and next(count) == line:
                signal.raise_signal(signal.SIGTERM)
            return at_line

        sys.settrace(lambda frame, *_: at_line if frame.f_code is Signals.handle.__wrapped__.__code__ else None)
        try:
            with Signals(control).handle():
                pass
        except KeyboardInterrupt:
            return True, True
        finally:
            sys.settrace(None)
        return next(count) > line, bool(control.reason)

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        for line in itertools.count():
            reached, noticed = stopped_at(line)
            if not reached:
                break
            assert noticed, f"lost at line {line}"
            raised += 1
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler and signal.set_wakeup_fd(-1) == -1
    finally:
        signal.signal(signal.SIGTERM, before)
    assert raised > 10


@PROCESS
def test_a_signal_that_takes_the_field_away_at_once_is_recorded_and_ends_the_run(tmp_path: Path) -> None:
    done = ended("SIGTERM twice", tmp_path, PATIENT)
    told = done.after_cause()
    late = [one for one in told[told.index(("zero", 0.0)) :] if one[0] == "apply" and one[1] > 0.0]
    # A command that was under way at that moment is followed by another zero().
    assert len(late) <= 1
    assert [event for event, amplitude_mt in told if event == "zero" or amplitude_mt > 0.0][-1] == "zero"
    assert done.status == 0, done.stderr
    assert outcome(done)[0] == "stopped"
    actions = events(done)
    assert any(action == "zero" and "SIGTERM again" in text for action, text in actions), actions


@pytest.mark.slow("the real command, stopped and continued")
def test_ctrl_z_stops_the_process_with_the_field_off_and_fg_ends_the_run(tmp_path: Path) -> None:
    done = ended("SIGTSTP", tmp_path, PATIENT)
    stopped = (tmp_path / "driver.log.stopped").read_text().split("\n")
    last = [line.split()[2:] for line in stopped if " apply " in line or " zero " in line][-1]
    assert last[1] == "0"  # nothing with a field was the last word when the process stood still
    assert any(" zero " in line for line in stopped)
    assert done.status == 0
    assert outcome(done) == ("stopped", "operator: zero field (SIGTSTP: Ctrl-Z)")
    assert events(done) == [("zero", "operator: zero field (SIGTSTP: Ctrl-Z)")]


@PROCESS
@pytest.mark.parametrize("name", ["zero() takes 30 ms, SIGINT twice", "zero() raises 5 times, SIGINT twice"])
def test_no_ctrl_c_interrupts_zero_and_one_that_raises_is_repeated(name: str, tmp_path: Path) -> None:
    done = ended(name, tmp_path, PATIENT)
    told = [event for event, _ in done.after_cause() if event.startswith("zero")]
    if "raises" in name:
        assert told.count("zero-raises") == 5
        assert told.index("zero") > max(place for place, event in enumerate(told) if event == "zero-raises")
        assert "zero() worked after 5 failures" in outcome(done)[1]
    else:
        assert told.count("zero-begins") == told.count("zero")  # each that was begun came to its end
        assert outcome(done)[0] == "stopped"
    assert done.status == 0


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("camera silent", marks=PROCESS),
        "camera 1.4 s late",
        pytest.param("stage never returns", marks=PROCESS),
    ],
)
def test_a_loop_that_hangs_loses_its_field_while_it_hangs_and_the_replay_is_exact(name: str, tmp_path: Path) -> None:
    done = ended(name, tmp_path)
    assert done.after_cause()[:3] == [("cause", 0.0), ("zero-begins", 0.0), ("zero", 0.0)]
    assert done.status == 1
    assert "no tick for 0.5 s" in done.stderr
    assert outcome(done) == ("failed", "guard: no tick for 0.5 s")
    assert events(done) == [("zero", "guard: no tick for 0.5 s")]


@PROCESS
@pytest.mark.parametrize("name", ["camera stuck in C", "camera stuck in C, SIGINT three times, SIGTERM"])
def test_a_camera_that_hangs_in_c_loses_the_field_and_the_process_ends_by_itself(name: str, tmp_path: Path) -> None:
    done = ended(name, tmp_path)
    assert [event for event, _ in done.after_cause()[-3:]] != ["returns"]  # the main thread has never come back
    assert done.status == 1
    assert "main thread" in done.stderr
    assert done.file() in ("whole", "recovered")
    assert replay_session(done.path, Change(), verify=True).comparison.identical


@pytest.mark.slow("the real command, ended by a stage")
def test_a_stage_that_raises_ends_the_run_after_the_field(tmp_path: Path) -> None:
    done = ended("stage raises", tmp_path, PATIENT)
    assert [event for event, _ in done.after_cause()[:3]] == ["cause", "zero-begins", "zero"]
    assert done.status == 1
    assert SessionReader(done.path).outcome["reason"] == "ValueError: a stage that fails"


@PROCESS
def test_a_worker_that_is_killed_ends_the_run_after_the_field(tmp_path: Path) -> None:
    """That one is stopped is told in the same way: tests/run/test_worker_process.py."""
    done = ended("worker killed", tmp_path, PATIENT)
    assert done.status == 1
    assert SessionReader(done.path).outcome["outcome"] == "failed"


def test_record_and_replay_are_functions_of_any_thread(tmp_path: Path) -> None:
    errors: list[BaseException] = []
    path = tmp_path / "thread.mcap"

    def both() -> None:
        try:
            verb.record(load_config(None, [*SMALL, "duration_s=1", PATIENT]), path, realtime=True)
            replay_session(path, Change(), out=tmp_path / "again.mcap")
        except BaseException as error:  # noqa: BLE001  told by the test
            errors.append(error)

    thread = threading.Thread(target=both)
    thread.start()
    thread.join()
    assert errors == []
    assert SessionReader(path).outcome["outcome"] == "time over"


def test_record_as_a_function_leaves_signals_alone_and_zeroes_on_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log: list[tuple[str, float]] = []

    class Rig(LoggedRig):
        def arrived(self, number, inputs):  # type: ignore[no-untyped-def]
            if number == 20:
                log.append(("cause", 0.0))
                signal.raise_signal(signal.SIGINT)
            return inputs

    logged = staticmethod(lambda event, amplitude_mt=0.0: log.append((event, amplitude_mt)))
    monkeypatch.setattr(LoggedRig, "log", logged, raising=False)
    monkeypatch.setattr("flowrec.rigs.simulated.rig.SimulatedRig", Rig)
    with pytest.raises(KeyboardInterrupt):
        verb.record(load_config(None, SMALL), tmp_path / "cut.mcap")
    told = log[log.index(("cause", 0.0)) :]
    assert ("zero", 0.0) in told
    assert not [one for one in told if one[0] == "apply" and one[1] > 0.0]
    assert SessionReader(tmp_path / "cut.mcap").outcome["outcome"] == "stopped"


def test_a_guard_shorter_than_the_frames_is_refused_before_anything_is_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["record", "--realtime", "--out", str(tmp_path / "x.mcap")]
    words += ["--set", "camera.rate_hz=60", "--set", "safety.guard_timeout_s=0.04"]
    assert run(words) == 2
    assert re.search(r"safety\.guard_timeout_s = 0\.04: .* 0\.05", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("by", ["a finalizer", "a bare except"])
def test_an_interruption_that_is_swallowed_comes_again(by: str) -> None:
    """Compilers and finalizers swallow exceptions; a stop must not wait for the end of the work."""
    control = RunControl()
    swallowed = []

    def wait() -> None:
        control.stop("stopped by a test")
        until(lambda: False)

    class Swallows:
        def __del__(self) -> None:
            wait()

    def work() -> str:
        if by == "a finalizer":
            Swallows()
        else:
            with contextlib.suppress(BaseException):
                wait()
        swallowed.append(True)
        until(lambda: False)
        return "worked to its end"

    with Signals(control).handle():
        assert control.unless_stopped(work, "stopped") == "stopped"
    assert swallowed
