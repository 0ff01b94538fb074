"""kill -9 at random moments of a live recording, and what `recover` makes of the rest."""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.store_writers import made_up_header, pictures, ticks_of
from flowrec.errors import SessionError
from flowrec.messages import Image
from flowrec.status import progress
from flowrec.store import SessionReader, SessionWriter, Split, recover
from flowrec.store.names import PARTIAL_SUFFIX, pieces

_RATE_HZ = 100.0
_SHORTEST_S, _LONGEST_S = 0.1, 2.5


def kills(count: int, folder: Path | None = None, split_s: float = 0.0) -> dict[str, Any]:
    """Seconds of the recording that are lost per kill, by the monotonic clock that its stamps are of.

    Every recovered session is read from end to end and recovered once more, which must change nothing. Runs that
    were killed before the first flush may have nothing to be saved; their whole length is the loss. With `split_s` they
    go on in another file after so many seconds: the finished ones must be whole, and no tick may be missing between.
    """
    images = pictures(640, 512, 4)
    moments = random.Random(0)  # noqa: S311  moments, not secrets
    lost_s: list[float] = []
    faults: list[str] = []
    too_short = parts = 0
    with tempfile.TemporaryDirectory(dir=folder) as name, progress("killing", count) as done:
        for number in range(count):
            path = Path(name) / f"{number}.mcap"
            child = os.fork()
            if child == 0:
                try:
                    _record(path, images, split_s)
                finally:
                    os._exit(1)
            while not pieces(path):
                time.sleep(0.001)
            time.sleep(moments.uniform(_SHORTEST_S, _LONGEST_S))
            killed_ns = time.monotonic_ns()
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            left = pieces(path)
            parts += len(left)
            stamps_ns: list[int] = []
            numbers: list[int] = []
            for piece in left:
                try:
                    saved = piece
                    if piece.name.endswith(PARTIAL_SUFFIX):
                        saved = recover(piece).path
                    with SessionReader(saved) as reader:
                        part = reader.header.part
                        begin_ns = part.carried_ns if part is not None and part.carried_ns is not None else -1
                        for tick in reader.ticks():
                            if tick.stamp_ns > begin_ns and tick.track is not None:
                                stamps_ns.append(tick.stamp_ns)
                                numbers.append(round(2 * float(tick.track.position_um[0])))
                    if recover(saved).changed:
                        faults.append(f"{saved.name}: recovery changes what was recovered")
                except SessionError as error:
                    # A part that has only begun, maybe without its head, is none yet; the run is what came before.
                    begun = "nothing can be saved" in str(error) or "nothing was recorded" in str(error)
                    if not begun or piece != left[-1]:
                        faults.append(str(error))
            if numbers != list(range(len(numbers))):
                hole = next(place for place, number in enumerate(numbers) if place != number)
                faults.append(f"tick {hole} is missing of a run in {len(left)} files")
            if stamps_ns:
                lost_s.append((killed_ns - stamps_ns[-1]) / 1e9)
            too_short += not stamps_ns
            for piece in pieces(path):
                piece.unlink()
            done(number + 1)
    return {
        "kills": count,
        "before_the_first_flush": too_short,
        "files": parts,
        "broken": len(faults),
        "faults": faults,
        "lost_s": {
            "median": float(np.median(lost_s)) if lost_s else float("nan"),
            "p99": float(np.percentile(lost_s, 99)) if lost_s else float("nan"),
            "max": max(lost_s, default=float("nan")),
        },
        "lost_s_each": lost_s,
    }


def _record(path: Path, images: list[Image], split_s: float) -> None:
    """Record in real time until somebody ends it; stamps are the monotonic clock's."""
    with SessionWriter(path, made_up_header(), frames="delta", pieces=Split(seconds=split_s or None)) as writer:
        for tick in ticks_of(images, 10**6, _RATE_HZ):
            now = time.monotonic_ns()
            assert tick.frame is not None
            assert tick.applied is not None
            assert tick.track is not None
            writer.write(
                replace(
                    tick,
                    stamp_ns=now,
                    frame=replace(tick.frame, stamp_ns=now),
                    applied=replace(tick.applied, stamp_ns=now),
                    track=replace(tick.track, stamp_ns=now),
                )
            )
            time.sleep(1.0 / _RATE_HZ)
