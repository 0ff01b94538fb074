"""`python -m tests.perf.large`: time to open a session of many gigabytes, and bytes read for its poses.

The file is real but for the pixels, which are holes in it: nobody who asks for poses may notice.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np
import typer
import zstandard

from flowrec.bench.harness import Results, run
from flowrec.core.terminal import progress, table
from flowrec.core.topics import TOPICS
from flowrec.core.units import NS_PER_S
from flowrec.store.channels import FRAMES, SLOTS, STATE
from tests.store.drafts import (
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    Draft,
    listing_of,
    made_up,
    record,
    small_draft,
    text,
)
from tests.store.made_up import encode

_FLUSH_S = 0.5
_FRAME_CHUNK_BYTES = 1 << 20
_PER_TICK = ("applied", "track", "estimate", "demand", "currents", "timing", "truth")
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_START_NS = NS_PER_S


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


def _write(path: Path, load: Load, seconds_long: float, with_frames: bool) -> Iterator[float]:
    """Write chunks as the writer does, without the pixels; yields the time written, s."""
    draft: Draft = small_draft()
    rng = np.random.default_rng(0)
    payloads = {
        topic.path: encode(made_up(topic.type, _START_NS, 0, rng)) for topic in TOPICS if topic.field in _PER_TICK
    }
    period_ns = round(NS_PER_S / load.rate_hz)
    per_flush = round(_FLUSH_S * load.rate_hz)
    per_frame_chunk = max(1, -(-_FRAME_CHUNK_BYTES // (load.width_px * load.height_px)))
    listed: list[tuple[int, bytes]] = []
    counts: dict[int, int] = {}
    ticks = int(seconds_long * load.rate_hz)
    with path.open("wb") as file:
        file.write(MAGIC + record(HEADER, text("flowrec") + text("flowrec perf large")))
        for opcode, body in draft.head:
            listed += listing_of(opcode, body, file.tell())
            file.write(record(opcode, body))
        for begin in range(0, ticks, per_flush):
            numbers = range(begin, min(begin + per_flush, ticks))
            for first in numbers[::per_frame_chunk] if with_frames else ():
                some = range(first, min(first + per_frame_chunk, numbers.stop))
                _add_frames(file, listed, counts, [_START_NS + number * period_ns for number in some], load)
            _add_state(file, listed, counts, [_START_NS + number * period_ns for number in numbers], payloads)
            yield begin / load.rate_hz
        for opcode, body in draft.tail:
            listed += listing_of(opcode, body, file.tell())
            file.write(record(opcode, body))
        _finish(file, draft, listed, counts, _START_NS + (ticks - 1) * period_ns)
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)  # as if it had not just been written


def _add_frames(
    file: BinaryIO, listed: list[tuple[int, bytes]], counts: dict[int, int], stamps: list[int], load: Load
) -> None:
    channel = SLOTS["/camera/frame"].channel
    assert SLOTS["/camera/frame"].group == FRAMES
    each = _MESSAGE_HEAD.size + 40 + load.width_px * load.height_px
    start, size = file.tell(), len(stamps) * each
    head = struct.pack("<QQQI", stamps[0], stamps[-1], size, 0) + text("") + struct.pack("<Q", size)
    file.write(struct.pack("<BQ", CHUNK, len(head) + size) + head)
    file.seek(size, os.SEEK_CUR)
    indexes = {channel: b"".join(struct.pack("<QQ", stamp, each * number) for number, stamp in enumerate(stamps))}
    _index(file, listed, counts, start, stamps, indexes, "", size, size)


def _add_state(
    file: BinaryIO,
    listed: list[tuple[int, bytes]],
    counts: dict[int, int],
    stamps: list[int],
    payloads: dict[str, bytes],
) -> None:
    content = bytearray()
    indexes: dict[int, bytes] = {}
    for stamp in stamps:
        for path, payload in payloads.items():
            assert SLOTS[path].group == STATE
            channel = SLOTS[path].channel
            indexes[channel] = indexes.get(channel, b"") + struct.pack("<QQ", stamp, len(content))
            content += _MESSAGE_HEAD.pack(MESSAGE, 22 + len(payload), channel, 0, stamp, stamp) + payload
    packed = zstandard.ZstdCompressor(level=1).compress(bytes(content))
    start = file.tell()
    head = struct.pack("<QQQI", stamps[0], stamps[-1], len(content), zlib.crc32(content)) + text("zstd")
    file.write(record(CHUNK, head + struct.pack("<Q", len(packed)) + packed))
    _index(file, listed, counts, start, stamps, indexes, "zstd", len(packed), len(content))


def _index(
    file: BinaryIO,
    listed: list[tuple[int, bytes]],
    counts: dict[int, int],
    start: int,
    stamps: list[int],
    indexes: dict[int, bytes],
    compression: str,
    packed: int,
    size: int,
) -> None:
    length, offsets = file.tell() - start, b""
    for channel, entries in indexes.items():
        offsets += struct.pack("<HQ", channel, file.tell())
        file.write(record(MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)) + entries))
        counts[channel] = counts.get(channel, 0) + len(entries) // 16
    place = struct.pack("<QQQQI", stamps[0], stamps[-1], start, length, len(offsets)) + offsets
    place += struct.pack("<Q", file.tell() - start - length) + text(compression)
    listed.append((CHUNK_INDEX, place + struct.pack("<QQ", packed, size)))


def _finish(file: BinaryIO, draft: Draft, listed: list[tuple[int, bytes]], counts: dict[int, int], end: int) -> None:
    file.write(record(DATA_END, struct.pack("<I", 0)))
    start = file.tell()
    file.write(b"".join(record(*part) for part in draft.index(listed, counts, [_START_NS, end])))
    file.write(struct.pack("<BQQQI", FOOTER, 20, start, 0, 0) + MAGIC)


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
