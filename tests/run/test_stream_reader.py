"""Streams of samples without a sender: steps of clocks, gaps, the bounded queue, silence; on a scripted stream."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from flowrec.core import HEARD, NS_PER_S, SAMPLES, SILENT, STREAMS, Action, Applied, RigError, Tick, UsageError
from flowrec.rigs import Chunk, LogStream, NoStreamError, RunLog, StreamHead
from flowrec.rigs.streams.stream import named_channels
from flowrec.run import RunControl, StreamInputs
from flowrec.run.stream_reader import StreamReader
from flowrec.stages import Inputs, StreamSettings
from flowrec.stages.control.events import event_of

PERIOD_NS = 10_000_000  # of 100 Hz
EPOCH_NS = 7 * NS_PER_S


def chunk(first: int, count: int, shift_ns: int = 0, age_ns: int = 2_000_000, start_ns: int = EPOCH_NS) -> Chunk:
    """Samples of 100 Hz, numbered from `first`; they arrive `age_ns` after the last one."""
    times = start_ns + PERIOD_NS * np.arange(first, first + count, dtype=np.int64)
    values = np.column_stack([np.arange(first, first + count), 100.0 + np.arange(first, first + count)])
    return Chunk(times + shift_ns, values.astype(np.float64), int(times[-1]) + age_ns)


@dataclass
class Scripted:
    """A stream that hands on what it is given."""

    polled = True
    coming: list[Chunk] = field(default_factory=list)

    def open(self) -> StreamHead:
        return StreamHead(("a", "b"), ("Pa", "K"), 100.0, "a test")

    def read(self, timeout_s: float) -> Chunk | None:
        return self.coming.pop(0) if self.coming else None

    def correction_s(self) -> float:
        return 0.0

    def close(self) -> None:
        pass


def reader_of(stream: Scripted, **settings: object) -> tuple[StreamReader, list[str]]:
    told: list[str] = []
    reader = StreamReader("pump", stream, StreamSettings(**settings), told.append)  # type: ignore[arg-type]
    reader.connect()
    return reader, told


def taken_of(reader: StreamReader, stream: Scripted) -> list[int]:
    """Stamps of the first channel of all that has come."""
    stamps: list[int] = []
    while stream.coming:
        stamps += [int(each) for part in reader.take() for each in part.times_ns[part.channel == 0]]
    return stamps


def test_samples_come_in_order_with_all_channels_and_none_is_lost() -> None:
    stream = Scripted([chunk(0, 5), chunk(5, 3)])
    reader, told = reader_of(stream)
    parts = reader.take() + reader.take()
    assert np.concatenate([part.values for part in parts]).reshape(-1, 2)[:, 0].tolist() == list(range(8))
    assert parts[0].channel.tolist() == [0, 1] * 5
    counts = reader.counts()
    assert (counts.samples, counts.lost, counts.missing, counts.steps) == (8, 0, 0, 0) and told == []
    assert counts.age_s == pytest.approx(0.002) and counts.jitter_s == pytest.approx(0.0)


@pytest.mark.parametrize("step_s", [-30.0, -0.3, 0.5, 3600.0])
def test_a_step_of_the_senders_clock_is_taken_out_and_told_once(step_s: float) -> None:
    step_ns = round(step_s * NS_PER_S)
    stream = Scripted([*(chunk(5 * n, 5) for n in range(20)), *(chunk(5 * n, 5, step_ns) for n in range(20, 40))])
    reader, told = reader_of(stream)
    stamps = np.array(taken_of(reader, stream))
    true = EPOCH_NS + PERIOD_NS * np.arange(200)
    assert np.abs(stamps - true).max() < 1_000_000
    assert reader.counts().steps == 1 and len(told) == 1 and f"{step_s:+.3f} s" in told[0]


def test_a_step_within_a_chunk_moves_only_the_samples_behind_it() -> None:
    before, after = chunk(0, 10), chunk(10, 10, -5 * NS_PER_S)
    joined = Chunk(
        np.concatenate([before.times_ns, after.times_ns]),
        np.concatenate([before.values, after.values]),
        after.arrival_ns,
    )
    stream = Scripted([joined])
    reader, _ = reader_of(stream)
    stamps = np.array(taken_of(reader, stream))
    assert np.abs(np.diff(stamps) - PERIOD_NS).max() <= 2_000_000 and (np.diff(stamps) > 0).all()


def test_a_gap_of_a_regular_stream_counts_as_missing_and_a_late_burst_does_not() -> None:
    stream = Scripted([chunk(0, 10), chunk(60, 10)])
    reader, _ = reader_of(stream)
    taken_of(reader, stream)
    assert reader.counts().missing == 50
    late = chunk(10, 50)
    burst = replace(late, times_ns=np.linspace(late.times_ns[-1] - PERIOD_NS, late.times_ns[-1], 50).astype(np.int64))
    stream = Scripted([chunk(0, 10), burst, chunk(60, 10)])  # a busy sender stamps what it sends late
    reader, _ = reader_of(stream)
    taken_of(reader, stream)
    assert reader.counts().missing <= 2


def test_the_queue_is_bounded_and_what_it_throws_away_is_counted() -> None:
    stream = Scripted()
    reader, _ = reader_of(stream, queue_samples=20)
    for n in range(10):
        reader._accept(chunk(5 * n, 5))
    left = reader.take()
    assert sum(len(part.values) for part in left) == 2 * 20
    counts = reader.counts()
    assert (counts.samples, counts.lost) == (50, 30)
    assert left[-1].values[-2] == 49.0  # the newest stays


@dataclass
class Clock:
    """A rig whose stamp 0 is at EPOCH_NS."""

    epoch_ns: int | None = EPOCH_NS


def ticks(count: int, every_s: float = 0.1, first: int = 0) -> Iterator[Inputs]:
    for n in range(first, first + count):
        stamp = round(n * every_s * NS_PER_S)
        yield Inputs(stamp, None, Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2)))


def inputs_of(settings: StreamSettings, stream: Scripted) -> tuple[StreamInputs, RunControl]:
    control = RunControl()
    made = {"realtime": True, "make": lambda *_args, **_more: stream}
    streams = StreamInputs({"pump": settings}, Clock(), control, lambda _text: None, **made)  # type: ignore[arg-type]
    streams.connect(ExitStack())
    return streams, control


def test_stamps_of_samples_are_on_the_session_clock() -> None:
    stream = Scripted([chunk(0, 5), chunk(5, 5)])
    streams, _ = inputs_of(StreamSettings(), stream)
    joined = list(streams.join(ticks(2)))
    found = [each.extra[SAMPLES] for each in joined]
    stamps = np.concatenate([each.sample_ns[each.channel == 1] for each in found])  # type: ignore[attr-defined]
    assert stamps.tolist() == (PERIOD_NS * np.arange(10)).tolist()
    assert found[1].latest.tolist() == [9.0, 109.0]  # type: ignore[attr-defined]
    states = joined[0].extra[STREAMS]
    assert states.channel_names() == ["pump/a", "pump/b"] and states.units == "Pa\nK"  # type: ignore[attr-defined]


@pytest.mark.parametrize("what", ["note", "hold", "stop"])
def test_a_stream_that_stops_is_told_and_holds_or_stops_the_run(what: str) -> None:
    stream = Scripted([chunk(10 * n, 10) for n in range(5)])
    streams, control = inputs_of(StreamSettings(silence_s=0.55, on_silence=what), stream)  # type: ignore[arg-type]
    last, events, actions = Tick(), [], []
    for inputs in streams.join(ticks(40)):
        if inputs.stamp_ns == 3 * NS_PER_S:
            stream.coming = [chunk(310 + 10 * n, 10) for n in range(20)]
        tick = replace(last, stamp_ns=inputs.stamp_ns, extra=last.extra.with_messages(inputs.extra))
        event = event_of(last, tick)
        events += [(inputs.stamp_ns / NS_PER_S, event.text)] if event is not None else []
        operator = control.next_event(inputs.stamp_ns, held=False)
        actions += [(inputs.stamp_ns / NS_PER_S, operator.action, operator.text)] if operator is not None else []
        last = tick
    assert events == [(1.0, "stream pump is silent"), (3.1, "stream pump is back")]
    assert (
        actions
        == {
            "note": [],
            "hold": [(1.0, Action.PAUSE, "stream pump is silent"), (3.1, Action.RESUME, "stream pump is back")],
            "stop": [(1.0, Action.STOP, "stream pump is silent")],
        }[what]
    )
    assert bool(control.reason) == (what == "stop")
    states = [last.extra[STREAMS].state.tolist()]  # type: ignore[attr-defined]
    assert states == [[HEARD]] and SILENT != HEARD


def test_a_robot_is_held_until_the_last_stream_for_which_it_is_held_is_back() -> None:
    streams = {"pump": Scripted([chunk(0, 10)]), "valve": Scripted([chunk(0, 10)])}
    control = RunControl()
    settings = dict.fromkeys(streams, StreamSettings(silence_s=0.55, on_silence="hold"))
    made = {"realtime": True, "make": lambda name, *_args, **_more: streams[name]}
    joined = StreamInputs(settings, Clock(), control, lambda _text: None, **made)  # type: ignore[arg-type]
    joined.connect(ExitStack())
    actions = []
    for inputs in joined.join(ticks(40)):
        for name, back_s in (("pump", 2), ("valve", 3)):
            if inputs.stamp_ns >= back_s * NS_PER_S:
                streams[name].coming.append(chunk(inputs.stamp_ns // PERIOD_NS, 10))
        while (event := control.next_event(inputs.stamp_ns, held=False)) is not None:
            actions.append((event.action, event.text))
    silent = [(Action.PAUSE, f"stream {name} is silent") for name in streams]
    assert actions == [*silent, (Action.RESUME, "stream valve is back")]


def test_what_a_person_holds_is_not_let_go_by_a_stream_that_is_back() -> None:
    silent, back = "stream pump is silent", "stream pump is back"
    control, held, seen = RunControl(), False, []

    def take() -> None:
        nonlocal held
        event = control.next_event(NS_PER_S, held)
        assert event is not None
        held = {Action.PAUSE: True, Action.RESUME: False}.get(Action(event.action), held)
        seen.append((event.action, held))

    for person_first in (True, False):
        for ask in sorted(("person", "stream"), reverse=not person_first):
            control.toggle_hold() if ask == "person" else control.request(Action.PAUSE, silent)
            take()
        control.request(Action.RESUME, back)
        take()
        control.toggle_hold()  # the person lets it go
        take()
    assert seen == 2 * [(Action.PAUSE, True), (Action.PAUSE, True), (Action.NOTE, True), (Action.RESUME, False)]
    control.request(Action.PAUSE, silent)
    take()
    control.request(Action.RESUME, back)
    take()
    assert seen[-2:] == [(Action.PAUSE, True), (Action.RESUME, False)], "held by the stream alone"


def test_a_sender_that_was_restarted_has_a_clock_of_its_own() -> None:
    class Restarted(Scripted):
        polled = False

        def read(self, timeout_s: float) -> Chunk | None:
            found = super().read(timeout_s)
            if found is not None and not len(found.times_ns):
                raise NoStreamError("its outlet has ended")
            return found

    stepped = [chunk(5 * n, 5, -30 * NS_PER_S) for n in range(10, 20)]
    ended = replace(chunk(0, 1), times_ns=np.zeros(0, np.int64))
    stream = Restarted()
    reader, _ = reader_of(stream)
    reader.start()
    stream.coming += [*(chunk(5 * n, 5) for n in range(10)), *stepped, ended]
    stream.coming += [chunk(5 * n, 5) for n in range(20, 30)]
    stamps: list[int] = []
    end_s = time.monotonic() + 10.0
    while len(stamps) < 150 and time.monotonic() < end_s:
        stamps += [int(each) for part in reader.take() for each in part.times_ns[part.channel == 0]]
        time.sleep(0.01)
    reader.close()
    counts = reader.counts()
    assert (len(stamps), counts.restarts, counts.steps) == (150, 1, 1)
    assert stamps[100:] == (EPOCH_NS + PERIOD_NS * np.arange(100, 150)).tolist()


def test_a_sender_that_ends_before_the_run_begins_is_looked_for_again() -> None:
    class Ended(Scripted):
        polled = False
        opened = 0

        def open(self) -> StreamHead:
            self.opened += 1
            return super().open()

        def read(self, timeout_s: float) -> Chunk | None:
            if self.opened == 1:
                raise NoStreamError("its outlet has ended")
            return super().read(timeout_s)

    stream = Ended()
    reader, told = reader_of(stream)
    reader.start()
    end_s = time.monotonic() + 10.0
    while not reader.state.restarts and time.monotonic() < end_s:
        time.sleep(0.01)
    reader.close()
    assert told == ["streams.pump: its outlet has ended; it is looked for again"]
    assert reader.state.restarts == 1 and not reader.state.gone


def test_values_of_a_program_are_a_stream_with_a_channel_a_name() -> None:
    run = RunLog()
    run.log("pump/pressure", EPOCH_NS, 1.0, "Pa")  # before the run has begun
    control = RunControl()
    settings = {"log": StreamSettings("log"), "valve": StreamSettings("log", unit="deg")}
    streams = StreamInputs(settings, Clock(), control, lambda _text: None, run, realtime=True)  # type: ignore[arg-type]
    with ExitStack() as stack:
        streams.connect(stack)
        joining = streams.join(ticks(3))
        next(joining)
        threads = [threading.Thread(target=run.log, args=("valve/angle", time.monotonic_ns(), n)) for n in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        second = next(joining)
        states, samples = second.extra[STREAMS], second.extra[SAMPLES]
        assert states.channel_names() == ["log/pump/pressure", "valve/angle"]  # type: ignore[attr-defined]
        assert states.units == "Pa\ndeg"  # type: ignore[attr-defined]
        assert sorted(samples.value.tolist()) == list(range(20))  # type: ignore[attr-defined]
        assert set(samples.channel.tolist()) == {1}  # type: ignore[attr-defined]
        assert samples.latest.tolist() == [1.0, samples.value[-1]]  # type: ignore[attr-defined]
        with pytest.raises(UsageError, match="of one line"):
            run.log("two\nlines", 0, 1.0)


def test_a_value_from_before_a_run_is_of_that_run_and_of_no_later_one() -> None:
    run, taken = RunLog(), []
    run.log("pressure", 1, 5.0)
    for _ in range(2):
        stream = LogStream("Pa")
        run.attach({"log": stream})
        taken.append(stream.read(0.0))
        run.attach({})
    first, second = taken
    assert first is not None and first.values.tolist() == [5.0] and second is None


def test_a_sender_that_is_not_there_is_refused_unless_it_is_only_noted() -> None:
    class Absent(Scripted):
        def open(self) -> StreamHead:
            raise NoStreamError("no outlet")

    with pytest.raises(RigError, match=r"streams\.pump: .*0\.1 s"):
        reader_of(Absent(), wait_s=0.1, on_silence="hold")
    reader, told = reader_of(Absent(), wait_s=0.1)
    assert reader.state.gone and len(told) == 1 and told[0].startswith("streams.pump: ")


def test_channels_are_named_by_the_settings_or_the_sender_or_their_number() -> None:
    assert named_channels(StreamSettings(), ["p", "q"], 2) == ("p", "q")
    assert named_channels(StreamSettings(channels=("x", "y")), ["p", "q"], 2) == ("x", "y")
    assert named_channels(StreamSettings(), ["p", "p"], 2) == ("1", "2")
    with pytest.raises(RigError, match="3 channels"):
        named_channels(StreamSettings(channels=("x", "y")), [], 3)
