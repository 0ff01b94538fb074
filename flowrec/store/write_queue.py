"""The queue from the control loop to a recorder in a thread, bounded by bytes, and which images enter it.

It has two priorities: images wait behind everything else, so that a slow disk delays no pose, and no pose is lost
with them when the process is killed.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from flowrec.core import NS_PER_S, Frame
from flowrec.store.codec import Encoded
from flowrec.store.frame_encodings import FrameEncoding
from flowrec.store.roi import Window

NewMessages = dict[str, Any]  # the new messages of one tick by field of Tick, in the order of the topic table
EncodedMessages = dict[str, Encoded | Frame]  # the same, as they are stored; images are encoded by the recorder

# One in 2, 4, 8 and 16 images is kept when the queue is filled to these ratios.
_DECIMATE_ABOVE = (0.5, 0.625, 0.75, 0.875)
_RESTORE_BELOW = 0.125  # far below the first threshold, so that the rate does not oscillate
_RESTORE_AFTER_S, _LONGEST_RESTORE_AFTER_S = 1.0, 32.0  # wait before a rate is restored; it doubles up to the second


class Entry(NamedTuple):
    """The new messages of one tick, or its image, and how many bytes they take in memory.

    Attributes
    ----------
    stamp_ns, messages, nbytes : stamp of the tick, its messages, their size.
    ticks : 1 for a tick itself, 0 for its image and for what is added to it.
    image_bytes : size of its image, which follows at the lower priority; 0 where none does.
    late : this is that image.
    dropped, missing : images that the writer left out, and that the camera has not delivered, since the entry before.
    window : of the image, where not all of it is recorded.
    event : in it, for which a snapshot is taken, as text; empty: none.
    start_unix_ns : another Unix time of stamp 0 than that of the header, told with the first entry.
    """

    stamp_ns: int
    messages: EncodedMessages
    nbytes: int
    ticks: int = 0
    image_bytes: int = 0
    late: bool = False
    dropped: int = 0
    missing: int = 0
    window: Window | None = None
    event: str = ""
    start_unix_ns: int | None = None

    def without_image(self) -> Entry:
        """All of it but its image, which is counted as left out."""
        others = {name: message for name, message in self.messages.items() if name != "frame"}
        return self._replace(messages=others, dropped=self.dropped + 1)


class End(NamedTuple):
    """The end of a run.

    Attributes
    ----------
    outcome, why : as of `SegmentedRun.finish`.
    last_ns : stamp of the last tick.
    dropped, missing, kept_every : of its images so far, as in `Drops`.
    discard : the files of the run are removed instead.
    """

    outcome: Mapping[str, str]
    why: str = ""
    last_ns: int = -1
    dropped: int = 0
    missing: int = 0
    kept_every: int = 1
    discard: bool = False


@dataclass(slots=True)
class Counters:
    """Counts of the ticks and images of one segment, or of several together."""

    ticks: int = 0
    dropped_frames: int = 0
    missing_frames: int = 0
    images: int = 0
    windows: int = 0  # images of which only a window was recorded

    def add(self, entry: Entry) -> None:
        """Count one entry."""
        self.ticks += entry.ticks
        self.dropped_frames += entry.dropped
        self.missing_frames += entry.missing
        self.images += "frame" in entry.messages
        self.windows += entry.window is not None

    def include(self, other: Counters) -> None:
        """Add other counters."""
        for name in (counter.name for counter in fields(self)):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def summary(self, encoding: FrameEncoding) -> dict[str, str]:
        """The entries that every outcome has besides its reason."""
        counts = {"ticks": str(self.ticks), "dropped_frames": str(self.dropped_frames)}
        if self.missing_frames:
            counts["frames_missing_from_camera"] = str(self.missing_frames)
        if self.windows:
            counts["frames_windows"] = (
                f"{self.windows} of {self.images} images hold what the tracker read, and are black elsewhere"
            )
        if not encoding.lossless:
            counts["frames_encoding"] = f"{encoding.name}, not lossless: a replay sees other pixels"
        return counts


class WriteQueue:
    """First in, first out for each priority; `close` lets the thread drain it, `abandon` releases waiting threads."""

    def __init__(self, limit_bytes: int) -> None:
        self.nbytes = 0  # waiting, or being encoded
        self._limit = limit_bytes
        self._state: deque[Entry] = deque()
        self._images: deque[Entry] = deque()
        self._changed = threading.Condition()
        self._abandoned = False
        self.end: End | None = None
        self._dropping = False
        self.given_up = 0  # images that were left out at the end
        self._flushed_ns = -1
        self.flush_wanted = False  # a thread waits for a flush

    @property
    def fill(self) -> float:
        """Ratio of the limit that is used, 0 to 1."""
        return self.nbytes / self._limit

    def has_room(self, nbytes: int) -> bool:
        """True if that many bytes fit in; an empty queue takes anything."""
        return self.nbytes == 0 or self.nbytes + nbytes <= self._limit

    def wait_for_room(self, nbytes: int) -> None:
        """Block until that many bytes fit in, or until the queue is abandoned."""
        with self._changed:
            self._changed.wait_for(lambda: self._abandoned or self.has_room(nbytes))

    def wait_for_flush(self, stamp_ns: int) -> None:
        """Block until the operating system has the ticks up to a stamp, or until the queue is abandoned."""
        with self._changed:
            if self._flushed_ns < stamp_ns:
                self.flush_wanted = True
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._abandoned or self._flushed_ns >= stamp_ns)

    def mark_flushed(self, stamp_ns: int) -> None:
        """Note that the operating system has the ticks up to a stamp."""
        if stamp_ns > self._flushed_ns:  # set by this thread alone
            with self._changed:
                self._flushed_ns, self.flush_wanted = stamp_ns, False
                self._changed.notify_all()

    def put(self, entry: Entry, image: Entry | None = None) -> None:
        """Append an entry, and its image at the lower priority; never blocks."""
        with self._changed:
            self._state.append(entry)
            self.nbytes += entry.nbytes
            if image is not None:
                self._images.append(image)
                self.nbytes += image.nbytes
            self._changed.notify_all()

    def take(self, timeout_s: float | None) -> Entry | None:
        """The next entry; None after the timeout, when all is taken and a flush is wanted, or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._state or self._images or self.end or self.flush_wanted, timeout_s)
            queue = self._state or self._images
            entry = queue.popleft() if queue else None
        if entry is None or not self._dropping or "frame" not in entry.messages:
            return entry
        self.given_up += 1
        return entry.without_image()

    @property
    def images_wait(self) -> bool:
        """True if the next entry may be the image of a tick that was taken before."""
        return bool(self._images)

    def drop_images(self) -> None:
        """Pass over the images that wait, and count them."""
        self._dropping = True

    def release(self, entry: Entry) -> None:
        """Free the bytes of an entry that the recorder has handled."""
        with self._changed:
            self.nbytes -= entry.nbytes
            self._changed.notify_all()

    @property
    def drained(self) -> bool:
        """Closed, with nothing left to take."""
        with self._changed:
            return self.end is not None and not self._state and not self._images

    def close(self, end: End) -> None:
        """Nothing more will be put. Of a run that is discarded, what waits is not written."""
        with self._changed:
            self.end = end
            if end.discard:
                self._clear()
            self._changed.notify_all()

    def abandon(self) -> None:
        """Discard what waits, because the disk has failed."""
        with self._changed:
            self._abandoned = True
            self._clear()
            self._changed.notify_all()

    def _clear(self) -> None:
        self._state.clear()
        self._images.clear()
        self.nbytes = 0


