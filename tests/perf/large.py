"""`python -m tests.perf.large`: time to open a session of many gigabytes, and bytes read for its poses.

The file is real but for the pixels, which are holes in it: nobody who asks for poses may notice.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mcap.records import Metadata

from flowrec.bench.harness import Results, run
from flowrec.core import NS_PER_S, TOPICS, progress, table
from flowrec.store import FRAME_PATH, SLOTS
from flowrec.store.channels import declarations
from flowrec.store.chunk import ChunkBuilder
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.lookup import gather
from flowrec.store.mcap_format import ChannelIndex, SealedChunk
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.session_metadata import OUTCOME, PROFILE, header_records
from tests.perf.store_writers import made_up_header
from tests.store.drafts import MESSAGE_INDEX, made_up, record
from tests.store.made_up import encode

_FLUSH_S = 0.5
_FRAME_CHUNK_BYTES = 1 << 20
_PER_TICK = ("applied", "track", "estimate", "demand", "currents", "timing", "truth")
_START_NS = NS_PER_S
_ZEROS = bytes(8 << 20)


@dataclass(frozen=True, slots=True)
class Load:
    """A camera."""

    width_px: int
    height_px: int
    rate_hz: float

    def __str__(self) -> str:
        return f"{self.width_px} x {self.height_px} at {self.rate_hz:g} Hz"


LOADS = (Load(640, 512, 100.0), Load(2448, 2048, 60.0))


def measure(
    gigabytes: Annotated[float, typer.Option("--gb", min=0.01, help="Size of each session (sparse files).")] = 10.0,
    folder: Annotated[Path | None, typer.Option(metavar="DIR", help="Where to write them; they are removed.")] = None,
) -> Results:
    """Write sparse sessions into a folder that is removed afterwards, and read them in processes of their own."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="flowrec-large-", dir=folder) as made:
        for load in LOADS:
            whole, alone = Path(made) / "whole.mcap", Path(made) / "state_alone.mcap"
            seconds_long = gigabytes * 1e9 / (load.width_px * load.height_px * load.rate_hz)
            with progress(f"writing {gigabytes:g} GB, {load}", seconds_long) as done:
                for path, with_frames in ((whole, True), (alone, False)):
                    for at_s in _write(path, load, seconds_long, with_frames):
                        done(at_s)
            row = {"load": str(load), "gigabytes": whole.stat().st_size / 1e9, "seconds": seconds_long}
            row["on_disk_mb"] = whole.stat().st_blocks * 512 / 1e6
            row |= _measured(whole, "second") | _measured(whole, "poses")
            row |= {f"two_files_{key}": value for key, value in _measured(alone, "poses").items()}
            for verb in ("info", "ls"):
                row[f"{verb}_s"] = _verb_s(verb, whole if verb == "info" else Path(made))
            rows.append(row)
            whole.unlink()
            alone.unlink()
    return {"rows": rows}


def show(figures: dict[str, Any]) -> None:
    """Print the tables."""
    for row in figures["rows"]:
        table(
            f"{row['load']}: {row['gigabytes']:.1f} GB, {row['seconds']:.0f} s",
            ("", "value"),
            [
                ("open", f"{row['open_s']:.3f} s, of the processor {row['open_cpu_s']:.3f} s"),
                (
                    "one second of poses from the middle",
                    f"{row['second_s']:.3f} s, of the processor {row['second_cpu_s']:.3f} s",
                ),
                ("memory for both", f"{row['second_mb']:.0f} MB ({row['second_peak_mb']:.0f} MB with the program)"),
                ("bytes read for it", f"{row['second_read_mb']:.2f} MB"),
                ("all poses: messages, time", f"{row['poses_count']}, {row['poses_s']:.2f} s"),
                ("all poses: bytes read, one file", f"{row['poses_read_mb']:.1f} MB"),
                ("all poses: bytes read, frames in a file apart", f"{row['two_files_poses_read_mb']:.1f} MB"),
                ("flowrec info, flowrec ls (a process each)", f"{row['info_s']:.2f} s, {row['ls_s']:.2f} s"),
            ],
        )


