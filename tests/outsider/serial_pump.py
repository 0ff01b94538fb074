"""A syringe pump on a serial port, as a package beside flowrec: its flow rate is a stream, and so is what was set.

    [project.entry-points."flowrec.streams"]
    serial_pump = "serial_pump:SerialPump"
    [streams.pump]  # of the configuration
    kind = "serial_pump"
    device = { port = "/dev/ttyUSB0", flow_ul_min = 12.0 }

    [pump]  # the flow of the map follows it
    channel = "pump/flow"
    nominal = 12.0

The pump takes `F 12.0`, and sends a line a sample: its clock in ms and the flow rate, as in `5310 11.98`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import serial

from flowrec.core import Range
from flowrec.rigs import Chunk, NoStreamError, StreamHead
from flowrec.stages import StreamSettings


class SerialPump:
    """a syringe pump on a serial port."""

    polled = False  # a thread of its own calls `read`, which may wait

    @dataclass(frozen=True, slots=True)
    class Settings:
        """Section [streams.NAME.device] of a configuration."""

        port: str = ""  # such as /dev/ttyUSB0
        baud: Annotated[int, Range(9600, 1_000_000)] = 115_200
        flow_ul_min: Annotated[float, Range(0.0, 1e4)] = 0.0  # what the pump is set to when the run begins

    def __init__(self, settings: Settings) -> None:
        self._settings, self._rest, self._offset_ns = settings, b"", 0
        self._port: serial.Serial | None = None

    @classmethod
    def of(cls, name: str, settings: StreamSettings) -> SerialPump:
        return cls(settings.device)

    def open(self) -> StreamHead:
        try:
            self._port = serial.Serial(self._settings.port, self._settings.baud, timeout=0.05, write_timeout=1.0)
            self._port.write(b"F %.3f\n" % self._settings.flow_ul_min)
        except serial.SerialException as error:
            raise NoStreamError(f"no pump on {self._settings.port}: {error}") from error
        self._rest, self._offset_ns = b"", 0
        return StreamHead(("flow", "set"), ("ul/min", "ul/min"), 0.0, f"pump on {self._settings.port}")

    def read(self, timeout_s: float) -> Chunk | None:
        assert self._port is not None, "the stream is open"
        try:
            self._rest += self._port.read(self._port.in_waiting or 1)
        except (serial.SerialException, OSError) as error:
            raise NoStreamError("the pump does not answer") from error
        *lines, self._rest = self._rest.split(b"\n")
        if not lines:
            return None
        arrival_ns, rows = time.monotonic_ns(), np.array([line.split() for line in lines], np.float64)
        times_ns = np.rint(1e6 * rows[:, 0]).astype(np.int64)
        self._offset_ns = self._offset_ns or arrival_ns - int(times_ns[-1])  # of its clock from this machine's
        values = np.column_stack([rows[:, 1], np.full(len(rows), self._settings.flow_ul_min)])
        return Chunk(times_ns + self._offset_ns, values, arrival_ns)

    def correction_s(self) -> float:
        return 1e-9 * self._offset_ns

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
