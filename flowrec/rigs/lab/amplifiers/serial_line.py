"""Amplifier `serial`: a microcontroller behind a serial port that generates the rotating field itself.

The recorder sends frequency, heading and amplitude, and repeats them; the firmware keeps the phase, turns the plane,
ramps the amplitude, counts the turns of the field, and goes to zero by itself when no line comes (serial_protocol.py,
firmware/). Each command is answered with what is put out at that time of the firmware's clock. That clock is fitted to
the host's like a camera's; half of the shortest round trip is taken as the delay of an answer.
"""

from __future__ import annotations

import errno
import math
import os
import select
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Self

import numpy as np
import serial
from serial.tools import list_ports

from flowrec.core import (
    NS_PER_S,
    DeviceClock,
    Fit,
    Measured,
    Priority,
    RigError,
    UsageError,
    realtime_priority,
    seconds,
)
from flowrec.rigs.lab.amplifiers.amplifier import KEEP_S, AmplifierInfo, not_before
from flowrec.rigs.lab.amplifiers.serial_protocol import (
    VERSION,
    ZERO,
    Reply,
    Telemetry,
    configuration,
    field_line,
    line,
    reply,
    telemetry,
)
from flowrec.stages import Coils, FieldCommand, FieldLog

if TYPE_CHECKING:
    from flowrec.stages import ResolvedConfig  # with every stage: this module starts without them

_BOOT_S = 4.0  # many boards start anew when their port is opened
_CONFIRM_S = 0.25  # for the answer to one line
_CONFIGURE_S = 2.0
_SILENT_S = 0.4  # a board that answers no command for so long does not answer
_LEAST_S = 0.008  # between two lines: a line and its answer take that long at 115200 baud
_TURNS = 1e-6  # the controller counts millionths of a revolution
_WRAP = 1 << 32  # its counters have 32 bits
_COILS = 3  # of a firmware that does not state their number


