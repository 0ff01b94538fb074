"""The last seconds of a run in memory, and files of what was around an event.

The ring is a row of segments of about a second, each with sealed chunks and all that was known when it began, so that
dropping the oldest needs nothing decoded, and memory is that of compressed data. At an event the ring is poured into
a file, and what follows goes the same way.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from flowrec.messages import Drops, Event, Frame, OperatorEvent
from flowrec.store.async_file_writer import Poured
from flowrec.store.channels import FRAMES
from flowrec.store.chunk import Sealed, kept
from flowrec.store.chunk_encoder import Packer
from flowrec.store.metadata import Part
from flowrec.store.paths import partial_path, snapshot_path
from flowrec.store.segments import Stretches, Tally, carried
from flowrec.store.session_file import Making, Piece
from flowrec.store.viewer_topics import Mirrors
from flowrec.store.write_queue import Entry, News
from flowrec.units import nanoseconds, seconds

_SEGMENT_S, _SEGMENTS = 1.0, 8  # a segment is as long, or a share of the ring
_TOLD = 20  # events of one snapshot
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What is kept of a run around an event: a mark, a note, a warning, images that begin to be lost, a bad end.

    Attributes
    ----------
    before_s, after_s : s of stamps before the event and after the last one that fell into the same snapshot.
    megabytes : what may be held in memory, in MB; where it is too little, `before_s` is what fits.
    """

    before_s: float
    after_s: float = 10.0
    megabytes: float = 1000.0


@dataclass(slots=True)
class _Taken:
    """A snapshot that is being taken."""

    file: Poured
    until_ns: int
    why: list[str]
    short: dict[str, str]  # what is to be said where the ring was too small
    tally: Tally = field(default_factory=Tally)

    def add(self, why: str, until_ns: int) -> None:
        """Another event meanwhile."""
        self.until_ns = until_ns
        if len(self.why) < _TOLD:
            self.why.append(why)

    @property
    def outcome(self) -> dict[str, str]:
        """How it ends when its time is over."""
        return {"outcome": "snapshot", "note": self.why[0], **self.said}

    @property
    def said(self) -> dict[str, str]:
        """What is said of it in any case."""
        return {**self.short, **({"also": "; ".join(self.why[1:])} if len(self.why) > 1 else {})}


class _Segment:
    """Some ticks that follow each other: in memory, or poured into a file."""

    def __init__(self, snapshots: Snapshots, packer: Packer, known: News, carried_ns: int | None) -> None:
        self.known = known  # at its beginning ...
        self.carried_ns = carried_ns  # ... by the tick before it
        self.begin_ns: int | None = None
        self.sequences = Counter(packer.sequences)
        self.image: list[Sealed] = []  # the last one before it
        self.chunks: list[Sealed] = []
        self.nbytes = 0
        self.packer = packer
        self.taken: _Taken | None = None
        self.forgotten = False  # too old before all of its images had come
        self.first = self.last = False  # of that snapshot, which ends ...
        self.outcome: dict[str, str] = {}  # ... like this
        self._snapshots = snapshots
        packer.take = self._keep

    @property
    def is_held(self) -> bool:
        """In memory, and needed."""
        return self.taken is None and not self.forgotten

    def add(self, entry: Entry) -> None:
        if self.begin_ns is None:
            self.begin_ns = entry.stamp_ns
        if not self.forgotten:
            self.packer.add(entry)

    def carry_image(self, stamp_ns: int, image: Frame) -> None:
        if self.taken is not None and not self.first:
            return  # the one before is in the same file
        take, self.packer.take = self.packer.take, self._keep_image if self.taken is None else self.taken.file.put
        self.packer.add(Entry(stamp_ns, {"frame": image}, 0))
        self.packer.seal((FRAMES,))
        self.packer.take = take

    def complete(self, tally: Tally) -> None:
        self.packer.seal()
        self._snapshots.completed(self, tally)

    def pour(self, taken: _Taken) -> None:
        """Into a file with what is there, and with what comes."""
        self.taken = taken
        taken.file.put(self.chunks)
        self.chunks, self.image, self.nbytes, self.known = [], [], 0, {}
        self.packer.take = taken.file.put

    def _keep(self, sealed: list[Sealed]) -> None:
        self.chunks += kept(sealed)
        self.nbytes += sum(len(chunk.data) for chunk in sealed)

    def _keep_image(self, sealed: list[Sealed]) -> None:
        self.image += kept(sealed)
        self.nbytes += sum(len(chunk.data) for chunk in sealed)


