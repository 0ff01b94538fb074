"""A run cut into stretches at the boundaries of ticks: which of them an entry belongs to.

Images wait behind the state (backlog.py), so when a stretch ends at a tick, images of it may still be on their way.
Each tick announces its own, so one knows when all have come; until then several stretches are open.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from flowrec.declarations import Message
from flowrec.messages import Frame
from flowrec.store.write_queue import Entry, News


@dataclass(slots=True)
class Tally:
    """What is counted of a stretch, or of several together."""

    ticks: int = 0
    dropped_frames: int = 0
    missing_frames: int = 0
    images: int = 0
    windows: int = 0  # images of which only a part was kept

    def add(self, entry: Entry) -> None:
        """Count one entry."""
        self.ticks += entry.ticks
        self.dropped_frames += entry.dropped
        self.missing_frames += entry.missing
        self.images += "frame" in entry.news
        self.windows += entry.window is not None

    def include(self, other: Tally) -> None:
        """Add what was counted elsewhere."""
        self.ticks += other.ticks
        self.dropped_frames += other.dropped_frames
        self.missing_frames += other.missing_frames
        self.images += other.images
        self.windows += other.windows

    def told(self) -> dict[str, str]:
        """As an outcome says it."""
        counts = {"ticks": str(self.ticks), "dropped_frames": str(self.dropped_frames)}
        if self.missing_frames:
            counts["frames_missing_from_camera"] = str(self.missing_frames)
        if self.windows:
            counts["frames_windows"] = (
                f"{self.windows} of {self.images} images hold what the tracker read, and are black elsewhere"
            )
        return counts


class Stretch(Protocol):
    """Takes the entries of some ticks that follow each other."""

    def add(self, entry: Entry) -> None:
        """Take one."""

    def carry_image(self, stamp_ns: int, image: Frame) -> None:
        """Take the last image before the stretch, which had not come when it began."""

    def complete(self, tally: Tally) -> None:
        """All has come, so much."""


S = TypeVar("S", bound=Stretch)


@dataclass(slots=True)
class Open(Generic[S]):
    """A stretch and what is known of it so far.

    Attributes
    ----------
    carried_ns : stamp of the last tick before it; None at the beginning of the run.
    begin_ns : stamp of its first tick; None before that.
    awaited, awaited_bytes : images that were announced and have not come.
    """

    stretch: S
    tally: Tally
    carried_ns: int | None = None
    begin_ns: int | None = None
    awaited: int = 0
    awaited_bytes: int = 0


class Stretches(Generic[S]):
    """Gives each entry to the stretch that it belongs to.

    Attributes
    ----------
    known : the latest message of each topic but the image, by field of Tick.
    last_ns : stamp of the tick at which it is known; None before the first.
    """

    def __init__(self, first: S) -> None:
        self.known: News = {}
        self.last_ns: int | None = None
        self._image: Frame | None = None
        self._open: deque[Open[S]] = deque([Open(first, Tally())])

    @property
    def current(self) -> Open[S]:
        """The one that ticks go to."""
        return self._open[-1]

    @property
    def open(self) -> tuple[Open[S], ...]:
        """That, and before it those which still wait for images."""
        return tuple(self._open)

    def add(self, entry: Entry) -> None:
        """Hand on one entry."""
        # The images come in order: those of an earlier stretch have all come before one of a later stretch does.
        place = self._open[0] if entry.late else self._open[-1]
        if entry.ticks and place.begin_ns is None:
            place.begin_ns = entry.stamp_ns
        place.tally.add(entry)
        place.stretch.add(entry)
        if entry.late:
            place.awaited -= 1
            place.awaited_bytes -= entry.nbytes
        else:
            self.last_ns = entry.stamp_ns
            self.known.update(entry.news)
            self.known.pop("frame", None)
            if entry.image_bytes:
                place.awaited += 1
                place.awaited_bytes += entry.image_bytes
        image = entry.news.get("frame")
        if isinstance(image, Frame):
            self._image = image
        self._let_go()

    def cut(self, following: S) -> None:
        """End the current stretch with the last tick; the ticks from here on go to another one."""
        self._open.append(Open(following, Tally(), carried_ns=self.last_ns))
        self._let_go()

    def _let_go(self) -> None:
        """Complete the stretches that have all of theirs, in order."""
        while len(self._open) > 1 and not self._open[0].awaited:
            ended = self._open.popleft()
            ended.stretch.complete(ended.tally)
            following = self._open[0]
            if self._image is not None and following.carried_ns is not None:
                following.stretch.carry_image(following.carried_ns, self._image)


def carried(stamp_ns: int, known: Mapping[str, Message]) -> Entry:
    """The tick at which everything known is told once more; it counts for none."""
    return Entry(stamp_ns, dict(known), 0)
