"""The counts of `flowrec check`, from one pass over the messages of a file.

Messages come in file order; those of one tick need not follow each other. Memory does not grow with the file.
"""

from __future__ import annotations

import heapq
from collections import Counter

from flowrec.core import (
    FIXED,
    Appearance,
    Applied,
    CameraLosses,
    Clocks,
    FlowrecError,
    Frame,
    Message,
    Shift,
    Timing,
    TopicTable,
    Track,
    invalid_numbers,
    seconds,
)
from flowrec.physics import chip_from_files
from flowrec.stages import TrackQuality, calibration_of, config_from_toml
from flowrec.store import Audit
from flowrec.verbs.verdict import Gap

GAP_PERIODS = 1.5
LISTED = 100  # longest gaps, and settings of the wall clock, that are kept in memory
_PENDING = 100_000  # incomplete ticks in memory; in files of flowrec these are half a second of ticks
_STEP_NS = 10_000  # resolution of the histogram of intervals
_INTERVALS = 100_000  # bins of that histogram
_FRAME, _APPLIED, _TRACK, _NO_IMAGE = 1, 2, 4, 8
_BITS = {"frame": _FRAME, "applied": _APPLIED, "track": _TRACK}


class ClockTally:
    """Counts of the messages about clocks.

    Attributes
    ----------
    last : the last message, which holds the totals; None without any.
    wall_set : settings of the wall clock during the run: stamp in ns, step in s.
    late_s, latest_s : mean and largest delay of the images' arrival, in s.
    """

    def __init__(self) -> None:
        self.last: Clocks | None = None
        self.wall_set: list[tuple[int, float]] = []
        self.late_s = self.latest_s = 0.0
        self._count = 0

    def add(self, message: Clocks) -> None:
        """Count one message."""
        before, self.last = self.last, message
        jumps, set_s = (before.wall_jumps, before.wall_set_s) if before is not None else (0, 0.0)
        if message.wall_jumps > jumps and len(self.wall_set) < LISTED:
            self.wall_set.append((message.stamp_ns, message.wall_set_s - set_s))
        self._count += 1
        self.late_s += (message.late_s - self.late_s) / self._count
        self.latest_s = max(self.latest_s, message.latest_s)