class Snapshots:
    """Keeps the last seconds of the entries, and writes files around events.

    Parameters
    ----------
    making : what they are made with.
    snapshot : what is kept.
    remarks : told what happens, for a person.

    Attributes
    ----------
    files : the finished ones, in order.

    Raises
    ------
    SessionError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(self, making: Making, snapshot: Snapshot, run: str, remarks: deque[str]) -> None:
        self.files: list[Path] = []
        self._remarks = remarks
        self._making = making
        self._before_ns, self._after_ns = nanoseconds(snapshot.before_s), nanoseconds(snapshot.after_s)
        self._segment_ns = min(nanoseconds(_SEGMENT_S), self._before_ns // _SEGMENTS)
        self._limit_bytes = int(1e6 * snapshot.megabytes)
        self._settings = snapshot
        self._run = run
        self._number = 0
        self._mirrors = Mirrors(making.unwanted, making.header.start_unix_ns)
        self._sequences: Counter[str] = Counter()
        self._free: list[Packer] = []
        self._ring: deque[tuple[_Segment, Tally]] = deque()  # without those that still wait for images
        self._short = False  # of memory, since the ring began to fill
        self._taken: _Taken | None = None
        self._ending: list[_Taken] = []
        self._ended_bytes = 0
        self._flushed_s, self._flushed_ns = time.monotonic(), 0
        self._flush_s = making.flush_every_s
        self._dropped = 0
        self._dropped_ns: int | None = None
        self._stretches = Stretches(self._segment({}, None))
        self._try()

    @property
    def partial_path(self) -> Path:
        """The file that is written just now, or that would be."""
        return partial_path(snapshot_path(self._making.path, self._number + (self._taken is None)))

    @property
    def size(self) -> int:
        """Bytes of the files."""
        taken = self._taken
        growing = [*tuple(self._ending), *([taken] if taken is not None else [])]
        return self._ended_bytes + sum(each.file.size for each in growing)

    @property
    def patience_s(self) -> float | None:
        """For how long one may wait for the next entry; None: for ever."""
        if self._taken is None:
            return None
        return max(_POLL_S, self._flushed_s + self._flush_s - time.monotonic())

    @property
    def flushed_ns(self) -> int | None:
        """All that was added: who keeps a run in memory is not to wait for a disk."""
        return self._stretches.last_ns

    def add(self, entry: Entry) -> None:
        """Keep one entry, or write it."""
        self._hear_of_ended()
        if entry.ticks:
            taken = self._taken
            if taken is not None and entry.stamp_ns > taken.until_ns:
                self._end()
            elif taken is None and self._is_full(entry.stamp_ns):
                self._cut()
        self._stretches.add(entry)
        why = self._why(entry)
        if why:
            self._take(why, entry.stamp_ns)

    def flush_if_due(self) -> None:
        """Hand on what has waited for long enough; in memory it may wait for ever."""
        taken, last_ns = self._taken, self._stretches.last_ns or 0
        if taken is None:
            return
        now = time.monotonic()
        if now >= self._flushed_s + self._flush_s or seconds(last_ns - self._flushed_ns) >= self._flush_s:
            for place in self._stretches.open:
                if place.stretch.taken is taken:
                    place.stretch.packer.seal()
            taken.file.sync_if_due()
            self._flushed_s, self._flushed_ns = now, last_ns

    def flush(self) -> None:
        """Nothing: nobody waits, see `flushed_ns`."""

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        """End what is being taken; with `why` take what the ring holds, for a run has ended badly."""
        if why:
            self._take(why, self._stretches.last_ns or 0)
        taken = self._taken
        if taken is not None:
            self._end({**outcome, **taken.said})
        self._hear_of_ended(wait=True)

    def close(self, reason: str = "") -> None:
        """Close all files as they are."""
        taken = [*self._ending, *([self._taken] if self._taken is not None else [])]
        for each in taken:
            each.file.close()

    def completed(self, segment: _Segment, tally: Tally) -> None:
        """All images of a segment have come."""
        taken = segment.taken
        if segment.forgotten:
            pass
        elif taken is None:
            self._ring.append((segment, tally))
            self._trim()
        else:
            taken.tally.include(tally)
            if segment.last:
                taken.file.finish({**segment.outcome, **self._making.said(taken.tally)}, self._mirrors.top_um_s)
        self._free.append(segment.packer)

    def _segment(self, known: News, carried_ns: int | None) -> _Segment:
        if self._free:
            packer = self._free.pop()
        else:
            packer = Packer(self._making.frames, self._mirrors, _nowhere, self._making.header.start_unix_ns)
            packer.sequences = self._sequences
        return _Segment(self, packer, known, carried_ns)

    def _cut(self) -> None:
        stretches = self._stretches
        stretches.cut(self._segment(dict(stretches.known), stretches.last_ns))
        self._trim()

    def _is_full(self, stamp_ns: int) -> bool:
        segment = self._stretches.current.stretch
        if segment.begin_ns is None:
            return False
        return stamp_ns - segment.begin_ns >= self._segment_ns or _SEGMENTS * segment.nbytes >= self._limit_bytes

    def _segments(self) -> list[_Segment]:
        """Those in memory, from the oldest on."""
        waiting = [place.stretch for place in self._stretches.open if place.stretch.is_held]
        return [segment for segment, _ in self._ring] + waiting

    def _is_old(self, segment: _Segment) -> bool:
        """Whether it reaches far enough into the past, without those before it."""
        last_ns = self._stretches.last_ns
        return last_ns is not None and segment.begin_ns is not None and last_ns - segment.begin_ns >= self._before_ns

    def _trim(self) -> None:
        """Forget what is older than asked for, or does not fit."""
        now_ns = self._stretches.last_ns or 0
        while self._ring:
            segments = self._segments()
            begin_ns, old = segments[1].begin_ns, self._is_old(segments[1])
            large = sum(segment.nbytes for segment in segments) > self._limit_bytes
            if not old and not large:
                return
            if not old and not self._short:
                self._short = True
                held_s = seconds(now_ns - (begin_ns or now_ns))
                self._remarks.append(
                    f"the last {held_s:.1f} of {self._settings.before_s:g} s fit into {self._settings.megabytes:g} MB;"
                    " set recording.snapshot_mb higher, or a slower camera"
                )
            self._ring.popleft()

    def _take(self, why: str, stamp_ns: int) -> None:
        """Begin a snapshot, or let the one that is being taken go on."""
        if self._taken is not None:
            self._taken.add(why, stamp_ns + self._after_ns)
            return
        self._trim()
        segments, making = self._segments(), self._making
        while len(segments) > 1 and self._is_old(segments[1]):  # still without some of its images, and not needed
            segments.pop(0).forgotten = True
        first = segments[0]
        held_s = seconds(stamp_ns - (stamp_ns if first.begin_ns is None else first.begin_ns))
        self._number += 1
        part = Part(self._run, self._number, "snapshot", first.carried_ns, why)
        file = Poured(
            snapshot_path(making.path, self._number),
            replace(making.header, part=part),
            making,
            limit_bytes=self._limit_bytes,
        )
        short = {"short_of_memory": f"{held_s:.1f} of {self._settings.before_s:g} s before the event"}
        self._taken = taken = _Taken(file, stamp_ns + self._after_ns, [why], short if self._short else {})
        if first.carried_ns is not None:
            # Numbered as if they had been written just before what follows.
            packer = Packer(making.frames, self._mirrors.twin(), _nowhere, making.header.start_unix_ns)
            packer.sequences = Counter({path: (number - 1) % 2**32 for path, number in first.sequences.items()})
            file.begin_with(packer, carried(first.carried_ns, first.known))
            file.put(first.image)
        first.first = True
        for _, tally in self._ring:
            taken.tally.include(tally)
        for segment in segments:
            segment.pour(taken)
        self._ring.clear()
        self._flushed_s, self._flushed_ns = time.monotonic(), stamp_ns
        self._remarks.append(f"{file.path}: {held_s:.1f} s before and what follows; {why}")

    def _end(self, outcome: Mapping[str, str] | None = None) -> None:
        """The tick before was the last one of the snapshot; the ring begins to fill again."""
        taken, segment = self._taken, self._stretches.current.stretch
        assert taken is not None
        segment.last, segment.outcome = True, dict(outcome if outcome is not None else taken.outcome)
        self._taken, self._short = None, False
        self._ending.append(taken)
        self._cut()

    def _why(self, entry: Entry) -> str:
        """What of this entry is worth a snapshot, for people; empty: nothing."""
        news = entry.news
        event, operator, drops = news.get("event"), news.get("operator"), news.get("drops")
        if isinstance(operator, OperatorEvent) and operator.action in ("mark", "note"):
            return f"{operator.action}: {operator.text}".rstrip(": ")
        if isinstance(event, Event) and event.level in ("warning", "error"):
            return event.text
        if isinstance(drops, Drops):
            dropped = drops.by_backlog + drops.by_camera
            if dropped > self._dropped:
                # Where images are lost all the time, each of them is no event.
                began = self._dropped_ns is None or entry.stamp_ns - self._dropped_ns > self._before_ns
                self._dropped, self._dropped_ns = dropped, entry.stamp_ns
                return "images are lost" if began else ""
        return ""

    def _hear_of_ended(self, *, wait: bool = False) -> None:
        """Of files that are whole, and of failures."""
        for taken in (*self._ending, *([self._taken] if self._taken is not None else [])):
            taken.file.check(wait=wait)
        while self._ending and self._ending[0].file.finished:
            done = self._ending.pop(0)
            done.file.close()
            self._ended_bytes += done.file.size
            self.files.append(done.file.path)
            self._remarks.append(f"{done.file.path}: whole, {done.file.size / 1e6:.1f} MB")

    def _try(self) -> None:
        """Whether a file can be made here; better now than at the event."""
        making = self._making
        path = snapshot_path(making.path, 1)
        piece = Piece(path, making.header, making)
        piece.partial_path.unlink(missing_ok=True)
        piece.close()  # after that, for another process may make a file of this name as soon as it is not locked


def _nowhere(_sealed: list[Sealed]) -> None:
    """Where a packer's chunks go before a segment has it."""
