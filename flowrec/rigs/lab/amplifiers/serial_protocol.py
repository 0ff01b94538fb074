"""The line protocol of flowrec-coils, version 1. firmware/README.md describes it for those who write a firmware.

A line is a verb and decimal integers, '*', and the CRC-16 (CCITT-FALSE) of what stands before it, as four hexadecimal
digits. Only 'Z' needs no checksum. Units: mHz, uT, uA, 1e-6 revolutions, us.
"""

from __future__ import annotations

import binascii
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats
from flowrec.stages import Coils, FieldCommand, field_limits

ZERO = b"\nZ\n"  # the newline ends a line that its writer may have left half written
VERSION = 1  # of the protocol; a board with another one is refused
_MILLION = 1_000_000  # revolutions and amperes are integers, in millionths
_INT32 = 2**31 - 1  # largest integer that a controller reads


@dataclass(frozen=True, slots=True)
class Reply:
    """A line of the firmware: the verb of the line that it answers, or E; its number, -1 if there is none; the rest."""

    verb: str
    number: int
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Output that the firmware reports for a time of its clock."""

    clock_us: int  # wraps at 2^32
    frequency_hz: float
    heading_rad: float  # direction in which the robot travels
    amplitude_mt: float
    turns: tuple[int, int]  # 1e-6 revolutions along x and y since the board started; wrap at 2^32
    currents_a: Floats  # (coils,)
    measured_a: Floats | None = None  # (coils,), by a board with sensors


def line(verb: str, number: int, *numbers: int) -> bytes:
    """A line for the firmware."""
    body = " ".join([verb, str(number), *map(str, numbers)]).encode()
    return body + b"*%04X\n" % _crc(body)


def reply(received: bytes) -> Reply | None:
    """Parse a received line; None: it is damaged, or of no flowrec-coils firmware."""
    body, star, crc = received.strip().rpartition(b"*")
    if not star or not body.strip() or crc != b"%04X" % _crc(body):
        return None
    verb, *words = body.decode("ascii", "replace").split()
    number = int(words[0]) if words and words[0].isdigit() else -1
    return Reply(verb, number, tuple(words[1:]))


def telemetry(answer: Reply, coils: int) -> Telemetry | None:
    """The telemetry of so many coils in a reply; None: it has none."""
    if answer.verb != "F":
        return None
    try:
        clock, mhz, heading, ut, _phase, _plane, x, y, *currents = (int(word) for word in answer.words)
    except ValueError:
        return None
    if len(currents) not in (coils, 2 * coils):
        return None
    heading_rad = heading / _MILLION * math.tau
    put_out_a = np.array(currents[:coils]) / _MILLION
    measured_a = np.array(currents[coils:]) / _MILLION if len(currents) == 2 * coils else None
    return Telemetry(clock, 1e-3 * mhz, heading_rad, 1e-3 * ut, (x, y), put_out_a, measured_a)


def field_line(number: int, command: FieldCommand) -> bytes:
    """The line of a command. Amplitudes are rounded down."""
    ramp_ut_s = _INT32 if command.ramp_mt_s * 1e3 > _INT32 else round(command.ramp_mt_s * 1e3)
    return line(
        "F",
        number,
        round(command.frequency_hz * 1e3),
        round(command.heading_rad / math.tau * _MILLION) % _MILLION,
        math.floor(command.amplitude_mt * 1e3 + 1e-6),
        round(command.limit_hz * 1e3),
        ramp_ut_s,
    )


def configuration(coils: Coils) -> Sequence[tuple[str, tuple[int, ...]]]:
    """Verbs and numbers that tell the firmware its coils: currents of three unit fields and of the bias, limits."""
    up = coils.field_mt(0.0, 0.0, 1.0)
    along, beside = (coils.field_mt(0.5 * math.pi, plane, 1.0) for plane in (0.0, 0.5 * math.pi))
    limits = field_limits(coils)
    vectors = [*(limits.inverse @ field for field in (up, along, beside)), limits.bias_a]
    return [
        *(("V", (n, *(round(value * _MILLION) for value in vector))) for n, vector in enumerate(vectors)),
        ("L", (math.floor(coils.max_current_a * _MILLION), max(round(coils.fade_mt * 1e3), 1))),
    ]


def _crc(body: bytes) -> int:
    return binascii.crc_hqx(body, 0xFFFF)
