"""A camera that follows a script: for the order of events that no real device shows at will."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from flowrec.core import RigError
from flowrec.rigs import CameraInfo, Grabbed, Wanted

INFO = CameraInfo("Scripted", "1", 4, 3, 8, 100.0, id_bits=16)
WANTED = Wanted(width_px=4, height_px=3, rate_hz=100.0)

Step = Grabbed | None | Exception | Callable[[], None]


def block(block_id: int | None, *, whole: bool = True, ticks: int | None = None, bits: int = 8) -> Grabbed:
    """A block that arrives now; its grey levels are its id."""
    image = np.full((3, 4), (block_id or 0) % 251, np.uint8) if whole else None
    return Grabbed(image, bits, block_id, ticks, time.monotonic_ns(), incomplete=not whole)


@dataclass
class Scripted:
    """Each call of `grab` takes one step: a block, a timeout, an error, or a call."""

    steps: deque[Step] = field(default_factory=deque)
    info: CameraInfo | Exception = INFO
    lost: int = 0
    answers: bool = True
    triggered: int = 0
    closed: threading.Event = field(default_factory=threading.Event)
    exhausted: threading.Event = field(default_factory=threading.Event)
    opened: int = 0

    @classmethod
    def of(cls, _wanted: Wanted) -> Scripted:
        return cls()

    @classmethod
    def delivering(cls, steps: Iterable[Step], **facts: object) -> Scripted:
        return cls(deque(steps), **facts)  # type: ignore[arg-type]

    def open(self) -> CameraInfo:
        self.opened += 1
        if isinstance(self.info, Exception):
            raise self.info
        return self.info

    def grab(self, timeout_s: float) -> Grabbed | None:
        if not self.steps:
            self.exhausted.set()
            self.closed.wait(timeout_s)
            return None
        step = self.steps.popleft()
        if isinstance(step, Exception):
            raise step
        if step is None or isinstance(step, Grabbed):
            return step
        step()
        return None

    def alive(self) -> bool:
        return self.answers

    def discarded(self) -> int:
        return self.lost

    def trigger(self) -> None:
        self.triggered += 1

    def close(self) -> None:
        self.closed.set()


GONE = RigError("the camera is gone")
