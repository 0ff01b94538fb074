"""The interface of an amplifier, and the table of amplifiers.

A rig never uses a row of the table directly, but through rigs/lab/drive.py, which puts the limits and the guardian
above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from flowrec.stages import FieldCommand, FieldLog

KEEP_S = 120.0  # of the log of an output


def not_before(log: FieldLog, stamp_ns: int) -> int:
    """The stamp of the next row of a log: this one, or that of the last row, if it is later."""
    return max(stamp_ns, int(log.times_ns[-1])) if len(log) else stamp_ns


@dataclass(frozen=True, slots=True)
class AmplifierInfo:
    """Properties that an amplifier reports when it is opened.

    Attributes
    ----------
    model, serial : as the device states them; serial '' if it has none.
    max_current_a : largest current of a coil that the device makes; inf where it only knows voltages.
    max_voltage_v : largest output voltage; inf where it only knows currents.
    max_output_hz : highest rate of its output samples.
    latency_s : from `apply` to the output, as configured; the field log holds what was measured.
    timer_s : silence after which the device itself goes to zero; 0: it holds its last output for ever.
    measures : it measures the currents, and has a method `read_back() -> Measured | None`: the latest measurement, with
        its stamp on the host's monotonic clock; None: there is none yet.
    """

    model: str
    serial: str
    max_current_a: float
    max_voltage_v: float
    max_output_hz: float
    latency_s: float
    timer_s: float
    measures: bool = False


class Amplifier(Protocol):
    """The amplifiers of all coils behind one device. No method but `open`, `zero` and `close` blocks."""

    def open(self) -> AmplifierInfo:
        """Find the device and take its outputs to zero. It stays disarmed: no command makes a field.

        Raises
        ------
        RigError : no device, a busy one, or another device than expected; one line.
        """

    def guard(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Arguments and open file descriptors with which the guardian process takes this output to zero.

        An amplifier of another package returns ("call", "module:function", *words): see lab/guardian.py.
        """

    def arm(self) -> None:
        """Let commands make a field from now on; until `zero`, or until the guardian or the device takes it away.

        Raises
        ------
        RigError : the device refuses.
        """

    def apply(self, command: FieldCommand) -> None:
        """Put out a field from the next output sample on; a command that is repeated keeps the device awake.

        Raises
        ------
        RigError : the device is gone, or has taken its output to zero by itself.
        """

    def put_out(self, until_ns: int) -> FieldLog:
        """Log of the field that was put out up to a time of the host's monotonic clock, with the latency in it."""

    def zero(self) -> None:
        """Take the output to zero now and disarm. Any thread, at any time, also during `apply`; repeats are harmless.

        Raises
        ------
        RigError : the device does not confirm it.
        """

    def close(self) -> None:
        """Release the device; the output is at zero."""
