"""One run that is stopped: `python -m tests.perf.stop_trial KIND OUT LOG [key=value ...]`, in a process of its own.

The rig is the simulated one, in real time, with a driver that writes a line for all that it is told:
`time_s thread event amplitude_mt`, with the time of CLOCK_MONOTONIC, which all processes share. KIND names a fault of
RIGS or STAGES, begun at the tick AT of the run, or `none`. The run is the command `flowrec record --realtime`.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from flowrec.core import Currents, RigError
from flowrec.rigs import SimulatedRig
from flowrec.rigs.simulated import rig as simulated
from flowrec.run import loop
from flowrec.stages import Inputs
from flowrec.verbs import cli
from flowrec.verbs import mission_run as verb
from tests.short_missions import SMALL, set_words

AT = 40
SETS = [*SMALL, "camera.rate_hz=60"]


class Log:
    """What the driver did, each line in the file before the call returns."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def __call__(self, event: str, amplitude_mt: float = 0.0) -> None:
        line = f"{time.monotonic():.6f} {threading.current_thread().name.replace(' ', '-')} {event} {amplitude_mt:g}\n"
        os.write(self._file, line.encode())


class LoggedRig(SimulatedRig):
    """The simulated rig with a driver log. Faults replace `arrived` and `switch_off`."""

    log: Callable[..., None]

    def arrived(self, number: int, inputs: Inputs) -> Inputs:
        """What the camera makes of its frame of this number."""
        return inputs

    def switch_off(self) -> None:
        """What the amplifier does for zero()."""

    def inputs(self) -> Iterator[Inputs]:
        for number, inputs in enumerate(super().inputs()):
            yield self.arrived(number, inputs)

    def apply(self, currents: Currents) -> None:
        refused = getattr(self, "_cut", False) and currents.amplitude_mt > 0.0
        self.log("refused" if refused else "apply", currents.amplitude_mt)
        super().apply(currents)

    def zero(self) -> None:
        self.log("zero-begins")
        self.switch_off()
        super().zero()
        self.log("zero")


def _stuck_in_c() -> None:
    """Never return, in C without the interpreter's lock: no signal interrupts a mutex that is locked twice."""
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(128)
    libc.pthread_mutex_lock(mutex)
    libc.pthread_mutex_lock(mutex)


def _for_ever() -> None:
    while True:
        pass


def _raise() -> None:
    raise ValueError("a stage that fails")


class _Raising(LoggedRig):
    """An amplifier whose zero() is refused a few times."""

    refusals = 5

    def switch_off(self) -> None:
        if self.refusals:
            self.refusals -= 1
            self.log("zero-raises")
            raise RigError("the amplifier does not answer")


class _Slow(LoggedRig):
    """An amplifier whose zero() takes 30 ms."""

    def switch_off(self) -> None:
        time.sleep(0.03)


class _CameraFault(LoggedRig):
    """A camera that does something else from the frame AT on."""

    fault: Callable[[], None] = staticmethod(lambda: None)

    def arrived(self, number: int, inputs: Inputs) -> Inputs:
        if number == AT:
            self.log("cause")
            self.fault()
        return inputs


class _CameraInC(_CameraFault):
    fault = staticmethod(_stuck_in_c)


class _CameraLate(_CameraFault):
    fault = staticmethod(lambda: ctypes.CDLL(None).usleep(1_400_000) and None)


class _CameraWaits(_CameraFault):
    fault = staticmethod(lambda: time.sleep(1e6))


class _Frozen(LoggedRig):
    """A camera that repeats its image, with stamps that grow."""

    _image: np.ndarray | None = None

    def arrived(self, number: int, inputs: Inputs) -> Inputs:
        assert inputs.frame is not None
        if number < AT:
            self._image = inputs.frame.image
            return inputs
        if number == AT:
            self.log("cause")
        return replace(inputs, frame=replace(inputs.frame, image=self._made(self._image)))

    def _made(self, image: np.ndarray | None) -> np.ndarray:
        assert image is not None
        return image.copy()


class _Black(_Frozen):
    """A camera whose images are black."""

    def _made(self, image: np.ndarray | None) -> np.ndarray:
        return np.zeros_like(image)


RIGS: dict[str, type[LoggedRig]] = {
    "camera-in-c": _CameraInC,
    "camera-late": _CameraLate,
    "camera-waits": _CameraWaits,
    "camera-frozen": _Frozen,
    "camera-black": _Black,
    "zero-raises": _Raising,
    "zero-slow": _Slow,
}
STAGES: dict[str, Callable[[], None]] = {"stage-raises": _raise, "stage-for-ever": _for_ever, "stage-in-c": _stuck_in_c}


def main(kind: str, out: str, log_path: str, *sets: str) -> None:
    for one in (signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):  # whoever starts this may run under nohup
        signal.signal(one, signal.SIG_DFL)
    log = Log(Path(log_path))
    LoggedRig.log = staticmethod(log)
    simulated.SimulatedRig = RIGS.get(kind, LoggedRig)  # type: ignore[misc]
    step, record, ticks = loop.step, verb.run_mission, iter(range(1 << 30))

    def failing(*arguments: object) -> object:
        if next(ticks) == AT:
            log("cause")
            STAGES[kind]()
        return step(*arguments)  # type: ignore[arg-type]

    def logged(*arguments: object, **named: object) -> object:
        try:
            return record(*arguments, **named)  # type: ignore[arg-type]
        finally:
            log("returns")

    if kind in STAGES:
        loop.step = failing  # type: ignore[assignment]
    verb.run_mission = logged  # type: ignore[assignment]
    words = set_words((*SETS, *sets))
    sys.argv = ["flowrec", "record", "--realtime", "--out", out, *words]
    cli.main()


if __name__ == "__main__":
    main(*sys.argv[1:])
