"""Routes queued entries to segments of a run: parts of it (split.py), or slices of the ring buffer.

A run is cut at the boundaries of ticks. Images wait behind the state (write_queue.py), so when a segment ends at a
tick, images of it may still be queued. Each tick announces its image; a segment stays open until every image that was
announced for it has come, so several may be open at a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Generic, Protocol, TypeVar

from flowrec.core import Frame, Message
from flowrec.store.frame_encodings import FrameEncoding
from flowrec.store.write_queue import Entry, NewMessages


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


class Segment(Protocol):
    """Takes the entries of consecutive ticks."""

    def add(self, entry: Entry) -> None:
        """Take one entry."""

    def add_keyframe_image(self, entry: Entry) -> None:
        """Take the last image before the segment, which was still queued when the segment began."""

    def end(self, counters: Counters) -> None:
        """End the segment: it has received all of its entries."""


S = TypeVar("S", bound=Segment)


@dataclass(slots=True)
class OpenSegment(Generic[S]):
    """A segment that may still receive entries.

    Attributes
    ----------
    keyframe_ns : stamp of the last tick before it; None at the beginning of the run.
    begin_ns : stamp of its first tick; None before that.
    awaited, awaited_bytes : number and size of the images that were announced and are still queued.
    """

    segment: S
    counters: Counters
    keyframe_ns: int | None = None
    begin_ns: int | None = None
    awaited: int = 0
    awaited_bytes: int = 0


class SegmentRouter(Generic[S]):
    """Gives each entry to the segment that it belongs to.

    Attributes
    ----------
    state : the latest message of each topic but the image, by field of Tick.
    last_ns : stamp of the tick at which that is the state; None before the first.
    open : the segments that are not complete; ticks go to the last one, the others wait for images.
    """

    def __init__(self, first: S) -> None:
        self.state: NewMessages = {}
        self.last_ns: int | None = None
        self.open: deque[OpenSegment[S]] = deque([OpenSegment(first, Counters())])
        self._image: Frame | None = None

    @property
    def current(self) -> OpenSegment[S]:
        """The segment that receives new ticks."""
        return self.open[-1]

    def add(self, entry: Entry) -> None:
        """Pass one entry to its segment."""
        # Images come in order: those of an earlier segment have all come before the first one of a later segment.
        place = self.open[0] if entry.late else self.open[-1]
        if entry.ticks and place.begin_ns is None:
            place.begin_ns = entry.stamp_ns
        place.counters.add(entry)
        place.segment.add(entry)
        if entry.late:
            place.awaited -= 1
            place.awaited_bytes -= entry.nbytes
        else:
            self.last_ns = entry.stamp_ns
            self.state.update(entry.messages)
            self.state.pop("frame", None)
            if entry.image_bytes:
                place.awaited += 1
                place.awaited_bytes += entry.image_bytes
        image = entry.messages.get("frame")
        if isinstance(image, Frame):
            self._image = image
        self._end_complete()

    def cut(self, following: S) -> None:
        """End the current segment with the last tick; the ticks from here on go to another one."""
        self.open.append(OpenSegment(following, Counters(), keyframe_ns=self.last_ns))
        self._end_complete()

    def _end_complete(self) -> None:
        while len(self.open) > 1 and not self.open[0].awaited:
            ended = self.open.popleft()
            ended.segment.end(ended.counters)
            following = self.open[0]
            if self._image is not None and following.keyframe_ns is not None:
                following.segment.add_keyframe_image(Entry(following.keyframe_ns, {"frame": self._image}, 0))


def keyframe(stamp_ns: int, state: Mapping[str, Message]) -> Entry:
    """The full state at a tick as one entry, which is not counted as a tick."""
    return Entry(stamp_ns, dict(state), 0)
