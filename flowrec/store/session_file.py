"""One file of a run while it is written: header records, outcome, final name and disk errors.

The options of a recording are here, because all files of a run are written with them.
"""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Metadata

from flowrec.core import (
    FIXED,
    MCAP,
    Output,
    SessionError,
    TopicTable,
    __version__,
    name_taken,
    put_in_place,
    sync_directory,
)
from flowrec.store.channels import declarations, left_out
from flowrec.store.chunk import ChunkEncoder, copy_chunks
from flowrec.store.frame_encodings import ENCODINGS, FrameEncoding
from flowrec.store.mcap_format import SealedChunk
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.roi import Region
from flowrec.store.run_files import PARTIAL_SUFFIX, partial_path, run_files
from flowrec.store.session_metadata import OUTCOME, PROFILE, VIEW, SessionHeader, header_records
from flowrec.store.write_queue import Entry


@dataclass(frozen=True, slots=True)
class Split:
    """Limits at which a part of a run is finished and the next one begins. With neither limit, a run is in one file.

    Attributes
    ----------
    megabytes : about the size of a part, in MB. A part whose keyframe alone is as large becomes twice as large.
    seconds : length of a part, in s of stamps.
    """

    megabytes: float | None = None
    seconds: float | None = None

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
    """Options of a recording; the section [recording] of the configuration, resolved.

    Attributes
    ----------
    frames : encoding of the images, a name of frame_encodings.py: raw, zstd, png, delta, or jpeg, which alone is lossy.
    flush_s : longest end of a run, in s of stamps, that is lost when the process is killed; without `block` also in s
        of wall time. Images that wait for a slow disk, at most `queue_limit_bytes`, are lost in addition.
    sync_s : the same for a power failure, as long as an fsync takes less than half of it.
    overwrite : replace all files of an earlier run of this name, once the new one is complete.
    block : what to do when the disk is slower than the run. True: `write` waits (simulation), also while more than
        `flush_s` of stamps is not yet with the operating system. False: images are decimated (write_queue.py) and
        counted; nothing else is ever dropped (live run).
    queue_limit_bytes : size of the queue to the writer's thread.
    files : a Split: the run X.mcap is written to the files X.part001.mcap, X.part002.mcap, ..., each of which is
        readable alone; a Snapshot: nothing is written but X.snap001.mcap, ... around events.
    region : record only the window around the robot of most images (roi.py); None: all of all images.
    leave_out : topics that are not recorded, as names or patterns such as `/view/*`.
    bits : depth of the images; another one is refused.
    keep_failed : False: a session that an exception ends leaves no file, and what `overwrite` would replace stays.
    clock : monotonic time in s, by which data is flushed and synced.
    topics : those of the run.
    start_by_clocks : stamp 0 is at the time of day that the first tick's /run/clocks says; the header's is a guess.
    """

    frames: str = "zstd"
    flush_s: float = 0.5
    sync_s: float = 1.0
    overwrite: bool = False
    block: bool = False
    queue_limit_bytes: int = 256 << 20
    files: Split | Snapshot = Split()
    region: Region | None = None
    leave_out: tuple[str, ...] = ()
    bits: int = 8
    keep_failed: bool = True
    clock: Callable[[], float] = time.monotonic
    start_by_clocks: bool = False
    topics: TopicTable = FIXED

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


class FileError(SessionError):
    """A file that can not be written; the text names it and says what to do."""


class SessionFile:
    """A file that is named `PATH.partial` until it is complete, and then renamed in one step.

    `sync` may run in another thread than the other methods.

    Parameters
    ----------
    path : its name.
    header : is written first.
    options : of the recording.

    Attributes
    ----------
    failed : an error has occurred; `flowrec recover` reads what was written.

    Raises
    ------
    FileError : from any method, when the disk refuses.
    """

    def __init__(self, path: Path, header: SessionHeader, options: WriterOptions) -> None:
        self.path = path
        self.partial_path = partial_path(path)
        self.failed = False
        self._name_synced = False
        self._options = options
        self._file = new_mcap(self.partial_path, overwrite=options.overwrite)
        try:
            self._write_head(header)
        except BaseException as error:
            self._file.close()
            if isinstance(error, OSError):
                raise _not_writable(self.partial_path, error) from error
            raise

    def restart(self, header: SessionHeader) -> None:
        """Write another header into a file that holds nothing but its header."""
        with self._mark_failed():
            self._file.clear()
            self._write_head(header)

    def _write_head(self, header: SessionHeader) -> None:
        options = self._options
        self._file.start(PROFILE, f"flowrec {__version__}")
        for record in (*header_records(header), *declarations(options.encoding, options.region, options.topics)):
            self._file.add(record)

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._file.size

    def add_chunks(self, chunks: list[SealedChunk]) -> None:
        """Append chunks, all in one write."""
        with self._mark_failed():
            self._file.add_chunks(chunks)

    def sync(self) -> None:
        """Force what was appended to the disk."""
        with self._mark_failed():
            self._file.sync()
            if not self._name_synced:
                sync_directory(self.partial_path.parent)  # otherwise a power failure may leave the file without a name
                self._name_synced = True

    def complete(self, outcome: Mapping[str, str], top_um_s: float | None) -> None:
        """Write outcome, colour scale of the views and summary, sync, and rename the file."""
        with self._mark_failed():
            if top_um_s is not None:
                self._file.add(Metadata(VIEW, {"speed_scale_um_s": repr(top_um_s)}))
            self._file.add(Metadata(OUTCOME, dict(outcome)))
            self._file.add_digest()
            self._file.finish()
            self._file.sync()
            try:
                put_in_place(self.partial_path, self.path, overwrite=self._options.overwrite)
            except (FileExistsError, IsADirectoryError) as error:
                raise name_taken(self.path, f" (the finished session stays in {self.partial_path})") from error

    def close(self) -> None:
        """Close the file without completing it."""
        self._file.close()

    def encoding_failed(self, error: SessionError) -> FileError:
        """The error for a message that can not be stored."""
        self.failed = True
        return FileError(
            f"{self.path}: {error}; `flowrec recover {self.partial_path}` recovers what was recorded before it"
        )

    @contextlib.contextmanager
    def _mark_failed(self) -> Iterator[None]:
        try:
            with disk_errors(self.partial_path):
                yield
        except BaseException:
            self.failed = True
            raise


