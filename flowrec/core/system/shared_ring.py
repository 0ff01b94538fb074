"""A ring buffer of records in memory that two processes share: one puts records in, the other takes them out.

The memory has no name in a file system: it is no file of /dev/shm, which containers make small, and it is gone with the
last process that has it. What was put in stays there for the other process, however the first one ended.

Two counters of bytes stand before the records, each written by one process only: `head` after a record is whole, `tail`
after it was used. The store of an aligned word of 8 bytes is atomic on x86-64 and ARM64. The order of the stores is
kept by the system call with which the one side wakes the other (shared_queue.py).
"""

from __future__ import annotations

import mmap
import os
import sys
import tempfile
from collections.abc import Iterable

import numpy as np

_WORD_BYTES = 8
_HEAD, _TAIL = 0, 8  # words, on two cache lines
_FIRST_FREE = 16  # word
_HEADER_BYTES = 512
WORDS = (_HEADER_BYTES // _WORD_BYTES) - _FIRST_FREE  # that the two processes may use for what they like
_SKIP = (1 << 64) - 1  # in the place of a length: the next record is at the beginning
_LARGE_BYTES = 1 << 16  # numpy copies larger parts without the interpreter's lock


class SharedRing:
    """One end of the ring; `put` belongs to one process, `take` and `release` to the other.

    Raises OSError: the system has not so much memory.

    Parameters
    ----------
    nbytes : room for records; each takes at most 15 bytes more than its parts. Any record of less than half of it
        has room in an empty ring.
    touched : all pages of memory are taken now; otherwise each when it is used.
    handle : that of the other end, to which this one belongs; None: the first one.

    Attributes
    ----------
    handle : to be inherited by the other process: a file descriptor, on Windows (untested) a name.
    words : `WORDS` numbers of 64 bit, all 0 at first.
    """

    def __init__(self, nbytes: int, touched: bool = False, handle: str | None = None) -> None:
        self.nbytes = -(-nbytes // _WORD_BYTES) * _WORD_BYTES
        self._memory, self.handle = _memory(_HEADER_BYTES + self.nbytes, handle)
        self._view = memoryview(self._memory)
        self._words = self._view[:_HEADER_BYTES].cast("Q")
        self.words = self._words[_FIRST_FREE:]
        self._records = self._view[_HEADER_BYTES:]
        self._taken = self._words[_TAIL]  # end of what was taken, and not yet released
        if touched:
            np.frombuffer(self._records, np.uint8)[:: mmap.PAGESIZE] = 0

    @property
    def used_bytes(self) -> int:
        """Bytes of the records that were put in and not released."""
        return self._words[_HEAD] - self._words[_TAIL]

    def has_room(self, nbytes: int) -> bool:
        """True if a record of so many bytes can be put in now."""
        return self._place(nbytes) is not None

    def put(self, parts: Iterable[bytes | memoryview]) -> bool:
        """Put in a record, unless there is no room for it; whether it was put in."""
        parts = tuple(parts)
        length = sum(map(len, parts))
        place = self._place(length)
        if place is None:
            return False
        head = self._words[_HEAD]
        at = head % self.nbytes
        if place != at:
            self._set_length(at, _SKIP)
            head += self.nbytes - at
        self._set_length(place, length)
        at = place + _WORD_BYTES
        for part in parts:
            if len(part) < _LARGE_BYTES:
                self._records[at : at + len(part)] = part
            else:
                np.copyto(np.frombuffer(self._records, np.uint8, len(part), at), np.frombuffer(part, np.uint8))
            at += len(part)
        self._words[_HEAD] = head + _size_of(length)  # last: the record is whole
        return True

    def take(self) -> memoryview | None:
        """The next record, valid until it is released; None: there is none."""
        if self._taken == self._words[_HEAD]:
            return None
        at = self._taken % self.nbytes
        length = int.from_bytes(self._records[at : at + _WORD_BYTES], "little")
        if length == _SKIP:
            self._taken += self.nbytes - at
            at = 0
            length = int.from_bytes(self._records[:_WORD_BYTES], "little")
        self._taken += _size_of(length)
        return self._records[at + _WORD_BYTES : at + _WORD_BYTES + length]

    def release(self) -> None:
        """Free the room of all that was taken."""
        self._words[_TAIL] = self._taken

    def close(self) -> None:
        """Give the memory back, as soon as no record of it is used any more."""
        for view in (self.words, self._words, self._records, self._view):
            view.release()
        self._memory.close()
        if sys.platform != "win32":
            os.close(int(self.handle))

    def _place(self, length: int) -> int | None:
        """The place for a record: behind the last one, or at the beginning; records are never divided."""
        size, free = _size_of(length), self.nbytes - self.used_bytes
        at = self._words[_HEAD] % self.nbytes
        to_end = self.nbytes - at
        if size <= to_end:
            return at if size <= free else None
        return 0 if to_end + size <= free else None

    def _set_length(self, at: int, length: int) -> None:
        self._records[at : at + _WORD_BYTES] = length.to_bytes(_WORD_BYTES, "little")


def _size_of(length: int) -> int:
    """Bytes that a record of so many takes."""
    return _WORD_BYTES + -(-length // _WORD_BYTES) * _WORD_BYTES


def _memory(nbytes: int, handle: str | None) -> tuple[mmap.mmap, str]:
    if sys.platform == "win32":
        handle = handle or f"flowrec-{os.urandom(8).hex()}"
        return mmap.mmap(-1, nbytes, tagname=handle), handle
    else:  # noqa: RET505 - mypy knows by it which lines are of which system
        if handle is None:
            if sys.platform == "linux":
                descriptor = os.memfd_create("flowrec-ring")
            else:
                with tempfile.TemporaryFile(prefix="flowrec-ring-") as file:  # no directory lists it
                    descriptor = os.dup(file.fileno())
            os.ftruncate(descriptor, nbytes)
            handle = str(descriptor)
        return mmap.mmap(int(handle), nbytes), handle
