"""Entries of the backlog -> one file, as durable as was promised. Runs in the writer's thread."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from flowrec.errors import SessionError
from flowrec.store.chunk import Sealed, kept
from flowrec.store.chunk_encoder import Packer
from flowrec.store.metadata import SessionHeader
from flowrec.store.session_file import Making, Piece, PieceError
from flowrec.store.viewer_topics import Mirrors
from flowrec.store.write_queue import Entry
from flowrec.topics import BY_FIELD
from flowrec.units import seconds

_POLL_S = 0.05


class Recorder:
    """Encodes ticks and keeps what is not yet on the disk young.

    What is older than `flush_s`, in wall time or in stamps, is with the operating system, and what is older than
    `sync_s` is kept by the disk, as long as one fsync takes less than half of that. It is done in a thread of its
    own: on a busy disk it may take a second, in which a camera fills the queue.

    Parameters
    ----------
    path, header : of the file.
    making : what it is made with.
    mirrors : makes the views for other programs.
    wait : until the disk keeps the head; else it does so with what comes next.

    Attributes
    ----------
    first_bytes : what the file begins with, its head and the tick that it was told to begin with.
    flushed_ns : stamp up to which all that was added is with the operating system; None before the first flush.

    Raises
    ------
    PieceError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(
        self,
        path: Path,
        header: SessionHeader,
        making: Making,
        mirrors: Mirrors,
        *,
        wait: bool = True,
    ) -> None:
        self._sync_every_s, self._flush_s = making.sync_every_s, making.flush_every_s
        self._mirrors = mirrors
        self._piece = Piece(path, header, making)
        self._frames = making.frames
        self._start_unix_ns = header.start_unix_ns
        self._packer = Packer(making.frames, mirrors, self._piece.add_chunks, header.start_unix_ns)
        self.first_bytes = self._piece.size
        self.flushed_ns: int | None = None
        self._beginning: Future[None] | None = None
        self._held: list[Sealed] = []
        self._flushed_s = self._synced_s = time.monotonic()
        self._synced_size = 0
        self._since_ns: int | None = None  # stamp of the last flush, or of the first entry
        self._last_ns = 0
        self._syncing: Future[None] | None = None
        self._beside = ThreadPoolExecutor(1, "session-sync")
        if wait:
            try:
                self._sync()
            except BaseException:
                self.close()
                raise

    @property
    def path(self) -> Path:
        """What the file will be called."""
        return self._piece.path

    @property
    def partial_path(self) -> Path:
        """What it is called until then."""
        return self._piece.partial_path

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._piece.size

    @property
    def waiting_bytes(self) -> int:
        """Bytes that were not, mostly before they are compressed."""
        return self._packer.size + sum(len(chunk.data) for chunk in self._held)

    @property
    def broken(self) -> bool:
        """Whether something has failed."""
        return self._piece.broken

    @property
    def patience_s(self) -> float | None:
        """For how long one may wait for the next entry before `flush_if_due` has something to do; None: for ever."""
        if self._beginning is not None:
            return _POLL_S
        if self._packer.size:
            return max(0.0, self._flushed_s + self._flush_s - time.monotonic())
        if self._synced_size < self._piece.size:
            # While the last fsync is still running there is nothing to do about the next one.
            shortest = _POLL_S if self._sync_running else 0.0
            return max(shortest, self._synced_s + self._sync_every_s - time.monotonic())
        return None

    def begin_with(self, entry: Entry) -> None:
        """Let one tick come first. Large flow fields take a while, in which chunks of what follows are held back."""
        self._packer.take = self._hold
        self._packer.sequences.update(BY_FIELD[field].path for field in entry.news)
        packer = Packer(self._frames, self._mirrors.twin(), self._piece.add_chunks, self._start_unix_ns)
        self._beginning = self._beside.submit(_begin, packer, entry)

    def wait_for_beginning(self) -> None:
        """Until that tick is in the file."""
        self._hear_of_beginning(wait=True)

    def add(self, entry: Entry) -> None:
        """Encode the messages of one tick; write the chunks that are full."""
        self._hear_of_beginning(wait=False)
        if self._since_ns is None:
            self._since_ns = entry.stamp_ns
        self._last_ns = max(self._last_ns, entry.stamp_ns)
        try:
            self._packer.add(entry)
        except PieceError:
            raise
        except SessionError as error:
            raise self._piece.spoiled(error) from error

    def flush_if_due(self) -> None:
        """Write what has waited for long enough, and have the disk keep it."""
        self._hear_of_beginning(wait=False)
        now, stamps_s = time.monotonic(), seconds(self._last_ns - (self._since_ns or 0))
        if now >= self._flushed_s + self._flush_s or stamps_s >= self._flush_s:
            self._flush()
            self._flushed_s, self._since_ns = now, self._last_ns
        if now >= self._synced_s + self._sync_every_s and self._synced_size < self._piece.size:
            self._sync_beside(now)

    def flush(self) -> None:
        """Write what waits."""
        self._hear_of_beginning(wait=True)
        self._flush()
        self._flushed_s, self._since_ns = time.monotonic(), self._last_ns

    def finish(self, outcome: Mapping[str, str]) -> None:
        """The rest of the messages, the outcome and the summary, down to the disk; then the file has its name."""
        self._hear_of_beginning(wait=True)
        self._flush()
        self._join_sync()
        self._piece.finish(outcome, self._mirrors.top_um_s)

    def close(self) -> None:
        """Close the file as it is."""
        self._beside.shutdown()
        self._piece.close()

    def _flush(self) -> None:
        self._packer.seal()
        if self._beginning is None and self._since_ns is not None:
            self.flushed_ns = self._last_ns

    def _hold(self, sealed: list[Sealed]) -> None:
        self._held += kept(sealed)

    def _hear_of_beginning(self, *, wait: bool) -> None:
        if self._beginning is None or not (wait or self._beginning.done()):
            return
        self._beginning.result()
        self._beginning = None
        self.first_bytes = self._piece.size
        self._packer.take = self._piece.add_chunks
        if self._held:
            held, self._held = self._held, []
            self._piece.add_chunks(held)

    def _sync(self) -> None:
        self._synced_size = self._piece.size
        self._piece.sync()
        self._synced_s = time.monotonic()

    def _sync_beside(self, now_s: float) -> None:
        if self._sync_running:
            return
        self._join_sync()
        self._flush()
        self._synced_s, self._synced_size = now_s, self._piece.size
        self._syncing = self._beside.submit(self._piece.sync)

    @property
    def _sync_running(self) -> bool:
        return self._syncing is not None and not self._syncing.done()

    def _join_sync(self) -> None:
        """Wait for the thread, and hear of its failure."""
        if self._syncing is not None:
            self._syncing.result()
            self._syncing = None


def _begin(packer: Packer, entry: Entry) -> None:
    packer.add(entry)
    packer.seal()
