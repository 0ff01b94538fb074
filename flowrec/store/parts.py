"""Writes a run to one file, or to its parts.

Part n + 1 starts with a keyframe: the full state at the tick at which part n ended, and the last image before it, at
their own stamps.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from flowrec.core import Outcome, SessionError, nanoseconds
from flowrec.store.chunk import ChunkEncoder
from flowrec.store.run_files import part_path
from flowrec.store.segments import RecordingPlan, Segment, SegmentedRun
from flowrec.store.session_file import SessionFile, Snapshot
from flowrec.store.session_metadata import Part, SessionHeader
from flowrec.store.write_queue import Entry


class PartSegment(Segment):
    """One part as it is recorded."""

    file: SessionFile

    def __init__(self, file: SessionFile, encoder: ChunkEncoder, number: int, keyframe_ns: int | None) -> None:
        super().__init__(encoder, keyframe_ns, file)
        self.number = number
        self._image_bytes = 0  # of the keyframe's image
        file.encoders.append(encoder)

    def is_larger_than(self, megabytes: float) -> bool:
        """True if the part has reached a size; with a keyframe of more than half of that, twice the keyframe's size.

        For images that are still queued the compression ratio of the part so far is assumed.
        """
        first_bytes = self.file.first_bytes + self._image_bytes
        own_bytes = self.file.all_bytes - first_bytes
        expected_bytes = own_bytes + self.awaited_bytes * min(1.0, own_bytes / max(1, self.raw_bytes))
        if expected_bytes < max(1e6 * megabytes - first_bytes, first_bytes):
            return False
        if not self.file.is_writing:
            return True
        # The size of the keyframe must be known before it is known how much of the part is its own.
        self.file.flush(wait=True)
        return self.is_larger_than(megabytes)

    def add_keyframe_image(self, entry: Entry) -> None:
        before = self.file.all_bytes
        self.add(entry)
        self._image_bytes += self.file.all_bytes - before


class Parts(SegmentedRun[PartSegment]):
    """Writes entries to one part after the other, or all of them to one file."""

    def __init__(self, plan: RecordingPlan, tell: Callable[[str], None]) -> None:
        super().__init__(plan, tell)
        assert not isinstance(plan.options.files, Snapshot)
        self._split = plan.options.files
        self._until_ns: int | None = None
        first = self._part(1)
        first.file.sync_head()
        self.open.append(first)

    @property
    def partial_path(self) -> Path:
        return self.open[-1].file.partial_path

    @property
    def flushed_ns(self) -> int | None:
        current = self.open[-1]
        # A part begins when the one before has been flushed.
        return current.keyframe_ns if current.file.flushed_ns is None else current.file.flushed_ns

    def begin_at(self, start_unix_ns: int) -> None:
        super().begin_at(start_unix_ns)
        self.open[-1].file.restart(self._header_of(1, None))

    def add(self, entry: Entry) -> None:
        self._collect_finished()
        if entry.ticks and self._is_due(entry.stamp_ns):
            last = self.open[-1]
            last.file.flush(wait=True)  # before anything of the next part: a kill must not leave a gap between them
            assert self._last_ns is not None
            self._cut(self._part(last.number + 1, Entry(self._last_ns, dict(self._state), 0)))
        self._route(entry)

    def flush(self) -> None:
        self.open[-1].file.flush(wait=True)

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        last = self.open[-1]
        last.counters.dropped_frames += int(outcome.get("dropped_frames", 0))  # before a recovery
        last.file.flush()
        self._complete(last.file, outcome, last.counters)
        self._collect_finished(wait=True)

    def close(self, reason: str = "") -> None:
        """Close all files. After a failure, with its `reason`, the parts that are not affected are finished first."""
        for part in self.open if reason and self._split else ():
            if part.file.failure is None:
                with contextlib.suppress(SessionError):  # the first failure matters more
                    self._finish_after_failure(part, reason)
        super().close()

    def _end(self, segment: PartSegment) -> None:
        """Finish a part that is not the last."""
        segment.file.flush(wait=True)
        self._complete(segment.file, self._continued_outcome(segment), segment.counters)

    def _finish_after_failure(self, part: PartSegment, reason: str) -> None:
        part.counters.dropped_frames += part.awaited
        outcome = {"outcome": Outcome.FAILED, "reason": reason}
        part.file.flush()
        self._complete(part.file, outcome if part is self.open[-1] else self._continued_outcome(part), part.counters)

    def _is_due(self, stamp_ns: int) -> bool:
        """True if a tick is the first one of another part."""
        split, part = self._split, self.open[-1]
        if part.begin_ns is None or not split:
            return False
        if split.seconds:
            every_ns = max(1, nanoseconds(split.seconds))
            if self._until_ns is None:
                self._until_ns = part.begin_ns + every_ns
            if stamp_ns >= self._until_ns:
                # The boundaries are multiples of the interval, also after a gap in the recording.
                self._until_ns += ((stamp_ns - self._until_ns) // every_ns + 1) * every_ns
                return True
        return bool(split.megabytes) and part.is_larger_than(split.megabytes or 0.0)

    def _part(self, number: int, keyframe: Entry | None = None) -> PartSegment:
        keyframe_ns = keyframe.stamp_ns if keyframe is not None else None
        path = part_path(self._path, number) if self._split else self._path
        file = SessionFile(path, self._header_of(number, keyframe_ns), self._options)
        self._unfinished.append(file)
        encoder = self._encoder(file.put)
        if keyframe is not None:
            encoder.sequences.update(self._options.topics.by_field[field].path for field in keyframe.messages)
            file.write_keyframe(self._encoder(file.put), keyframe)
        return PartSegment(file, encoder, number, keyframe_ns)

    def _header_of(self, number: int, keyframe_ns: int | None) -> SessionHeader:
        if not self._split:
            return self._header
        return replace(self._header, part=Part(self._plan.run, number, keyframe_ns=keyframe_ns))

    def _continued_outcome(self, part: PartSegment) -> dict[str, str]:
        return {"outcome": Outcome.CONTINUED, "next": part_path(self._path, part.number + 1).name}
