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
from flowrec.store import SessionReader, SessionWriter, recover

_RATE_HZ = 100.0
_SHORTEST_S, _LONGEST_S = 0.1, 2.5


def kills(count: int, folder: Path | None = None) -> dict[str, Any]:
    """Seconds of the recording that are lost per kill, by the monotonic clock that its stamps are of.

    Every recovered session is read from end to end and recovered once more, which must change nothing. Runs that
    were killed before the first flush may have nothing to be saved; their whole length is the loss.
    """
    images = pictures(640, 512, 4)
    moments = random.Random(0)  # noqa: S311  moments, not secrets
    lost_s: list[float] = []
    too_short = broken = 0
    with tempfile.TemporaryDirectory(dir=folder) as name, progress("killing", count) as done:
        for number in range(count):
            path = Path(name) / f"{number}.mcap"
            child = os.fork()
            if child == 0:
                try:
                    _record(path, images)
                finally:
                    os._exit(1)
            partial = path.with_name(path.name + ".partial")
            while not partial.exists():
                time.sleep(0.001)
            time.sleep(moments.uniform(_SHORTEST_S, _LONGEST_S))
            killed_ns = time.monotonic_ns()
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            try:
                saved = recover(partial)
                with SessionReader(saved.path) as reader:
                    last_ns = [tick.stamp_ns for tick in reader.ticks()][-1]
                lost_s.append((killed_ns - last_ns) / 1e9)
                broken += recover(saved.path).changed
                saved.path.unlink()
            except SessionError as error:
                if "before its first whole tick" not in str(error):
                    broken += 1
                too_short += 1
                partial.unlink(missing_ok=True)
            done(number + 1)
    return {
        "kills": count,
        "before_the_first_flush": too_short,
        "broken": broken,
        "lost_s": {
            "median": float(np.median(lost_s)) if lost_s else float("nan"),
            "p99": float(np.percentile(lost_s, 99)) if lost_s else float("nan"),
            "max": max(lost_s, default=float("nan")),
        },
        "lost_s_each": lost_s,
    }


def _record(path: Path, images: list[Image]) -> None:
    """Record in real time until somebody ends it; stamps are the monotonic clock's."""
    with SessionWriter(path, made_up_header(), frames="delta") as writer:
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
