"""Inputs of a run from other programs and devices: samples of streams, and messages of extra topics.

A tick has the samples of all streams ([streams.NAME]) that have come since the tick before, as one message. Their
stamps are on the session clock. In real time this is the host's monotonic clock from the rig's stamp 0 on; what a
simulated rig measures has its stamps from the rig.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from flowrec.core import (
    BY_STREAM,
    EXPECTED,
    HEARD,
    NS_PER_S,
    SAMPLES,
    SILENT,
    STREAMS,
    Action,
    Floats,
    Message,
    Samples,
    StreamStates,
    UsageError,
    seconds,
)
from flowrec.rigs import (
    Clocked,
    LogStream,
    Measuring,
    Rig,
    RunLog,
    SampleStream,
    SettableStream,
    settings_of_device,
)
from flowrec.run.control import RunControl
from flowrec.run.stream_reader import StreamReader
from flowrec.stages import STREAM_KINDS, ExtraRow, Inputs, StreamSettings

_STATED_NS = NS_PER_S  # from one message with the state of the streams to the next, if only counts have changed
_JOIN_S = 1.0


@dataclass(slots=True)
class _Known:
    """A reader, and what the run knows of its stream."""

    reader: StreamReader
    places: list[int]  # of its channels in the list of all
    own_clock: bool  # its stamps are on the session clock already
    heard_ns: int | None = None  # stamp of the tick with its latest samples; None: no tick yet
    state: int = EXPECTED
    holds: bool = False  # the robot is held because of it


class StreamInputs:
    """The streams of a configuration, read while it is entered as a context.

    Raises UsageError: a stream that this rig can not have.

    Parameters
    ----------
    settings : sections [streams.NAME] by name.
    rig : of the run; it states when its stamp was 0, and a simulated one has a sensor.
    control : a stream that stops can hold the robot or end the run.
    tell : called with one line when a stream ends, comes back, or its clock steps.
    log : values of the program that records, for the streams of the kind `log`.
    realtime : the run keeps to the wall clock.
    make : makes the stream of a section, as `stream_of` does.
    """

    def __init__(
        self,
        settings: Mapping[str, StreamSettings],
        rig: Rig,
        control: RunControl,
        tell: Callable[[str], None],
        log: RunLog | None = None,
        *,
        realtime: bool,
        make: Callable[..., SampleStream] | None = None,
    ) -> None:
        self._clocked = rig if isinstance(rig, Clocked) else None
        self._control = control
        streams = {name: (make or stream_of)(name, each, rig, realtime=realtime) for name, each in settings.items()}
        self._known = [
            _Known(StreamReader(name, stream, settings[name], tell), [], _needs_rig(settings[name]))
            for name, stream in streams.items()
        ]
        for name, stream in streams.items():
            if isinstance(stream, SettableStream):
                for place, channel in enumerate(settings[name].channels):
                    control.outputs[f"{name}/{channel}"] = partial(stream.set, place)
        self._log = log
        self._logged: dict[str, LogStream] = {
            name: stream for name, stream in streams.items() if isinstance(stream, LogStream)
        }
        self._channels: list[str] = []
        self._units: list[str] = []
        self._latest: Floats = np.zeros(0)
        self._stated_ns = -_STATED_NS
        self._stated: tuple[object, ...] = ()

    def connect(self, stack: ExitStack, read: Mapping[str, str] = MappingProxyType({})) -> None:
        """Find all senders; the stack closes them again.

        `read`: the setting that names each channel that a stage reads, by its STREAM/CHANNEL.

        Raises
        ------
        RigError : one line; a sender that is not there, or can not be used.
        UsageError : a sender states its channels, and one that a stage reads is none of them.
        """
        for each in self._known:
            stack.callback(each.reader.close)
            each.reader.connect()
            there = each.reader.head.channels
            for channel, setting in read.items():
                name, _, wanted = channel.partition("/")
                if name == each.reader.name and there and wanted not in there:
                    raise UsageError(
                        f"{setting} = {channel!r}: stream {name} has no such channel, but {', '.join(there)}"
                    )
        if self._log is not None:
            self._log.attach(self._logged, self._control.set_output)
            stack.callback(self._log.attach, {})

    def __enter__(self) -> Self:
        for each in self._known:
            each.reader.start()
        return self

    def __exit__(self, *error: object) -> None:
        for each in self._known:
            each.reader.close()

    def join(self, arriving: Iterator[Inputs]) -> Iterator[Inputs]:
        """The inputs with the samples that have come since the last ones, and the state of the streams."""
        for inputs in arriving:
            new: dict[str, Message] = {}
            samples = self._samples(inputs.stamp_ns)
            if samples is not None:
                new[SAMPLES] = samples
            self._judge(inputs.stamp_ns)
            states = self._states(inputs.stamp_ns)
            if states is not None:
                new[STREAMS] = states
            yield replace(inputs, extra={**inputs.extra, **new}) if new else inputs

    def _samples(self, stamp_ns: int) -> Samples | None:
        epoch_ns = (self._clocked.epoch_ns if self._clocked is not None else None) or 0
        channel, times, values = [], [], []
        for each in self._known:
            each.heard_ns = stamp_ns if each.heard_ns is None else each.heard_ns
            taken = each.reader.take()
            self._name_channels(each)
            if not taken:
                continue
            each.heard_ns = stamp_ns
            each.state = max(each.state, HEARD)
            places = np.array(each.places, np.int32)
            for part in taken:
                channel.append(places[part.channel])
                times.append(part.times_ns - (0 if each.own_clock else epoch_ns))
                values.append(part.values)
        if not values:
            return None
        places, found = np.concatenate(channel), np.concatenate(values)
        latest = np.full(len(self._channels), np.nan)
        latest[: len(self._latest)] = self._latest
        latest[places] = found  # of several values of a channel numpy keeps the last
        self._latest = latest
        return Samples(stamp_ns, places, np.concatenate(times), found, latest)

    def _name_channels(self, known: _Known) -> None:
        """Give a place to channels that are new; no channel ever changes its place."""
        head = known.reader.head
        for number in range(len(known.places), len(head.channels)):
            known.places.append(len(self._channels))
            self._channels.append(f"{known.reader.name}/{head.channels[number]}")
            self._units.append(head.units[number])

    def _judge(self, stamp_ns: int) -> None:
        """Tell which streams are silent, and do what their settings say."""
        for each in self._known:
            assert each.heard_ns is not None, "the samples have been taken"
            reader = each.reader
            quiet_s = seconds(stamp_ns - each.heard_ns)
            gone = reader.state.gone and quiet_s > 0.0
            silent = gone or quiet_s > reader.silence_s
            if silent == (each.state == SILENT):
                continue
            if not silent and quiet_s > 0.0:
                continue  # nothing has come since
            each.state = SILENT if silent else HEARD
            text = f"{BY_STREAM}{reader.name} is {'silent' if silent else 'back'}"
            if silent and reader.settings.on_silence == "stop":
                self._control.stop(text)
            elif silent and reader.settings.on_silence == "hold":
                each.holds = self._control.request(Action.PAUSE, text)
            elif not silent and each.holds:
                each.holds = False
                if not any(other.holds for other in self._known):
                    self._control.request(Action.RESUME, text)

    def _states(self, stamp_ns: int) -> StreamStates | None:
        """The state of the streams, if it has changed, and about once a second."""
        counts = [each.reader.state for each in self._known]
        judged = [(each.state, count.steps, count.restarts) for each, count in zip(self._known, counts, strict=True)]
        key = (len(self._channels), *judged)
        due = stamp_ns - self._stated_ns >= _STATED_NS
        if key == self._stated and not due:
            return None
        self._stated, self._stated_ns = key, stamp_ns
        counts = [each.reader.counts() for each in self._known]
        made = {
            name: np.array([getattr(count, name) for count in counts], kind)
            for names, kind in ((_WHOLE, np.int64), (_FLOATS, np.float64))
            for name in names
        }
        return StreamStates(
            stamp_ns,
            "\n".join(each.reader.name for each in self._known),
            "\n".join(self._channels),
            "\n".join(self._units),
            np.array([each.state for each in self._known], np.int32),
            **made,  # type: ignore[arg-type]
        )


_WHOLE = ("samples", "lost", "missing", "steps", "restarts")
_FLOATS = ("correction_s", "age_s", "jitter_s")


def _needs_rig(settings: StreamSettings) -> bool:
    return "rig" in STREAM_KINDS[settings.kind].needs


def stream_of(name: str, settings: StreamSettings, rig: Rig, *, realtime: bool) -> SampleStream:
    """The stream of a section. Raises UsageError: this rig can not have it."""
    if _needs_rig(settings):
        if not isinstance(rig, Measuring):
            raise UsageError(f"streams.{name}.kind = {settings.kind!r}: this rig measures nothing; name another kind")
        return rig.stream(name, settings)
    if not realtime or not isinstance(rig, Clocked):
        raise UsageError(
            f"streams.{name}.kind = {settings.kind!r}: samples of other programs come in real time; record with "
            "--realtime or the rig lab, or leave the section out"
        )
    kind = STREAM_KINDS[settings.kind].load()
    own: Any = getattr(kind, "Settings", None)
    if own is not None:
        settings = replace(settings, device=settings_of_device(own, settings.device, f"streams.{name}.device"))
    elif settings.device:
        raise UsageError(f"streams.{name}.device: the kind {settings.kind!r} has no settings of its own; leave it out")
    stream: SampleStream = kind.of(name, settings)
    return stream


class Streams:
    """Messages of extra topics from other programs and devices, read while it is entered as a context.

    Each topic is read in a thread of its own, so that the loop waits for none. A tick takes the latest message of a
    topic; the message gets the stamp of that tick.

    Parameters
    ----------
    rows : the extra topics of the run; those whose row has `stream` are read.
    tell : called with one line if a stream fails or yields what is no message of its topic; the run goes on without it.
    """

    def __init__(self, rows: Iterable[ExtraRow], tell: Callable[[str], None]) -> None:
        self._rows = [row for row in rows if callable(getattr(row.settings, "stream", None))]
        self._tell = tell
        self._latest: dict[str, Any] = {}  # messages by path
        self._changed = threading.Lock()
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._read, args=(row,), name=f"stream {row.topic.path}", daemon=True)
            for row in self._rows
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._closing.set()
        for thread in self._threads:
            thread.join(_JOIN_S)  # a thread that still waits for its device ends with the process

    def join(self, arriving: Iterator[Inputs]) -> Iterator[Inputs]:
        """The inputs with the messages that have come since the last ones."""
        for inputs in arriving:
            if not self._latest:
                yield inputs
                continue
            with self._changed:
                taken, self._latest = self._latest, {}
            new = {path: replace(message, stamp_ns=inputs.stamp_ns) for path, message in taken.items()}
            yield replace(inputs, extra={**inputs.extra, **new})

    def _read(self, row: ExtraRow) -> None:
        path, kind = row.topic.path, row.topic.type
        try:
            for message in row.settings.stream():
                if type(message) is not kind:
                    raise TypeError(f"a {type(message).__name__} where a {kind.__name__} belongs")
                with self._changed:
                    self._latest[path] = message
                if self._closing.is_set():
                    return
        except Exception as error:  # noqa: BLE001 - the code of others; it is told
            why = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
            self._tell(f"{path}: its stream has failed ({why}); the run goes on without it")
