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
import pytest

from flowrec.rigs import compiled_firmware, emulated_board
from flowrec.rigs.emulated.coils import FULL_A, OutputSamples, compiler

_ROOT = Path(__file__).parents[2]


needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C++ compiler")


def compiled(folder: Path, timer_ms: int = 100, coils: int = 3, sensors: bool = False) -> Path:
    """The firmware as a program; a test is skipped where nothing can compile it."""
    if compiler() is None:
        pytest.skip("needs a C++ compiler")
    return compiled_firmware(folder, timer_ms, coils, sensors=sensors)


@dataclass(frozen=True)
class Device(OutputSamples):
    """A twin with coils on it. Currents are those with an amplifier of 1 A/V."""

    kind: str = "serial"  # or ni
    address: str = ""

    @property
    def sets(self) -> tuple[str, ...]:
        """Settings with which a recorder finds it."""
        if self.kind == "serial":
            return (f'lab.serial.port="{self.address}"',)
        return ("lab.amplifier=ni", f'lab.ni.server="{self.address}"', f'lab.ni.channels="{channels(self.coils)}"')

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
    measures its currents, and so does `ni` where inputs are asked for; while there is a file `fault` in the folder, the
    first coil has half of its current.

    `folder` gets the file of the outputs.
    """
    file = folder / f"{kind}.samples"
    if kind != "ni":
        program = compiled(
            Path(_programs().name), timer_ms if kind.endswith("timer") else 0, coils, kind.endswith("sensors")
        )
        with emulated_board(program, file, coils, folder / "fault") as board:
            yield Device(file, FULL_A, coils, "serial", board.port)
        return
    command = [sys.executable, "-m", "tests.twins.ni", file, str(coils)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    env = environment(TWIN_FAULT=str(folder / "fault"))
    with subprocess.Popen(command, **pipes, text=True, cwd=_ROOT, env=env) as server:
        try:
            assert server.stdout is not None
            yield Device(file, 1.0, coils, "ni", f"127.0.0.1:{server.stdout.readline().strip()}")
        finally:
            server.kill()


def channels(coils: int) -> str:
    """Outputs of the NI twin for so many coils."""
    return f"cDAQ1Mod1/ao0:{coils - 1}"


def sense_channels(coils: int) -> str:
    """Inputs of the NI twin that measure the currents of so many coils."""
    return f"cDAQ1Mod2/ai0:{coils - 1}"


def environment(**more: str) -> dict[str, str]:
    """Of a child that finds modules where this process does."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | more
