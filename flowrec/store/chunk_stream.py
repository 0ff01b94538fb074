"""The messages of some chunks in order of time, decompressed ahead of the reader in threads."""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from operator import attrgetter

from mcap.records import ChunkIndex

from flowrec.store.mcap_index import records_of
from flowrec.store.mcap_reader import CHUNK_LIMIT_BYTES, MESSAGES_LIMIT, Record, Source

_AHEAD_BYTES = 32 << 20  # decompressed before they are asked for
_AHEAD_CHUNKS = 16
_THREADS = 2
_FEW = 64  # messages of a chunk that may wait as objects

Ready = Callable[[Record], Record]
_Bundle = list[bytes | memoryview | list[Record]]  # of each chunk its content, or its messages

by_time = attrgetter("log_ns")


@contextlib.contextmanager
def threads() -> Iterator[Executor]:
    """The threads that decompress; who stops reading early does not wait for what was to come."""
    executor = ThreadPoolExecutor(_THREADS, "session-reader")
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def lane(
    source: Source, chunks: Iterable[ChunkIndex], executor: Executor, ready: Ready | None = None
) -> Iterator[Record]:
    """Merge chunks into one stream of messages; those of equal time stay in file order.

    flowrec's own chunks of a group follow each other in time. Where other programs have rewritten a file,
    chunks that overlap are read together and sorted.

    Parameters
    ----------
    ready : what can be done with each record in the threads, where a chunk holds few and large ones: images. It
        gives the record back with a message of at most twice its size as payload, or as it was.

    Raises
    ------
    SessionError : a chunk is damaged, or more chunks overlap than fit into memory.
    """
    waiting = deque(
        _bundles(source, sorted(chunks, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset)))
    )
    running: deque[tuple[list[ChunkIndex], Future[_Bundle]]] = deque()
    ahead_bytes = 0
    while waiting or running:
        while waiting and len(running) < _AHEAD_CHUNKS:
            weight = _weight(waiting[0])
            if ahead_bytes and ahead_bytes + weight > _AHEAD_BYTES:
                break  # one that is larger than all that may be ahead comes alone
            bundle = waiting.popleft()
            running.append((bundle, executor.submit(_contents, source, bundle, ready)))
            ahead_bytes += weight
        bundle, future = running.popleft()
        # A small message as an object takes more memory than as bytes: they are made for one bundle at a time.
        records = _sorted_messages(source, bundle, future.result())
        del future
        yield from records
        del records
        ahead_bytes -= _weight(bundle)


def _bundles(source: Source, chunks: list[ChunkIndex]) -> Iterator[list[ChunkIndex]]:
    bundle: list[ChunkIndex] = []
    size = end_ns = 0
    for chunk in chunks:
        if bundle and chunk.message_start_time > end_ns:
            yield bundle
            bundle, size = [], 0
        bundle.append(chunk)
        size += chunk.uncompressed_size  # compared with the chunk before it is unpacked, or at least before it is used
        end_ns = max(end_ns, chunk.message_end_time) if len(bundle) > 1 else chunk.message_end_time
        if size > CHUNK_LIMIT_BYTES and len(bundle) > 1:
            raise source.damaged(chunk.chunk_start_offset, "too many chunks claim the same time")
    if bundle:
        yield bundle


def _weight(bundle: list[ChunkIndex]) -> int:
    return sum(chunk.uncompressed_size for chunk in bundle)


def _contents(source: Source, bundle: list[ChunkIndex], ready: Ready | None) -> _Bundle:
    return [_content(source, chunk, ready) for chunk in bundle]


def _content(source: Source, chunk: ChunkIndex, ready: Ready | None) -> bytes | memoryview | list[Record]:
    content = source.chunk(chunk)
    if ready is None:
        return content
    with source.parsing(chunk.chunk_start_offset):
        if len(list(itertools.islice(records_of(content), _FEW))) == _FEW:
            return content
    return [ready(record) for record in source.messages_in(content, chunk.chunk_start_offset)]


def _sorted_messages(source: Source, bundle: list[ChunkIndex], contents: _Bundle) -> Iterator[Record]:
    places = [chunk.chunk_start_offset for chunk in bundle]
    records: list[Record] = []
    for place, content in sorted(zip(places, contents, strict=True), key=lambda pair: pair[0]):
        records += content if isinstance(content, list) else source.messages_in(content, place)
        if len(records) > MESSAGES_LIMIT:
            raise source.damaged(place, "too many messages claim the same time")
    records.sort(key=by_time)
    # What comes later is merged by the times of the index; they are not to be trusted either.
    first_ns = min(chunk.message_start_time for chunk in bundle)
    last_ns = max(chunk.message_end_time for chunk in bundle)
    if records and not first_ns <= records[0].log_ns <= records[-1].log_ns <= last_ns:
        raise source.damaged(places[0], "there are messages of other times than the index tells")
    return iter(records)
