"""Writes a run to one file, or to parts that follow each other and are each readable alone.

Part n + 1 starts with a keyframe: the full state at the tick at which part n ended, and the last image before it, at
their own stamps. A part is finished in a side thread, because the writer's thread must not wait for a disk.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from flowrec.core import Outcome, SessionError, nanoseconds, seconds
from flowrec.store.chunk import ChunkEncoder, copy_chunks
from flowrec.store.mcap_format import SealedChunk
from flowrec.store.run_files import part_path
from flowrec.store.segments import Counters, OpenSegment, SegmentRouter, keyframe
from flowrec.store.session_file import FileError, SessionFile, Split, WriterOptions
from flowrec.store.session_metadata import Part, SessionHeader
from flowrec.store.viewer_topics import ViewerTopics
from flowrec.store.write_queue import Entry

_POLL_S = 0.05


class PartFile(SessionFile):
    """One part as it is recorded: encodes ticks, and bounds the age of what is not yet on the disk.

    Data older than `flush_s`, in wall time or in stamps, has been passed to the operating system. Data older than
    `sync_s` is on the disk, as long as one fsync takes less than half of that. The fsync runs in a side thread: on a
    busy disk it may take a second, in which a camera would fill the queue.

    Parameters
    ----------
    parts, number : the run, and which part of it this is.
    header : of this part.
    first : its keyframe, which the side thread encodes, because large flow fields take long. Later chunks are held back
        until it is written. None: the run begins here, and the header is synced at once.

    Attributes
    ----------
    flushed_ns : stamp up to which the operating system has all that was added; None before the first flush.

    Raises
    ------
    FileError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(self, parts: Parts, number: int, path: Path, header: SessionHeader, first: Entry | None) -> None:
        super().__init__(path, header, parts.options)
        self.number = number
        self._start_unix_ns = header.start_unix_ns
        self.flushed_ns: int | None = None
        self._parts = parts
        self._encoder = self._new_encoder(parts.views)
        self._first_bytes = self.size  # of head and keyframe
        self._image_bytes = 0  # of the keyframe's image
        self._raw_bytes = 1  # of what was added
        self._writing_keyframe: Future[None] | None = None
        self._held: list[SealedChunk] = []
        self._flushed_s = self._synced_s = self._options.clock()
        self._synced_size = 0
        self._since_ns: int | None = None  # stamp of the last flush, or of the first entry
        self._last_ns = 0
        self._syncing: Future[None] | None = None
        self._side = ThreadPoolExecutor(1, "session-sync")
        if first is None:
            try:
                self._synced_size = self.size
                self.sync()
                self._synced_s = self._options.clock()
            except BaseException:
                self.close()
                raise
            return
        self._encoder.sink = self._hold
        self._encoder.sequences.update(self._options.topics.by_field[field].path for field in first.messages)
        self._writing_keyframe = self._side.submit(_encode_all, self._new_encoder(parts.views.copy()), first)

    @property
    def timeout_s(self) -> float | None:
        """Time until `flush_if_due` has something to do, in s; None: not before the next entry."""
        if self._writing_keyframe is not None:
            return _POLL_S
        if self._encoder.size:
            return max(0.0, self._flushed_s + self._options.flush_interval_s - self._options.clock())
        if self._synced_size < self.size:
            # While the last fsync is still running there is nothing to do about the next one.
            shortest = _POLL_S if self._sync_running else 0.0
            return max(shortest, self._synced_s + self._options.sync_interval_s - self._options.clock())
        return None

    def begin_at(self, header: SessionHeader) -> None:
        """Take another start of the session, before anything was added."""
        self.restart(header)
        self._encoder.start_unix_ns = header.start_unix_ns
        self._first_bytes = self.size
        self.sync()

    def is_larger_than(self, megabytes: float, awaited_bytes: int) -> bool:
        """True if the part has reached a size; with a keyframe of more than half of that, twice the keyframe's size.

        For images that are still queued the compression ratio of the part so far is assumed.
        """
        first_bytes = self._first_bytes + self._image_bytes
        own_bytes = self._all_bytes - first_bytes
        expected_bytes = own_bytes + awaited_bytes * min(1.0, own_bytes / self._raw_bytes)
        if expected_bytes < max(1e6 * megabytes - first_bytes, first_bytes):
            return False
        if self._writing_keyframe is None:
            return True
        # The size of the keyframe must be known before it is known how much of the part is its own.
        self._check_keyframe(wait=True)
        return self.is_larger_than(megabytes, awaited_bytes)

    def add(self, entry: Entry) -> None:
        """Encode the messages of one tick; write the chunks that are full."""
        self._raw_bytes += entry.nbytes
        self._check_keyframe(wait=False)
        if self._since_ns is None:
            self._since_ns = entry.stamp_ns
        self._last_ns = max(self._last_ns, entry.stamp_ns)
        try:
            self._encoder.add(entry)
        except FileError:
            raise
        except SessionError as error:
            raise self.encoding_failed(error) from error

    def add_keyframe_image(self, entry: Entry) -> None:
        before = self._all_bytes
        self.add(entry)
        self._image_bytes += self._all_bytes - before

    def end(self, counters: Counters) -> None:
        self._parts.finish_part(self, counters)

    def flush_if_due(self) -> None:
        """Write and sync the data whose interval has passed."""
        self._check_keyframe(wait=False)
        options, stamps_s = self._options, seconds(self._last_ns - (self._since_ns or 0))
        now = options.clock()
        if now >= self._flushed_s + options.flush_interval_s or stamps_s >= options.flush_interval_s:
            self._flush()
        if now >= self._synced_s + options.sync_interval_s and self._synced_size < self.size and not self._sync_running:
            self._join_sync()
            self._write_waiting()
            self._synced_s, self._synced_size = now, self.size
            self._syncing = self._side.submit(self.sync)

    def flush(self) -> None:
        """Write all that was added."""
        self._check_keyframe(wait=True)
        self._flush()

    def finish(self, outcome: Mapping[str, str]) -> None:
        """Write the rest of the messages, and complete the file."""
        self.flush()
        self._join_sync()
        self.complete(outcome, self._parts.views.top_um_s)

    def close(self) -> None:
        self._side.shutdown()
        super().close()

    def _new_encoder(self, views: ViewerTopics) -> ChunkEncoder:
        options = self._options
        return ChunkEncoder(options.encoding, views, self.add_chunks, self._start_unix_ns, options.topics)

    @property
    def _all_bytes(self) -> int:
        """Bytes in the file and bytes that are not written yet, of which most are not compressed yet."""
        return self.size + self._encoder.size + sum(len(chunk.data) for chunk in self._held)

    def _flush(self) -> None:
        self._write_waiting()
        self._flushed_s, self._since_ns = self._options.clock(), self._last_ns

    def _write_waiting(self) -> None:
        self._encoder.seal()
        if self._writing_keyframe is None and self._since_ns is not None:
            self.flushed_ns = self._last_ns

    def _hold(self, chunks: list[SealedChunk]) -> None:
        self._held += copy_chunks(chunks)

    def _check_keyframe(self, *, wait: bool) -> None:
        """Write the chunks that were held back, once the keyframe is in the file."""
        if self._writing_keyframe is None or not (wait or self._writing_keyframe.done()):
            return
        self._writing_keyframe.result()
        self._writing_keyframe = None
        self._first_bytes = self.size
        self._encoder.sink = self.add_chunks
        if self._held:
            held, self._held = self._held, []
            self.add_chunks(held)

    @property
    def _sync_running(self) -> bool:
        return self._syncing is not None and not self._syncing.done()

    def _join_sync(self) -> None:
        """Wait for the side thread; raises its error."""
        if self._syncing is not None:
            self._syncing.result()
            self._syncing = None