class Tally:
    """Counts of the messages of one file.

    Attributes
    ----------
    ticks : ticks with a report of the coils or a track.
    images_missing : ticks without an image, where the camera had one.
    images_alone : ticks with nothing but an image.
    inputs_missing : ticks that can not be replayed: no report of the coils, or neither image nor track.
    unfinished_ticks : ticks with inputs that no stage has answered.
    dropped : images that the writer counted as dropped.
    index_steps, index_backwards : numbers of images that were left out, and that went backwards.
    not_finite : NaN and infinity where they do not belong, by topic and field.
    repeated, repeated_ns : messages of the keyframe of a part, by field of Tick: number, and own stamp.
    latest_ns : own stamp of the last message, by field of Tick.
    losses : what the camera had lost at the last count; None: it does not count.
    """

    def __init__(self) -> None:
        self.ticks = self.images_missing = self.images_alone = self.inputs_missing = self.unfinished_ticks = 0
        self.dropped = self.index_steps = self.index_backwards = 0
        self.not_finite: Counter[str] = Counter()
        self.repeated: Counter[str] = Counter()
        self.repeated_ns: dict[str, int] = {}
        self.latest_ns: dict[str, int] = {}
        self.clocks = ClockTally()
        self.losses: CameraLosses | None = None
        self._intervals: Counter[int] = Counter()
        self._longest: list[tuple[int, int]] = []  # a heap of length and beginning in ns
        self._last_ns: int | None = None
        self._last_index: int | None = None
        self._pending: dict[int, int] = {}  # by time of the tick, which of _BITS have been seen
        self._keyframe_ns: int | None = None
        self._topics: TopicTable = FIXED

    def begin(self, found: Audit) -> None:
        """Take the header, before the first message."""
        part = found.header.part if found.header is not None else None
        self._keyframe_ns = part.keyframe_ns if part is not None else None
        self._topics = found.topics

    def add(self, name: str, log_ns: int, message: Message) -> None:
        """Count one message: its field of Tick, the time of its tick in ns, itself."""
        for wrong in invalid_numbers(message):
            self.not_finite[f"{self._topics.by_field[name].path} {wrong}"] += 1
        self.latest_ns[name] = stamp_ns = message.stamp_ns  # type: ignore[attr-defined]
        if log_ns == self._keyframe_ns:
            self.repeated[name] += 1
            self.repeated_ns[name] = stamp_ns
        elif name in _BITS:
            without_image = isinstance(message, Applied) and message.without_image
            self._add_to_tick(log_ns, _BITS[name] | (_NO_IMAGE if without_image else 0))
        if isinstance(message, Applied) and not message.without_image:
            self._add_interval(log_ns)
        if isinstance(message, Frame):
            step = message.index - self._last_index - 1 if self._last_index is not None else 0
            self.index_steps += max(step, 0)
            self.index_backwards += step < 0
            self._last_index = message.index
        elif isinstance(message, Timing):
            self.dropped = max(self.dropped, message.dropped_frames)
        elif isinstance(message, Clocks):
            self.clocks.add(message)
        elif isinstance(message, CameraLosses):
            self.losses = message

    def close(self) -> None:
        """Count the ticks that did not become complete."""
        for bits in self._pending.values():
            self._count(bits)
        self._pending.clear()

    @property
    def period_ns(self) -> int:
        """Median interval of the ticks, 0 when there are fewer than two."""
        half = (self._intervals.total() + 1) // 2
        for interval, count in sorted(self._intervals.items()):
            half -= count
            if half <= 0:
                return interval
        return 0

    def gaps(self, first_ns: int) -> tuple[list[Gap], int]:
        """The longest gaps in order of time, and the number of all."""
        limit = GAP_PERIODS * self.period_ns
        count = sum(count for interval, count in self._intervals.items() if interval > limit)
        longest = sorted((begin, length) for length, begin in self._longest if length > limit + _STEP_NS / 2)
        return [Gap(seconds(begin - first_ns), seconds(length)) for begin, length in longest], count

    def _add_interval(self, log_ns: int) -> None:
        last_ns, self._last_ns = self._last_ns, log_ns
        if last_ns is None or log_ns <= last_ns:
            return
        interval = round((log_ns - last_ns) / _STEP_NS) * _STEP_NS
        if interval in self._intervals or len(self._intervals) < _INTERVALS:
            self._intervals[interval] += 1
        heapq.heappush(self._longest, (log_ns - last_ns, last_ns))
        if len(self._longest) > LISTED:
            heapq.heappop(self._longest)

    def _add_to_tick(self, log_ns: int, bit: int) -> None:
        bits = self._pending.pop(log_ns, 0) | bit
        if bits in (_FRAME | _APPLIED | _TRACK, _NO_IMAGE | _APPLIED | _TRACK):
            self._count(bits)
            return
        self._pending[log_ns] = bits
        if len(self._pending) > _PENDING:
            self._count(self._pending.pop(next(iter(self._pending))))

    def _count(self, bits: int) -> None:
        if bits == _FRAME:
            self.images_alone += 1
            return
        self.ticks += 1
        self.unfinished_ticks += bits == _FRAME | _APPLIED
        self.images_missing += bits == _APPLIED | _TRACK
        self.inputs_missing += not bits & _APPLIED or bits == _APPLIED


class TrackTally:
    """Judges the track from the messages of one file in order; those of a time belong to one tick."""

    def __init__(self) -> None:
        self._quality: TrackQuality | None = None
        self._at_ns = 0
        self._track: Track | None = None
        self._appearance: Appearance | None = None
        self._shift: Shift | None = None

    def begin(self, found: Audit) -> None:
        """Take the header; without a readable one nothing is judged, and `check` tells of it elsewhere."""
        if found.header is None:
            return
        try:
            head = found.header
            config = config_from_toml(head.config_toml, "its configuration", head.provenance)
            chip = chip_from_files(head.chip_png, head.chip_toml, "its chip")
        except FlowrecError:
            return
        shape = config.camera.height_px, config.camera.width_px
        self._quality = TrackQuality(calibration_of(config, chip), shape, config.robot)

    def add(self, log_ns: int, message: Message) -> None:
        """Take one message: the time of its tick in ns, itself."""
        if log_ns != self._at_ns:
            self.close()
            self._at_ns = log_ns
        if isinstance(message, Track):
            self._track = message
        elif isinstance(message, Appearance):
            self._appearance = message
        elif isinstance(message, Shift):
            self._shift = message

    def close(self) -> None:
        """Take the tick whose messages are complete."""
        if self._quality is not None:
            self._quality.take(self._track, self._appearance, self._shift)

    def doubts(self) -> list[str]:
        """Reasons to doubt the track; none if there is no reason."""
        return [] if self._quality is None else self._quality.doubts()
