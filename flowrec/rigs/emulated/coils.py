"""An emulated amplifier: the firmware of the package, compiled for this computer, behind a pseudo terminal.

A recorder finds a serial port with a board behind it. What the board puts out goes to a file of samples, from which an
emulated world moves its robot.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import flowrec
from flowrec.core import Floats, Ints, RigError

FIRMWARE = Path(flowrec.__file__).parent / "rigs/lab/amplifiers/firmware"
SKETCH = FIRMWARE / "flowrec_coils/flowrec_coils.ino"
FULL_A = 5.0  # of the outputs
_COMPUTER = FIRMWARE / "on_a_computer"
_COMPILERS = ("g++", "clang++", "c++")
# Pins of more coils than the board that the firmware is written for has; a sensor of each coil.
_PINS = {3: (), 6: ("-DPWM_PINS=2,3,4,5,6,7", "-DDIR_PINS=8,9,10,11,12,13")}
_SENSORS = {3: "0,1,2", 6: "0,1,2,3,4,5"}
_SAID = 300  # letters of what a compiler prints


@dataclass(frozen=True)
class OutputSamples:
    """A file of samples of the outputs, which grows."""

    file: Path  # records of `sample`, one for each change of the outputs
    a_per_unit: float = FULL_A  # current of a coil in A for one unit in the file
    coils: int = 3  # their number

    @property
    def sample_bytes(self) -> int:
        """Length of a record of the file."""
        return sample(self.coils).itemsize

    def end(self) -> int:
        """The byte of the file from which on the samples to come are."""
        return self.file.stat().st_size // self.sample_bytes * self.sample_bytes

    def outputs(self, from_byte: int = 0) -> tuple[Ints, Floats]:
        """(n,) times on CLOCK_MONOTONIC in ns, and (n, coils) currents in A from each time on."""
        with self.file.open("rb") as stream:
            stream.seek(from_byte)
            data = stream.read()
        found = np.frombuffer(data[: len(data) // self.sample_bytes * self.sample_bytes], sample(self.coils))
        return found["at_ns"], found["coils"] * self.a_per_unit


@dataclass(frozen=True)
class EmulatedBoard:
    """A running board: the name of its port, its outputs, and its process."""

    port: str
    samples: OutputSamples
    process: subprocess.Popen[str]


def sample(coils: int = 3) -> np.dtype[np.void]:
    """A record of the file of the outputs: time on CLOCK_MONOTONIC in ns, and the coils in parts of the full scale."""
    return np.dtype([("at_ns", "<i8"), ("coils", "<f8", coils)])


def compiler() -> str | None:
    """The C++ compiler of this computer; None: there is none."""
    return next((found for name in _COMPILERS if (found := shutil.which(name)) is not None), None)


def compiled_firmware(folder: Path, timer_ms: int = 100, coils: int = 3, *, sensors: bool = False) -> Path:
    """The board as a program in a folder, where it is kept. With `timer_ms` = 0 it does not go to zero by itself.

    Boards have 3 or 6 coils, and with `sensors` they measure their currents. Raises RigError: there is no compiler, or
    it refuses.
    """
    program = folder / f"board{timer_ms}_{coils}_{sensors}"
    if program.exists():
        return program
    found = compiler()
    if found is None:
        raise RigError("the emulated amplifier is the firmware, compiled: no C++ compiler here; sudo apt install g++")
    made = program.with_name(f"{program.name}.{os.getpid()}")
    options = ["-Wall", "-Wextra", "-Werror", "-O1", f"-DTIMER_MS={timer_ms}", "-DPWM_FULL=1000000", f"-I{_COMPUTER}"]
    options += [*_PINS[coils], f"-DTWIN_COILS={coils}", "-DSENSE_ZERO=1000000", "-DSENSE_UA=5L"]
    options += [f"-DSENSE_PINS={_SENSORS[coils]}"] if sensors else []
    files: list[str | Path] = ["-include", _COMPUTER / "Arduino.h", "-x", "c++", SKETCH, _COMPUTER / "arduino.cpp"]
    command: list[str | Path] = [found, *options, *files, "-o", made]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own firmware
    if done.returncode:
        said = " ".join(done.stderr.split())[:_SAID]
        raise RigError(f"{found} can not compile the firmware of the emulated amplifier: {said}")
    made.rename(program)
    return program


@contextmanager
def emulated_board(program: Path, file: Path, coils: int = 3, fault: Path | None = None) -> Iterator[EmulatedBoard]:
    """The firmware behind a pseudo terminal, in real time; `file` gets the samples of its outputs.

    While there is a file `fault`, the first coil has half of its current.
    """
    env = os.environ | ({"TWIN_FAULT": str(fault)} if fault else {})
    command: list[str | Path] = [program, "pty", file]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as process:  # noqa: S603 - compiled above
        try:
            assert process.stdout is not None
            yield EmulatedBoard(process.stdout.readline().strip(), OutputSamples(file, coils=coils), process)
        finally:
            process.kill()
