"""The queue from the control loop to a recorder in another process: two rings in shared memory, of state and of images.

An entry is a record: a pickled head with all but the payloads, then these; pixels are copied once, into the ring. What
was put in is written, however the process that has put it in ended.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import struct
import sys
import time
from typing import Any

import numpy as np

from flowrec.core import Frame, Outcome, SessionError, SharedRing, pixel_type, seconds
from flowrec.store.codec import Encoded
from flowrec.store.write_queue import End, Entry

_STATE_BYTES = 160 << 20  # twice a tick of 80 MB, which always has room in an empty ring
# Besides the limit, for the same reason, and so that the image that was taken last stays in its place while all that
# may wait is put in: it may become the first one of the next part.
_IMAGE_BYTES = 64 << 20
_MARGIN_BYTES = 1 << 20
_END_BYTES = 1 << 18  # of the ring of the state that no entry takes, so that the end of the run has room there
_POLL_S = 0.0005
_PARENT_S = 1.0  # between two looks whether the run is still there
_HEAD = struct.Struct("<I")
_FLUSHED, _WANTED, _DROP, _FILES = range(4)  # words of the ring of the state


class SharedQueue:
    """The end of the queue in the run; see WriteQueue.

    Raises OSError: the system has not so much memory.

    Parameters
    ----------
    limit_bytes : of what waits.
    images : images have a ring of their own, and all memory is taken now; else they are put in with the rest.
    """

    def __init__(self, limit_bytes: int, *, images: bool) -> None:
        self._limit = limit_bytes
        self._state = SharedRing(_STATE_BYTES, images)
        self._rings = [self._state]
        if images:
            self._rings.append(SharedRing(limit_bytes + _IMAGE_BYTES, images))
        self._wake = -1
        self._abandoned = False
        self._files_bytes = 0

    @property
    def handles(self) -> list[tuple[int, str]]:
        """Size and handle of each ring, for the other process."""
        return [(ring.nbytes, ring.handle) for ring in self._rings]

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Descriptors that the other process has to inherit."""
        return tuple(int(ring.handle) for ring in self._rings) if sys.platform != "win32" else ()

    def wake_by(self, descriptor: int) -> None:
        """Take the pipe by which the other process is woken."""
        self._wake = descriptor
        if sys.platform != "win32":
            os.set_blocking(descriptor, False)

    @property
    def nbytes(self) -> int:
        """Bytes that wait for the recorder."""
        return 0 if self._abandoned else sum(ring.used_bytes for ring in self._rings)

    @property
    def fill(self) -> float:
        """Ratio of the limit that is used, 0 to 1."""
        return self.nbytes / self._limit

    @property
    def files_bytes(self) -> int:
        """Bytes of the files so far."""
        if not self._abandoned:
            self._files_bytes = self._state.words[_FILES]
        return self._files_bytes

    def has_room(self, nbytes: int) -> bool:
        """True if that many bytes fit in; an empty queue takes anything."""
        used = self.nbytes
        within = used == 0 or used + nbytes <= self._limit
        return within and self._rings[-1].has_room(nbytes + _MARGIN_BYTES)

    def wait_for_room(self, nbytes: int) -> None:
        """Block until that many bytes fit in, or until the queue is abandoned."""
        while self.nbytes and not self.has_room(nbytes):
            time.sleep(_POLL_S)

    def wait_for_flush(self, stamp_ns: int) -> None:
        """Block until the operating system has the ticks up to a stamp, or until the queue is abandoned."""
        words = self._state.words
        if words[_FLUSHED] <= stamp_ns:
            words[_WANTED] = 1
            self._wake_up()
            while not self._abandoned and words[_FLUSHED] <= stamp_ns:
                time.sleep(_POLL_S)

    def put(self, entry: Entry, image: Entry | None = None) -> None:
        """Append an entry, and its image at the lower priority; never blocks.

        Raises SessionError: the ring of the state is full, because the recorder has not taken anything for long, or the
        tick is larger than half of it.
        """
        if self._abandoned:
            return
        record = _record_of(entry)
        if not (self._state.has_room(sum(map(len, record)) + _END_BYTES) and self._state.put(record)):
            behind_mb, tick_mb = self._state.used_bytes / 1e6, entry.nbytes / 1e6
            found = f"the recorder is {behind_mb:.0f} MB behind, and a tick of {tick_mb:.1f} MB has no room"
            raise SessionError(f"{found}: is its disk hung?")
        if image is not None:
            self._rings[-1].put(_record_of(image))
        self._wake_up()

    def drop_images(self) -> None:
        """Let the recorder pass over the images that wait, and count them."""
        if not self._abandoned:
            self._state.words[_DROP] = 1
            self._wake_up()

    def close(self, end: End | None = None) -> None:
        """Nothing more will be put; without an `end`, give the memory back."""
        if end is None:
            self.abandon()
            for ring in self._rings:
                ring.close()
            self._rings = []
        elif not self._abandoned:
            self._state.put((_HEAD.pack(0), pickle.dumps(end)))
            self._wake_up()

    def abandon(self) -> None:
        """Discard what waits, because the recorder has failed."""
        self._abandoned = True

    def _wake_up(self) -> None:
        # The recorder is awake already; or it has ended, which recorder_process.py tells.
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._wake, b"\0")


