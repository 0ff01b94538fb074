"""A file that is written from memory in a thread of its own: what is sealed elsewhere waits here for the disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from flowrec.store.chunk import Sealed, kept
from flowrec.store.chunk_encoder import Packer
from flowrec.store.metadata import SessionHeader
from flowrec.store.session_file import Making, Piece
from flowrec.store.write_queue import Entry


class Poured:
    """Takes chunks at once and writes them in order.

    Parameters
    ----------
    path, header : of the file.
    making : what it is made with.
    limit_bytes : how much may wait; beyond that `put` does.

    Raises
    ------
    PieceError : when the file can not be made; what fails later is raised by `check`.
    """

    def __init__(self, path: Path, header: SessionHeader, making: Making, *, limit_bytes: int) -> None:
        self.path = path
        self.finished = False
        self._piece = Piece(path, header, making)
        self._limit_bytes = limit_bytes
        self._sync_every_s = making.sync_every_s
        self._synced_s, self._synced_size = time.monotonic(), 0
        self._waiting_bytes = 0
        self._written = threading.Condition()
        self._failure: BaseException | None = None
        self._last: Future[None] | None = None
        self._thread = ThreadPoolExecutor(1, "session-snapshot")

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._piece.size

    def begin_with(self, packer: Packer, entry: Entry) -> None:
        """A tick that comes first; it is packed in the thread, too, for that may take as long as writing it."""
        packer.take = self._piece.add_chunks
        self._last = self._thread.submit(self._begin, packer, entry)

    def put(self, sealed: list[Sealed]) -> None:
        """Chunks, the next ones in the file."""
        chunks = kept(sealed)
        for chunk in chunks:
            nbytes = len(chunk.data)
            with self._written:
                self._written.wait_for(lambda: self._failure is not None or self._waiting_bytes <= self._limit_bytes)
                self._waiting_bytes += nbytes
            self._last = self._thread.submit(self._write, chunk, nbytes)

    def sync_if_due(self) -> None:
        """Have the disk keep what was written, also where nothing more comes."""
        if self._last is not None and self._last.done():
            self._last = self._thread.submit(self._sync_if_due)

    def finish(self, outcome: Mapping[str, str], top_um_s: float | None) -> None:
        """The end of the file, when all has been written."""
        self._last = self._thread.submit(self._finish, outcome, top_um_s)

    def check(self, *, wait: bool = False) -> None:
        """Raise what has failed; with `wait`, after all has been written."""
        if wait and self._last is not None:
            futures.wait([self._last])
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Close the file as it is, with what was put."""
        self._thread.shutdown()
        self._piece.close()

    def _begin(self, packer: Packer, entry: Entry) -> None:
        try:
            packer.add(entry)
            packer.seal()
        except BaseException as error:  # noqa: BLE001  whatever it is, the writer has to hear of it
            self._failure = error

    def _write(self, chunk: Sealed, nbytes: int) -> None:
        try:
            if self._failure is None:
                self._piece.add_chunks([chunk])
                self._sync_if_due()
        except BaseException as error:  # noqa: BLE001  as above
            self._failure = error
        finally:
            with self._written:
                self._waiting_bytes -= nbytes
                self._written.notify_all()

    def _sync_if_due(self) -> None:
        now, size = time.monotonic(), self._piece.size
        if self._failure is None and now >= self._synced_s + self._sync_every_s and self._synced_size < size:
            try:
                self._piece.sync()
            except BaseException as error:  # noqa: BLE001  as above
                self._failure = error
            self._synced_s, self._synced_size = now, size

    def _finish(self, outcome: Mapping[str, str], top_um_s: float | None) -> None:
        try:
            if self._failure is None:
                self._piece.finish(outcome, top_um_s)
                self.finished = True
        except BaseException as error:  # noqa: BLE001  as above
            self._failure = error
