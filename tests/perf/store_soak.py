"""A long run in real time as a user records it: memory of each process, losses, drift of the clocks, check, verify."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

import flowrec
from flowrec.core import NS_PER_S, progress, table

_RATE_HZ = 60.0
_VERIFIED_S = 180.0
_WARM_S = 60.0  # until the mission holds at its goal, and each process has its size
_SETTINGS = (f"camera.rate_hz={_RATE_HZ:g}", "camera.width_px=640", "camera.height_px=512", "recording.admission_s=0")


def soak_run(minutes: float, folder: Path | None = None, settings: tuple[str, ...] = _SETTINGS) -> dict[str, Any]:
    """Record a simulated mission of 640x512 at 60 Hz in real time, which holds at its goal until the time is over."""
    seconds = 60.0 * minutes
    with tempfile.TemporaryDirectory(prefix="flowrec-soak-", dir=folder) as name:
        path = Path(name) / "soak.mcap"
        options = [f"--set={text}" for text in (*settings, f"mission.wait_at_goal_s={seconds:g}")]
        command = ["record", "--realtime", "--accept-losses", f"--duration={seconds:g}", f"--out={path}", *options]
        run = subprocess.Popen(_flowrec(*command), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        memory: dict[int, list[tuple[float, float]]] = defaultdict(list)
        names: dict[int, str] = {}
        began_s = time.monotonic()
        with progress("soaking", seconds) as done:
            while run.poll() is None:
                at_s = time.monotonic() - began_s
                for process in _family(run.pid):
                    memory[process].append((at_s, _memory_mb(process)))
                    names[process] = "the run" if process == run.pid else _name(process) or names.get(process, "")
                done(min(at_s, seconds))
                time.sleep(1.0)
        session = flowrec.open(path)
        outcome = session.outcome
        found: dict[str, Any] = {
            "minutes": minutes,
            "status": run.returncode,
            "file_mb": path.stat().st_size / 1e6,
            "images": session.topics["/camera/frame"],
            "dropped": outcome.get("frames_dropped", 0),
            "missing": outcome.get("frames_missing_from_camera", 0),
            "clocks": outcome.get("clocks", "not stated"),
            "wall_ppm": _drift_ppm(session),
            "own_mb": {f"{names[process]} ({process})": _growth(rows, seconds) for process, rows in memory.items()},
        }
        start_s = session.duration_s - _VERIFIED_S
        late = (f"--from={start_s:g}",) if start_s > 0.0 else ()
        for verb, more in (("check", ()), ("replay", ("--verify", *late))):
            begun_s = time.monotonic()
            told = subprocess.run(
                _flowrec(verb, str(path), *more, "--json"), check=False, capture_output=True, text=True
            )
            found[verb] = {"status": told.returncode, "s": time.monotonic() - begun_s, "said": _last_line(told)}
        return found


def show_soak(found: dict[str, Any]) -> None:
    """Print the figures."""
    rows = [(name, f"{found[name]}") for name in ("status", "images", "dropped", "missing", "clocks")]
    rows += [("file", f"{found['file_mb']:.0f} MB"), ("wall clock against monotonic", f"{found['wall_ppm']:.2f} ppm")]
    rows += [
        (
            f"own memory of {kind}",
            f"{each['first_mb']:.0f} to {each['last_mb']:.0f} MB, {each['mb_per_minute']:+.2f} a minute",
        )
        for kind, each in found["own_mb"].items()
    ]
    rows += [
        (verb, f"status {found[verb]['status']}, {found[verb]['s']:.0f} s: {found[verb]['said']}")
        for verb in ("check", "replay")
    ]
    table(f"A run of {found['minutes']:g} min, 640x512 at {_RATE_HZ:g} Hz, in real time", ("", "value"), rows)


def _flowrec(*words: str) -> list[str]:
    return [sys.executable, "-m", "flowrec", *words]


def _family(root: int) -> list[int]:
    """The process and all below it."""
    children: dict[int, list[int]] = defaultdict(list)
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue  # it has ended
            children[parent].append(int(entry.name))
    found = [root]
    for process in found:
        found += children[process]
    return found


def _name(process: int) -> str:
    """The module that a process runs; '' where it does not say."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return ""
    return next((os.fsdecode(after) for word, after in itertools.pairwise(words) if word == b"-m"), "")


def _memory_mb(process: int) -> float:
    """Memory of its own, without what is shared, as the ring of images is."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next((float(line.split()[1]) / 1e3 for line in lines if line.startswith("RssAnon:")), float("nan"))


def _growth(rows: list[tuple[float, float]], until_s: float) -> dict[str, float]:
    """Memory when it had settled and when the time is over, the slope between, and the highest, also at the close."""
    at_s, mb = np.array([row for row in rows if np.isfinite(row[1])] or [(0.0, 0.0)]).T
    settled = (at_s >= min(_WARM_S, 0.5 * until_s)) & (at_s <= until_s)
    settled |= not settled.any()
    slope = np.polyfit(at_s[settled], mb[settled], 1)[0] * 60.0 if settled.sum() > 2 else 0.0
    return {
        "first_mb": float(mb[settled][0]),
        "last_mb": float(mb[settled][-1]),
        "highest_mb": float(mb.max()),
        "mb_per_minute": float(slope),
    }


def _drift_ppm(session: flowrec.Session) -> float:
    """Wall clock against monotonic clock over the run, by the first and the last reading of both."""
    read = list(session.messages("clocks"))
    if len(read) < 2:
        return float("nan")
    wall_ns = read[-1].wall_ns - read[0].wall_ns
    monotonic_ns = read[-1].monotonic_ns - read[0].monotonic_ns
    return 1e6 * (wall_ns / monotonic_ns - 1.0) if monotonic_ns > NS_PER_S else float("nan")


def _last_line(told: subprocess.CompletedProcess[str]) -> str:
    try:
        said = json.loads(told.stdout)
    except ValueError:
        return (told.stderr.strip().splitlines() or ["nothing"])[-1]
    if "identical" in said:
        return f"{said['ticks'] - said['different_ticks']} of {said['ticks']} ticks the same"
    return str(said.get("verdict") or said.get("findings") or "no findings")
