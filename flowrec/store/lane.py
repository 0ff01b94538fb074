"""The messages of some chunks in order of time, decompressed ahead of the reader in threads."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from operator import attrgetter

from mcap.records import ChunkIndex

from flowrec.store.source import CHUNK_LIMIT_BYTES, Record, Source

_AHEAD_BYTES = 32 << 20  # decompressed before they are asked for
_AHEAD_CHUNKS = 16
_THREADS = 2

by_time = attrgetter("log_ns")


@contextlib.contextmanager
def threads() -> Iterator[Executor]:
    """The threads that decompress; who stops reading early does not wait for what was to come."""
    executor = ThreadPoolExecutor(_THREADS, "session-reader")
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def lane(source: Source, chunks: Iterable[ChunkIndex], executor: Executor) -> Iterator[Record]:
    """Merge chunks into one stream of messages; those of equal time stay in file order.

    flowrec's own chunks of a group follow each other in time. Where other programs have rewritten a file,
    chunks that overlap are read together and sorted.

    Raises
    ------
    SessionError : a chunk is damaged, or more chunks overlap than fit into memory.
    """
    waiting = deque(
        _bundles(source, sorted(chunks, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset)))
    )
    running: deque[tuple[int, Future[list[Record]]]] = deque()
    ahead_bytes = 0
    while waiting or running:
        while waiting and len(running) < _AHEAD_CHUNKS and (ahead_bytes < _AHEAD_BYTES or not running):
            bundle = waiting.popleft()
            weight = sum(chunk.uncompressed_size for chunk in bundle)
            running.append((weight, executor.submit(_sorted_messages, source, bundle)))
            ahead_bytes += weight
        weight, future = running.popleft()
        records = future.result()
        ahead_bytes -= weight
        yield from records


def _bundles(source: Source, chunks: list[ChunkIndex]) -> Iterator[list[ChunkIndex]]:
    bundle: list[ChunkIndex] = []
    size = end_ns = 0
    for chunk in chunks:
        if bundle and chunk.message_start_time > end_ns:
            yield bundle
            bundle, size = [], 0
        bundle.append(chunk)
        size += chunk.uncompressed_size
        end_ns = max(end_ns, chunk.message_end_time) if len(bundle) > 1 else chunk.message_end_time
        if size > CHUNK_LIMIT_BYTES:
            raise source.damaged(chunk.chunk_start_offset, "too many chunks claim the same time")
    if bundle:
        yield bundle


def _sorted_messages(source: Source, bundle: list[ChunkIndex]) -> list[Record]:
    in_file_order = sorted(bundle, key=lambda chunk: chunk.chunk_start_offset)
    return sorted((record for chunk in in_file_order for record in source.messages(chunk)), key=by_time)