class SerialAmplifier:
    """See amplifier.Amplifier.

    Parameters
    ----------
    port, baud : of the board.
    coils : what the firmware is configured with.
    """

    @classmethod
    def of(cls, config: ResolvedConfig) -> Self:
        """The amplifier of a configuration."""
        return cls(config.lab.serial.port, config.lab.serial.baud, config.coils)

    @staticmethod
    def ports() -> list[str]:
        """The serial ports of this computer; none is opened, because what is behind it may be another device."""
        return sorted(port.device for port in list_ports.comports())

    def __init__(self, port: str, baud: int, coils: Coils) -> None:
        self._name, self._baud, self._coils = port, baud, coils
        self._port: serial.Serial | None = None
        self._number = 0
        self._fault = ""
        self._permitted = False  # by arm(), until zero()
        self._on = False  # whether the last command has a field
        self._half = False  # whether the last line was written in part only
        self._written_s = 0.0
        # The reader's thread hands over what it reads in queues that lock themselves.
        self._reader: threading.Thread | None = None
        self._closing = False
        self._replies: deque[Reply] = deque(maxlen=64)
        self._measured: deque[tuple[Telemetry, int, int]] = deque(maxlen=10_000)  # with the times of line and answer
        self._sent: dict[int, tuple[int, bool]] = {}  # number: when, and whether with a field
        self._heard_s = 0.0
        self._zeros = 0  # confirmations of Z
        self._answered = threading.Condition()
        self._read_back: Measured | None = None
        # The log, for the loop's thread only.
        self._log = FieldLog(coils=coils.count)
        self._no_field = Telemetry(0, 0.0, 0.0, 0.0, (0, 0), np.zeros(coils.count))
        self._clock = DeviceClock(unit=1000.0, wrap=_WRAP)
        self._fit: Fit | None = None
        self._round_trip_ns = math.inf
        self._before: tuple[int, Telemetry] | None = None

    # ---- for the rig

    def open(self) -> AmplifierInfo:
        self._port = self._open_port()
        self._closing, self._fault = False, ""
        self._reader = threading.Thread(target=self._read, name="amplifier", daemon=True)
        self._reader.start()
        try:
            return self._identify()
        except BaseException:
            self.close()
            raise

    def guard(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        # The descriptor itself, not the name: a second opening would start many boards anew.
        assert self._port is not None
        descriptor = self._port.fileno()
        return ("serial", str(descriptor)), (descriptor,)

    def arm(self) -> None:
        for verb, numbers in configuration(self._coils):
            answer = self._ask(verb, *numbers, timeout_s=_CONFIGURE_S)
            if answer is None or answer.verb != verb:
                raise RigError(f"{self._name}: the amplifier refuses its configuration ({_words(answer)})")
        self._permitted = True

    def apply(self, command: FieldCommand) -> None:
        if not self._permitted:
            return
        now_s = time.monotonic()
        field = command.amplitude_mt > 0.0
        if field and not self._on:
            # The firmware has disarmed itself in a time without commands.
            self._write(line("A", self._next()))
            self._heard_s = now_s
        elif now_s - self._written_s < _LEAST_S and field == self._on:
            return  # the next command or beat brings it
        self._on = field
        if self._fault:
            raise RigError(self._fault)
        if field and now_s - self._heard_s > _SILENT_S:
            raise RigError(f"{self._name}: the amplifier has not answered for {_SILENT_S:g} s; see to its cable")
        number = self._next()
        self._sent[number] = (time.monotonic_ns(), field)
        self._write(field_line(number, command))
        if len(self._sent) > 1000:
            self._sent.pop(next(iter(self._sent)))

    def put_out(self, until_ns: int) -> FieldLog:
        """Log of the output. The last row lasts on; the next answer replaces its frequency and heading by the means."""
        while self._measured:
            self._take(*self._measured.popleft())
        self._log.forget(until_ns - round(KEEP_S * NS_PER_S))
        return self._log

    def read_back(self) -> Measured | None:
        """The latest measurement, at the arrival of its answer."""
        return self._read_back

    def zero(self) -> None:
        self._permitted = self._on = False
        if self._port is None:
            return
        for _ in range(4):
            before = self._zeros
            try:
                # One system call, without a lock: any thread may be in the middle of a line.
                os.write(self._port.fileno(), ZERO)
            except (OSError, serial.SerialException) as error:
                raise RigError(f"{self._name}: the amplifier can not be reached ({error})") from error
            with self._answered:
                if self._answered.wait_for(lambda seen=before: self._zeros > seen, _CONFIRM_S):  # type: ignore[misc]
                    self._measured.append((self._no_field, time.monotonic_ns(), 0))
                    return
        raise RigError(f"{self._name}: the amplifier does not confirm that it is at zero")

    def close(self) -> None:
        self._closing = True
        if self._reader is not None:
            self._reader.join()
            self._reader = None
        if self._port is not None:
            self._port.close()
            self._port = None

    # ---- opening

    def _open_port(self) -> serial.Serial:
        there = ", ".join(self.ports()) or "none"
        if not self._name:
            raise UsageError(f"lab.serial.port: which serial port is the amplifier's? There are: {there}")
        try:
            # Another recorder is kept out; the guardian has the same descriptor, and so keeps others out as well.
            return serial.Serial(self._name, self._baud, timeout=0, write_timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            if number in (errno.EAGAIN, errno.EBUSY):
                raise RigError(
                    f"{self._name}: another program uses this port; close it, or its guardian ends"
                ) from error
            if number == errno.EACCES:
                raise RigError(f"{self._name}: no right to use this port; sudo adduser $USER dialout") from error
            why = (
                "there is no such port"
                if number == errno.ENOENT
                else f"it can not be used as a serial port ({_first_line(error)})"
            )
            raise RigError(f"lab.serial.port = {self._name!r}: {why}; ports here: {there}") from error

    def _identify(self) -> AmplifierInfo:
        end_s = time.monotonic() + _BOOT_S
        answer: Reply | None = None
        while answer is None and time.monotonic() < end_s:
            self._write(ZERO)
            answer = self._ask("I")
            if self._fault:
                raise RigError(self._fault)
        if answer is None and self._heard_s:
            raise RigError(f"{self._name}: another device than flowrec-coils answers; is lab.serial.port right?")
        if answer is None:
            raise RigError(
                f"{self._name}: no answer in {_BOOT_S:g} s; is the firmware on the board, lab.serial.baud right?"
            )
        try:
            model, *numbers = answer.words
            version, most_ua, timer_ms, _update_hz, coils, sensors = map(
                int, (numbers + [str(_COILS), "0"][len(numbers) - 4 :])
            )
        except ValueError as error:
            raise RigError(
                f"{self._name}: another device than flowrec-coils answers (by {_words(answer)!r}); is lab.serial.port "
                "right?"
            ) from error
        if version != VERSION:
            raise RigError(f"{self._name}: protocol {version}, where {VERSION} is needed; put the new firmware on it")
        if coils != self._coils.count:
            raise UsageError(
                f"{self._name}: the firmware drives {coils} coils, where coils.mt_per_a has {self._coils.count} "
                "columns; give that one column a coil, or the sketch the pins of all coils (PWM_PINS, DIR_PINS)"
            )
        return AmplifierInfo(
            model=model,
            serial="",
            max_current_a=1e-6 * most_ua,
            max_voltage_v=math.inf,
            max_output_hz=math.inf,
            latency_s=0.01,
            timer_s=1e-3 * timer_ms,
            measures=sensors == coils,
        )

    def _ask(self, verb: str, *numbers: int, timeout_s: float = _CONFIRM_S) -> Reply | None:
        """The answer to a line; None: there is none."""
        number = self._next()
        self._write(line(verb, number, *numbers))
        found: list[Reply] = []

        def has_reply() -> bool:
            found.extend(one for one in self._replies if one.number == number)
            return bool(found)

        with self._answered:
            self._answered.wait_for(has_reply, timeout_s)
        return found[0] if found else None

    # ---- writing

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _write(self, text: bytes) -> None:
        """Write without waiting. A line that finds no room is cut; the next one begins with a newline."""
        port = self._port
        if port is None:
            raise RigError(f"{self._name}: the amplifier is not open")
        text = b"\n" + text if self._half else text
        try:
            written = os.write(port.fileno(), text)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise RigError(f"{self._name}: the amplifier is gone ({error.strerror}); see to its cable") from error
        self._half = written < len(text)
        self._written_s = time.monotonic()

    # ---- the reader's thread

    @realtime_priority(Priority.DEVICE)  # what it reads is stamped on arrival
    def _read(self) -> None:
        assert self._port is not None
        descriptor, rest = self._port.fileno(), b""
        while not self._closing:
            try:
                if not select.select([descriptor], [], [], 0.05)[0]:
                    continue
                received = os.read(descriptor, 4096)
            except BlockingIOError:
                continue
            except OSError:
                received = b""
            if not received:
                if os.isatty(descriptor):  # the guardian, which has the same port, was faster
                    continue
                self._fault = f"{self._name}: the amplifier is gone; see to its cable"
                return
            arrival_ns = time.monotonic_ns()
            *lines, rest = (rest + received).split(b"\n")
            rest = rest[-256:]
            for text in lines:
                self._heard_s = self._heard_s or 1e-9
                answer = reply(text)
                if answer is not None:
                    self._hear(answer, arrival_ns)

    def _hear(self, answer: Reply, arrival_ns: int) -> None:
        self._heard_s = seconds(arrival_ns)
        measured = telemetry(answer, self._coils.count)
        sent_ns, field = self._sent.pop(answer.number, (0, False))
        if measured is not None and sent_ns:
            self._measured.append((measured, sent_ns, arrival_ns))
            if measured.measured_a is not None:
                self._read_back = Measured(arrival_ns, measured.measured_a, measured.currents_a)
            return
        if answer.verb == "E" and field:
            why = "no line reached it in time" if "timer" in answer.words else _words(answer)
            self._fault = f"{self._name}: the amplifier has gone to zero by itself ({why}); the run ends"
        with self._answered:
            self._zeros += answer.verb == "Z"
            self._replies.append(answer)
            self._answered.notify_all()

    # ---- the log

    def _take(self, now: Telemetry, sent_ns: int, arrival_ns: int) -> None:
        """Add an answer to the log, and the mean of the time between the last answer and this one."""
        if now is self._no_field:
            self._append(sent_ns, now)
            self._before = None
            return
        self._round_trip_ns = min(self._round_trip_ns, arrival_ns - sent_ns)
        self._fit = fit = self._clock.take(self._fit, now.clock_us, arrival_ns)
        if not fit.good:
            return
        stamp_ns = fit.stamp_ns - round(0.5 * self._round_trip_ns)
        if self._before is not None:
            since_ns, before = self._before
            stamp_ns = max(stamp_ns, since_ns + 1)
            x, y = (_TURNS * _signed_difference(a - b) for a, b in zip(now.turns, before.turns, strict=True))
            per_s = math.hypot(x, y) / seconds(stamp_ns - since_ns)
            heading = math.atan2(y, x) if per_s > 0.0 else before.heading_rad
            amplitude = before.amplitude_mt if before.amplitude_mt > 0.0 or per_s == 0.0 else now.amplitude_mt
            self._log.append(since_ns, per_s, heading, amplitude, before.currents_a)
        self._append(stamp_ns, now)
        self._before = (stamp_ns, now)

    def _append(self, stamp_ns: int, now: Telemetry) -> None:
        self._log.append(
            not_before(self._log, stamp_ns), now.frequency_hz, now.heading_rad, now.amplitude_mt, now.currents_a
        )


def _signed_difference(difference: int) -> int:
    """A difference of two counters that wrap at 2^32."""
    return (difference + _WRAP // 2) % _WRAP - _WRAP // 2


def _words(answer: Reply | None) -> str:
    return " ".join((answer.verb, *answer.words)) if answer is not None else "no answer"


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [repr(error)])[0]
