"""Counts of the messages that recovery keeps and loses, and the outcome that records them."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flowrec.core import BY_PATH, Applied, Outcome, Timing, message_fields, seconds
from flowrec.store.channels import SessionContents
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.rows import Row
from flowrec.store.scan import Scan
from flowrec.store.segments import Counters

_COUNTED = ("ticks", "dropped_frames", "frames_dropped")  # the last one in older files
_STAMP, _ABSENT = (
    [each.name for each in message_fields(Applied)].index(name) for name in ("stamp_ns", "absent_until_ns")
)
_DROPPED = [each.name for each in message_fields(Timing)].index("dropped_frames")


def _times() -> array[int]:
    return array("q")


@dataclass(slots=True)
class RecoveryTally:
    """Ticks and messages that are kept, and those that have to be left out; all times are those of ticks.

    Attributes
    ----------
    keyframe_ns : stamp of the keyframe of a part, which was counted where it was recorded; None where there is none.
    applied_ns, track_ns, frames_ns : of messages of these topics, which make a tick complete.
    without_image_ns : of ticks to which the camera had no image to give.
    dropped_frames : images that the run left out, as it counted them itself.
    ticks : with anything but an image, complete or not.
    first_ns : of the first message of any known topic.
    undeclared : messages of channels whose declaration was not found, or is damaged.
    skipped, first_skipped : messages that can not be decoded, and why the first can not.
    """

    keyframe_ns: int | None = None
    applied_ns: array[int] = field(default_factory=_times)
    track_ns: array[int] = field(default_factory=_times)
    frames_ns: array[int] = field(default_factory=_times)
    without_image_ns: array[int] = field(default_factory=_times)
    dropped_frames: int = 0
    ticks: int = 0
    first_ns: int | None = None
    undeclared: int = 0
    skipped: int = 0
    first_skipped: str = ""
    _tick_ns: int = -1

    def add(self, name: str, tick_ns: int, row: Row) -> None:
        """Enter a message that is kept, by its field of Tick and the row of its values."""
        if self.first_ns is None or tick_ns < self.first_ns:
            self.first_ns = tick_ns
        if name == "frame":
            self.frames_ns.append(tick_ns)
            return
        if tick_ns > self._tick_ns:
            self.ticks += tick_ns != self.keyframe_ns
            self._tick_ns = tick_ns
        if name == "applied":
            self.applied_ns.append(tick_ns)
            if row[_ABSENT] == row[_STAMP]:
                self.without_image_ns.append(tick_ns)
        elif name == "track":
            self.track_ns.append(tick_ns)
        elif name == "timing":
            self.dropped_frames = row[_DROPPED]

    def skip(self, fault: str) -> None:
        """Enter a message that can not be decoded."""
        self.skipped += 1
        self.first_skipped = self.first_skipped or fault

    @property
    def end_ns(self) -> int | None:
        """Stamp of the last tick with inputs and outputs, which are always in the same chunk; None without one."""
        return min(max(self.applied_ns), max(self.track_ns)) if self.applied_ns and self.track_ns else None


@dataclass(frozen=True, slots=True)
class Losses:
    """Amount of a session that is kept, and what was lost.

    Attributes
    ----------
    ticks, until_s : complete ticks without the keyframe of a part, and the time of the last one.
    lost : what was lost, as text; empty when nothing was.
    outcome : of the recovered session.
    """

    ticks: int
    until_s: float
    lost: str
    outcome: dict[str, str]


def losses(contents: SessionContents, found: Scan, tally: RecoveryTally, end_ns: int) -> Losses:
    """Judge what was found by a scan that filled `tally`; `end_ns` as in it."""
    complete = np.intersect1d(_array(tally.applied_ns), _array(tally.track_ns))
    complete = complete[(complete <= end_ns) & (complete != tally.keyframe_ns)]
    frames = np.unique(_array(tally.frames_ns))
    imageless = np.setdiff1d(complete, frames, assume_unique=True)
    missing = np.setdiff1d(imageless, _array(tally.without_image_ns)).size - tally.dropped_frames
    # Only replays are written without images.
    missing = missing if frames.size or not contents.header.parent else 0
    lost = "; ".join(_texts(contents, found, tally, missing, int((frames > end_ns).sum())))
    until_s = seconds(end_ns - (tally.first_ns or 0))
    return Losses(complete.size, until_s, lost, _outcome(contents, tally, lost, until_s))


def _array(times: array[int]) -> NDArray[np.int64]:
    return np.frombuffer(times, np.int64) if times else np.zeros(0, np.int64)


def _texts(
    contents: SessionContents, found: Scan, tally: RecoveryTally, images_missing: int, images_ahead: int
) -> Iterator[str]:
    if not found.ended:
        yield "the last moments, which were not on the disk"
    if found.lost_bytes:
        yield f"{found.lost_bytes} damaged or cut-off bytes, the first at {found.first_lost}"
    # The sequence numbers of a part may continue those of the part before.
    begin_ns = -1 if tally.keyframe_ns is None else tally.keyframe_ns
    applied = next((number for number, name in contents.fields.items() if name == "applied"), -1)
    if gaps := [gap for gap in found.gaps.get(applied, []) if gap.before_ns > begin_ns]:
        from_s = seconds(gaps[0].before_ns - (tally.first_ns or 0))
        yield f"{sum(gap.messages for gap in gaps)} ticks on the way (from {from_s:.2f} s on a replay is not exact)"
    # A topic that the file does not declare was not recorded, unless there are messages that belong to none.
    if tally.undeclared:
        absent = sorted(set(BY_PATH) - {channel.topic for channel in contents.channels.values()})
        yield f"{tally.undeclared} messages of topics whose declaration is damaged ({', '.join(absent) or 'unknown'})"
    if images_missing > 0:
        yield f"{images_missing} images"
    if images_ahead:
        yield f"all but the image of the last {images_ahead} ticks, which a replay passes over"
    if tally.skipped:
        yield f"{tally.skipped} messages that make no sense, the first is {tally.first_skipped}"


def _outcome(contents: SessionContents, tally: RecoveryTally, lost: str, until_s: float) -> dict[str, str]:
    recorded = {key: value for key, value in contents.outcome.items() if key not in _COUNTED}
    encoding = ENCODINGS.get(contents.frame_encoding) or ENCODINGS["raw"]
    marks = {"recovered_from": contents.source.path.name}
    marks |= Counters(ticks=tally.ticks, dropped_frames=tally.dropped_frames).summary(encoding)
    if not lost:
        return {"outcome": Outcome.ENDED, **recorded, **marks}
    if "outcome" in recorded:
        marks["ended_as"] = recorded["outcome"]
    return {**recorded, **marks, "outcome": Outcome.CUT, "note": f"recovered up to {until_s:.2f} s; lost: {lost}"}
