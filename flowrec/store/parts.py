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
from flowrec.store.run_files import part_number, part_path
from flowrec.store.segments import RecordingPlan, Segment, SegmentedRun
from flowrec.store.session_file import SessionFile, Snapshot
from flowrec.store.session_metadata import Part, SessionHeader


class Parts(SegmentedRun):
    """Writes entries to one part after the other, or all of them to one file."""

    def __init__(self, plan: RecordingPlan, tell: Callable[[str], None]) -> None:
        super().__init__(plan, tell)
        assert not isinstance(plan.options.files, Snapshot)
        self._split = plan.options.files
        self._until_ns: int | None = None
        self._number = 0  # of the current part
        self.open.append(self._part())
        self._file.sync_head()

    @property
    def _file(self) -> SessionFile:
        """That of the current part."""
        return _file_of(self.open[-1])

    @property
    def partial_path(self) -> Path:
        return self._file.partial_path

    @property
    def flushed_ns(self) -> int | None:
        flushed_ns = self._file.flushed_ns
        return self.open[-1].keyframe_ns if flushed_ns is None else flushed_ns  # after the part before was flushed

    def begin_at(self, start_unix_ns: int) -> None:
        super().begin_at(start_unix_ns)
        self._file.restart(self._header_of(None))

    def _cut_before(self, stamp_ns: int) -> None:
        if self._is_due(stamp_ns):
            self._file.flush(wait=True)  # before anything of the next part: a kill must not leave a gap between them
            self._cut(self._part())

    def flush(self) -> None:
        self._file.flush(wait=True)

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        self._file.flush()
        self._complete(self._file, outcome, self.open[-1].counters)
        self._collect_finished(wait=True)

    def close(self, reason: str = "") -> None:
        """Close all files. After a failure, with its `reason`, the parts that are not affected are finished first."""
        for part in self.open if reason and self._split else ():
            if _file_of(part).failure is None:
                with contextlib.suppress(SessionError):  # the first failure matters more
                    self._finish_after_failure(part, reason)
        super().close()

    def _end(self, segment: Segment) -> None:
        """Finish a part that is not the last."""
        file = _file_of(segment)
        file.flush(wait=True)
        self._complete(file, self._outcome_of_part(file), segment.counters)

    def _finish_after_failure(self, part: Segment, reason: str) -> None:
        file, last = _file_of(part), part is self.open[-1]
        part.counters.dropped_frames += part.awaited
        file.flush()
        failed = {"outcome": Outcome.FAILED, "reason": reason}
        self._complete(file, failed if last else self._outcome_of_part(file), part.counters)

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
        return bool(split.megabytes) and self._is_large(part, 1e6 * (split.megabytes or 0.0))

    def _is_large(self, part: Segment, limit_bytes: float) -> bool:
        """True if a part has reached a size; with a keyframe of more than half of that, twice the keyframe's size.

        For images that are still queued the compression ratio of the part so far is assumed.
        """
        file = self._file
        first_bytes = file.first_bytes + part.image_bytes
        own_bytes = file.all_bytes - first_bytes
        expected_bytes = own_bytes + part.awaited_bytes * min(1.0, own_bytes / max(1, part.raw_bytes))
        if expected_bytes < max(limit_bytes - first_bytes, first_bytes):
            return False
        if not file.is_writing:
            return True
        # The size of the keyframe must be known before it is known how much of the part is its own.
        file.flush(wait=True)
        return self._is_large(part, limit_bytes)

    def _part(self) -> Segment:
        """The next part, and its file."""
        self._number += 1
        encoder, keyframe = self._encoder(), self._state_now()
        if keyframe is not None:
            encoder.sequences.update(self._options.topics.by_field[field].path for field in keyframe.messages)
        part = Segment(encoder, keyframe)
        path = part_path(self._path, self._number) if self._split else self._path
        file = SessionFile(path, self._header_of(part.keyframe_ns), self._options)
        self._begin_file(file, part)
        file.encoders.append(encoder)
        part.write_to(file, begins_file=True)
        return part

    def _header_of(self, keyframe_ns: int | None) -> SessionHeader:
        """The header of the current part."""
        if not self._split:
            return self._header
        return replace(self._header, part=Part(self._plan.run, self._number, keyframe_ns=keyframe_ns))

    def _outcome_of_part(self, file: SessionFile) -> dict[str, str]:
        """The outcome of a part that is not the last."""
        return {"outcome": Outcome.CONTINUED, "next": part_path(self._path, part_number(file.path) + 1).name}


def _file_of(part: Segment) -> SessionFile:
    assert part.file is not None
    return part.file
