"""Gives queued entries to segments of a run: parts of it, or slices of the ring buffer (ring_buffer.py).

A run is cut at the boundaries of ticks. Images wait behind the state (write_queue.py), so when a segment ends at a
tick, images of it may still be queued. Each tick announces its image; a segment stays open until every image that was
announced for it has come, so several may be open at a time. A file is completed in a side thread, because the writer's
thread must not wait for a disk.

Part n + 1 starts with a keyframe: the full state at the tick at which part n ended, and the last image before it, at
their own stamps.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Generic, TypeVar

from flowrec.core import Frame, Outcome, SessionError, nanoseconds
from flowrec.store.chunk import ChunkEncoder, Sink
from flowrec.store.mcap_writer import FileError
from flowrec.store.run_files import part_path
from flowrec.store.session_file import SessionFile, Split, WriterOptions
from flowrec.store.session_metadata import Part, SessionHeader
from flowrec.store.viewer_scene import ChipCamera
from flowrec.store.write_queue import Counters, EncodedMessages, Entry


class Segment(ABC):
    """Takes the entries of consecutive ticks.

    Attributes
    ----------
    encoder : of its messages.
    keyframe_ns : stamp of the last tick before it; None at the beginning of the run.
    begin_ns : stamp of its first tick; None before that.
    awaited, awaited_bytes : number and size of the images that were announced and are still queued.
    """

    def __init__(self, encoder: ChunkEncoder, keyframe_ns: int | None) -> None:
        self.encoder, self.keyframe_ns = encoder, keyframe_ns
        self.begin_ns: int | None = None
        self.counters = Counters()
        self.awaited = self.awaited_bytes = 0

    @abstractmethod
    def add(self, entry: Entry) -> None:
        """Take one entry."""

    @abstractmethod
    def add_keyframe_image(self, entry: Entry) -> None:
        """Take the last image before the segment, which was still queued when the segment began."""


S = TypeVar("S", bound=Segment)


class SegmentedRun(ABC, Generic[S]):
    """Gives each entry of a run to the segment that it belongs to, and completes the files.

    Parameters
    ----------
    path, header, options, camera : of the run.
    run : a random word for the heads of its files.

    Attributes
    ----------
    files : the finished ones, in order.
    open : the segments that are not complete; ticks go to the last one, the others wait for images.

    Raises
    ------
    SessionError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(
        self, path: Path, header: SessionHeader, options: WriterOptions, camera: ChipCamera | None, run: str
    ) -> None:
        self.files: list[Path] = []
        self.open: deque[S] = deque()
        self._path, self._header, self._options, self._run = path, header, options, run
        self._camera = camera
        self._state: EncodedMessages = {}  # the latest message of each topic but the image, by field of Tick, ...
        self._last_ns: int | None = None  # ... at the tick with this stamp
        self._image: Frame | None = None
        self._unfinished: list[SessionFile] = []
        self._finished_bytes = 0
        self._side = ThreadPoolExecutor(1, "session-finish")

    @property
    @abstractmethod
    def partial_path(self) -> Path:
        """The file that is written at present, or the next one."""

    @property
    @abstractmethod
    def flushed_ns(self) -> int | None:
        """Stamp up to which no state waits for the disk; None before the first flush."""

    @property
    def size(self) -> int:
        """Bytes of the files so far. May be asked for by another thread."""
        return self._finished_bytes + sum(file.size for file in tuple(self._unfinished))

    @property
    def timeout_s(self) -> float | None:
        """Time until `flush_if_due` has something to do, in s; None: not before the next entry."""
        return min((s for file in self._growing if (s := file.timeout_s) is not None), default=None)

    def begin_at(self, start_unix_ns: int) -> None:
        """Take another Unix time of stamp 0, before anything was added."""
        self._header = replace(self._header, start_unix_ns=start_unix_ns)
        self.open[-1].encoder.start_unix_ns = start_unix_ns

    @abstractmethod
    def add(self, entry: Entry) -> None:
        """Take one entry."""

    def flush_if_due(self) -> None:
        """Write and sync the data whose interval has passed."""
        for file in self._growing:
            file.flush_if_due()

    @abstractmethod
    def flush(self) -> None:
        """Write all that was added, so far as `flushed_ns` waits for it."""

    @abstractmethod
    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        """End the run; its files are on the disk then. `why` : the reason of a bad end."""

    def close(self, reason: str = "") -> None:
        """Close all files: those that are to be completed first, the others as they are. `reason` : of a failure."""
        while any(file.completion is not None for file in self._unfinished):
            with contextlib.suppress(SessionError):
                self._collect_finished(wait=True)
        self._side.shutdown()
        for file in self._unfinished:
            file.close()

    @abstractmethod
    def _end(self, segment: S) -> None:
        """Take a segment that has received all of its entries."""

    @property
    def _growing(self) -> list[SessionFile]:
        """The files that have not received all that belongs into them."""
        return [file for file in self._unfinished if file.completion is None]

    def _encoder(self, sink: Sink) -> ChunkEncoder:
        options = self._options
        return ChunkEncoder(options.encoding, sink, self._header.start_unix_ns, options.topics)

    def _route(self, entry: Entry) -> None:
        """Pass one entry to its segment."""
        # Images come in order: those of an earlier segment have all come before the first one of a later segment.
        segment = self.open[0] if entry.late else self.open[-1]
        if entry.ticks and segment.begin_ns is None:
            segment.begin_ns = entry.stamp_ns
        segment.counters.add(entry)
        segment.add(entry)
        if entry.late:
            segment.awaited -= 1
            segment.awaited_bytes -= entry.nbytes
        else:
            self._last_ns = entry.stamp_ns
            self._state.update(entry.messages)
            self._state.pop("frame", None)
            if entry.image_bytes:
                segment.awaited += 1
                segment.awaited_bytes += entry.image_bytes
        image = entry.messages.get("frame")
        if isinstance(image, Frame):
            self._image = image
        self._end_complete()

    def _cut(self, following: S) -> None:
        """End the current segment with the last tick; the ticks from here on go to another one."""
        self.open.append(following)
        self._end_complete()

    def _end_complete(self) -> None:
        while len(self.open) > 1 and not self.open[0].awaited:
            self._end(self.open.popleft())
            following = self.open[0]
            if self._image is not None and following.keyframe_ns is not None:
                following.add_keyframe_image(Entry(following.keyframe_ns, {"frame": self._image}, 0))

    def _complete(self, file: SessionFile, outcome: Mapping[str, str], counters: Counters) -> None:
        """Complete a file in the side thread."""
        outcome = {**outcome, **counters.summary(self._options.encoding)}
        file.completion = self._side.submit(file.complete, outcome, self._camera)

    def _collect_finished(self, *, wait: bool = False) -> None:
        """Note the files that are complete; raises the error of a file."""
        for file in tuple(self._unfinished):
            if file.completion is not None and (wait or file.completion.done()):
                self._unfinished.remove(file)
                try:
                    file.completion.result()
                    self._note_finished(file)
                finally:
                    file.close()
        for file in self._growing:
            file.check()

    def _note_finished(self, file: SessionFile) -> None:
        self.files.append(file.path)
        self._finished_bytes += file.size