class QueueReader:
    """The end of the queue in the recorder; see WriteQueue.

    Parameters
    ----------
    handles : of the rings.
    pipe : by which the run wakes this process; it is closed when the run has ended, unless that was forked.
    """

    def __init__(self, handles: list[tuple[int, str]], pipe: int) -> None:
        self._rings = [SharedRing(nbytes, handle=handle) for nbytes, handle in handles]
        self._words, self._pipe = self._rings[0].words, pipe
        self._taken_from = self._rings[0]
        self._alive, self._parent = True, os.getppid()
        self._last_ns = 0
        self.end: End | None = None
        self.given_up = 0

    def note_files_bytes(self, nbytes: int) -> None:
        """Tell the run the size of the files. Any thread."""
        self._words[_FILES] = nbytes

    @property
    def flush_wanted(self) -> bool:
        """True if the run waits for a flush."""
        return bool(self._words[_WANTED])

    @property
    def images_wait(self) -> bool:
        """True if the next entry may be the image of a tick that was taken before."""
        return any(ring.used_bytes for ring in self._rings[1:])

    @property
    def drained(self) -> bool:
        """The run has told its end, or has ended without; nothing is left to take."""
        return self.end is not None and (self.end.discard or not any(ring.used_bytes for ring in self._rings))

    def take(self, timeout_s: float | None) -> Entry | None:
        """The next entry; None after the timeout, when a flush is wanted, or at the end."""
        entry = self._next()
        if entry is not None or self.end is not None or self.flush_wanted:
            return entry
        if self._alive:
            ready, _, _ = select.select([self._pipe], [], [], _PARENT_S if timeout_s is None else timeout_s)
            closed = bool(ready) and not os.read(self._pipe, 1 << 16)
            self._alive = not closed and os.getppid() == self._parent  # else nothing more can come
        entry = self._next()
        if entry is None and not self._alive and self.end is None:
            note = f"the process of the run ended without closing the file, at {seconds(self._last_ns):.3f} s"
            self.end = End({"outcome": Outcome.FAILED, "note": f"{note}; its recorder has completed it"}, note)
        return entry

    def release(self, _entry: Entry) -> None:
        """Free the room of the entry that was taken last."""
        self._taken_from.release()

    def mark_flushed(self, stamp_ns: int) -> None:
        """Note that the operating system has the ticks up to a stamp."""
        if stamp_ns + 1 > self._words[_FLUSHED]:
            self._words[_FLUSHED], self._words[_WANTED] = stamp_ns + 1, 0

    def _next(self) -> Entry | None:
        for ring in self._rings:
            record = ring.take()
            if record is None:
                continue
            self._taken_from = ring
            found = _content_of(record, copied=ring is self._rings[0] or len(record) > _IMAGE_BYTES)
            if isinstance(found, End):
                self.end = found
                ring.release()
                continue
            self._last_ns = max(self._last_ns, found.stamp_ns)
            if self._words[_DROP] and "frame" in found.messages:
                self.given_up += 1
                return found.without_image()
            return found
        return None


def _record_of(entry: Entry) -> tuple[bytes | memoryview, ...]:
    """An entry as parts of a record."""
    told: list[Any] = []
    parts: list[bytes | memoryview] = []
    for field, message in entry.messages.items():
        if isinstance(message, Frame):
            image = np.ascontiguousarray(message.image)
            told.append((field, message.stamp_ns, message.index, message.bits, image.shape))
            parts.append(image.reshape(-1).view(np.uint8).data)
        else:
            told.append((field, message.stamp_ns, message.sequence, sum(map(len, message.payload))))
            parts += message.payload
    head = pickle.dumps((tuple(entry._replace(messages={})), told), pickle.HIGHEST_PROTOCOL)
    return _HEAD.pack(len(head)), head, *parts


def _content_of(record: memoryview, *, copied: bool) -> Entry | End:
    """Its inverse. Payloads are copied, because the recorder keeps the latest of each topic; pixels are on demand."""
    (length,) = _HEAD.unpack_from(record)
    at = _HEAD.size
    if not length:
        return pickle.loads(record[at:])  # noqa: S301 - from our own parent
    given, told = pickle.loads(record[at : at + length])  # noqa: S301 - from our own parent
    entry = Entry(*given)
    at += length
    for field, stamp_ns, number, *rest in told:
        if len(rest) == 2:
            bits, shape = rest
            image = np.frombuffer(record, pixel_type(bits), shape[0] * shape[1], at).reshape(shape)
            entry.messages[field] = Frame(stamp_ns, number, image.copy() if copied else image, bits)
            at += image.nbytes
        else:
            entry.messages[field] = Encoded(stamp_ns, number, (bytes(record[at : at + rest[0]]),))
            at += rest[0]
    return entry
