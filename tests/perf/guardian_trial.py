"""A recorder with its coils on, until something is done to it: `guardian_trial KIND ADDRESS SILENCE_S [FAULT]`.

It prints `on` when the field is at its full amplitude, and `failed TEXT` when the coils are lost. FAULT `hang` makes it
keep the interpreter's lock in C from then on, `spin` makes it compute without an end, both after printing the time.
"""

from __future__ import annotations

import ctypes
import sys
import time

import numpy as np

from flowrec.control.coils import Coils
from flowrec.errors import RigError
from flowrec.messages import Currents
from flowrec.rig_settings import OutputLimits
from flowrec.rigs.lab.amplifiers.amplifier import Amplifier
from flowrec.rigs.lab.amplifiers.limits import Limits
from flowrec.rigs.lab.drive import BEAT_S, Drive
from flowrec.robot import Robot
from flowrec.system.processes import realtime_priority

COILS = Coils(bias_mt=(0.05, 0.0, -0.04))
ROBOT = Robot(radius_um=50.0, max_speed_um_s=500.0, step_out_hz=30.0)
OUTPUT = OutputLimits()
CHANNELS = "cDAQ1Mod1/ao0:2"
_FRAME_S = 1.0 / 60.0


def amplifier(kind: str, address: str, silence_s: float = 0.1) -> Amplifier:
    """The amplifier of a twin."""
    if kind == "serial":
        from flowrec.rigs.lab.amplifiers.serial_line import SerialAmplifier

        return SerialAmplifier(address, 115_200, COILS)
    from flowrec.rigs.lab.amplifiers.ni import NiAmplifier
    from flowrec.rigs.lab.amplifiers.ni_process import Settings

    return NiAmplifier(Settings(CHANNELS, address, COILS, ROBOT, OUTPUT, silence_s))


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


def main(kind: str, address: str, silence_s: str, fault: str = "") -> None:
    """See above."""
    limits = Limits(COILS, ROBOT, OUTPUT, lambda text: print(text, flush=True))
    with Drive(amplifier(kind, address, float(silence_s)), limits, float(silence_s), 1.0) as drive:
        print("guardian", drive._guardian._process.pid, flush=True)
        if kind == "ni":
            print("process", drive._amplifier._process.pid, flush=True)
        number, said, before_ns = 0, False, None
        while True:
            drive.apply(currents(8.0 + 6.0 * np.sin(0.05 * number), 0.02 * number))
            end_s = time.monotonic() + _FRAME_S
            while (left_s := end_s - time.monotonic()) > 0.0:
                time.sleep(min(left_s, BEAT_S))
                drive.beat()
            number += 1
            now_ns = time.monotonic_ns()
            applied = drive.applied(now_ns, before_ns)
            before_ns = now_ns
            if not said and applied.amplitude_mt >= 3.999:
                print("on", flush=True)
                said = True
                faulty_s = time.monotonic() + 0.2
            if said and fault and time.monotonic() > faulty_s:
                print("fault", time.monotonic_ns(), flush=True)
                if fault == "hang":
                    ctypes.PyDLL(None).usleep(3_000_000)
                while fault == "spin":
                    pass


if __name__ == "__main__":
    try:
        with realtime_priority():  # as flowrec record has it
            main(*sys.argv[1:])
    except RigError as error:
        print("failed", error, flush=True)
