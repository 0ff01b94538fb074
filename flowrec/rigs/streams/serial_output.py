"""Outputs beside the coils on a serial port, such as a lamp, a valve or a function generator: set, and recorded.

    [streams.generator]
    kind = "serial"
    channels = ["volt", "hertz"]
    on_silence = "stop"

    [streams.generator.device]
    port = "/dev/ttyUSB0"
    lines = ["VOLT {:.3f}", "FREQ {:.1f}"]
    values = [2.0, 1.5e6]
    most = [5.0, 3e6]
    rest = [0.0, 1.5e6]
    ask = ["VOLT?", "FREQ?"]

`rest` is sent however the run ends, but by a kill of the whole process: what must not stay on then needs a device that
switches off by itself.
"""

from __future__ import annotations

import math
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import serial

from flowrec.core import Range, UsageError
from flowrec.rigs.streams.stream import Chunk, NoStreamError, StreamHead
from flowrec.stages import StreamSettings

if sys.platform == "win32":
    _GONE: tuple[type[Exception], ...] = (serial.SerialException, OSError)
else:
    import termios

    _GONE = (serial.SerialException, OSError, termios.error)  # what a port that is gone raises
_ANSWER_S = 0.5  # in which a device answers
_WRITE_S = 1.0
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class SerialOutputSettings:
    """Section [streams.NAME.device] of the kind `serial`; lists have an element for each of `channels`."""

    port: str = ""  # of the device, such as /dev/ttyUSB0
    baud: Annotated[int, Range(300, 4_000_000)] = 115_200
    lines: tuple[str, ...] = ()  # line that sets each channel; {} in it is the value, {:.3f} one with three digits
    values: tuple[float, ...] = ()  # what is set before the run
    rest: tuple[float, ...] = ()  # what is set after the run; []: it stays as it is
    least: tuple[float, ...] = ()  # least value of each channel; []: no limit
    most: tuple[float, ...] = ()  # largest value of each channel; []: no limit
    # line that asks for each channel, of whose answer the first number is recorded; []: what was sent is recorded
    ask: tuple[str, ...] = ()
    period_s: Annotated[float, Range(0.05, 60.0)] = 1.0  # from one sample of all channels to the next

    def refuse_unfit(self, channels: tuple[str, ...], where: str) -> None:
        """Raise UsageError, one line, where the lists do not fit the channels, or a value is beyond its limits."""
        if not channels:
            raise UsageError(f"{where}.channels: name what is set, such as ['light']")
        for name in ("lines", "values", "rest", "least", "most", "ask"):
            given = len(getattr(self, name))
            if given != len(channels) and (given or name in ("lines", "values")):
                raise UsageError(
                    f"{where}.device.{name} has {given} elements, where there are {len(channels)} channels"
                )
        for name, line in zip(channels, self.lines, strict=True):
            try:
                plain = line.format(1.0) == line.format(2.0)
            except (ValueError, LookupError) as error:
                raise UsageError(f"{where}.device.lines: {line!r} for {name}: {error}") from error
            if plain:
                raise UsageError(
                    f"{where}.device.lines: {line!r} for {name} has no place for the value, such as {{:.3f}}"
                )
        for place, name in enumerate(channels):
            for value in (*self.values[place : place + 1], *self.rest[place : place + 1]):
                self.refuse_value(place, f"{where}.device: {name}", value)

    def refuse_value(self, place: int, name: str, value: float) -> None:
        """Raise UsageError where a channel may not have a value."""
        least = self.least[place] if self.least else -math.inf
        most = self.most[place] if self.most else math.inf
        if not (least <= value <= most and math.isfinite(value)):
            raise UsageError(f"{name} = {value:g}: must be from {least:g} to {most:g}")


class SerialOutput:
    """See rigs.streams.stream.SettableStream."""

    polled = False
    Settings = SerialOutputSettings

    def __init__(self, name: str, channels: tuple[str, ...], unit: str, settings: SerialOutputSettings) -> None:
        settings.refuse_unfit(channels, f"streams.{name}")
        self._name, self._channels, self._unit, self._settings = name, channels, unit, settings
        self._port: serial.Serial | None = None
        self._values = list(settings.values)  # as set last: a device that comes back gets them again
        self._orders: deque[tuple[int, float]] = deque()
        self._ordered = threading.Event()
        self._due_s = -math.inf

    @classmethod
    def of(cls, name: str, settings: StreamSettings) -> SerialOutput:
        """The stream of a section.

        Raises
        ------
        UsageError : its lists do not fit its channels.
        """
        device: Any = settings.device  # of its own type by now, see settings_of_device
        return cls(name, settings.channels, settings.unit, device)

    def set(self, place: int, value: float) -> None:
        self._settings.refuse_value(place, f"{self._name}/{self._channels[place]}", value)
        self._orders.append((place, value))
        self._ordered.set()

    def open(self) -> StreamHead:
        name, baud = self._settings.port, self._settings.baud
        try:  # exclusively: the amplifier, which does so too, gets no line that is not meant for it
            self._port = serial.Serial(name, baud, timeout=_ANSWER_S, write_timeout=_WRITE_S, exclusive=True)
        except _GONE as error:
            raise NoStreamError(f"no device on {name!r}: {error}") from error
        for place, value in enumerate(self._values):
            self._send(self._settings.lines[place].format(value))
        self._due_s = -math.inf
        units = (self._unit,) * len(self._channels)
        return StreamHead(self._channels, units, 1.0 / self._settings.period_s, f"device on {name}")

    def read(self, timeout_s: float) -> Chunk | None:
        if not self._orders and time.monotonic() < self._due_s:
            self._ordered.wait(timeout_s)
        self._ordered.clear()
        changed = bool(self._orders)
        while self._orders:
            place, self._values[place] = self._orders.popleft()
            self._send(self._settings.lines[place].format(self._values[place]))
        now_s = time.monotonic()
        if not changed and now_s < self._due_s:
            return None
        self._due_s = now_s + self._settings.period_s
        with self._open_port() as port:
            _ = port.in_waiting  # raises where the device is gone, also one that is never asked
        values = [self._ask(line) for line in self._settings.ask] or self._values
        now_ns = time.monotonic_ns()
        return Chunk(np.array([now_ns]), np.array([values], np.float64), now_ns)

    def correction_s(self) -> float:
        return 0.0

    def close(self) -> None:
        port, self._port = self._port, None
        if port is None:
            return
        with suppress(*_GONE):  # what is unplugged can not be set
            for line, value in zip(self._settings.lines, self._settings.rest, strict=False):
                port.write(line.format(value).encode() + b"\n")
            port.flush()
        port.close()

    def _send(self, line: str) -> None:
        with self._open_port() as port:
            port.write(line.encode() + b"\n")

    def _ask(self, line: str) -> float:
        """The first number of the answer to a line."""
        with self._open_port() as port:
            port.reset_input_buffer()
        self._send(line)
        with self._open_port() as port:
            answer = port.readline(200)
        number = _NUMBER.search(answer)
        if number is None:
            raise NoStreamError(f"the device answers {line!r} with {answer.decode(errors='replace')!r}, not a number")
        return float(number[0])

    @contextmanager
    def _open_port(self) -> Iterator[serial.Serial]:
        assert self._port is not None, "the stream is open"
        try:
            yield self._port
        except _GONE as error:
            raise NoStreamError(f"the device on {self._settings.port} does not answer: {error}") from error
