"""Seconds and memory of a solve on masks of 128 to 1024 pixels a side; one process each (`python -m`), for its peak."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.bench.harness import peak_mb
from flowrec.chip.builtin import straight
from flowrec.chip.chip import Chip
from flowrec.chip.io import without_pockets
from flowrec.chip.openings import find_openings, guess_inlets
from flowrec.chip.vessels import vessels
from flowrec.flow import FlowSolver
from flowrec.flow.newton_solver import system

Pattern = Literal["vessels", "posts"]
_PITCH_PX, _RADIUS_PX = 32, 13


def speed_case(pattern: Pattern, side_px: int, k: int) -> dict[str, Any]:
    """Cold and warm seconds, unknowns and peak memory, measured in a fresh process."""
    command = [sys.executable, "-m", "flowrec.bench.speed", pattern, str(side_px), str(k)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603 - our own words
    row: dict[str, Any] = json.loads(done.stdout)
    return row


def _mask(pattern: Pattern, side: int) -> NDArray[np.bool_]:
    if pattern == "vessels":
        drawn = vessels(1).mask[:, :256]
        at = np.arange(side) * 256 // side
        return np.asarray(drawn[at][:, at])
    y, x = np.mgrid[:side, :side] + 0.5
    x = x + (y // _PITCH_PX) % 2 * _PITCH_PX / 2
    mask = np.hypot(x % _PITCH_PX - _PITCH_PX / 2, y % _PITCH_PX - _PITCH_PX / 2) > _RADIUS_PX
    mask[:3] = mask[-3:] = False
    return np.asarray(mask)


def _measure(pattern: Pattern, side: int, k: int) -> dict[str, Any]:
    FlowSolver(1).solve(straight())  # imports and compiled code are not what is measured
    mask = _mask(pattern, side)
    openings = guess_inlets(find_openings(mask))
    chip = without_pockets(Chip(pattern, mask, 10.0, openings, 1.0, 1000.0))
    before = peak_mb()
    began = time.perf_counter()
    FlowSolver(k).solve(chip)
    cold = time.perf_counter() - began
    peak = peak_mb()
    other = chip.with_boundary(0.8 * chip.boundary_values, viscosity_mpa_s=1.2)
    began = time.perf_counter()
    FlowSolver(k).solve(other)
    warm = time.perf_counter() - began
    equations = system(chip, k)
    # Mass: of the speeds the solver carries, in units of the fastest.
    moving = equations.linear(np.array([[float(o.kind == "inlet")] for o in chip.openings]))[:, 0]
    padded = np.append(moving, 0.0)
    u, v = padded[equations.grid.u.number], padded[equations.grid.v.number]
    lost = np.abs(np.diff(u, axis=1) + np.diff(v, axis=0)).max() / np.abs(moving).max()
    return {
        "pattern": pattern,
        "side_px": side,
        "k": k,
        "fluid_px": int(chip.mask.sum()),
        "unknowns": int(equations.stream.curl.shape[1]),
        "cold_s": cold,
        "warm_s": warm,
        "peak_memory_mb": peak - before,
        "mass_lost_in_a_cell": float(lost),
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_measure(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))  # type: ignore[arg-type]
