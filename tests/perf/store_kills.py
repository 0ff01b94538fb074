"""kill -9 at random moments of a recording, of the run, its recorder or both, and what is left or restored."""

from __future__ import annotations

import mmap
import os
import random
import signal
import struct
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.harness import print_rows
from flowrec.core import Image, OperatorEvent, SessionError, Tick, progress, seconds
from flowrec.store import PARTIAL_SUFFIX, SessionReader, SessionWriter, WriterOptions, recover
from flowrec.store.run_files import run_files
from flowrec.store.session_file import Snapshot, Split
from tests.perf.store_writers import made_up_header, pictures, ticks_of

_SHORTEST_S, _LONGEST_S = 0.1, 2.5
_PART_S = 0.4
_FLUSH_S = 0.5
_HANDED = struct.Struct("<QQQ")  # stamp of the last tick that was handed over, ns; how many were; the recorder's pid
_VICTIMS = ("run", "recorder", "both")
_END_S = 60.0  # for the recorder to complete the file


@dataclass(frozen=True, slots=True)
class Kind:
    """One way to record, and the largest loss that README states, in s of stamps: of the state and of the images."""

    name: str
    width: int = 640
    height: int = 512
    rate_hz: float = 100.0
    frames: str = "delta"
    realtime: bool = True
    pieces: Split | Snapshot = field(default_factory=Split)
    mark_every: int = 0  # ticks
    state_s: float = _FLUSH_S
    images_s: float = _FLUSH_S
    victim: str = "run"


@dataclass(slots=True)
class _Found:
    """Losses and faults of the kills of one kind."""

    kills: int = 0
    files: int = 0
    before_the_first_flush: int = 0
    faults: list[str] = field(default_factory=list)
    late: list[str] = field(default_factory=list)  # losses in real time beyond the stated ones: the machine was slow
    state_s: list[float] = field(default_factory=list)
    images_s: list[float] = field(default_factory=list)


def _kinds(split_s: float) -> tuple[Kind, ...]:
    kinds = (
        Kind("real time"),
        Kind("faster than real time", realtime=False, rate_hz=60.0),
        # Images wait for a slow disk for up to 4 s, as with `recording.queue_mb` left alone.
        Kind("2448x2048 at 20 Hz", 2448, 2048, 20.0, "zstd", images_s=4.0 + _FLUSH_S),
        Kind(f"parts of {split_s:g} s", pieces=Split(seconds=split_s)),
        Kind("ring, from a mark on", pieces=Snapshot(2.0, 60.0), mark_every=10**6),
    )
    nothing = {"state_s": 0.0, "images_s": 0.0}  # is lost of a run whose recorder lives
    return tuple(
        replace(kind, name=f"{kind.name}: {victim}", victim=victim, **(nothing if victim == "run" else {}))
        for victim in _VICTIMS
        for kind in kinds
    )


def kills(count: int, folder: Path | None = None, split_s: float = 0.0) -> dict[str, Any]:
    """Loss per kill, in s of stamps: from the last tick handed over to the last one recovered.

    `count` kills of each kind, of the run, of its recorder and of both. A recorder that lives completes the file.
    Every recovered session is read from end to end and recovered once more, which must
    change nothing. Runs that were killed before the first flush may have nothing to be saved; their length is no loss
    of more than that. In parts, the finished ones must be whole, and no tick may be missing between.
    """
    kinds = _kinds(split_s or _PART_S)
    moments = random.Random(0)
    rows = {}
    with tempfile.TemporaryDirectory(dir=folder) as name, progress("killing", count * len(kinds)) as done:
        for place, kind in enumerate(kinds):
            images = pictures(kind.width, kind.height, 4)
            found = _Found()
            for number in range(count):
                _kill(kind, images, Path(name) / f"{number}.mcap", moments.uniform(_SHORTEST_S, _LONGEST_S), found)
                done(place * count + number + 1)
            rows[kind.name] = _row(kind, found)
    return {
        "kills": count * len(kinds),
        "broken": sum(len(row["faults"]) for row in rows.values()),
        "late": sum(len(row["late"]) for row in rows.values()),
        "kinds": rows,
    }


def show(found: dict[str, Any]) -> None:
    """Print the table."""
    lost = "{{{0}_lost_s[median]:.2f}}, {{{0}_lost_s[max]:.2f}} / {{{0}_stated_s:g}}"
    print_rows(
        "kill -9, lost in s of stamps: median, worst / stated",
        [
            {"name": name, **row, "broken": len(row["faults"]), "late": len(row["late"])}
            for name, row in found["kinds"].items()
        ],
        {
            "": "{name}",
            "kills": "{kills}",
            "files": "{files}",
            "before the first flush": "{before_the_first_flush}",
            "broken": "{broken}",
            "late": "{late}",
            "state": lost.format("state"),
            "images": lost.format("images"),
        },
    )


