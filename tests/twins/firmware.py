"""The firmware of the package, compiled for this computer: behind a pseudo terminal, or by a clock of the caller."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import flowrec

SKETCH = Path(flowrec.__file__).parent / "rigs/lab/amplifiers/firmware/flowrec_coils/flowrec_coils.ino"
_SHIM = Path(__file__).parent / "arduino"
FULL_A = 5.0  # of the outputs
_PINS = {3: (), 6: ("-DPWM_PINS=2,3,4,5,6,7", "-DDIR_PINS=8,9,10,11,12,13")}
_SENSORS = {3: "0,1,2", 6: "0,1,2,3,4,5"}


def sample(coils: int = 3) -> np.dtype[np.void]:
    """A record of the file of the outputs."""
    return np.dtype([("at_ns", "<i8"), ("coils", "<f8", coils)])


def compiled(folder: Path, timer_ms: int = 100, coils: int = 3, sensors: bool = False) -> Path:
    """The twin's program. With `timer_ms` = 0 the firmware does not go to zero by itself."""
    if shutil.which("g++") is None:
        pytest.skip("needs g++")
    program = folder / f"twin{timer_ms}_{coils}_{sensors}"
    if not program.exists():
        made = program.with_name(f"{program.name}.{os.getpid()}")
        options = ["-Wall", "-Wextra", "-Werror", "-O1", f"-DTIMER_MS={timer_ms}", "-DPWM_FULL=1000000", f"-I{_SHIM}"]
        options += [*_PINS[coils], f"-DTWIN_COILS={coils}", "-DSENSE_ZERO=1000000", "-DSENSE_UA=5L"]
        options += [f"-DSENSE_PINS={_SENSORS[coils]}"] if sensors else []
        files = ["-include", _SHIM / "Arduino.h", "-x", "c++", SKETCH, _SHIM / "arduino.cpp"]
        subprocess.run(["g++", *options, *files, "-o", made], check=True)
        made.rename(program)
    return program


@dataclass
class FirmwareTwin:
    """A running twin: the name of its port, and the file of its outputs."""

    port: str
    file: Path
    process: subprocess.Popen[str]
    coils: int = 3

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) times on CLOCK_MONOTONIC in ns, and (n, coils) currents in A from each time on."""
        return read_samples(self.file, FULL_A, coils=self.coils)


def read_samples(file: Path, full: float = 1.0, from_byte: int = 0, coils: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Times and outputs in a file of samples."""
    with file.open("rb") as stream:
        stream.seek(from_byte)
        data = stream.read()
    kind = sample(coils)
    found = np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], kind)
    return found["at_ns"], found["coils"] * full


@contextmanager
def firmware_twin(program: Path, file: Path, coils: int = 3, fault: Path | None = None) -> Iterator[FirmwareTwin]:
    """The firmware behind a pseudo terminal, in real time. While there is a file `fault`, the first coil has half."""
    env = os.environ | ({"TWIN_FAULT": str(fault)} if fault else {})
    with subprocess.Popen([program, "pty", file], stdout=subprocess.PIPE, text=True, env=env) as process:
        try:
            assert process.stdout is not None
            yield FirmwareTwin(process.stdout.readline().strip(), file, process, coils)
        finally:
            process.kill()
