"""Blocks of output samples of the rotating field, continuous from block to block, for whatever device."""

from __future__ import annotations

from dataclasses import dataclass, replace

from flowrec.core import Floats
from flowrec.rigs.lab.amplifiers.limits import CommandLimits
from flowrec.stages import FieldCommand, FieldState, MotionSegment, field_motion


@dataclass(frozen=True, slots=True)
class Block:
    """Samples at a constant command.

    Attributes
    ----------
    currents_a : (n + 1, coils) at the samples, and at the first one of the next block.
    voltages_v : (n, coils) held from sample to sample.
    segments : how the robot travels meanwhile; amplitude_mt : of the field in the middle.
    """

    currents_a: Floats
    voltages_v: Floats
    segments: tuple[MotionSegment, ...]
    amplitude_mt: float


class Waveform:
    """The field as samples. Its phase is accumulated, so a command changes the frequency but never the phase.

    Parameters
    ----------
    limits : every block is checked by them.
    output_hz : sample rate as the device has it, which may differ from the one asked for.
    """

    def __init__(self, limits: CommandLimits, output_hz: float) -> None:
        coils = limits.coils
        self._coils = replace(coils, amplifier=replace(coils.amplifier, output_hz=output_hz))
        self._limits = limits
        self._state = FieldState()

    @property
    def amplitude_mt(self) -> float:
        """Amplitude at the end of the last block."""
        return self._state.amplitude_mt

    def block(self, command: FieldCommand, count: int) -> Block:
        """The next samples.

        Raises
        ------
        RigError : a sample is beyond a limit; none of the block may be put out.
        """
        duration_s = count / self._coils.amplifier.output_hz
        motion = field_motion(self._state, command)
        currents, voltages = self._coils.output_samples(self._state, command, count)
        self._limits.check_samples(currents, voltages)
        block = Block(currents, voltages, motion.segments(duration_s), float(motion.amplitude(0.5 * duration_s)))
        self._state = motion.after(duration_s)
        return block