def _kill(kind: Kind, images: list[Image], path: Path, after_s: float, found: _Found) -> None:
    with mmap.mmap(-1, _HANDED.size) as handed:
        child = os.fork()
        if child == 0:
            try:
                _record(kind, path, images, handed)
            finally:
                os._exit(1)
        while not _HANDED.unpack_from(handed)[1]:
            time.sleep(0.001)
        time.sleep(after_s)
        _, _, recorder = _HANDED.unpack_from(handed)
        for process in {"run": (child,), "recorder": (recorder,), "both": (child, recorder)}[kind.victim]:
            os.kill(process, signal.SIGKILL)
        os.waitpid(child, 0)  # a run whose recorder has ended ends, too
        handed_ns, _, _ = _HANDED.unpack_from(handed)
    end_s = time.monotonic() + _END_S
    while Path(f"/proc/{recorder}").exists() and time.monotonic() < end_s:
        time.sleep(0.01)
    found.kills += 1
    if kind.victim == "run" and list(path.parent.glob(f"*{PARTIAL_SUFFIX}")):
        found.faults.append("the recorder has left an incomplete file")
    left = run_files(path)
    found.files += len(left)
    state: list[tuple[int, int]] = []  # number of the tick and its stamp
    frame_ns = 0
    for piece in left:
        try:
            saved = recover(piece).path if piece.name.endswith(PARTIAL_SUFFIX) else piece
            with SessionReader(saved) as reader:
                for tick in _own_ticks(reader):
                    if tick.applied is not None and tick.applied.stamp_ns == tick.stamp_ns and tick.track is not None:
                        state.append((round(2 * float(tick.track.position_um[0])), tick.stamp_ns))
                    if tick.frame is not None:
                        frame_ns = max(frame_ns, tick.frame.stamp_ns)
            if recover(saved).changed:
                found.faults.append(f"{saved.name}: recovery changes what was recovered")
        except SessionError as error:
            # A part that has only begun, maybe without its head, is none yet; the run is what came before.
            begun = "nothing can be saved" in str(error) or "nothing was recorded" in str(error)
            if not begun or piece != left[-1]:
                found.faults.append(str(error))
    numbers = [number for number, _ in state]
    if numbers != list(range(len(numbers))):
        found.faults.append(f"a tick is missing of a run in {len(left)} files")
    if state:  # else the whole run, which was short
        found.state_s.append(seconds(handed_ns - state[-1][1]))
        found.images_s.append(seconds(handed_ns - frame_ns))
        # A run may be killed between handing over and noting that; then more is recorded than it knows.
        if found.state_s[-1] > kind.state_s or found.images_s[-1] > kind.images_s:
            text = f"more than stated is lost: {found.state_s[-1]:.2f} s, {found.images_s[-1]:.2f} s"
            # No load of the machine excuses a run that waits for its disk, or a recorder that lives.
            is_exact = not kind.realtime or (kind.victim == "run" and found.state_s[-1] > kind.state_s)
            (found.faults if is_exact else found.late).append(text)
    found.before_the_first_flush += not state
    for piece in run_files(path):
        piece.unlink()


def _own_ticks(reader: SessionReader) -> Iterator[Tick]:
    """The ticks of a part without its keyframe, which repeats the last tick of the part before."""
    begin_ns = -1 if reader.keyframe_ns is None else reader.keyframe_ns
    return (tick for tick in reader.ticks() if tick.stamp_ns > begin_ns)


def _row(kind: Kind, found: _Found) -> dict[str, Any]:
    return {
        "kills": found.kills,
        "files": found.files,
        "before_the_first_flush": found.before_the_first_flush,
        "faults": found.faults,
        "late": found.late,
        **{f"{what}_stated_s": getattr(kind, f"{what}_s") for what in ("state", "images")},
        **{f"{what}_lost_s": _spread(getattr(found, f"{what}_s")) for what in ("state", "images")},
    }


def _spread(lost_s: list[float]) -> dict[str, float]:
    if not lost_s:
        return dict.fromkeys(("median", "p99", "max"), float("nan"))
    return {"median": float(np.median(lost_s)), "p99": float(np.percentile(lost_s, 99)), "max": max(lost_s)}


def _record(kind: Kind, path: Path, images: list[Image], handed: mmap.mmap) -> None:
    """Record until the process is killed. In real time, stamps are those of the monotonic clock."""
    options = WriterOptions(frames=kind.frames, flush_s=_FLUSH_S, block=not kind.realtime, files=kind.pieces)
    options = replace(options, own_process=True)
    with SessionWriter(path, made_up_header(), options) as writer:
        recorder = writer._recorder._child.process.pid
        for number, made in enumerate(ticks_of(images, 10**6, kind.rate_hz)):
            tick = _at(made, time.monotonic_ns()) if kind.realtime else made
            if kind.mark_every and number % kind.mark_every == 0:
                tick = replace(tick, operator=OperatorEvent(tick.stamp_ns, "mark", ""))
            writer.write(tick)
            _HANDED.pack_into(handed, 0, tick.stamp_ns, number + 1, recorder)
            if kind.realtime:
                time.sleep(1.0 / kind.rate_hz)


def _at(tick: Tick, now_ns: int) -> Tick:
    """The tick with other stamps."""
    assert tick.frame is not None
    assert tick.applied is not None
    assert tick.track is not None
    return replace(
        tick,
        stamp_ns=now_ns,
        frame=replace(tick.frame, stamp_ns=now_ns),
        applied=replace(tick.applied, stamp_ns=now_ns),
        track=replace(tick.track, stamp_ns=now_ns),
    )
