"""One file of a run while it is written: header records, outcome, final name and disk errors.

The options of a recording are here, because all files of a run are written with them.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from flowrec.core import (
    FIXED,
    SessionError,
    TopicTable,
    __version__,
    name_taken,
    put_in_place,
    seconds,
    shell_word,
    sync_directory,
)
from flowrec.store.channels import declarations, left_out
from flowrec.store.chunk import ChunkEncoder, copy_chunks
from flowrec.store.file_end import end_file
from flowrec.store.frame_encodings import ENCODINGS, FrameEncoding
from flowrec.store.mcap_format import SealedChunk
from flowrec.store.mcap_writer import FileError, disk_errors, new_mcap, not_writable
from flowrec.store.roi import Region
from flowrec.store.run_files import partial_path
from flowrec.store.session_metadata import PROFILE, SessionHeader, header_records
from flowrec.store.signature import signature_file
from flowrec.store.viewer_scene import ChipCamera
from flowrec.store.write_queue import Entry

_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class Split:
    """Limits at which a part of a run is finished and the next one begins. With neither limit, a run is in one file."""

    # about the size of a part, in MB. A part whose keyframe alone is as large becomes twice as large.
    megabytes: float | None = None
    seconds: float | None = None  # length of a part, in s of stamps

    def __bool__(self) -> bool:
        return bool(self.megabytes or self.seconds)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Interval that is recorded around an event: a mark, a note, a warning, the first lost image, a bad end.

    Attributes
    ----------
    before_s, after_s : s of stamps before the event and after the last event in the same snapshot.
    megabytes : what may be held in memory, in MB; where it is too little, `before_s` is what fits.
    """

    before_s: float
    after_s: float = 10.0
    megabytes: float = 1000.0


@dataclass(frozen=True, slots=True)
class WriterOptions:
    """Options of a recording; the section [recording] of the configuration, resolved."""

    # encoding of the images, a name of frame_encodings.py: raw, zstd, png, delta, or jpeg, which alone is lossy
    frames: str = "zstd"
    # longest end of a run, in s of stamps, that is lost when the process is killed; without `block` also in s of wall
    # time. Images that wait for a slow disk, at most `queue_limit_bytes`, are lost in addition.
    flush_s: float = 0.5
    sync_s: float = 1.0  # the same for a power failure, as long as an fsync takes less than half of it
    overwrite: bool = False  # replace all files of an earlier run of this name, once the new one is complete
    # what to do when the disk is slower than the run. True: `write` waits (simulation), also while more than `flush_s`
    # of stamps is not yet with the operating system. False: images are decimated (write_queue.py) and counted; nothing
    # else is ever dropped (live run).
    block: bool = False
    queue_limit_bytes: int = 256 << 20  # size of the queue to the recorder
    # a Split: the run X.mcap is written to the files X.part001.mcap, X.part002.mcap, ..., each of which is readable
    # alone; a Snapshot: nothing is written but X.snap001.mcap, ... around events.
    files: Split | Snapshot = Split()
    # record only the window around the robot of most images (roi.py); None: all of all images
    region: Region | None = None
    leave_out: tuple[str, ...] = ()  # topics that are not recorded, as names or patterns such as `/view/*`
    bits: int = 8  # depth of the images; another one is refused
    # False: a session that an exception ends leaves no file, and what `overwrite` would replace stays
    keep_failed: bool = True
    clock: Callable[[], float] = time.monotonic  # monotonic time in s, by which data is flushed and synced
    # a run whose recorder fails goes on; `close` raises the failure. False: `write` raises it.
    accept_losses: bool = False
    own_process: bool = False  # record in a process of its own, which finishes the files however the run ends
    # stamp 0 is at the time of day that the first tick's /run/clocks says; the header's is a guess
    start_by_clocks: bool = False
    topics: TopicTable = FIXED  # those of the run

    @property
    def left_out_topics(self) -> frozenset[str]:
        """The topics that match `leave_out`; raises UsageError as channels.left_out."""
        return left_out(self.leave_out, self.topics)

    @property
    def encoding(self) -> FrameEncoding:
        """Encoding of the images; raises UsageError if it can not hold their depth."""
        return ENCODINGS[self.frames].of(self.bits)

    @property
    def sync_interval_s(self) -> float:
        """Half of `sync_s`: the fsync itself may take the other half."""
        return self.sync_s / 2

    @property
    def flush_interval_s(self) -> float:
        """Half of `flush_s`: the other half allows for a thread that is scheduled late, or a slow disk."""
        return 0.5 * min(self.flush_s, self.sync_interval_s)