class FrameDecimation:
    """Decides which images are left out when the disk is slower than the camera.

    One in `every` images is kept, counted from the first, so that the kept ones are evenly spaced also across a change.
    When the queue has run low, `every` is halved; if it must soon be doubled again, the next try waits twice as long.
    `every`: 1, 2, 4, 8 or 16.
    """

    def __init__(self) -> None:
        self.every = 1
        self._number = -1
        self._restore_after_s = _RESTORE_AFTER_S
        self._changed_ns: int | None = None  # when `every` was last halved or doubled

    def keeps(self, fill: float, stamp_ns: int) -> bool:
        """True if the next image is kept, the queue being filled to that ratio (0 to 1)."""
        self._number += 1
        wanted: int = 2 ** sum(fill >= limit for limit in _DECIMATE_ABOVE)
        since_s = float("inf") if self._changed_ns is None else (stamp_ns - self._changed_ns) / NS_PER_S
        if wanted > self.every:
            if since_s < self._restore_after_s:
                self._restore_after_s = min(2.0 * self._restore_after_s, _LONGEST_RESTORE_AFTER_S)
            self.every, self._changed_ns = wanted, stamp_ns
        elif self.every > 1 and fill < _RESTORE_BELOW and since_s >= self._restore_after_s:
            self.every, self._changed_ns = self.every // 2, stamp_ns
        return self._number % self.every == 0