def write_sparse(path: Path, load: Load, gigabytes: float) -> None:
    """Write a session of that size."""
    for _ in _write(path, load, gigabytes * 1e9 / (load.width_px * load.height_px * load.rate_hz), True):
        pass


class SparseWriter(McapWriter):
    """Leaves holes where images are, which are all the same view of zeros."""

    def _append(self, *buffers: bytes | memoryview) -> None:
        for buffer in buffers:
            if buffer.obj is _ZEROS if isinstance(buffer, memoryview) else False:
                self.size += len(buffer)
                self._file.seek(self.size)
            else:
                super()._append(buffer)


def _write(path: Path, load: Load, seconds_long: float, with_frames: bool) -> Iterator[float]:
    """Write chunks as the writer does, without the pixels; yields the time written, s."""
    rng = np.random.default_rng(0)
    payloads = {
        topic.path: encode(made_up(topic.type, _START_NS, 0, rng))  # type: ignore[no-untyped-call]
        for topic in TOPICS
        if topic.field in _PER_TICK
    }
    period_ns = round(NS_PER_S / load.rate_hz)
    per_flush = round(_FLUSH_S * load.rate_hz)
    per_frame_chunk = max(1, -(-_FRAME_CHUNK_BYTES // (load.width_px * load.height_px)))
    ticks = int(seconds_long * load.rate_hz)
    with contextlib.closing(SparseWriter(path)) as out:
        out.start(PROFILE, "flowrec perf large")
        for part in (*header_records(made_up_header()), *declarations(ENCODINGS["raw"])):
            out.add(part)
        for begin in range(0, ticks, per_flush):
            numbers = range(begin, min(begin + per_flush, ticks))
            for first in numbers[::per_frame_chunk] if with_frames else ():
                some = range(first, min(first + per_frame_chunk, numbers.stop))
                out.add_chunks([_frames([_START_NS + number * period_ns for number in some], load)])
            builder = ChunkBuilder()
            for number in numbers:
                stamp = _START_NS + number * period_ns
                for topic, payload in payloads.items():
                    builder.add(SLOTS[topic].channel, number, stamp, stamp, (payload,))
            out.add_chunks([builder.seal()])
            yield begin / load.rate_hz
        out.add(Metadata(OUTCOME, {"outcome": "goal reached"}))
        for copies in gather(path, out.summary(), 0):
            out.add(copies)
        out.add_digest()
        out.finish()
        out.sync()
    descriptor = os.open(path, os.O_RDONLY)
    os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)  # as if it had not just been written
    os.close(descriptor)


def _frames(stamps: list[int], load: Load) -> SealedChunk:
    """A chunk of images whose content is a hole."""
    each = 31 + 40 + load.width_px * load.height_px  # head, what stands before the pixels, pixels
    entries = b"".join(struct.pack("<QQ", stamp, each * number) for number, stamp in enumerate(stamps))
    channel = SLOTS[FRAME_PATH].channel
    index = record(MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)) + entries)
    size = len(stamps) * each
    indexes = [ChannelIndex(channel, len(stamps), 0, index)]
    return SealedChunk("", memoryview(_ZEROS)[:size], stamps[0], stamps[-1], 0, size, indexes)


def _measured(path: Path, what: str) -> dict[str, float]:
    """Results of poses.py in a process of its own."""
    command = [sys.executable, "-m", "tests.perf.poses", what, str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    row: dict[str, float] = json.loads(done.stdout)
    return row


def _verb_s(verb: str, path: Path) -> float:
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "flowrec", verb, str(path)], check=True, capture_output=True)
    return time.perf_counter() - began


if __name__ == "__main__":
    run(measure, show)
