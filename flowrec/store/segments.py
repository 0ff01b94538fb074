"""Records a run: takes entries from a queue, gives each to its segment of the run, and completes the files.

The segments are parts of the run (parts.py), or slices of the ring buffer (ring_buffer.py). A run is cut at the
boundaries of ticks. Images wait behind the state (write_queue.py), so when a segment ends at a tick, images of it may
still be queued. Each tick announces its image; a segment stays open until every image that was announced for it has
come, so several may be open at a time. A file is completed in a side thread, because the writer's thread must not wait
for a disk.

It works in a process of its own, which outlives the run, or in a thread of the run's process (recorder_process.py).
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from flowrec.core import Drops, Frame, SessionError, remove_idle
from flowrec.store.channels import FRAME_PATH, FRAMES
from flowrec.store.chunk import ChunkEncoder, copy_chunks
from flowrec.store.codec import codec_of, encode_record
from flowrec.store.mcap_format import SealedChunk
from flowrec.store.mcap_writer import FileError
from flowrec.store.run_files import run_files
from flowrec.store.session_file import SessionFile, WriterOptions
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.shared_queue import QueueReader
from flowrec.store.viewer_scene import ChipCamera
from flowrec.store.write_queue import Counters, EncodedMessages, End, Entry, WriteQueue


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """Order to record a run.

    Attributes
    ----------
    path, header, options, camera : of the run.
    run : a random word for the heads of its files.
    replaced : files of an earlier run, which may be removed after this one, with their inodes.
    """

    path: Path
    header: SessionHeader
    options: WriterOptions
    camera: ChipCamera | None
    run: str
    replaced: Mapping[Path, int]


class Segment:
    """Consecutive ticks of a run: a part of it, or a slice of the ring buffer.

    Its chunks go to a file; until it has one they stay in memory.

    Attributes
    ----------
    encoder : of its messages.
    keyframe : the state at the last tick before it, without the image; None at the beginning of the run.
    sequences : the next sequence numbers when it began.
    file : that its chunks go to; None: they stay in memory.
    begins_file : it is the first one in its file.
    held, held_image : its chunks in memory, and that of the last image before it.
    image_bytes : size of the latter, wherever it is.
    begin_ns : stamp of its first tick; None before that.
    awaited, awaited_bytes : number and size of the images that were announced and are still queued.
    raw_bytes : size of what was added.
    discarded : it is too old before all of its images have come, and takes no more.
    """

    def __init__(self, encoder: ChunkEncoder, keyframe: Entry | None) -> None:
        self.encoder, self.keyframe, self.sequences = encoder, keyframe, Counter(encoder.sequences)
        self.file: SessionFile | None = None
        self.begins_file = self.discarded = False
        self.held: list[SealedChunk] = []
        self.held_image: list[SealedChunk] = []
        self.begin_ns: int | None = None
        self.counters = Counters()
        self.image_bytes = self.awaited = self.awaited_bytes = self.raw_bytes = 0
        encoder.sink = self._hold

    @property
    def keyframe_ns(self) -> int | None:
        """Stamp of the keyframe."""
        return self.keyframe.stamp_ns if self.keyframe is not None else None

    def write_to(self, file: SessionFile, *, begins_file: bool) -> None:
        """Write the chunks in memory, and later ones, to a file; where that begins, the image before them as well."""
        self.file, self.begins_file = file, begins_file
        self.keyframe = self.keyframe and self.keyframe._replace(messages={})  # they are written, or not needed
        file.put([*(self.held_image if begins_file else ()), *self.held])
        self.held, self.held_image = [], []
        self.encoder.sink = file.put

    def add(self, entry: Entry) -> None:
        """Take one entry."""
        if self.discarded:
            return
        self.raw_bytes += entry.nbytes
        if self.file is not None:
            self.file.note(entry.stamp_ns)
        try:
            self.encoder.add(entry)
        except SessionError as error:
            if self.file is None or isinstance(error, FileError):
                raise
            raise self.file.encoding_failed(error) from error

    def add_keyframe_image(self, image: Frame) -> None:
        """Take the last image before it, which was still queued when it began, as a chunk of its own."""
        if self.keyframe is None or (self.file is not None and not self.begins_file):
            return  # the segment before it is in the same file
        sink, self.encoder.sink = self.encoder.sink, self._take_image
        self.encoder.add(Entry(self.keyframe.stamp_ns, {"frame": image}, 0))
        self.encoder.seal((FRAMES,))
        self.encoder.sink = sink

    def _take_image(self, chunks: list[SealedChunk]) -> None:
        self.image_bytes += _size_of(chunks)
        if self.file is not None:
            self.file.put(chunks)
        else:
            self.held_image += copy_chunks(chunks)

    def _hold(self, chunks: list[SealedChunk]) -> None:
        self.held += copy_chunks(chunks)

    @property
    def held_bytes(self) -> int:
        """Size of its chunks in memory."""
        return _size_of(self.held) + _size_of(self.held_image)


def _size_of(chunks: list[SealedChunk]) -> int:
    return sum(len(chunk.data) for chunk in chunks)


class SegmentedRun(ABC):
    """The files of a run while they are written; each entry goes to the segment that it belongs to.

    Raises SessionError: from any method, when the disk refuses, or a message can not be encoded.

    Parameters
    ----------
    plan : what is to be recorded; the head of its file is on the disk when the constructor returns.
    tell : receives what happens, as text.

    Attributes
    ----------
    files : the finished ones, in order.
    open : the segments that are not complete; ticks go to the last one, the others wait for images.
    dropped : images that were left out at the end.
    """

    def __init__(self, plan: RecordingPlan, tell: Callable[[str], None]) -> None:
        self.files: list[Path] = []
        self.open: deque[Segment] = deque()
        self.dropped = 0
        self._plan, self._path, self._header, self._options = plan, plan.path, plan.header, plan.options
        self._tell = tell
        self._state: EncodedMessages = {}  # the latest message of each topic but the image, by field of Tick, ...
        self._last_ns: int | None = None  # ... at the tick with this stamp
        self._image: Frame | None = None
        self._unfinished: list[SessionFile] = []
        self._finished_bytes = 0
        self._side = ThreadPoolExecutor(1, "session-finish")

    def record(self, queue: WriteQueue | QueueReader) -> None:
        """Write what the queue gives until the end of the run, then complete the files, or remove them.

        Raises SessionError: the disk refuses, or an image can not be stored; what was written stays in a `.partial`
        file.
        """
        reason = ""
        try:
            while not queue.drained:
                self._record_next(queue)
            assert queue.end is not None
            if not queue.end.discard:
                self._finish_run(queue.end, queue.given_up)
        except Exception as error:
            reason = f"{error}"
            raise
        finally:
            unfinished = self.partial_path
            self.close(reason)
        if queue.end.discard:
            for file in (unfinished, *self.files):
                file.unlink(missing_ok=True)

    def _record_next(self, queue: WriteQueue | QueueReader) -> None:
        entry = queue.take(self.timeout_s)
        if entry is not None:
            if entry.start_unix_ns is not None:
                self.begin_at(entry.start_unix_ns)
            self.add(entry)
        if entry is None and queue.flush_wanted:
            self.flush()
        # The image of a tick comes after its other messages: where possible, whole ticks are flushed.
        elif entry is None or "frame" in entry.messages or not queue.images_wait:
            self.flush_if_due()
        if (flushed_ns := self.flushed_ns) is not None:
            queue.mark_flushed(flushed_ns)
        if entry is not None:
            queue.release(entry)

    def _finish_run(self, end: End, given_up: int) -> None:
        if given_up:
            self.dropped = given_up
            drops = Drops(end.last_ns, FRAME_PATH, end.dropped + given_up, end.missing, end.kept_every)
            encoded = encode_record(drops, codec_of(Drops), self._header.start_unix_ns)
            self.add(Entry(end.last_ns, {"drops": encoded}, 0))  # at the last tick, because no other comes
        self.finish(end.outcome, end.why)
        if not self.files:  # what was there before may stay
            return
        replaced = self._plan.replaced
        for stale in set(run_files(self._path)) & set(replaced) - set(self.files):
            if stale.stat().st_ino == replaced[stale]:
                try:
                    remove_idle(stale)  # unless another process is writing it by now
                except OSError as error:
                    self._tell(f"{stale}: is left from an earlier run and can not be removed ({error.strerror})")

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

    def add(self, entry: Entry) -> None:
        """Take one entry."""
        self._collect_finished()
        if entry.ticks:
            self._cut_before(entry.stamp_ns)
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

    @abstractmethod
    def _cut_before(self, stamp_ns: int) -> None:
        """End the current segment, where it is time to, before a tick."""

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
    def _end(self, segment: Segment) -> None:
        """Take a segment that has received all of its entries."""

    @property
    def _growing(self) -> list[SessionFile]:
        """The files that have not received all that belongs into them."""
        return [file for file in self._unfinished if file.completion is None]

    def _encoder(self) -> ChunkEncoder:
        """An encoder whose chunks go nowhere until a segment uses it."""
        options = self._options
        return ChunkEncoder(options.encoding, lambda _: None, self._header.start_unix_ns, options.topics)

    def _begin_file(self, file: SessionFile, segment: Segment) -> None:
        """Write the keyframe of the first segment of a file."""
        self._unfinished.append(file)
        if segment.keyframe is not None:
            encoder = self._encoder()
            # Numbered as if they had been written just before what follows.
            encoder.sequences = Counter({topic: (number - 1) % 2**32 for topic, number in segment.sequences.items()})
            file.write_keyframe(encoder, segment.keyframe)

    def _state_now(self) -> Entry | None:
        """The keyframe of a segment that begins now."""
        return Entry(self._last_ns, dict(self._state), 0) if self._last_ns is not None else None

    def _cut(self, following: Segment) -> None:
        """End the current segment with the last tick; the ticks from here on go to another one."""
        self.open.append(following)
        self._end_complete()

    def _end_complete(self) -> None:
        while len(self.open) > 1 and not self.open[0].awaited:
            self._end(self.open.popleft())
            if self._image is not None:
                self.open[0].add_keyframe_image(self._image)

    def _complete(self, file: SessionFile, outcome: Mapping[str, str], counters: Counters) -> None:
        """Complete a file in the side thread."""
        outcome = {**outcome, **counters.summary(self._options.encoding)}
        file.completion = self._side.submit(file.complete, outcome, self._plan.camera)

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