class SessionFile:
    """A file of a run while it is recorded: named `PATH.partial` until it is complete, and then renamed in one step.

    Data older than `flush_s`, in wall time or in stamps, has been passed to the operating system. Data older than
    `sync_s` is on the disk, as long as one fsync takes less than half of that. The fsync runs in a side thread: on a
    busy disk it may take a second, in which a camera would fill the queue. That thread writes, too, what would delay
    the caller: a keyframe, and with a `limit_bytes` all chunks. What is put later than that waits for it. Raises
    FileError: from any method, when the disk refuses; what fails in the side thread is raised by `check`.

    Parameters
    ----------
    path : its name.
    header : is written first.
    options : of the recording.
    limit_bytes : chunks are written by the side thread; `put` blocks while more bytes than this wait for it.

    Attributes
    ----------
    encoders : whose chunks go to this file.
    flushed_ns : stamp up to which the operating system has all that was added; None before the first flush.
    first_bytes : size of header and keyframe.
    failure : the first error, after which nothing is written; `flowrec recover` reads what was written before.
    completion : that of `complete` in another thread, once the file has received all that belongs into it.
    """

    def __init__(
        self, path: Path, header: SessionHeader, options: WriterOptions, *, limit_bytes: int | None = None
    ) -> None:
        self.path = path
        self.partial_path = partial_path(path)
        self.encoders: list[ChunkEncoder] = []
        self.flushed_ns: int | None = None
        self.failure: BaseException | None = None
        self.completion: Future[None] | None = None
        self._options = options
        self._limit_bytes = limit_bytes
        self._waiting_bytes = 0  # of chunks that the side thread is to write
        self._written = threading.Condition()
        self._writing: Future[None] | None = None  # the last of these
        self._syncing: Future[None] | None = None
        self._name_synced = False
        self._synced_size = 0
        self._since_ns: int | None = None  # stamp of the last flush, or of the first entry
        self._last_ns = 0
        self._side = ThreadPoolExecutor(1, "session-file")
        self._file = new_mcap(self.partial_path, overwrite=options.overwrite)
        try:
            self._write_head(header)
        except BaseException as error:
            self._file.close()
            if isinstance(error, OSError):
                raise not_writable(self.partial_path, error) from error
            raise
        self._flushed_s = self._synced_s = options.clock()

    def _write_head(self, header: SessionHeader) -> None:
        options = self._options
        self._start_unix_ns = header.start_unix_ns
        self._file.start(PROFILE, f"flowrec {__version__}")
        for record in (*header_records(header), *declarations(options.encoding, options.region, options.topics)):
            self._file.add(record)
        self.first_bytes = self.size

    def restart(self, header: SessionHeader) -> None:
        """Write another header into a file that holds nothing but its header, and sync it."""
        with self._mark_failed():
            self._file.clear()
            self._write_head(header)
        self.sync_head()

    def sync_head(self) -> None:
        """Force the header to the disk, before anything else is put."""
        try:
            self._synced_size = self.size
            self.sync()
            self._synced_s = self._options.clock()
        except BaseException:
            self.close()
            raise

    def write_keyframe(self, encoder: ChunkEncoder, keyframe: Entry) -> None:
        """Let the side thread write the first messages. It encodes them, too: large flow fields take long."""
        encoder.sink = self.add_chunks

        def write() -> None:
            encoder.add(keyframe)
            encoder.seal()
            self.first_bytes = self.size

        self._writing = self._aside(write)

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._file.size

    @property
    def all_bytes(self) -> int:
        """Bytes in the file and bytes that are not written yet, of which most are not compressed yet."""
        return self.size + self._waiting_bytes + sum(encoder.size for encoder in self.encoders)

    @property
    def timeout_s(self) -> float | None:
        """Time until `flush_if_due` has something to do, in s; None: not before the next entry."""
        options = self._options
        if self.is_writing:
            return _POLL_S
        if any(encoder.size for encoder in self.encoders):
            return max(0.0, self._flushed_s + options.flush_interval_s - options.clock())
        if self._synced_size < self.size:
            # While the last fsync is still running there is nothing to do about the next one.
            shortest = _POLL_S if self.is_syncing else 0.0
            return max(shortest, self._synced_s + options.sync_interval_s - options.clock())
        return None

    @property
    def is_writing(self) -> bool:
        """True while the side thread has something to write."""
        return self._writing is not None and not self._writing.done()

    @property
    def is_syncing(self) -> bool:
        """True while an fsync is under way."""
        return self._syncing is not None and not self._syncing.done()

    def note(self, stamp_ns: int) -> None:
        """Count the age of what is added to the encoders from this entry on."""
        if self._since_ns is None:
            self._since_ns = stamp_ns
        self._last_ns = max(self._last_ns, stamp_ns)

    def put(self, chunks: list[SealedChunk]) -> None:
        """Write chunks, all in one write, behind what the side thread has to write."""
        if self._limit_bytes is None and not self.is_writing:
            self.check()
            self.add_chunks(chunks)
            return
        own, nbytes = copy_chunks(chunks), sum(len(chunk.data) for chunk in chunks)

        def write() -> None:
            try:
                if self.failure is None:
                    self.add_chunks(own)
            finally:
                with self._written:
                    self._waiting_bytes -= nbytes
                    self._written.notify_all()

        with self._written:
            if self._limit_bytes is not None:
                limit_bytes = self._limit_bytes
                self._written.wait_for(lambda: self.failure is not None or self._waiting_bytes <= limit_bytes)
            self._waiting_bytes += nbytes
        self._writing = self._aside(write)

    def add_chunks(self, chunks: list[SealedChunk]) -> None:
        """Write chunks at once."""
        with self._mark_failed():
            self._file.add_chunks(chunks)

    def flush_if_due(self) -> None:
        """Write and sync the data whose interval has passed."""
        self.check()
        options, stamps_s = self._options, seconds(self._last_ns - (self._since_ns or 0))
        now = options.clock()
        if now >= self._flushed_s + options.flush_interval_s or stamps_s >= options.flush_interval_s:
            self.flush()
        is_ready = not self.is_syncing and (self._limit_bytes is not None or not self.is_writing)
        if is_ready and now >= self._synced_s + options.sync_interval_s and self._synced_size < self.size:
            self.flush()
            self._synced_s, self._synced_size = now, self.size
            self._syncing = self._aside(self.sync)

    def flush(self, *, wait: bool = False) -> None:
        """Write all that was added; with `wait`, also what the side thread has to write."""
        for encoder in self.encoders:
            encoder.seal()
        if wait and self._writing is not None:
            futures.wait([self._writing])
            self.check()
        self._flushed_s = self._options.clock()
        if self._since_ns is not None:
            self._since_ns = self._last_ns
            if not self.is_writing:
                self.flushed_ns = self._last_ns

    def sync(self) -> None:
        """Force what was written to the disk; may run in another thread than the other methods."""
        with self._mark_failed():
            self._file.sync()
            if not self._name_synced:
                sync_directory(self.partial_path.parent)  # otherwise a power failure may leave the file without a name
                self._name_synced = True

    def check(self) -> None:
        """Raise the first error."""
        if self.failure is not None:
            raise self.failure

    def complete(self, outcome: Mapping[str, str], camera: ChipCamera | None) -> None:
        """Write outcome, viewer topics (of this camera) and summary behind all else, sync, and rename the file."""
        self._side.shutdown()
        self.check()
        with self._mark_failed():
            left_out = self._options.left_out_topics
            end_file(self.partial_path, self._file, outcome, camera, self._start_unix_ns, left_out)
            try:
                put_in_place(self.partial_path, self.path, overwrite=self._options.overwrite)
                signature_file(self.path).unlink(missing_ok=True)  # of the file that was replaced
            except (FileExistsError, IsADirectoryError) as error:
                raise name_taken(self.path, f" (the finished session stays in {self.partial_path})") from error

    def close(self) -> None:
        """Write what the side thread has to write, and close the file without completing it."""
        self._side.shutdown()
        self._file.close()

    def encoding_failed(self, error: SessionError) -> FileError:
        """The error for a message that can not be stored."""
        self.failure = FileError(
            f"{self.path}: {error}; "
            f"`flowrec recover {shell_word(self.partial_path)}` recovers what was recorded before it"
        )
        return self.failure

    def _aside(self, work: Callable[[], None]) -> Future[None]:
        """Run a function in the side thread; `failure` receives its error."""

        def run() -> None:
            with self._mark_failed():
                work()

        return self._side.submit(run)

    @contextlib.contextmanager
    def _mark_failed(self) -> Iterator[None]:
        try:
            with disk_errors(self.partial_path, kept=self._options.keep_failed):
                yield
        except BaseException as error:
            self.failure = self.failure or error
            raise
