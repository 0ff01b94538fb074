"""Twins of amplifiers, each in a process of its own, with a file of what their outputs did."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.twins.firmware import FULL_A, compiled, firmware_twin, read_samples, sample

_ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Device:
    """A twin with coils on it."""

    kind: str  # serial or ni
    address: str
    file: Path
    coils: int = 3

    @property
    def sets(self) -> tuple[str, ...]:
        """Settings with which a recorder finds it."""
        if self.kind == "serial":
            return (f'lab.serial.port="{self.address}"',)
        return ("lab.amplifier=ni", f'lab.ni.server="{self.address}"', f'lab.ni.channels="{channels(self.coils)}"')

    @property
    def a_per_unit(self) -> float:
        """Current of a coil for one unit of the outputs in the file, with an amplifier of 1 A/V."""
        return FULL_A if self.kind == "serial" else 1.0

    @property
    def sample_bytes(self) -> int:
        """Length of a record of the file."""
        return sample(self.coils).itemsize

    def end(self) -> int:
        """The byte of the file from which on the samples to come are."""
        return self.file.stat().st_size // self.sample_bytes * self.sample_bytes

    def outputs(self, from_byte: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """(n,) times on CLOCK_MONOTONIC in ns, and (n, coils) currents in A from each time on."""
        return read_samples(self.file, self.a_per_unit, from_byte, self.coils)

    def energised(self, from_byte: int = 0) -> bool:
        """Whether there was a field since then."""
        return bool(self.outputs(from_byte)[1].any())

    def off_ns(self, since_ns: int, from_byte: int = 0) -> int | None:
        """From when on all outputs were zero, for good; None: they are not."""
        times, outputs = self.outputs(from_byte)
        on = np.flatnonzero((outputs != 0.0).any(axis=1))
        if on.size == 0 or on[-1] + 1 == len(times):
            return None if on.size else since_ns
        return max(int(times[on[-1] + 1]), since_ns)


@cache
def _programs() -> TemporaryDirectory[str]:
    """Compiled firmware of this process."""
    return TemporaryDirectory()


@contextmanager
def device(kind: str, folder: Path, timer_ms: int = 100, coils: int = 3) -> Iterator[Device]:
    """`serial`: the firmware's own timer is off, so that the guardian is alone; `serial+timer`; `ni`. `serial+sensors`
    measures its currents; while there is a file `fault` in the folder, its first coil has half of its current.

    `folder` gets the file of the outputs.
    """
    file = folder / f"{kind}.samples"
    if kind != "ni":
        program = compiled(
            Path(_programs().name), timer_ms if kind.endswith("timer") else 0, coils, kind.endswith("sensors")
        )
        with firmware_twin(program, file, coils, folder / "fault") as twin:
            yield Device("serial", twin.port, file, coils)
        return
    command = [sys.executable, "-m", "tests.twins.ni", file, str(coils)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, cwd=_ROOT, env=environment()) as server:
        try:
            assert server.stdout is not None
            yield Device("ni", f"127.0.0.1:{server.stdout.readline().strip()}", file, coils)
        finally:
            server.kill()


def channels(coils: int) -> str:
    """Outputs of the NI twin for so many coils."""
    return f"cDAQ1Mod1/ao0:{coils - 1}"


def environment(**more: str) -> dict[str, str]:
    """Of a child that finds modules where this process does."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | more
