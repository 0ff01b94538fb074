"""The coils of a lab's rig: limits, guardian and amplifier as one, so that no command reaches an amplifier past them.

    with Drive.of(config) as drive:        # device found, limits checked, guardian started; nothing is energised
        for frame in ...:                  # while it waits for a frame, the loop calls drive.beat() every BEAT_S
            applied = drive.applied_at(stamp_ns, previous_stamp_ns)
            drive.apply(currents)

Times are those of the host's monotonic clock.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from flowrec.core import Applied, Currents, Measured, RigError, UsageError, nanoseconds, seconds
from flowrec.rigs.lab.amplifiers.amplifier import Amplifier, AmplifierInfo
from flowrec.rigs.lab.amplifiers.limits import CommandLimits, ReadBack
from flowrec.rigs.lab.guardian import ONLY_HARDWARE, Guardian
from flowrec.stages import AMPLIFIERS, FieldCommand, FieldLog

if TYPE_CHECKING:
    from flowrec.stages import ResolvedConfig  # with every stage: this module starts without them

_NOTABLE = 0.05  # relative change of the frequency by which a command can be told from that before it
_SAME = 0.02  # likewise, within which a field is that of the command
_STAMP_ERROR_S = 1e-3  # of the log of the outputs
_AWAITED_S = 1.0  # a command that has not taken effect by then was replaced by another one
BEAT_S = 0.02  # between beats, at most, while the loop waits for a frame
_REST = FieldCommand()


class Drive:
    """Coils of a lab.

    Only `zero` and `let_go` may be called in another thread than the loop's.

    Parameters
    ----------
    amplifier : closed.
    limits : of every command.
    silence_s : of the guardian.
    patience_s : longest time from one command to the next while a field is on. A loop that only waits stops to beat.
    guardian : makes the guardian, not yet entered.
    clock : monotonic time in s.

    Attributes
    ----------
    info : what the amplifier says of itself, inside of the context.
    field_ms : from the latest command of another frequency to the field that it asks for, by the log of the outputs;
        None before there was one.
    """

    @classmethod
    def of(cls, config: ResolvedConfig, tell: Callable[[str], None] = lambda _text: None) -> Self:
        """The coils of a configuration; `tell` is called with one line when a command is changed."""
        limits = CommandLimits(config.coils, config.robot, config.lab.output, tell)
        silence_s, patience_s = config.lab.guardian_s, config.safety.guard_timeout_s + config.lab.guardian_s
        return cls(AMPLIFIERS[config.lab.amplifier].load().of(config), limits, silence_s, patience_s)

    info: AmplifierInfo

    def __init__(
        self,
        amplifier: Amplifier,
        limits: CommandLimits,
        silence_s: float,
        patience_s: float,
        guardian: Callable[..., Guardian] = Guardian,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._make_guardian, self._clock = guardian, clock
        self._amplifier, self._limits = amplifier, limits
        self._silence_s, self._patience_s = silence_s, patience_s
        self._stack = ExitStack()
        self._guardian: Guardian | None = None
        self._taken_away = False  # by zero(), in any thread: one attribute, no lock
        self._let_go = False  # by let_go(), likewise
        self._command = _REST
        self._commanded_s = self._on_until_s = 0.0
        self._read_back = ReadBack(None, 0.0)
        self._accounted: tuple[int, int, np.ndarray] | None = None  # the last frame's times, and its turns
        self.field_ms: float | None = None
        self._awaited: tuple[int, float] | None = None  # time and frequency of a command whose field is to come

    def __enter__(self) -> Self:
        """Find the amplifier, check the limits, start the guardian. The output is at zero.

        Raises
        ------
        RigError, UsageError : one line; nothing is energised.
        """
        with ExitStack() as stack:
            self.info = self._amplifier.open()
            stack.callback(self._amplifier.close)
            self._limits.check(self.info)
            shortest_s = min(filter(None, (self._silence_s, self.info.timer_s)))
            if shortest_s < 2.0 * BEAT_S:
                raise UsageError(
                    f"lab.guardian_s or the amplifier's timer = {shortest_s:g} s: the loop beats every {BEAT_S:g} s; "
                    f"at least {2.0 * BEAT_S:g} s are needed"
                )
            made = self._make_guardian(*self._amplifier.guard(), silence_s=self._silence_s)
            self._guardian = stack.enter_context(made)
            self._amplifier.arm()
            stack.callback(self._amplifier.zero)
            self._stack = stack.pop_all()
        self._taken_away = False
        self._command, self._accounted = _REST, None
        self._read_back = ReadBack(self._limits.output.measured_within_a, self._limits.output.measured_after_s)
        self._commanded_s = self._clock()
        return self

    def __exit__(self, *error: object) -> None:
        self.zero()
        self._stack.close()
        self._guardian = None

    def apply(self, currents: Currents) -> None:
        """Send a command of the loop, held to the limits. Never waits.

        Raises
        ------
        RigError : the amplifier or the guardian has failed; the output is at zero, or its own timer takes it there.
        """
        if self._taken_away:
            return
        self._let_go = False
        now_s = self._clock()
        self._send(self._limits.admit(currents, time.monotonic_ns()), now_s)
        self._commanded_s = now_s

    def let_go(self) -> None:
        """Let the next beat take the field away, as `rest` does. Any thread."""
        self._let_go = True

    def rest(self) -> None:
        """Take the field away until the next command: while the camera is gone."""
        if not self._taken_away and self._command.amplitude_mt > 0.0:
            self._send(replace(self._limits.rest(time.monotonic_ns()), heading_rad=self._command.heading_rad))

    def beat(self) -> None:
        """Say that the loop works. To be called by the loop, and only by it, at least every BEAT_S while it waits.

        Raises
        ------
        RigError : see `apply`.
        """
        if self._let_go:
            self.rest()
        now_s = self._clock()
        if now_s - self._commanded_s <= self._patience_s or self._command.amplitude_mt == 0.0:
            self._send(self._command, now_s)

    def applied_at(self, stamp_ns: int, before_ns: int | None) -> Applied:
        """Field between two frames. Late reports on the time before correct the number of turns."""
        log = self.put_out(stamp_ns)
        self._look_for_field(log)
        result = log.applied_at(stamp_ns, before_ns)
        late = np.zeros(2)
        if self._accounted is not None and self._accounted[1] == before_ns:
            late = log.turns(*self._accounted[:2]) - self._accounted[2]
        if before_ns is not None:
            self._accounted = (before_ns, stamp_ns, result.turns)
        return replace(result, turns=result.turns + late)

    def read_back(self) -> Measured | None:
        """The latest measurement of the currents; None: there is none, or the amplifier does not measure."""
        measured: Measured | None = self._amplifier.read_back() if self.info.measures else None  # type: ignore[attr-defined]
        return measured

    def _look_for_field(self, log: FieldLog) -> None:
        """Find when the awaited command took effect, by its frequency, which differs from that before it."""
        if self._awaited is None:
            return
        sent_ns, frequency_hz = self._awaited
        first = int(np.searchsorted(log.times_ns, sent_ns - nanoseconds(_STAMP_ERROR_S)))
        there = np.abs(log.frequency_hz[first:] - frequency_hz) < _SAME * frequency_hz
        if there.any():
            self.field_ms = max(1e-6 * float(log.times_ns[first + int(np.argmax(there))] - sent_ns), 0.0)
            self._awaited = None
        elif seconds(time.monotonic_ns() - sent_ns) > _AWAITED_S:
            self._awaited = None

    def put_out(self, until_ns: int) -> FieldLog:
        """Log of the field that was put out up to a time of the host's monotonic clock."""
        return self._amplifier.put_out(until_ns)

    def zero(self) -> None:
        """Take the output to zero; until the context is entered again, no command brings a field back. Any thread.

        Raises
        ------
        RigError : neither amplifier nor guardian confirms it.
        """
        self._taken_away = True
        try:
            self._amplifier.zero()
        except RigError:
            guardian = self._guardian
            if guardian is None or not guardian.trip():
                raise

    def _send(self, command: FieldCommand, now_s: float | None = None) -> None:
        guardian = self._guardian
        assert guardian is not None, "commands are for the inside of the context"
        now_s = self._clock() if now_s is None else now_s
        command = _REST if self._taken_away else command
        before_hz = self._command.frequency_hz if self._command.amplitude_mt > 0.0 else 0.0
        changes = abs(command.frequency_hz - before_hz) > _NOTABLE * command.frequency_hz
        if self._awaited is None and command.amplitude_mt > 0.0 and changes:
            self._awaited = (time.monotonic_ns(), command.frequency_hz)
        if command.amplitude_mt > 0.0:
            self._on_until_s = float("inf")
        elif self._command.amplitude_mt > 0.0:
            self._on_until_s = now_s + self._limits.off_s + self.info.latency_s
        self._command = command
        try:
            # The guardian knows first, so that no field is on without it.
            guardian.beat(energised=now_s < self._on_until_s)
            fault = self._read_back.fault(self.read_back())
            if fault:
                raise RigError(f"{self.info.model}: {fault}")
            self._amplifier.apply(command)
        except RigError:
            with contextlib.suppress(RigError):  # the first error says what happened
                self.zero()
            raise
        if self._taken_away and command.amplitude_mt > 0.0:  # zero() came while the command was on its way
            self._amplifier.zero()


