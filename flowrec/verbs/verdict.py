"""The verdict of `flowrec check`, and its counts from one pass over the messages of a file.

Messages come in file order; those of one tick need not follow each other. Memory does not grow with the file.
"""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from flowrec.core import (
    FIXED,
    STREAMS,
    Applied,
    CameraLosses,
    Clocks,
    Coverage,
    Figures,
    Frame,
    Message,
    Timing,
    TopicTable,
    invalid_numbers,
    printable,
    seconds,
)
from flowrec.stages import TrackQuality
from flowrec.store import Audit

RATE_TOLERANCE = 0.05  # relative, of the rate of images against the one that was asked for
GAP_PERIODS = 1.5  # between two frames from which on one is missing: halfway between one period and two
LISTED = 100  # longest gaps, and settings of the wall clock, that are kept in memory
_PENDING = 100_000  # incomplete ticks in memory; in files of flowrec these are half a second of ticks
_STEP_NS = 10_000  # resolution of the histogram of intervals
_INTERVALS = 100_000  # bins of that histogram
_FRAME, _APPLIED, _TRACK, _NO_IMAGE = 1, 2, 4, 8  # bits: which messages a tick has
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
    streams : the last state of the streams of other programs, in the type of the file; None: there are none.
    quality : judges the track; None: the head can not be read, which `check` tells elsewhere.
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
        self.streams: Any = None
        self._intervals: Counter[int] = Counter()
        self._longest: list[tuple[int, int]] = []  # a heap of length and beginning in ns
        self._last_ns: int | None = None
        self._last_index: int | None = None
        self._pending: dict[int, int] = {}  # by time of the tick, which of _BITS have been seen
        self._keyframe_ns: int | None = None
        self._topics: TopicTable = FIXED
        self.quality: TrackQuality | None = None
        self._judged: dict[str, Any] = dict.fromkeys(("track", "appearance", "shift"))
        self._judged_ns = 0

    def begin(self, found: Audit, quality: TrackQuality | None) -> None:
        """Take the header, before the first message."""
        part = found.header.part if found.header is not None else None
        self._keyframe_ns = part.keyframe_ns if part is not None else None
        self._topics, self.quality = found.topics, quality

    def add(self, name: str, log_ns: int, message: Message) -> None:
        """Count one message: its field of Tick, the time of its tick in ns, itself."""
        for wrong in invalid_numbers(message):
            self.not_finite[f"{self._topics.by_field[name].path} {wrong}"] += 1
        self.latest_ns[name] = stamp_ns = message.stamp_ns
        if log_ns != self._judged_ns:
            self._judge_track()
            self._judged_ns = log_ns
        if name in self._judged:
            self._judged[name] = message
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
        elif name == STREAMS and hasattr(message, "restarts"):  # else of another package
            self.streams = message

    def close(self) -> None:
        """Count the ticks that did not become complete, and judge the last track."""
        self._judge_track()
        for bits in self._pending.values():
            self._count(bits)
        self._pending.clear()

    def _judge_track(self) -> None:
        """Take the tick whose messages are complete: those of a time belong to one tick."""
        if self.quality is not None:
            self.quality.take(**self._judged)

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


_JUDGEMENTS = {
    "good": (0, "GOOD: {integrity}; can be replayed"),
    "usable": (3, "USABLE: {integrity}; can be replayed, but something was lost or is odd"),
    "bad": (1, "NOT USABLE as it is ({integrity})"),
}
# Never more than this is said: whoever can edit the file can edit its digest.
CONSISTENT = "consistent, unsigned"
NO_DIGEST = "no digest to be consistent with"
DAMAGED = "damaged or edited"
UNFINISHED = "not finished"
_MARKS = {"bad": "!!", "odd": "! "}


@dataclass(frozen=True, slots=True)
class Gap:
    """A time without a frame."""

    at_s: float  # of its beginning, since the first tick
    length_s: float


@dataclass(frozen=True, slots=True)
class CheckFinding:
    """Something wrong or unusual."""

    level: Literal["bad", "odd"]  # the session can not be used as it is; something was lost or is unusual
    about: str
    text: str


@dataclass(slots=True)
class Verdict:
    """Report of `flowrec check`.

    Attributes
    ----------
    path : the file.
    findings : what is wrong or unusual.
    facts : what was examined, as text by name.
    figures : the same in numbers, with the unit in the key.
    topics : messages read, by topic.
    gaps : the longest times without a frame, in order of time; `gap_count` is the number of all.
    parts : the verdicts on the parts of a run that was split.
    covered : how much of the file was read.
    integrity : whether it agrees with itself: one of the words above.
    """

    path: Path
    covered: Coverage
    findings: list[CheckFinding] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)
    figures: Figures = field(default_factory=dict)
    topics: dict[str, int] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    gap_count: int = 0
    parts: list[Verdict] = field(default_factory=list)
    integrity: str = CONSISTENT

    @property
    def word(self) -> Literal["good", "usable", "bad", "stopped"]:
        """The judgement; none where the file was not read to its end."""
        if self.covered.stopped:
            return "stopped"
        levels = {finding.level for finding in self.findings}
        return "bad" if "bad" in levels else "usable" if levels else "good"

    @property
    def exit_status(self) -> int:
        """0 good, 3 usable but something was lost or is odd, 1 not to be replayed, 130 or 143 stopped."""
        return self.covered.status if self.covered.stopped else _JUDGEMENTS[self.word][0]

    @property
    def judgement(self) -> str:
        """The judgement in a line."""
        if self.covered.stopped:
            found = "with what is below" if self.findings else "without a fault"
            return self.covered.sentence(found)
        return _JUDGEMENTS[self.word][1].format(integrity=self.integrity)

    def odd(self, about: str, text: str) -> None:
        """Add a finding: something was lost or is unusual."""
        self.findings.append(CheckFinding("odd", about, printable(text)))

    def bad(self, about: str, text: str) -> None:
        """Add a finding: the session can not be replayed as it is."""
        self.findings.append(CheckFinding("bad", about, printable(text)))

    def fact(self, about: str, text: str) -> None:
        """Add a fact."""
        self.facts[about] = printable(text)

    def lines(self) -> list[str]:
        """The verdict as lines of text, the judgement first."""
        lines = [printable(f"{self.path.name}: {self.judgement}")]
        ordered = sorted(self.findings, key=lambda finding: list(_MARKS).index(finding.level))
        lines += [f"  {_MARKS[finding.level]} {finding.text}" for finding in ordered]
        width = max(map(len, self.facts), default=0)
        return [*lines, *(f"  {name:{width}s}  {text}" for name, text in self.facts.items())]

    def as_json(self) -> dict[str, Any]:
        content = asdict(self)
        del content["path"]
        head = {"session": str(self.path), "verdict": self.word, "exit_status": self.exit_status}
        parts = [part.as_json() for part in self.parts]
        return head | content | {"parts": parts, "covered": self.covered.as_json()}
