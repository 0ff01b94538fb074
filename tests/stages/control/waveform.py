"""What the outputs play between two commands: field, currents and voltages, sample by sample.

A state goes in and the state at the end comes out, nothing is kept: two blocks on end are the same as one of twice
the length. A block runs from its first sample to just before the next block's first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Currents
from flowrec.stages import Coils, FieldCommand, FieldState, field_motion

BLOCK_S = 0.01  # of a buffered output: two of them queued make 20 ms of the delay from command to motion


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Samples of the outputs at the amplifier's output_hz, and the field where they end."""

    field_mt: NDArray[np.float64]  # (n, 3) of the coils, with the bias compensated
    currents_a: NDArray[np.float64]  # (n, 3)
    voltages_v: NDArray[np.float64]  # (n, 3) each held until the next sample
    after: FieldState  # at the first sample of the next block


def block(coils: Coils, state: FieldState, order: FieldCommand, count: int) -> Block:
    """`count` samples from a state on, under an order."""
    way, rate = field_motion(state, order), coils.amplifier.output_hz
    time = np.arange(count) / rate
    currents, voltages = coils.output_samples(state, order, count)
    field = coils.field_mt(way.phase(time), way.plane(time), way.amplitude(time))
    return Block(field, currents[:-1], voltages, way.after(count / rate))


def tail(coils: Coils, state: FieldState, order: FieldCommand) -> Block:
    """The way to nothing: the field goes on turning while its amplitude ramps down; the last sample is zero volts.

    For a stop, and to follow the last block that was ordered: whoever feeds the outputs queues it as soon as no next
    block is there in time, so that a process that has died leaves no field.
    """
    still = replace(order, amplitude_mt=0.0, ramp_mt_s=coils.ramp_mt_s)
    # One more than the ramp has, for when rounding would leave a little of it; rounding does not take it away.
    count = math.floor(state.amplitude_mt / coils.ramp_mt_s * coils.amplifier.output_hz * (1.0 + 1e-12)) + 1
    down = block(coils, state, still, count)
    nothing = np.zeros((1, 3))
    return Block(
        np.concatenate([down.field_mt, nothing]),
        np.concatenate([down.currents_a, nothing]),
        np.concatenate([down.voltages_v, nothing]),
        down.after,
    )


def outputs(coils: Coils, state: FieldState, currents: Currents, block_s: float = BLOCK_S) -> Block:
    """The next block under a command; its voltages (n, 3) are what a card's buffer takes.

    The command may have been given for any earlier state: the field goes to it from the one it is in, and a weaker
    one than `limit_hz` was meant for turns no faster than it can be followed.
    """
    asked = coils.state_and_command(currents)[1]
    share = min(state.amplitude_mt / asked.amplitude_mt, 1.0) if asked.amplitude_mt > 0.0 else 1.0
    limit_hz = asked.limit_hz * share
    order = replace(asked, limit_hz=limit_hz, frequency_hz=min(asked.frequency_hz, limit_hz))
    return block(coils, state, order, round(block_s * coils.amplifier.output_hz))
