"""Asynchronous file writer: queues finished chunks and writes them in a background thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from flowrec.store.chunk import ChunkEncoder, SealedChunk, detached
from flowrec.store.session_file import SessionFile, WriterOptions
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.write_queue import Entry


class AsyncFileWriter(SessionFile):
    """Takes chunks at once and writes them in order.

    Parameters
    ----------
    path, header, options : of the file.
    limit_bytes : how much may wait; beyond that `put` blocks.

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
        self._synced_s, self._synced_size = time.monotonic(), 0
        self._waiting_bytes = 0
        self._written = threading.Condition()
        self._failure: BaseException | None = None
        self._last: Future[None] | None = None
        self._thread = ThreadPoolExecutor(1, "session-snapshot")

    def put_keyframe(self, encoder: ChunkEncoder, entry: Entry) -> None:
        """Write the first tick. It is encoded in the thread, too, because that may take as long as writing it."""
        encoder.sink = self.add_chunks

        def encode() -> None:
            encoder.add(entry)
            encoder.seal()

        self._submit(encode)

    def put(self, chunks: list[SealedChunk]) -> None:
        """Append chunks."""
        for chunk in detached(chunks):
            with self._written:
                self._written.wait_for(lambda: self._failure is not None or self._waiting_bytes <= self._limit_bytes)
                self._waiting_bytes += len(chunk.data)
            self._submit(self._write, chunk)

    def sync_if_due(self) -> None:
        """Sync what was written, also where nothing more comes."""
        if self._last is not None and self._last.done():
            self._submit(self._sync)

    def finish(self, outcome: Mapping[str, str], top_um_s: float | None) -> None:
        """Complete the file when all has been written."""

        def finish() -> None:
            self.complete(outcome, top_um_s)
            self.finished = True

        self._submit(finish)

    def check(self, *, wait: bool = False) -> None:
        """Raise what has failed; with `wait`, after all has been written."""
        if wait and self._last is not None:
            futures.wait([self._last])
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Close the file as it is, with what was put."""
        self._thread.shutdown()
        super().close()

    def _submit(self, work: Callable[..., None], *arguments: SealedChunk) -> None:
        """Have the thread do something, unless something has failed before."""

        def run() -> None:
            try:
                if self._failure is None:
                    work(*arguments)
            except BaseException as error:  # noqa: BLE001  whatever it is, the writer must raise it
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
        now, size = time.monotonic(), self.size
        if now >= self._synced_s + self._options.sync_interval_s and self._synced_size < size:
            self.sync()
            self._synced_s, self._synced_size = now, size
