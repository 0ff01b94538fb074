"""Streams of the Lab Streaming Layer from real outlets in other processes: alive, killed, restarted, stepped, twice."""

from __future__ import annotations

import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import HEARD, SAMPLES, SILENT, STREAMS, Applied, RigError, Samples, StreamStates
from flowrec.rigs import RunLog
from flowrec.run import RunControl, StreamInputs
from flowrec.stages import Inputs, StreamSettings, load_config
from flowrec.store import Session
from flowrec.verbs.record import record
from flowrec.verbs.replay_segments import verify
from tests.extras import why
from tests.real_time import Clock
from tests.short_missions import SMALL

pylsl = pytest.importorskip("pylsl", reason=why("pylsl"))


@contextmanager
def outlet(name: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    """An outlet in a process of its own; see tests/twins/lsl_outlet.py."""
    command = [sys.executable, "-m", "tests.twins.lsl_outlet", name, *words]
    child = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert child.stdout is not None and child.stdout.readline().startswith("ready")
        yield child
    finally:
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout):
            assert pipe is not None
            pipe.close()


class Listening:
    """What a run of 30 ticks a second would take of streams."""

    def __init__(self, told: list[str], **settings: StreamSettings) -> None:
        self.told = told
        self._stack = ExitStack()
        self._rig = Clock(time.monotonic_ns())
        self.inputs = StreamInputs(settings, self._rig, RunControl(), told.append, realtime=True)  # type: ignore[arg-type]
        self.samples: list[Samples] = []
        self.states: list[StreamStates] = []

    def __enter__(self) -> Listening:
        self.inputs.connect(self._stack)
        self._stack.enter_context(self.inputs)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def until(self, done: Callable[[], bool], limit_s: float = 20.0) -> None:
        end_s = time.monotonic() + limit_s
        for joined in self.inputs.join(self._ticks()):
            if (samples := joined.extra.get(SAMPLES)) is not None:
                self.samples.append(samples)  # type: ignore[arg-type]
            if (states := joined.extra.get(STREAMS)) is not None:
                self.states.append(states)  # type: ignore[arg-type]
            if done():
                return
            assert time.monotonic() < end_s, (self.told, self.states[-1:])

    def _ticks(self) -> Iterator[Inputs]:
        while True:
            time.sleep(1.0 / 30.0)
            assert self._rig.epoch_ns is not None
            stamp = time.monotonic_ns() - self._rig.epoch_ns
            yield Inputs(stamp, None, Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2)))

    def count(self) -> int:
        return sum(len(each.value) for each in self.samples)

    def values(self, place: int = 0) -> np.ndarray:
        return np.concatenate([each.value[each.channel == place] for each in self.samples])

    def stamps(self, place: int = 0) -> np.ndarray:
        return np.concatenate([each.sample_ns[each.channel == place] for each in self.samples])


@pytest.fixture
def name() -> str:
    """A name that no other outlet of this network has."""
    return f"pump{uuid.uuid4().hex[:12]}"


def test_no_sample_is_lost_and_stamps_are_those_of_this_machine(name: str) -> None:
    with outlet(name, "--rate", "200"), Listening([], pump=StreamSettings(outlet=name)) as heard:
        heard.until(lambda: heard.count() >= 400)
        values, stamps = heard.values(), heard.stamps()
        assert (np.diff(values) == 1.0).all()  # each, in order
        assert np.abs(np.diff(stamps) / 1e6 - 5.0).max() < 1.0  # ms; the sender stamps them evenly
        heard.until(lambda: len(heard.states) > 2)
        last = heard.states[-1]
        assert last.channel_names() == ["pump/flow0", "pump/flow1"] and last.units == "ul/min\nul/min"
        assert abs(last.correction_s[0]) < 0.05 and 0.0 < last.age_s[0] < 1.0
        assert (last.lost[0], last.missing[0], last.steps[0], last.state[0]) == (0, 0, 0, HEARD)


