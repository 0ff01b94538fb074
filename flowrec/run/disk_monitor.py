"""Disk monitor: free space, the time until it is used up, and the floor below which a run is ended.

A thread asks for the free space, because a disk may never answer.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from flowrec.core import SessionError

_PERIOD_S = 1.0
_SAMPLES = 30  # over which the rate is taken
_GB = 1e9

FreeBytes = Callable[[Path], int]


def free_bytes(folder: Path) -> int:
    """Bytes that can still be written to a folder."""
    return shutil.disk_usage(folder).free


def refuse_below(floor_gb: float, folder: Path, free: FreeBytes = free_bytes) -> None:
    """Raise SessionError if a run would be ended as soon as it has begun."""
    try:
        left_gb = free(folder) / _GB
    except OSError:
        return  # creating the file gives the better error
    if left_gb < floor_gb:
        raise SessionError(
            f"{folder}: {left_gb:.2g} GB left on this disk, less than recording.disk_floor_gb = {floor_gb:g}; "
            "free some space, or choose another place with --out"
        )


class DiskMonitor:
    """Measures every second the free space of the disk that a session is written to.

    Parameters
    ----------
    folder : of the session.
    written : returns the bytes of the session so far.
    floor_gb : below it `low` is called once with the reason; 0: never.
    free : returns the free bytes of a folder.
    clock_s : returns the time of a sample, which only differences are taken of.
    """

    def __init__(
        self,
        folder: Path,
        written: Callable[[], int],
        floor_gb: float,
        low: Callable[[str], None],
        free: FreeBytes = free_bytes,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder = folder
        self._written = written
        self._floor_gb = floor_gb
        self._low = low
        self._free = free
        self._clock_s = clock_s
        self._left: int | None = None
        self._samples: deque[tuple[float, int]] = deque(maxlen=_SAMPLES)

    @contextmanager
    def running(self) -> Iterator[DiskMonitor]:
        """Context in which the thread runs."""
        over = threading.Event()
        threading.Thread(target=self._run, args=(over,), name="disk", daemon=True).start()
        try:
            yield self
        finally:
            over.set()

    def _run(self, over: threading.Event) -> None:
        while not self.sample() and not over.wait(_PERIOD_S):
            pass

    def sample(self) -> bool:
        """Measure the free space once; True if it is below the floor."""
        try:
            left = self._free(self._folder)
        except OSError:
            self._left = None  # the writer will get the error
            return False
        self._samples.append((self._clock_s(), self._written()))
        self._left = left  # after the sample: another thread may ask for the text
        if self._floor_gb > 0.0 and left < self._floor_gb * _GB:
            self._low(f"disk floor: {left / _GB:.2g} GB left on {self._folder}")
            return True
        return False

    @property
    def text(self) -> str:
        """For the status line: `disk 120 GB left, 6 h`, the time until the floor at the present rate."""
        if self._left is None:
            return "disk ?"
        text = f"disk {self._left / _GB:.3g} GB left"
        (begin_s, begin), (end_s, end) = self._samples[0], self._samples[-1]
        if end <= begin or end_s <= begin_s:
            return text
        room = max(self._left - self._floor_gb * _GB, 0.0)
        return f"{text}, {_duration(room * (end_s - begin_s) / (end - begin))}"


def _duration(seconds: float) -> str:
    for size, name in ((86_400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {name}" if seconds < 1000.0 * size else f"more than 1000 {name}"
    return f"{seconds:.0f} s"
