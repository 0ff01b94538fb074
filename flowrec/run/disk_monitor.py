"""The disk under a run: how much is left, how long that will do, and the floor below which the run is ended.

A thread looks: asking a disk that does not answer may take for ever.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from flowrec.errors import SessionError

_PERIOD_S = 1.0
_SPAN = 30  # looks back over which the rate is taken
_GB = 1e9

FreeBytes = Callable[[Path], int]


def free_bytes(folder: Path) -> int:
    """What may still be written there."""
    state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


def refuse_below(floor_gb: float, folder: Path, free: FreeBytes = free_bytes) -> None:
    """Raise SessionError where a run would be ended as soon as it has begun."""
    try:
        left_gb = free(folder) / _GB
    except OSError:
        return  # whoever makes the file knows better what is wrong
    if left_gb < floor_gb:
        raise SessionError(
            f"{folder}: {left_gb:.2g} GB left on this disk, less than recording.disk_floor_gb = {floor_gb:g}; "
            "free some space, or choose another place with --out"
        )


class DiskWatch:
    """Looks every second at what is left where a session is written.

    Parameters
    ----------
    folder : where.
    written : bytes of the session so far.
    floor_gb : below it `low` is called, once, with the reason; 0: never.
    free : who is asked, for tests.
    """

    def __init__(
        self,
        folder: Path,
        written: Callable[[], int],
        floor_gb: float,
        low: Callable[[str], None],
        free: FreeBytes = free_bytes,
    ) -> None:
        self._folder = folder
        self._written = written
        self._floor_gb = floor_gb
        self._low = low
        self._free = free
        self._left: int | None = None
        self._looks: deque[tuple[float, int]] = deque(maxlen=_SPAN)

    @contextmanager
    def watching(self) -> Iterator[DiskWatch]:
        """Look for the length of the context."""
        over = threading.Event()
        threading.Thread(target=self._watch, args=(over,), name="disk", daemon=True).start()
        try:
            yield self
        finally:
            over.set()

    def _watch(self, over: threading.Event) -> None:
        while True:
            if self.look():
                return
            if over.wait(_PERIOD_S):
                return

    def look(self) -> bool:
        """Look once; whether it was too little."""
        try:
            self._left = self._free(self._folder)
        except OSError:
            self._left = None  # the writer will hear of it
            return False
        self._looks.append((time.monotonic(), self._written()))
        if self._floor_gb > 0.0 and self._left < self._floor_gb * _GB:
            self._low(f"disk floor: {self._left / _GB:.2g} GB left on {self._folder}")
            return True
        return False

    @property
    def text(self) -> str:
        """For the status line: `disk 120 GB left, 6 h`; the time is that to the floor, at the present rate."""
        if self._left is None:
            return "disk ?"
        said = f"disk {self._left / _GB:.3g} GB left"
        (begin_s, begin), (end_s, end) = (self._looks[0], self._looks[-1]) if self._looks else ((0.0, 0), (0.0, 0))
        if end <= begin or end_s <= begin_s:
            return said
        room = max(self._left - self._floor_gb * _GB, 0.0)
        return f"{said}, {_duration(room * (end_s - begin_s) / (end - begin))}"


def _duration(seconds: float) -> str:
    for size, name in ((86_400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {name}" if seconds < 1000.0 * size else f"more than 1000 {name}"
    return f"{seconds:.0f} s"
