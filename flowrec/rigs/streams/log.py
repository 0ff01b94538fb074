"""Values that a program gives to a run: `run = RunLog()`, `record(..., log=run)`, `run.log(name, stamp_ns, value)`."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from flowrec.core import UsageError
from flowrec.rigs.streams.stream import Chunk, StreamHead
from flowrec.stages import LOG, StreamSettings

_MOST_CHANNELS = 1000  # of a run: one is a name, and whoever puts a time into names finds out
_NAME_LIMIT = 100  # letters of a name


class RunLog:
    """Values beside a run, from any thread of the program that records: they are recorded, and replayed, as inputs.

    The run that `flowrec.record(..., realtime=True, log=run)` records takes them.

    >>> import time
    >>> run = flowrec.RunLog()
    >>> run.log("pump/pressure", time.monotonic_ns(), 2.1e4, "Pa")
    """

    def __init__(self) -> None:
        self._streams: dict[str, LogStream] = {}
        self._early: deque[tuple[str, int, float, str]] = deque(maxlen=1000)  # before the run has taken it
        self._lock = threading.Lock()
        self._set: Callable[[str, float], None] | None = None

    def log(self, name: str, stamp_ns: int, value: float, unit: str = "") -> None:
        """Give one value; it never waits.

        Parameters
        ----------
        name : such as pump/pressure. Of [streams.pump] with kind = "log" it is the channel `pressure`, else it is a
            channel of [streams.log], which `record` adds.
        stamp_ns : when it was measured, as by time.monotonic_ns().
        unit : of the value; that of the first call holds.

        Raises
        ------
        UsageError : a name that is empty, too long or of several lines; or too many names.
        """
        if not name or len(name) > _NAME_LIMIT or not name.isprintable():
            raise UsageError(f"log {name[:_NAME_LIMIT]!r}: give a name such as pump/pressure, of one line")
        with self._lock:
            if not self._streams:
                self._early.append((name, int(stamp_ns), float(value), unit))
                return
            first, _, rest = name.partition("/")
            stream, channel = (self._streams[first], rest) if rest and first in self._streams else (None, name)
            stream = stream if stream is not None else self._streams[LOG]
            stream.add(channel, int(stamp_ns), float(value), unit)

    def set(self, name: str, value: float) -> None:
        """Set an output of the run beside the coils, such as `lamp/light` of [streams.lamp]; it never waits.

        Raises
        ------
        UsageError : no run has it now, or it must not have this value.
        """
        if self._set is None:
            raise UsageError(f"set {name!r}: no run is under way that takes it")
        self._set(name, float(value))

    def attach(self, streams: dict[str, LogStream], setting: Callable[[str, float], None] | None = None) -> None:
        """Give the values to these streams, by name, and what is set to `setting`, from now on; the run calls it."""
        with self._lock:
            self._streams, self._set = streams, setting
            early = list(self._early)
            self._early.clear()
        for each in early if streams else ():
            self.log(*each)


class LogStream:
    """The values of a RunLog for one section [streams.NAME]; see rigs.streams.stream.SampleStream."""

    polled = True

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._head = StreamHead((), ())
        self._places: dict[str, int] = {}
        self._waiting: deque[tuple[int, int, float]] = deque()

    @classmethod
    def of(cls, name: str, settings: StreamSettings) -> LogStream:
        """The stream of a section."""
        return cls(settings.unit)

    def add(self, channel: str, stamp_ns: int, value: float, unit: str) -> None:
        """Add a value; the lock of the RunLog is held.

        Raises
        ------
        UsageError : too many names.
        """
        place = self._places.setdefault(channel, len(self._places))
        if place >= len(self._head.channels):
            if place >= _MOST_CHANNELS:
                del self._places[channel]
                raise UsageError(f"log {channel!r}: there are {_MOST_CHANNELS} names; log fewer")
            head = self._head
            self._head = StreamHead((*head.channels, channel), (*head.units, unit or self._unit), 0.0, "this program")
        self._waiting.append((place, stamp_ns, value))

    def open(self) -> StreamHead:
        return self._head

    def read(self, timeout_s: float) -> Chunk | None:
        rows = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if not rows:
            return None
        places, stamps, values = zip(*rows, strict=True)
        return Chunk(
            np.array(stamps, np.int64),
            np.array(values, np.float64),
            time.monotonic_ns(),
            np.array(places, np.int32),
            self._head,
        )

    def correction_s(self) -> float:
        return math.nan

    def close(self) -> None:
        """There is nothing to disconnect."""
