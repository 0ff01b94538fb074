"""What waits for the disk: a queue bounded by bytes, from the control loop to the writer's thread.

Two lanes: images wait behind everything else, so that a slow disk delays no pose and a kill takes none with it.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from flowrec.declarations import Message
from flowrec.store.roi import Window

News = dict[str, Message]  # the new messages of one tick by field of Tick, in the order of the topic table


class Entry(NamedTuple):
    """The new messages of one tick and about what they weigh in memory.

    Attributes
    ----------
    stamp_ns, news, nbytes : its stamp, its messages, their weight.
    ticks : 1 for a tick itself, 0 for its image and for what is added to it.
    image_bytes : weight of its image, which follows in the other lane; 0 where none does.
    late : it is that image.
    dropped, missing : images that the writer left out, and that the camera has not delivered, up to here from the
        entry before.
    """

    stamp_ns: int
    news: News
    nbytes: int
    ticks: int = 0
    image_bytes: int = 0
    late: bool = False
    dropped: int = 0
    missing: int = 0
    window: Window | None = None  # of the image, where not all of it is to be kept


class Backlog:
    """First in, first out in each lane; `close` lets the thread drain it, `abandon` frees everyone who waits."""

    def __init__(self, limit_bytes: int) -> None:
        self.nbytes = 0  # waiting, or in the hands of the thread
        self._limit = limit_bytes
        self._state: deque[Entry] = deque()
        self._images: deque[Entry] = deque()
        self._changed = threading.Condition()
        self._closed = self._abandoned = False
        self._flushed_ns = -1
        self._flush_wanted = False

    @property
    def fill(self) -> float:
        """Share of the room that is taken, 0 to 1."""
        return self.nbytes / self._limit

    def has_room(self, nbytes: int) -> bool:
        """Whether that many bytes fit in; an empty queue takes anything."""
        return self.nbytes == 0 or self.nbytes + nbytes <= self._limit

    def wait_for_room(self, nbytes: int) -> None:
        """Block until that many bytes fit in, or until the queue is abandoned."""
        with self._changed:
            self._changed.wait_for(lambda: self._abandoned or self.has_room(nbytes))

    def wait_for_flush(self, stamp_ns: int) -> None:
        """Block until the ticks up to a stamp are with the operating system, or until the queue is abandoned."""
        with self._changed:
            if self._flushed_ns < stamp_ns:
                self._flush_wanted = True
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._abandoned or self._flushed_ns >= stamp_ns)

    @property
    def flush_wanted(self) -> bool:
        """Whether somebody waits for that."""
        return self._flush_wanted

    def flushed(self, stamp_ns: int) -> None:
        """The ticks up to a stamp are with the operating system."""
        if stamp_ns > self._flushed_ns:  # set by this thread alone
            with self._changed:
                self._flushed_ns, self._flush_wanted = stamp_ns, False
                self._changed.notify_all()

    def put(self, entry: Entry, image: Entry | None = None) -> None:
        """Append an entry, `image` to the lane that waits; never blocks."""
        with self._changed:
            for news, lane in ((entry, self._state), (image, self._images)):
                if news is not None:
                    lane.append(news)
                    self.nbytes += news.nbytes
            self._changed.notify_all()

    def take(self, timeout_s: float | None) -> Entry | None:
        """The next entry; None after the time is over, when all is taken and a flush is wanted, or the end has come."""
        with self._changed:
            self._changed.wait_for(lambda: self._state or self._images or self._closed or self._flush_wanted, timeout_s)
            lane = self._state or self._images
            return lane.popleft() if lane else None

    @property
    def images_wait(self) -> bool:
        """Whether the next entry may be the image of a tick that was taken before."""
        return bool(self._images)

    def drop_images(self) -> int:
        """Take the images out of what waits; how many there were."""
        with self._changed:
            dropped = len(self._images)
            for place, image in enumerate(self._images):
                self._images[place] = image._replace(news={}, dropped=1)
            for place, entry in enumerate(self._state):  # where nobody minds to wait, images travel with the rest
                if "frame" in entry.news:
                    others = {name: message for name, message in entry.news.items() if name != "frame"}
                    self._state[place] = entry._replace(news=others, dropped=entry.dropped + 1)
                    dropped += 1
        return dropped

    def done(self, entry: Entry) -> None:
        """The entry has been dealt with: its bytes are free again."""
        with self._changed:
            self.nbytes -= entry.nbytes
            self._changed.notify_all()

    @property
    def drained(self) -> bool:
        """Closed, with nothing left to take."""
        with self._changed:
            return self._closed and not self._state and not self._images

    def close(self) -> None:
        """Nothing more will come."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def abandon(self) -> None:
        """Forget what waits; the disk has failed."""
        with self._changed:
            self._closed = self._abandoned = True
            self._state.clear()
            self._images.clear()
            self.nbytes = 0
            self._changed.notify_all()