@dataclass(frozen=True, slots=True)
class CoilProbe:
    """Result of the check of the coils by `flowrec doctor`; nothing was energised for it.

    Attributes
    ----------
    info : of the amplifier.
    amplitude_mt, rotation_hz : the field that the limits permit.
    trip_s : time from a request to the guardian until the amplifier has confirmed that it is at zero.
    warnings : one line each.
    """

    info: AmplifierInfo
    amplitude_mt: float
    rotation_hz: float
    trip_s: float
    warnings: tuple[str, ...]


def probe_amplifier(config: ResolvedConfig) -> CoilProbe:
    """Open the amplifier, check the limits, start the guardian and let it take the output, which is at zero, to zero.

    Raises
    ------
    RigError, UsageError : one line.
    """
    drive = Drive.of(config)
    with drive:
        guardian = drive._guardian  # noqa: SLF001 - of this module
        assert guardian is not None
        trip_s = guardian.probe()
        limits, info = drive._limits, drive.info  # noqa: SLF001
    warnings = []
    if config.robot.delay_s < info.latency_s:
        warnings.append(
            f"robot.delay_s = {config.robot.delay_s:g}: this amplifier alone takes {info.latency_s:g} s from a command "
            "to the output; set it to that and the camera's delay"
        )
    if not info.timer_s:
        warnings.append(f"{info.model} has no timer of its own: {ONLY_HARDWARE}")
    if limits.amplitude_mt < config.coils.amplitude_mt:
        warnings.append(
            f"the coils make {limits.amplitude_mt:.3g} of coils.amplitude_mt = {config.coils.amplitude_mt:g}"
        )
    return CoilProbe(info, limits.amplitude_mt, limits.rotation_hz, trip_s, tuple(warnings))
