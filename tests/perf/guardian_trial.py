"""A recorder with its coils on, until something is done to it.

It says `on` when the field is at its full amplitude, and `failed TEXT` when the coils are lost. The fault `hang` makes
it keep the interpreter's lock in C from then on, `spin` makes it compute without an end, both after saying the time.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

from flowrec.core import Currents, RigError, realtime_priority
from flowrec.physics import Robot
from flowrec.rigs import CommandLimits
from flowrec.rigs.lab.amplifiers.amplifier import Amplifier
from flowrec.rigs.lab.drive import BEAT_S, Drive
from flowrec.stages import Coils, OutputLimits
from tests.twins.coils import channels, sense_channels

COILS = Coils(bias_mt=(0.05, 0.0, -0.04))
# Three pairs that are not quite alike. At 2.1 A currents of least norm make 3.73 mT in any direction; 4 are possible.
SIX_COILS = Coils(
    mt_per_a=((1.3, 0.8, 0.1, -0.1, 0.05, 0.0), (0.1, -0.05, 0.9, 1.1, 0.0, 0.1), (0.0, 0.1, -0.05, 0.05, 1.0, 1.1)),
    bias_mt=(0.05, 0.0, -0.04),
    max_current_a=2.1,
)
ROBOT = Robot(radius_um=50.0, max_speed_um_s=500.0, step_out_hz=30.0)
OUTPUT = OutputLimits()
_FRAME_S = 1.0 / 60.0


def coils_of(count: int) -> Coils:
    """The settings of so many coils."""
    return COILS if count == COILS.count else SIX_COILS


def amplifier(
    kind: str, address: str, silence_s: float = 0.1, coils: Coils = COILS, *, sensors: bool = False
) -> Amplifier:
    """The amplifier of a twin; with `sensors` the inputs of an NI twin are read, too."""
    if kind == "serial":
        from flowrec.rigs.lab.amplifiers.serial_line import SerialAmplifier

        return SerialAmplifier(address, 115_200, coils)
    from flowrec.rigs.lab.amplifiers.ni import NiAmplifier
    from flowrec.rigs.lab.amplifiers.ni_process import NiSettings

    inputs = sense_channels(coils.count) if sensors else ""
    return NiAmplifier(NiSettings(channels(coils.count), address, coils, ROBOT, OUTPUT, silence_s, inputs))


def currents(frequency_hz: float, heading_rad: float, amplitude_mt: float = 4.0) -> Currents:
    """A command of the loop."""
    return Currents(
        stamp_ns=time.monotonic_ns(),
        frequency_hz=frequency_hz,
        heading_rad=heading_rad,
        amplitude_mt=amplitude_mt,
        phase_rad=0.0,
        currents_a=np.zeros(3),
        saturated=False,
        limit_hz=27.0,
    )


def record(say: Callable[[str], None], kind: str, address: str, silence_s: float, fault: str, count: int) -> None:
    """Drive the coils until it is killed."""
    coils = coils_of(count)
    limits = CommandLimits(coils, ROBOT, OUTPUT, say)
    with Drive(amplifier(kind, address, silence_s, coils), limits, silence_s, 1.0) as drive:
        say(f"guardian {drive._guardian._process.pid}")
        if kind == "ni":
            say(f"process {drive._amplifier._process.pid}")
        number, said, before_ns = 0, False, None
        while True:
            drive.apply(currents(8.0 + 6.0 * np.sin(0.05 * number), 0.02 * number))
            end_s = time.monotonic() + _FRAME_S
            while (left_s := end_s - time.monotonic()) > 0.0:
                time.sleep(min(left_s, BEAT_S))
                drive.beat()
            number += 1
            now_ns = time.monotonic_ns()
            applied = drive.applied_at(now_ns, before_ns)
            before_ns = now_ns
            if not said and applied.amplitude_mt >= 0.999 * limits.amplitude_mt:
                say("on")
                said = True
                faulty_s = time.monotonic() + 0.2
            if said and fault and time.monotonic() > faulty_s:
                say(f"fault {time.monotonic_ns()}")
                if fault == "hang":
                    ctypes.PyDLL(None).usleep(3_000_000)
                while fault == "spin":
                    pass


def main(connection: Connection, kind: str, address: str, silence_s: float, fault: str, count: int = 3) -> None:
    """The process; it says on the connection what the module's docstring states."""
    try:
        with realtime_priority():  # as flowrec record has it
            record(connection.send, kind, address, silence_s, fault, count)
    except RigError as error:
        connection.send(f"failed {error}")
