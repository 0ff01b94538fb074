"""Ring buffer: the last seconds of a run in memory, and snapshot files of the time around an event.

The ring is a sequence of segments of about a second, each with sealed chunks and the full state when it began, so that
dropping the oldest needs no decoding, and memory is that of compressed data. At an event the ring is written to a file,
and what follows goes to the same file.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from flowrec.core import Action, Drops, Event, Level, OperatorEvent, Outcome, nanoseconds, seconds
from flowrec.store.channels import FRAMES
from flowrec.store.chunk import ChunkEncoder, Sink, copy_chunks
from flowrec.store.mcap_format import SealedChunk
from flowrec.store.run_files import partial_path, snapshot_path
from flowrec.store.segments import Counters, SegmentRouter, keyframe
from flowrec.store.session_file import AsyncFileWriter, SessionFile, Snapshot, WriterOptions
from flowrec.store.session_metadata import Part, SessionHeader
from flowrec.store.viewer_topics import ViewerTopics
from flowrec.store.write_queue import Entry, NewMessages

_SEGMENT_S, _SEGMENTS = 1.0, 8  # length of a segment in s, at most this fraction of the ring
_EVENTS_LISTED = 20  # of one snapshot
_POLL_S = 0.02


@dataclass(slots=True)
class _SnapshotFile:
    """A snapshot that is being written."""

    file: AsyncFileWriter
    until_ns: int
    events: list[str]
    shortage: dict[str, str]  # for the outcome, where the ring was too small
    counters: Counters = field(default_factory=Counters)

    @property
    def summary(self) -> dict[str, str]:
        """For the outcome, however the snapshot ends."""
        more = {"also": "; ".join(self.events[1:])} if len(self.events) > 1 else {}
        return {**self.shortage, **more}


class _RingSegment:
    """Consecutive ticks: in memory, or written to a snapshot."""

    def __init__(self, ring: RingBuffer, encoder: ChunkEncoder, state: NewMessages, keyframe_ns: int | None) -> None:
        self.state = state  # at the last tick before it, ...
        self.keyframe_ns = keyframe_ns  # ... which has this stamp
        self.begin_ns: int | None = None
        self.sequences = Counter(encoder.sequences)
        self.image: list[SealedChunk] = []  # the last one before it
        self.chunks: list[SealedChunk] = []
        self.encoder = encoder
        self.snapshot: _SnapshotFile | None = None
        self.discarded = False  # too old before all of its images had come
        self.is_first = self.is_last = False  # of that snapshot, which ends ...
        self.outcome: dict[str, str] = {}  # ... with this outcome
        self._ring = ring
        encoder.sink = self._keep(self.chunks)

    @property
    def nbytes(self) -> int:
        """Size of its chunks in memory."""
        return sum(len(chunk.data) for chunks in (self.chunks, self.image) for chunk in chunks)

    def add(self, entry: Entry) -> None:
        if self.begin_ns is None:
            self.begin_ns = entry.stamp_ns
        if not self.discarded:
            self.encoder.add(entry)

    def add_keyframe_image(self, entry: Entry) -> None:
        if self.snapshot is not None and not self.is_first:
            return  # the segment before it is in the same file
        sink = self.encoder.sink
        self.encoder.sink = self._keep(self.image) if self.snapshot is None else self.snapshot.file.put
        self.encoder.add(entry)
        self.encoder.seal((FRAMES,))
        self.encoder.sink = sink

    def end(self, counters: Counters) -> None:
        self.encoder.seal()
        self._ring.segment_ended(self, counters)

    def write_to(self, snapshot: _SnapshotFile) -> None:
        """Write the chunks in memory, and later entries, to a file."""
        self.snapshot = snapshot
        snapshot.file.put(self.chunks)
        self.chunks, self.image, self.state = [], [], {}
        self.encoder.sink = snapshot.file.put

    @staticmethod
    def _keep(chunks: list[SealedChunk]) -> Sink:
        return lambda sealed: chunks.extend(copy_chunks(sealed))


class RingBuffer:
    """Keeps the last seconds of the entries, and writes files around events.

    Parameters
    ----------
    path, header, options : of the run.
    settings : what a snapshot contains.
    run : a random word for the heads of its files.
    remarks : receives what happens, as text.

    Attributes
    ----------
    files : the finished ones, in order.

    Raises
    ------
    SessionError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(
        self,
        path: Path,
        header: SessionHeader,
        options: WriterOptions,
        settings: Snapshot,
        run: str,
        remarks: deque[str],
    ) -> None:
        self.files: list[Path] = []
        self._path, self._header, self._options, self._run = path, header, options, run
        self._settings = settings
        self._remarks = remarks
        self._before_ns, self._after_ns = nanoseconds(self._settings.before_s), nanoseconds(self._settings.after_s)
        self._segment_ns = min(nanoseconds(_SEGMENT_S), self._before_ns // _SEGMENTS)
        self._limit_bytes = int(1e6 * self._settings.megabytes)
        self._number = 0
        self._views = ViewerTopics.of_session(header, options.left_out_topics)
        self._sequences: Counter[str] = Counter()
        self._free: list[ChunkEncoder] = []
        self._ring: deque[tuple[_RingSegment, Counters]] = deque()  # without those that still wait for images
        self._is_short = False  # the ring has been too small since it began to fill
        self._snapshot: _SnapshotFile | None = None
        self._finishing: list[_SnapshotFile] = []
        self._finished_bytes = 0
        self._flushed_s, self._flushed_ns = time.monotonic(), 0
        self._dropped = 0
        self._dropped_ns: int | None = None
        self._router = SegmentRouter(self._segment({}, None))
        self._check_disk()

    def begin_at(self, start_unix_ns: int) -> None:
        """Take another Unix time of stamp 0, before anything was added."""
        self._header = replace(self._header, start_unix_ns=start_unix_ns)
        self._views.begin_at(start_unix_ns)
        self._router.current.segment.encoder.start_unix_ns = start_unix_ns

    @property
    def partial_path(self) -> Path:
        """The file that is written at present, or the next one."""
        return partial_path(snapshot_path(self._path, self._number + (self._snapshot is None)))

    @property
    def size(self) -> int:
        """Bytes of the files. May be asked for by another thread."""
        return self._finished_bytes + sum(snapshot.file.size for snapshot in self._unfinished_files())

    @property
    def timeout_s(self) -> float | None:
        """Time until `flush_if_due` has something to do, in s; None: not before the next entry."""
        if self._snapshot is None:
            return None
        return max(_POLL_S, self._flushed_s + self._options.flush_interval_s - time.monotonic())

    @property
    def flushed_ns(self) -> int | None:
        """Stamp of the last entry: a run in memory never waits for the disk."""
        return self._router.last_ns

    def add(self, entry: Entry) -> None:
        """Keep one entry in the ring, or write it."""
        self._collect_finished()
        if entry.ticks:
            snapshot = self._snapshot
            if snapshot is not None and entry.stamp_ns > snapshot.until_ns:
                self._end({"outcome": Outcome.SNAPSHOT, "note": snapshot.events[0], **snapshot.summary})
            elif snapshot is None and self._is_full(entry.stamp_ns):
                self._cut()
        self._router.add(entry)
        event = self._event_in(entry)
        if event:
            self._take(event, entry.stamp_ns)

    def flush_if_due(self) -> None:
        """Write and sync the data of a snapshot whose interval has passed; the ring stays in memory."""
        snapshot, last_ns = self._snapshot, self._router.last_ns or 0
        if snapshot is None:
            return
        now, interval_s = time.monotonic(), self._options.flush_interval_s
        if now >= self._flushed_s + interval_s or seconds(last_ns - self._flushed_ns) >= interval_s:
            for place in self._router.open:
                if place.segment.snapshot is snapshot:
                    place.segment.encoder.seal()
            snapshot.file.sync_if_due()
            self._flushed_s, self._flushed_ns = now, last_ns

    def flush(self) -> None:
        """Nothing to do, see `flushed_ns`."""

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        """End the snapshot; with `why`, the reason of a bad end, a snapshot of the ring is taken first."""
        if why:
            self._take(why, self._router.last_ns or 0)
        if self._snapshot is not None:
            self._end({**outcome, **self._snapshot.summary})
        self._collect_finished(wait=True)

    def close(self, reason: str = "") -> None:
        """Close all files as they are."""
        for snapshot in self._unfinished_files():
            snapshot.file.close()

    def segment_ended(self, segment: _RingSegment, counters: Counters) -> None:
        """Add a complete segment to the ring or to its snapshot."""
        snapshot = segment.snapshot
        if snapshot is not None:
            snapshot.counters.include(counters)
            if segment.is_last:
                outcome = {**segment.outcome, **snapshot.counters.summary(self._options.encoding)}
                snapshot.file.finish(outcome, self._views.top_um_s)
        elif not segment.discarded:
            self._ring.append((segment, counters))
            self._trim()
        self._free.append(segment.encoder)

    def _unfinished_files(self) -> tuple[_SnapshotFile, ...]:
        return (*self._finishing, *((self._snapshot,) if self._snapshot is not None else ()))

    def _segment(self, state: NewMessages, keyframe_ns: int | None) -> _RingSegment:
        encoder = self._free.pop() if self._free else self._encoder(self._views, self._sequences)
        return _RingSegment(self, encoder, state, keyframe_ns)

    def _encoder(self, views: ViewerTopics, sequences: Counter[str]) -> ChunkEncoder:
        options, start_unix_ns = self._options, self._header.start_unix_ns
        encoder = ChunkEncoder(options.encoding, views, _discard, start_unix_ns, options.topics)
        encoder.sequences = sequences
        return encoder

    def _cut(self) -> None:
        self._router.cut(self._segment(dict(self._router.state), self._router.last_ns))
        self._trim()

    def _is_full(self, stamp_ns: int) -> bool:
        segment = self._router.current.segment
        if segment.begin_ns is None:
            return False
        return stamp_ns - segment.begin_ns >= self._segment_ns or _SEGMENTS * segment.nbytes >= self._limit_bytes

    def _segments(self) -> list[_RingSegment]:
        """The segments in memory, oldest first."""
        waiting = [place.segment for place in self._router.open]
        return [segment for segment, _ in self._ring] + [
            segment for segment in waiting if segment.snapshot is None and not segment.discarded
        ]

    def _is_old(self, segment: _RingSegment) -> bool:
        """True if the ring is long enough without the segments before this one."""
        last_ns = self._router.last_ns
        return last_ns is not None and segment.begin_ns is not None and last_ns - segment.begin_ns >= self._before_ns

    def _trim(self) -> None:
        """Discard segments that are older than the settings ask for, or do not fit into memory."""
        now_ns = self._router.last_ns or 0
        while self._ring:
            segments = self._segments()
            begin_ns, old = segments[1].begin_ns, self._is_old(segments[1])
            large = sum(segment.nbytes for segment in segments) > self._limit_bytes
            if not old and not large:
                return
            if not old and not self._is_short:
                self._is_short = True
                held_s = seconds(now_ns - (begin_ns or now_ns))
                self._remarks.append(
                    f"the last {held_s:.1f} of {self._settings.before_s:g} s fit into {self._settings.megabytes:g} MB;"
                    " set recording.snapshot_mb higher, or a slower camera"
                )
            self._ring.popleft()

    def _take(self, event: str, stamp_ns: int) -> None:
        """Begin a snapshot, or extend the one that is being written."""
        if self._snapshot is not None:
            self._snapshot.until_ns = stamp_ns + self._after_ns
            if len(self._snapshot.events) < _EVENTS_LISTED:
                self._snapshot.events.append(event)
            return
        self._trim()
        segments = self._segments()
        while len(segments) > 1 and self._is_old(segments[1]):  # still waits for images, and is not needed
            segments.pop(0).discarded = True
        first = segments[0]
        held_s = seconds(stamp_ns - (stamp_ns if first.begin_ns is None else first.begin_ns))
        self._number += 1
        header = replace(self._header, part=Part(self._run, self._number, "snapshot", first.keyframe_ns, event))
        path = snapshot_path(self._path, self._number)
        file = AsyncFileWriter(path, header, self._options, limit_bytes=self._limit_bytes)
        shortage = {"short_of_memory": f"{held_s:.1f} of {self._settings.before_s:g} s before the event"}
        snapshot = _SnapshotFile(file, stamp_ns + self._after_ns, [event], shortage if self._is_short else {})
        self._snapshot = snapshot
        if first.keyframe_ns is not None:
            # Numbered as if they had been written just before what follows.
            sequences = Counter({topic: (number - 1) % 2**32 for topic, number in first.sequences.items()})
            encoder = self._encoder(self._views.copy(), sequences)
            file.put_keyframe(encoder, keyframe(first.keyframe_ns, first.state))
            file.put(first.image)
        first.is_first = True
        for _, counters in self._ring:
            snapshot.counters.include(counters)
        for segment in segments:
            segment.write_to(snapshot)
        self._ring.clear()
        self._flushed_s, self._flushed_ns = time.monotonic(), stamp_ns
        self._remarks.append(f"{file.path}: {held_s:.1f} s before and what follows; {event}")

    def _end(self, outcome: Mapping[str, str]) -> None:
        """End the snapshot with the tick before; the ring begins to fill again."""
        snapshot, segment = self._snapshot, self._router.current.segment
        assert snapshot is not None
        segment.is_last, segment.outcome = True, dict(outcome)
        self._snapshot, self._is_short = None, False
        self._finishing.append(snapshot)
        self._cut()

    def _event_in(self, entry: Entry) -> str:
        """The event in this entry that a snapshot is taken for, as text; empty: none."""
        event, operator, drops = map(entry.messages.get, ("event", "operator", "drops"))
        if isinstance(operator, OperatorEvent) and operator.action in (Action.MARK, Action.NOTE):
            return f"{operator.action}: {operator.text}".rstrip(": ")
        if isinstance(event, Event) and event.level in (Level.WARNING, Level.ERROR):
            return event.text
        if isinstance(drops, Drops):
            dropped = drops.by_backlog + drops.by_camera
            if dropped > self._dropped:
                # Where images are lost all the time, the first one is the event.
                began = self._dropped_ns is None or entry.stamp_ns - self._dropped_ns > self._before_ns
                self._dropped, self._dropped_ns = dropped, entry.stamp_ns
                return "images are lost" if began else ""
        return ""

    def _collect_finished(self, *, wait: bool = False) -> None:
        """Note the files that are complete; raises the error of a file."""
        for snapshot in self._unfinished_files():
            snapshot.file.check(wait=wait)
        while self._finishing and self._finishing[0].file.finished:
            file = self._finishing.pop(0).file
            file.close()
            self._finished_bytes += file.size
            self.files.append(file.path)
            self._remarks.append(f"{file.path}: whole, {file.size / 1e6:.1f} MB")

    def _check_disk(self) -> None:
        """Make a file and remove it, so that an error is reported at the start and not at the event."""
        file = SessionFile(snapshot_path(self._path, 1), self._header, self._options)
        file.partial_path.unlink(missing_ok=True)
        file.close()  # after that, for another process may make a file of this name as soon as it is not locked


def _discard(_chunks: list[SealedChunk]) -> None:
    """The sink of an encoder that no segment uses yet."""
