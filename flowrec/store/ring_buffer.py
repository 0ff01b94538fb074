"""Ring buffer: the last seconds of a run in memory, and snapshot files of the time around an event.

The ring is a sequence of segments of about a second, each with sealed chunks and the full state when it began, so that
dropping the oldest needs no decoding, and memory is that of compressed data. At an event the ring is written to a file,
and what follows goes to the same file.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from flowrec.core import Action, Drops, Event, Level, OperatorEvent, Outcome, nanoseconds, seconds
from flowrec.store.chunk import ChunkEncoder
from flowrec.store.run_files import partial_path, snapshot_path
from flowrec.store.segments import RecordingPlan, Segment, SegmentedRun
from flowrec.store.session_file import SessionFile, Snapshot, WriterOptions
from flowrec.store.session_metadata import Part, SessionHeader
from flowrec.store.write_queue import Counters, Entry, NewMessages

_SEGMENT_S, _SEGMENTS = 1.0, 8  # length of a segment in s, at most this fraction of the ring
_EVENTS_LISTED = 20  # of one snapshot


class _SnapshotFile(SessionFile):
    """A snapshot that is being written.

    Attributes
    ----------
    until_ns : stamp after which it ends.
    events : in it, as text.
    outcome : for its end; before that, what is said of a ring that was too small.
    last : segment in it; None until it ends.
    """

    def __init__(self, path: Path, header: SessionHeader, options: WriterOptions, limit_bytes: int) -> None:
        super().__init__(path, header, options, limit_bytes=limit_bytes)
        self.until_ns = 0
        self.events: list[str] = []
        self.last: Segment | None = None
        self.outcome: dict[str, str] = {}
        self.counters = Counters()


class RingBuffer(SegmentedRun):
    """Keeps the last seconds of the entries, and writes files around events."""

    def __init__(self, plan: RecordingPlan, tell: Callable[[str], None]) -> None:
        super().__init__(plan, tell)
        assert isinstance(plan.options.files, Snapshot)
        self._settings = settings = plan.options.files
        self._before_ns, self._after_ns = nanoseconds(settings.before_s), nanoseconds(settings.after_s)
        self._segment_ns = min(nanoseconds(_SEGMENT_S), self._before_ns // _SEGMENTS)
        self._limit_bytes = int(1e6 * settings.megabytes)
        self._number = 0
        self._sequences: Counter[str] = Counter()
        self._free: list[ChunkEncoder] = []
        self._ring: deque[Segment] = deque()  # without those that still wait for images
        self._is_short = False  # the ring has been too small since it began to fill
        self._snapshot: _SnapshotFile | None = None
        self.open.append(self._segment())
        # Make a file and remove it, so that an error is reported at the start and not at the event.
        file = SessionFile(snapshot_path(plan.path, 1), plan.header, plan.options)
        file.partial_path.unlink(missing_ok=True)
        file.close()  # after that, for another process may make a file of this name as soon as it is not locked

    @property
    def partial_path(self) -> Path:
        return partial_path(snapshot_path(self._path, self._number + (self._snapshot is None)))

    @property
    def flushed_ns(self) -> int | None:
        return self._last_ns  # a run in memory never waits for the disk

    def add(self, entry: Entry) -> None:
        super().add(entry)
        if entry.event:
            self._take(entry.event, entry.stamp_ns)

    def _cut_before(self, stamp_ns: int) -> None:
        snapshot = self._snapshot
        if snapshot is not None and stamp_ns > snapshot.until_ns:
            self._end_snapshot({"outcome": Outcome.SNAPSHOT, "note": snapshot.events[0]})
        elif snapshot is None and self._is_full(stamp_ns):
            self._cut(self._segment())

    def flush(self) -> None:
        pass  # see flushed_ns

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        """End the snapshot; with `why`, the reason of a bad end, a snapshot of the ring is taken first."""
        if why:
            self._take(why, self._last_ns or 0)
        if self._snapshot is not None:
            self._end_snapshot(outcome)
        self._collect_finished(wait=True)

    def _end(self, segment: Segment) -> None:
        """Add a complete segment to the ring or to its snapshot."""
        snapshot = segment.file
        segment.encoder.seal()
        if isinstance(snapshot, _SnapshotFile):
            snapshot.encoders.remove(segment.encoder)
            snapshot.counters.include(segment.counters)
            if snapshot.last is segment:
                self._complete(snapshot, snapshot.outcome, snapshot.counters)
        elif not segment.discarded:
            self._ring.append(segment)
            self._trim()
        self._free.append(segment.encoder)

    def _segment(self) -> Segment:
        encoder = self._free.pop() if self._free else self._encoder()
        encoder.sequences = self._sequences
        return Segment(encoder, self._state_now())

    def _note_finished(self, file: SessionFile) -> None:
        super()._note_finished(file)
        self._tell(f"{file.path}: whole, {file.size / 1e6:.1f} MB")

    def _is_full(self, stamp_ns: int) -> bool:
        segment = self.open[-1]
        if segment.begin_ns is None:
            return False
        return stamp_ns - segment.begin_ns >= self._segment_ns or _SEGMENTS * segment.held_bytes >= self._limit_bytes

    def _segments(self) -> list[Segment]:
        """The segments in memory, oldest first."""
        return [*self._ring, *(each for each in self.open if each.file is None and not each.discarded)]

    def _is_old(self, segment: Segment) -> bool:
        """True if the ring is long enough without the segments before this one."""
        begin_ns, last_ns = segment.begin_ns, self._last_ns
        return last_ns is not None and begin_ns is not None and last_ns - begin_ns >= self._before_ns

    def _trim(self) -> None:
        """Discard segments that are older than the settings ask for, or do not fit into memory."""
        now_ns = self._last_ns or 0
        while self._ring:
            segments = self._segments()
            begin_ns, old = segments[1].begin_ns, self._is_old(segments[1])
            large = sum(segment.held_bytes for segment in segments) > self._limit_bytes
            if not old and not large:
                return
            if not old and not self._is_short:
                self._is_short = True
                held_s = seconds(now_ns - (begin_ns or now_ns))
                self._tell(
                    f"the last {held_s:.1f} of {self._settings.before_s:g} s fit into {self._settings.megabytes:g} MB;"
                    " set recording.snapshot_mb higher, or a slower camera"
                )
            self._ring.popleft()

    def _take(self, event: str, stamp_ns: int) -> None:
        """Begin a snapshot, or extend the one that is being written."""
        snapshot = self._snapshot or self._begin_snapshot(event, stamp_ns)
        snapshot.until_ns = stamp_ns + self._after_ns
        if len(snapshot.events) < _EVENTS_LISTED:
            snapshot.events.append(event)

    def _begin_snapshot(self, event: str, stamp_ns: int) -> _SnapshotFile:
        self._trim()
        segments = self._segments()
        while len(segments) > 1 and self._is_old(segments[1]):  # still waits for images, and is not needed
            segments.pop(0).discarded = True
        first = segments[0]
        held_s = seconds(stamp_ns - (stamp_ns if first.begin_ns is None else first.begin_ns))
        self._number += 1
        header = replace(self._header, part=Part(self._plan.run, self._number, "snapshot", first.keyframe_ns, event))
        path = snapshot_path(self._path, self._number)
        self._snapshot = snapshot = _SnapshotFile(path, header, self._options, self._limit_bytes)
        self._begin_file(snapshot, first)
        if self._is_short:
            short = f"{held_s:.1f} of {self._settings.before_s:g} s before the event"
            snapshot.outcome = {"short_of_memory": short}
        for segment in self._ring:
            snapshot.counters.include(segment.counters)
        for segment in segments:
            segment.write_to(snapshot, begins_file=segment is first)
        snapshot.encoders += [segment.encoder for segment in self.open if not segment.discarded]
        self._ring.clear()
        self._tell(f"{path}: {held_s:.1f} s before and what follows; {event}")
        return snapshot

    def _end_snapshot(self, outcome: Mapping[str, str]) -> None:
        """End the snapshot with the tick before; the ring begins to fill again."""
        snapshot = self._snapshot
        assert snapshot is not None
        others = {"also": "; ".join(snapshot.events[1:])} if len(snapshot.events) > 1 else {}
        snapshot.last, snapshot.outcome = self.open[-1], {**outcome, **snapshot.outcome, **others}
        self._snapshot, self._is_short = None, False
        self._cut(self._segment())


class SnapshotTrigger:
    """Finds what a snapshot is taken for: a mark, a note, a warning, an error, the first lost image."""

    def __init__(self, settings: Snapshot) -> None:
        self._before_ns = nanoseconds(settings.before_s)
        self._dropped = 0
        self._dropped_ns: int | None = None

    def event_in(self, stamp_ns: int, messages: NewMessages) -> str:
        """The event in the new messages of a tick, as text; empty: none."""
        event, operator, drops = map(messages.get, ("event", "operator", "drops"))
        if isinstance(operator, OperatorEvent) and operator.action in (Action.MARK, Action.NOTE):
            return f"{operator.action}: {operator.text}".rstrip(": ")
        if isinstance(event, Event) and event.level in (Level.WARNING, Level.ERROR):
            return event.text
        if isinstance(drops, Drops):
            dropped = drops.by_backlog + drops.by_camera
            if dropped > self._dropped:
                # Where images are lost all the time, the first one is the event.
                began = self._dropped_ns is None or stamp_ns - self._dropped_ns > self._before_ns
                self._dropped, self._dropped_ns = dropped, stamp_ns
                return "images are lost" if began else ""
        return ""
