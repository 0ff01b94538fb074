"""What else could take the images off the control loop's hands; each packs with zstd and throws the result away.

Their stall is the least that any recorder of the kind can have: a thread that hardly needs the interpreter, and a
process that is handed every image through shared memory.
"""

from __future__ import annotations

import queue
import threading
import zlib
from multiprocessing import get_context
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np
import zstandard

from flowrec.messages import Tick

_SLOTS = 16  # images in shared memory


def _pack(compressor: zstandard.ZstdCompressor, content: memoryview) -> None:
    packed = compressor.compress(content)
    zlib.crc32(content)
    zlib.crc32(packed)


class BareThread:
    """A thread beside the loop."""

    def __init__(self) -> None:
        self._images: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def write(self, tick: Tick) -> None:
        if tick.frame is not None:
            self._images.put(tick.frame.image)

    def close(self) -> None:
        self._images.put(None)
        self._thread.join()

    def _work(self) -> None:
        compressor = zstandard.ZstdCompressor(level=1)
        while (image := self._images.get()) is not None:
            _pack(compressor, image.data)


class BareProcess:
    """A process beside the loop; what it costs the loop is one more copy of every image, and a message."""

    def __init__(self, nbytes: int) -> None:
        context = get_context("spawn")
        self._nbytes = nbytes
        self._memory: Any = SharedMemory(create=True, size=_SLOTS * nbytes)
        self._slots, far = context.Pipe()
        self._process = context.Process(target=_work_in_process, args=(self._memory.name, nbytes, far), daemon=True)
        self._process.start()
        self._slots.recv()  # it is there
        self._next = 0

    def write(self, tick: Tick) -> None:
        if tick.frame is not None:
            at = self._next * self._nbytes
            slot = np.frombuffer(self._memory.buf, np.uint8, self._nbytes, at)
            np.copyto(slot, tick.frame.image.reshape(-1))
            self._slots.send(self._next)
            self._next = (self._next + 1) % _SLOTS

    def close(self) -> None:
        self._slots.send(None)
        self._process.join()
        self._memory.close()
        self._memory.unlink()


def _work_in_process(name: str, nbytes: int, slots: Any) -> None:
    memory: Any = SharedMemory(name)
    compressor = zstandard.ZstdCompressor(level=1)
    slots.send(True)
    while (slot := slots.recv()) is not None:
        content = memory.buf[slot * nbytes : (slot + 1) * nbytes]
        _pack(compressor, content)
        content.release()
    memory.close()