def test_the_time_correction_is_added_and_one_that_does_not_answer_costs_no_sample(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def correction(_inlet: object, timeout: float) -> float:
        """The sender's clock is a quarter of a second ahead, which is told once."""
        asked.append(timeout)
        if len(asked) > 1:
            raise TimeoutError
        return -0.25

    monkeypatch.setattr(pylsl.StreamInlet, "time_correction", correction)
    with outlet(name, "--rate", "200"), Listening([], pump=StreamSettings(outlet=name)) as heard:
        heard.until(lambda: len(asked) > 2)
        assert (np.diff(heard.values()) == 1.0).all()
        heard.until(lambda: len(heard.states) > 1)
        assert heard.states[-1].correction_s[0] == -0.25 and 0.25 < heard.states[-1].age_s[0] < 0.5


def test_a_killed_outlet_is_silent_at_once_and_heard_again_when_it_is_restarted(name: str) -> None:
    told: list[str] = []
    with Listening(told, pump=StreamSettings(outlet=name, on_silence="note", wait_s=0.1)) as heard:
        with outlet(name, "--source", "one"):
            heard.until(lambda: heard.count() > 20)
        heard.until(lambda: heard.states[-1].state[0] == SILENT)
        before, count = heard.states[-1].restarts[0], heard.count()
        with outlet(name, "--source", "one"):
            heard.until(lambda: heard.count() > count + 20)
            heard.until(lambda: heard.states[-1].state[0] == HEARD)
        assert heard.states[-1].restarts[0] == before + 1
        assert any("its outlet has ended; it is looked for again" in line for line in told)


@pytest.mark.slow("restarts an outlet; a restart with the same channels stands above")
def test_a_restart_with_other_channels_stays_silent_and_is_told_once(name: str) -> None:
    told: list[str] = []
    with Listening(told, pump=StreamSettings(outlet=name, wait_s=0.1)) as heard:
        with outlet(name):
            heard.until(lambda: heard.count() > 20)
        count = heard.count()
        with outlet(name, "--channels", "3"):
            heard.until(lambda: any("other channels" in line for line in told))
            heard.until(lambda: heard.states[-1].state[0] == SILENT)
        assert sum("other channels" in line for line in told) == 1 and heard.count() - count < 400


def test_a_stepped_clock_is_noticed_and_its_stamps_stay_those_of_this_machine(name: str) -> None:
    told: list[str] = []
    with outlet(name) as sender, Listening(told, pump=StreamSettings(outlet=name)) as heard:
        heard.until(lambda: heard.count() > 100)
        assert sender.stdin is not None
        sender.stdin.write("step -30\n")
        sender.stdin.flush()
        heard.until(lambda: heard.states[-1].steps[0] == 1)
        count = heard.count()
        heard.until(lambda: heard.count() > count + 100)
        values, stamps = heard.values(), heard.stamps()
        fit = np.polyfit(values, stamps / 1e6, 1)
        assert fit[0] == pytest.approx(10.0, rel=0.1)  # ms a sample: no jump of 30 s
        assert np.abs(stamps / 1e6 - np.polyval(fit, values)).max() < 150.0
        assert any("has stepped by -" in line for line in told)


def test_two_outlets_of_one_name_are_refused_with_both_named_and_a_query_tells_them_apart(name: str) -> None:
    with outlet(name, "--source", "first"), outlet(name, "--source", "second"):
        with (
            pytest.raises(RigError, match=r"2 outlets with name .*first.*second"),
            Listening([], pump=StreamSettings(outlet=name)),
        ):
            pass
        with Listening([], pump=StreamSettings(outlet=name, query="source_id='second'")) as heard:
            heard.until(lambda: heard.count() > 20)


def test_an_outlet_of_texts_or_of_nobody_is_refused_in_one_line(name: str) -> None:
    with (
        pytest.raises(RigError, match=r"^streams\.pump: .* \(wait_s\)$"),
        Listening([], pump=StreamSettings(outlet=name, wait_s=0.1, on_silence="stop")),
    ):
        pass


@pytest.mark.slow("a mission of the simulated rig in real time, and its replay")
def test_a_mission_with_streams_is_replayed_identically_and_has_the_same_samples(name: str, tmp_path: Path) -> None:
    run = RunLog()
    run.log("valve/angle", time.monotonic_ns(), 3.0, "deg")
    config = load_config(None, [*SMALL, f"streams.pump.outlet={name}"])
    with outlet(name, "--rate", "1000", "--channels", "8"):
        record(config, tmp_path / "run.mcap", realtime=True, duration_s=3.0, log=run)
    report = verify(tmp_path / "run.mcap")
    assert report.identical, report
    with Session(tmp_path / "run.mcap") as session:
        pump = session.stream("pump/flow7")
        assert (np.diff(pump.value) == 1.0).all() and pump.unit == "ul/min"
        assert session.stream("log/valve/angle").value.tolist() == [3.0]
