"""Cost of split files and of the ring buffer for the control loop: `python -m tests.perf.store --split S`."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.harness import print_rows
from flowrec.core import FlowField, Image, OperatorEvent, Tick, progress
from flowrec.run.loop import SWITCH_S
from flowrec.store import SessionWriter, WriterOptions
from flowrec.store.session_file import Snapshot, Split
from tests.perf.store_writers import made_up_header, pictures, ticks_of

_RATE_HZ = 60.0
_WIDTH, _HEIGHT = 1224, 1024  # what two cores that do other things as well keep up with
_FIELD = (512, 640)  # rows and columns of a flow field: 4 MB with its pressure, to be told anew in every part
_RING = 64
_WARM = 30  # ticks until queue and memory have their size
_NEAR = 20  # ticks from a split on


def splits(folder: Path | None, split_s: float, duration_s: float, rounds: int) -> dict[str, Any]:
    """Duration of `write` in a loop at 60 Hz with 1224x1024 images: one file, parts, and a ring buffer with a mark.

    Runs take turns. Of the parts, the ticks about their ends are looked at apart.
    """
    images = pictures(_WIDTH, _HEIGHT)
    ring = [np.ones_like(images[0]) for _ in range(_RING)]
    kinds: dict[str, Split | Snapshot] = {
        "one file": Split(),
        "parts": Split(seconds=split_s),
        "ring": Snapshot(split_s, split_s, 4000.0),
    }
    rows: dict[str, list[Any]] = {kind: [] for kind in kinds}
    with tempfile.TemporaryDirectory(dir=folder) as name, progress("flying", rounds * len(kinds)) as done:
        for number in range(rounds * len(kinds)):
            kind = list(kinds)[number % len(kinds)]
            rows[kind].append(_fly(Path(name), kinds[kind], images, ring, duration_s))
            done(number + 1)
    split_ticks = max(1, round(split_s * _RATE_HZ))
    return {
        "split_s": split_s,
        "ticks": round(duration_s * _RATE_HZ) * rounds,
        "rows": {kind: _row(runs, split_ticks) for kind, runs in rows.items()},
    }


def _fly(
    folder: Path, pieces: Split | Snapshot, images: list[Image], ring: list[Image], duration_s: float
) -> dict[str, Any]:
    path = folder / "split.mcap"
    write_ms: list[float] = []
    queue_mb = 0.0
    cpu_s = time.process_time()
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    with SessionWriter(path, made_up_header(), WriterOptions(frames="zstd", files=pieces, overwrite=True)) as writer:
        began = time.perf_counter()
        for number, tick in enumerate(_ticks(images, round(duration_s * _RATE_HZ))):
            wait_s = began + number / _RATE_HZ - time.perf_counter()
            if wait_s > 0:
                time.sleep(wait_s)
            assert tick.frame is not None
            image = ring[number % len(ring)]
            np.copyto(image, tick.frame.image)
            given = replace(tick, frame=replace(tick.frame, image=image))
            before = time.perf_counter()
            writer.write(given)
            write_ms.append(1e3 * (time.perf_counter() - before))
            queue_mb = max(queue_mb, writer.queue_bytes / 1e6)
    sys.setswitchinterval(before_s)
    cpu_s = time.process_time() - cpu_s
    files = writer.files
    size = sum(file.stat().st_size for file in files)
    for file in files:
        file.unlink()
    return {
        "write_ms": write_ms,
        "queue_mb": queue_mb,
        "dropped": writer.dropped_frames,
        "files": len(files),
        "mb": size / 1e6,
        "cpu_s": cpu_s,
    }


def _ticks(images: list[Image], count: int) -> Iterator[Tick]:
    """Ticks with two flow fields from the first one on, and a mark in the middle."""
    y, x = np.mgrid[-1.0 : 1.0 : _FIELD[0] * 1j, -1.0 : 1.0 : _FIELD[1] * 1j]
    velocity = np.stack([100.0 * (1.0 - y * y), 10.0 * np.sin(9.0 * x)], axis=-1).astype(np.float32)
    pressure = (-50.0 * x).astype(np.float32)
    mark: OperatorEvent | None = None
    fields: dict[str, FlowField] = {}
    for number, tick in enumerate(ticks_of(images, count, _RATE_HZ)):
        if not fields:
            field = FlowField(
                tick.stamp_ns, 1, "fvm", 5.0, velocity, pressure, None, np.array([50.0, 0.0]), 1.0, 998.0, ""
            )
            fields = {"assumed": field, "refined": field}
        if number == count // 2:
            mark = OperatorEvent(tick.stamp_ns, "mark", "")
        yield replace(tick, operator=mark, assumed=fields["assumed"], refined=fields["refined"])


def _row(runs: list[dict[str, Any]], split_ticks: int) -> dict[str, float]:
    everything = np.concatenate([run["write_ms"][_WARM:] for run in runs])
    near = np.concatenate(
        [
            [ms for number, ms in enumerate(run["write_ms"]) if number >= split_ticks and number % split_ticks < _NEAR]
            for run in runs
        ]
    )
    ticks = sum(len(run["write_ms"]) for run in runs)
    return {
        "p50_ms": float(np.median(everything)),
        "p99_ms": float(np.percentile(everything, 99)),
        "max_ms": float(everything.max()),
        "near_p50_ms": float(np.median(near)) if len(near) else float("nan"),
        "near_p99_ms": float(np.percentile(near, 99)) if len(near) else float("nan"),
        "near_max_ms": float(near.max()) if len(near) else float("nan"),
        "queue_mb": max(run["queue_mb"] for run in runs),
        "dropped": sum(run["dropped"] for run in runs),
        "files": sum(run["files"] for run in runs),
        "mb": sum(run["mb"] for run in runs),
        "cpu_ms_per_frame": 1e3 * sum(run["cpu_s"] for run in runs) / ticks,
    }


def show_splits(found: dict[str, Any]) -> None:
    """Print the table."""
    base_ms = found["rows"]["one file"]["near_max_ms"]
    print_rows(
        f"write() at 60 Hz with 1224x1024 images, {found['ticks']} ticks each; parts of {found['split_s']:g} s, a ring "
        "of as much and a mark; near: the third of a second from where a part begins, the same ticks of the others",
        [{"kind": kind, "of_base": row["near_max_ms"] / base_ms, **row} for kind, row in found["rows"].items()],
        {
            "": "{kind}",
            "p50 ms": "{p50_ms:.3f}",
            "p99 ms": "{p99_ms:.2f}",
            "max ms": "{max_ms:.1f}",
            "near p99": "{near_p99_ms:.2f}",
            "near max": "{near_max_ms:.1f}",
            "of one file": "{of_base:.2f}",
            "queue MB": "{queue_mb:.0f}",
            "dropped": "{dropped}",
            "files": "{files}",
            "CPU ms": "{cpu_ms_per_frame:.1f}",
        },
    )