def _encode_all(encoder: ChunkEncoder, entry: Entry) -> None:
    encoder.add(entry)
    encoder.seal()


class Parts:
    """Writes entries to one part after the other.

    Parameters
    ----------
    path, header, options : of the run.
    split : when the next part begins.
    run : a random word for the heads of its parts.

    Attributes
    ----------
    files : the finished parts, in order.
    views : makes the viewer topics of all parts.

    Raises
    ------
    SessionError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(self, path: Path, header: SessionHeader, options: WriterOptions, split: Split, run: str) -> None:
        self.files: list[Path] = []
        self.options = options
        self.views = ViewerTopics.of_session(header, options.left_out_topics)
        self._path, self._header, self._split, self._run = path, header, split, run
        self._until_ns: int | None = None
        self._finished_bytes = 0
        self._finishing: deque[tuple[PartFile, Future[None]]] = deque()
        self._side = ThreadPoolExecutor(1, "session-finish")
        self._router = SegmentRouter(self._part(1))

    @property
    def partial_path(self) -> Path:
        """The file that is written at present."""
        return self._router.current.segment.partial_path

    @property
    def size(self) -> int:
        """Bytes handed to the operating system. May be asked for by another thread."""
        finishing = sum(part.size for part, _ in tuple(self._finishing))
        return self._finished_bytes + finishing + sum(place.segment.size for place in tuple(self._router.open))

    @property
    def timeout_s(self) -> float | None:
        """Time until `flush_if_due` has something to do, in s; None: not before the next entry."""
        return min((s for place in self._router.open if (s := place.segment.timeout_s) is not None), default=None)

    @property
    def flushed_ns(self) -> int | None:
        """Stamp up to which the operating system has all state; None before the first flush."""
        current = self._router.current
        # A part begins when the one before has been flushed.
        return current.keyframe_ns if current.segment.flushed_ns is None else current.segment.flushed_ns

    def begin_at(self, start_unix_ns: int) -> None:
        """Take another Unix time of stamp 0, before anything was added."""
        self._header = replace(self._header, start_unix_ns=start_unix_ns)
        self.views.begin_at(start_unix_ns)
        part = self._router.current.segment
        part.begin_at(self._header_of(part.number, None))

    def add(self, entry: Entry) -> None:
        """Write one entry, to the part that it belongs to."""
        self._collect_finished(wait=False)
        if entry.ticks and self._is_due(entry.stamp_ns):
            last, last_ns = self._router.current.segment, self._router.last_ns
            assert last_ns is not None
            last.flush()  # before anything of the next part: a kill must not leave a gap between them
            self._router.cut(self._part(last.number + 1, keyframe(last_ns, self._router.state)))
        self._router.add(entry)

    def flush_if_due(self) -> None:
        """Write and sync the data whose interval has passed."""
        for place in self._router.open:
            place.segment.flush_if_due()

    def flush(self) -> None:
        """Write all that was added."""
        self._router.current.segment.flush()

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        """Finish the last part; everything is on the disk then. `why` is for snapshots only."""
        last = self._router.current
        try:
            last.counters.dropped_frames += int(outcome.get("dropped_frames", 0))  # before a recovery
            last.segment.finish({**outcome, **last.counters.summary(self.options.encoding)})
        finally:
            self._collect_finished(wait=True)
        self.files.append(last.segment.path)

    def close(self, reason: str = "") -> None:
        """Close all files. After a failure, with its `reason`, the parts that are not affected are finished first."""
        self._side.shutdown()
        with contextlib.suppress(SessionError):
            self._collect_finished(wait=True)
        for place in self._router.open:
            if reason and not place.segment.failed and self._split:
                with contextlib.suppress(SessionError):  # the first failure matters more
                    self._finish_after_failure(place, reason)
            place.segment.close()

    def finish_part(self, part: PartFile, counters: Counters) -> None:
        """Finish a part that is not the last, in the side thread."""
        part.flush()
        outcome = {**self._continued_outcome(part), **counters.summary(self.options.encoding)}
        self._finishing.append((part, self._side.submit(part.finish, outcome)))

    def _finish_after_failure(self, place: OpenSegment[PartFile], reason: str) -> None:
        place.counters.dropped_frames += place.awaited
        part, is_last = place.segment, place is self._router.current
        outcome = {"outcome": Outcome.FAILED, "reason": reason} if is_last else self._continued_outcome(part)
        part.finish({**outcome, **place.counters.summary(self.options.encoding)})
        self.files.append(part.path)

    def _is_due(self, stamp_ns: int) -> bool:
        """True if a tick is the first one of another part."""
        split, place = self._split, self._router.current
        if place.begin_ns is None or not split:
            return False
        if split.seconds:
            every_ns = max(1, nanoseconds(split.seconds))
            if self._until_ns is None:
                self._until_ns = place.begin_ns + every_ns
            if stamp_ns >= self._until_ns:
                # The boundaries are multiples of the interval, also after a gap in the recording.
                self._until_ns += ((stamp_ns - self._until_ns) // every_ns + 1) * every_ns
                return True
        return bool(split.megabytes) and place.segment.is_larger_than(split.megabytes or 0.0, place.awaited_bytes)

    def _part(self, number: int, first: Entry | None = None) -> PartFile:
        path = part_path(self._path, number) if self._split else self._path
        return PartFile(self, number, path, self._header_of(number, first), first)

    def _header_of(self, number: int, first: Entry | None) -> SessionHeader:
        if not self._split:
            return self._header
        keyframe_ns = first.stamp_ns if first is not None else None
        return replace(self._header, part=Part(self._run, number, keyframe_ns=keyframe_ns))

    def _continued_outcome(self, part: PartFile) -> dict[str, str]:
        return {"outcome": Outcome.CONTINUED, "next": part_path(self._path, part.number + 1).name}

    def _collect_finished(self, *, wait: bool) -> None:
        while self._finishing and (wait or self._finishing[0][1].done()):
            part, finished = self._finishing.popleft()
            try:
                finished.result()
                self.files.append(part.path)
                self._finished_bytes += part.size
            finally:
                part.close()
