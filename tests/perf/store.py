"""`python -m tests.perf.store`: cost of recording, compared with plain mcap and foxglove-sdk writers.

The writers take turns with the same data on memory-backed storage, if there is any, so that the disk does not add
noise. The throughput of the disk is measured separately, where the session would be written.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import progress
from flowrec.store import SessionReader, SessionWriter, WriterOptions, recover
from tests.perf import store_equal
from tests.perf.store_kills import kills
from tests.perf.store_kills import show as show_kills
from tests.perf.store_loop import soak, stall
from tests.perf.store_region import regions
from tests.perf.store_soak import show_soak, soak_run
from tests.perf.store_splits import show_splits, splits
from tests.perf.store_writers import LOADS, WRITERS, Load, made_up_header, pictures, ticks_of

_MEMORY = Path("/dev/shm")
_AIM = {"p99_ratio": 1.2, "disk_mb_s": 350.0, "throughput": 0.9}


def measure(
    folder: Annotated[
        Path | None, typer.Option("--at", metavar="DIR", help="Which disk; by default that of temporary files.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer messages and rounds, half a minute.")] = False,
    minutes: Annotated[float, typer.Option(min=0.0, help="Only a soak: a run of so long, and a ring.")] = 0.0,
    killed: Annotated[
        int, typer.Option("--kills", min=0, help="Only kill so many recordings of each kind and recover them.")
    ] = 0,
    split_s: Annotated[
        float,
        typer.Option("--split", min=0.0, metavar="S", help="Only measure the loop while files are split after S."),
    ] = 0.0,
    equal: Annotated[
        bool, typer.Option("--equal", help="Only compare writers and encoders with the libraries', at equal terms.")
    ] = False,
) -> Results:
    """Throughput of each writer, stall of the control step, read, seek and recovery times.

    With `killed`, `split_s` is the length of the parts of the runs that are recorded in parts.
    """
    if equal:
        return {"equal": store_equal.measure(*((1, 0.1, 0.5) if quick else (3, 1.0, 3.0)))}
    if minutes:
        return {"run": soak_run(minutes, folder), "soak_ring": soak(minutes, folder, keeping=True)}
    if killed:
        return {"kills": kills(killed, folder, split_s)}
    if split_s:
        return {"splits": splits(folder, split_s, 3.0 if quick else 12.0, 1 if quick else 3)}
    share = 0.1 if quick else 1.0
    seconds = 2.0 if quick else 10.0
    with tempfile.TemporaryDirectory(dir=folder) as disk_name:
        disk = Path(disk_name)
        with tempfile.TemporaryDirectory(dir=_MEMORY if _MEMORY.is_dir() else folder) as fast_name:
            fast = Path(fast_name)
            throughput = [_one_load(load, fast, share, 1 if quick else 3) for load in LOADS]
            reading = _reading(fast, 300 if quick else 3000)
            windows = regions(fast, 1.0 if quick else 10.0)
        return {
            "storage": {"throughput": str(fast.parent), "stall": str(disk.parent)},
            "disk_mb_s": _disk_mb_s(disk, 100e6 if quick else 1e9),
            "throughput": throughput,
            "stall": stall(disk, seconds, 1 if quick else 3),
            "reading": reading,
            "regions": windows,
            "aims": _AIM,
        }


def _one_load(load: Load, folder: Path, share: float, rounds: int) -> dict[str, Any]:
    """Every writer on one load: the median of its rounds, the writers in turn."""
    count = max(20, round(load.messages * share))
    data = load.data()
    nbytes = len(data[0].payload)
    taken: dict[str, list[tuple[float, float, int]]] = {name: [] for name in load.writers}
    with progress(load.name, rounds * len(taken)) as done:
        for number in range(rounds * len(taken)):
            name = load.writers[number % len(taken)]
            path = folder / "bench.mcap"
            began, began_cpu = time.perf_counter(), time.process_time()
            WRITERS[name](path, data, count)
            taken[name].append((time.perf_counter() - began, time.process_time() - began_cpu, path.stat().st_size))
            path.unlink()
            done(number + 1)
    rows = {}
    for name, times in taken.items():
        wall_s, cpu_s, size = (float(np.median(column)) for column in zip(*times, strict=True))
        rows[name] = {
            "messages_s": count / wall_s,
            "mb_s": count * nbytes / wall_s / 1e6,
            "cpu_ms_per_message": 1e3 * cpu_s / count,
            "ratio": count * nbytes / size,
        }
    return {"load": load.name, "messages": count, "nbytes": nbytes, "rows": rows, "rival": load.rival}


def _disk_mb_s(folder: Path, nbytes: float) -> float:
    """What the disk takes of one writer with an fsync at the end."""
    block = np.random.default_rng(0).integers(0, 256, 1 << 22, dtype=np.uint8).tobytes()
    count = int(nbytes / len(block)) + 1
    path = folder / "disk"
    began = time.perf_counter()
    with path.open("wb", buffering=0) as file:
        for _ in range(count):
            file.write(block)
        os.fsync(file.fileno())
    taken = time.perf_counter() - began
    path.unlink()
    return count * len(block) / taken / 1e6


def _reading(folder: Path, count: int) -> dict[str, float]:
    """Seconds to open, seek, read and recover one session of poses and 640x512 images."""
    path = folder / "session.mcap"
    with SessionWriter(path, made_up_header(), WriterOptions(frames="delta", block=True)) as writer:
        for tick in ticks_of(pictures(640, 512), count, 100.0):
            writer.write(tick)
    found: dict[str, float] = {"mb": path.stat().st_size / 1e6, "ticks": count}

    def timed(name: str, began: float) -> None:
        found[name] = time.perf_counter() - began

    began = time.perf_counter()
    with closing(SessionReader(path)) as reader:
        timed("open_s", began)
        middle_ns = (reader.first_ns + reader.last_ns) // 2
        began = time.perf_counter()
        reader.tick_before(middle_ns)
        timed("seek_s", began)
        began = time.perf_counter()
        for tick in reader.ticks(middle_ns, with_frames=False):
            if tick.stamp_ns > middle_ns + 10**9:
                break
        timed("one_second_of_poses_s", began)
        began = time.perf_counter()
        for _ in reader.ticks():
            pass
        timed("all_s", began)
    cut = folder / "cut.mcap.partial"
    shutil.copyfile(path, cut)
    os.truncate(cut, int(0.9 * path.stat().st_size))
    began = time.perf_counter()
    recover(cut)
    timed("recover_s", began)
    return found


def show(figures: dict[str, Any]) -> None:
    """Print the figures as tables."""
    if "run" in figures:
        show_soak(figures["run"])
        names = ("minutes", "file_mb", "dropped", "lowest_mb", "highest_mb", "growth_mb_per_minute")
        rows = [{"name": name.replace("_", " "), "value": figures["soak_ring"][name]} for name in names]
        print_rows("A ring of 30 s, 640x512 at 100 Hz", rows, {"": "{name}", "value": "{value:.1f}"})
        return
    for key, shown in {"equal": store_equal.show, "splits": show_splits, "kills": show_kills}.items():
        if key in figures:
            shown(figures[key])
            return
    for load in figures["throughput"]:
        best = load["rows"][load["rival"]]["messages_s"]
        print_rows(
            f"{load['load']}: {load['messages']} messages of {load['nbytes'] / 1e3:.1f} kB",
            [{"writer": name, "of": row["messages_s"] / best, **row} for name, row in load["rows"].items()],
            {
                "writer": "{writer}",
                "messages/s": "{messages_s:.0f}",
                "MB/s": "{mb_s:.0f}",
                "of foxglove-sdk": "{of:.2f}",
                "CPU ms": "{cpu_ms_per_message:.3f}",
                "ratio": "{ratio:.2f}",
            },
        )
    loop = figures["stall"]
    priority = "real-time" if loop["loop_in_real_time"] else "ordinary"
    off_ms = loop["rows"]["off"]["p99_ms"]
    print_rows(
        f"Control step, 2448x2048 at 60 Hz, {loop['ticks']} steps each, {priority} priority; "
        f"disk {figures['disk_mb_s']:.0f} MB/s",
        [{"recording": name, "of_off": row["p99_ms"] / off_ms, **row} for name, row in loop["rows"].items()],
        {
            "recording": "{recording}",
            "p50 ms": "{p50_ms:.2f}",
            "p99 ms": "{p99_ms:.2f}",
            "max ms": "{max_ms:.1f}",
            "p99 of off": "{of_off:.2f}",
            "dropped": "{dropped}",
            "queue MB": "{queue_mb:.0f}",
            "CPU ms per frame": "{cpu_ms_per_frame:.1f}",
        },
    )
    read = figures["reading"]
    print_rows(
        f"Reading {read['mb']:.0f} MB, {read['ticks']} ticks with 640x512 images",
        [{"what": name[:-2].replace("_", " "), "ms": 1e3 * read[name]} for name in read if name.endswith("_s")],
        {"": "{what}", "ms": "{ms:.1f}"},
    )
    print_rows(
        "Whole images and windows around the robot, one image whole every 10 s",
        figures["regions"],
        {
            "camera": "{camera}",
            "encoding": "{encoding}",
            "region": "{region}",
            "MB per minute": "{mb_per_minute:.0f}",
            "cores": "{cores:.2f}",
        },
    )


if __name__ == "__main__":
    run(measure, show)
