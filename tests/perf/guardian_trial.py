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

from flowrec.core.errors import RigError
from flowrec.core.messages import Currents
from flowrec.core.system.processes import realtime_priority
from flowrec.physics.robot import Robot
from flowrec.rigs.lab.amplifiers.amplifier import Amplifier
from flowrec.rigs.lab.amplifiers.limits import CommandLimits
from flowrec.rigs.lab.drive import BEAT_S, Drive
from flowrec.stages.control.coils import Coils
from flowrec.stages.rig_settings import OutputLimits
from tests.twins.coils import CHANNELS

COILS = Coils(bias_mt=(0.05, 0.0, -0.04))
ROBOT = Robot(radius_um=50.0, max_speed_um_s=500.0, step_out_hz=30.0)
OUTPUT = OutputLimits()
_FRAME_S = 1.0 / 60.0


def amplifier(kind: str, address: str, silence_s: float = 0.1) -> Amplifier:
    """The amplifier of a twin."""
    if kind == "serial":
        from flowrec.rigs.lab.amplifiers.serial_line import SerialAmplifier

        return SerialAmplifier(address, 115_200, COILS)
    from flowrec.rigs.lab.amplifiers.ni import NiAmplifier
    from flowrec.rigs.lab.amplifiers.ni_process import NiSettings

    return NiAmplifier(NiSettings(CHANNELS, address, COILS, ROBOT, OUTPUT, silence_s))


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


def record(say: Callable[[str], None], kind: str, address: str, silence_s: float, fault: str) -> None:
    """Drive the coils until it is killed."""
    with Drive(amplifier(kind, address, silence_s), CommandLimits(COILS, ROBOT, OUTPUT, say), silence_s, 1.0) as drive:
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
            if not said and applied.amplitude_mt >= 3.999:
                say("on")
                said = True
                faulty_s = time.monotonic() + 0.2
            if said and fault and time.monotonic() > faulty_s:
                say(f"fault {time.monotonic_ns()}")
                if fault == "hang":
                    ctypes.PyDLL(None).usleep(3_000_000)
                while fault == "spin":
                    pass


def main(connection: Connection, kind: str, address: str, silence_s: float, fault: str) -> None:
    """The process; it says on the connection what the module's docstring states."""
    try:
        with realtime_priority():  # as flowrec record has it
            record(connection.send, kind, address, silence_s, fault)
    except RigError as error:
        connection.send(f"failed {error}")