def new_mcap(path: Path, *, overwrite: bool) -> McapWriter:
    """Begin a file; raises FileError where it can not be made."""
    try:
        return McapWriter(path, overwrite=overwrite)
    except OSError as error:
        raise _not_writable(path, error) from error


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turns an OSError of writing the file into a FileError that says what to do."""
    try:
        yield
    except OSError as error:
        raise _disk_failed(path, error) from error


def refuse_if_taken(path: Path, *, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse the output X.mcap as `Output.check` does, and any file of that run, finished or not, in the same way.

    Raises
    ------
    OutputError : as `Output.check`.
    FileError : the unfinished file of a killed run is there, which `overwrite` would remove.
    """
    there = run_files(path)
    Output(path, MCAP, tuple(inputs), overwrite).check((*there, partial_path(path)))
    if overwrite:
        return
    for file in there:
        if not file.name.endswith(PARTIAL_SUFFIX):
            raise name_taken(file)
        raise FileError(
            f"{file}: is left from a run that did not finish; `flowrec recover {file}`"
            " saves it, another --out or --overwrite records without it"
        )


def _not_writable(path: Path, error: OSError) -> FileError:
    if isinstance(error, FileNotFoundError):
        return FileError(f"{path.parent}: no such directory; make it, or choose another place with --out")
    if isinstance(error, BlockingIOError):
        return FileError(f"{path}: is being written by another process just now; choose another name with --out")
    return FileError(f"{path}: can not be made ({error.strerror}); choose another place with --out")


def _disk_failed(path: Path, error: OSError) -> FileError:
    if error.errno == errno.ENOENT:
        return FileError(
            f"{path}: no longer exists: the file or its directory was removed or renamed during the recording"
        )
    what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else f"writing failed ({error.strerror})"
    return FileError(f"{path}: {what}; free some space, then `flowrec recover {path}` saves what was recorded")


class AsyncFileWriter(SessionFile):
    """A session file that a background thread writes: chunks are queued and written in order.

    Parameters
    ----------
    path, header, options : of the file.
    limit_bytes : size of the queue; `put` blocks while it is full.

    Attributes
    ----------
    finished : the file is complete.

    Raises
    ------
    FileError : when the file can not be made; what fails later is raised by `check`.
    """

    def __init__(self, path: Path, header: SessionHeader, options: WriterOptions, *, limit_bytes: int) -> None:
        super().__init__(path, header, options)
        self.finished = False
        self._limit_bytes = limit_bytes
        self._synced_s, self._synced_size = options.clock(), 0
        self._waiting_bytes = 0
        self._written = threading.Condition()
        self._failure: BaseException | None = None
        self._last: Future[None] | None = None
        self._thread = ThreadPoolExecutor(1, "session-snapshot")

    def put_keyframe(self, encoder: ChunkEncoder, entry: Entry) -> None:
        """Write the keyframe. The thread encodes it, too, because that may take as long as writing it."""
        encoder.sink = self.add_chunks

        def encode() -> None:
            encoder.add(entry)
            encoder.seal()

        self._submit(encode)

    def put(self, chunks: list[SealedChunk]) -> None:
        """Append chunks."""
        for chunk in copy_chunks(chunks):
            with self._written:
                self._written.wait_for(lambda: self._failure is not None or self._waiting_bytes <= self._limit_bytes)
                self._waiting_bytes += len(chunk.data)
            self._submit(self._write, chunk)

    def sync_if_due(self) -> None:
        """Sync what was written, also if no other chunk follows."""
        if self._last is not None and self._last.done():
            self._submit(self._sync)

    def finish(self, outcome: Mapping[str, str], top_um_s: float | None) -> None:
        """Complete the file when all has been written."""

        def finish() -> None:
            self.complete(outcome, top_um_s)
            self.finished = True

        self._submit(finish)

    def check(self, *, wait: bool = False) -> None:
        """Raise the error of the thread, if any; with `wait`, after all has been written."""
        if wait and self._last is not None:
            futures.wait([self._last])
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Write what is queued, and close the file without completing it."""
        self._thread.shutdown()
        super().close()

    def _submit(self, work: Callable[..., None], *arguments: SealedChunk) -> None:
        """Run a function in the thread, unless an earlier one has failed."""

        def run() -> None:
            try:
                if self._failure is None:
                    work(*arguments)
            except BaseException as error:  # noqa: BLE001  `check` raises it
                self._failure = error
            finally:
                with self._written:
                    self._waiting_bytes -= sum(len(chunk.data) for chunk in arguments)
                    self._written.notify_all()

        self._last = self._thread.submit(run)

    def _write(self, chunk: SealedChunk) -> None:
        self.add_chunks([chunk])
        self._sync()

    def _sync(self) -> None:
        now, size = self._options.clock(), self.size
        if now >= self._synced_s + self._options.sync_interval_s and self._synced_size < size:
            self.sync()
            self._synced_s, self._synced_size = now, size