class PartSegment(Segment):
    """One part as it is recorded."""

    def __init__(self, file: SessionFile, encoder: ChunkEncoder, number: int, keyframe_ns: int | None) -> None:
        super().__init__(encoder, keyframe_ns)
        self.file, self.number = file, number
        self._image_bytes = 0  # of the keyframe's image
        self._raw_bytes = 1  # of what was added
        file.encoders.append(encoder)

    def is_larger_than(self, megabytes: float) -> bool:
        """True if the part has reached a size; with a keyframe of more than half of that, twice the keyframe's size.

        For images that are still queued the compression ratio of the part so far is assumed.
        """
        first_bytes = self.file.first_bytes + self._image_bytes
        own_bytes = self.file.all_bytes - first_bytes
        expected_bytes = own_bytes + self.awaited_bytes * min(1.0, own_bytes / self._raw_bytes)
        if expected_bytes < max(1e6 * megabytes - first_bytes, first_bytes):
            return False
        if not self.file.is_writing:
            return True
        # The size of the keyframe must be known before it is known how much of the part is its own.
        self.file.flush(wait=True)
        return self.is_larger_than(megabytes)

    def add(self, entry: Entry) -> None:
        self._raw_bytes += entry.nbytes
        self.file.note(entry.stamp_ns)
        try:
            self.encoder.add(entry)
        except FileError:
            raise
        except SessionError as error:
            raise self.file.encoding_failed(error) from error

    def add_keyframe_image(self, entry: Entry) -> None:
        before = self.file.all_bytes
        self.add(entry)
        self._image_bytes += self.file.all_bytes - before


class Parts(SegmentedRun[PartSegment]):
    """Writes entries to one part after the other.

    Parameters
    ----------
    split : when the next part begins.
    """

    def __init__(
        self,
        path: Path,
        header: SessionHeader,
        options: WriterOptions,
        camera: ChipCamera | None,
        split: Split,
        run: str,
    ) -> None:
        super().__init__(path, header, options, camera, run)
        self._split = split
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
        return (
            replace(self._header, part=Part(self._run, number, keyframe_ns=keyframe_ns))
            if self._split
            else self._header
        )

    def _continued_outcome(self, part: PartSegment) -> dict[str, str]:
        return {"outcome": Outcome.CONTINUED, "next": part_path(self._path, part.number + 1).name}
