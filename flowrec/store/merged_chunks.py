"""The messages of many chunks in order of time, decompressed in threads ahead of who reads them."""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from operator import attrgetter

from mcap.records import ChunkIndex

from flowrec.store.mcap_format import CHUNK_LIMIT_BYTES, MESSAGES_LIMIT, Record, records_in
from flowrec.store.mcap_reader import McapReader

# Chunks that are decompressed before they are asked for. Their number grows while they are read, so that a caller who
# needs only the first messages fetches little.
_AHEAD_BYTES, _AHEAD_CHUNKS, AHEAD_AT_FIRST = 32 << 20, 48, 4
_ANNOUNCED_BYTES = 16 << 20  # at a time, of what is wanted as a whole
_THREADS = 2
_THREAD_NAME = "session-reader"
_FEW = 64  # messages of a chunk that may wait as objects

Decode = Callable[[Record], Record]
_ChunkContent = bytes | memoryview | list[Record]
by_time, _place = attrgetter("log_ns"), attrgetter("chunk_start_offset")
in_time = attrgetter("message_start_time", "chunk_start_offset")


@contextlib.contextmanager
def threads() -> Iterator[Executor]:
    """The threads that decompress; where a reading is abandoned, the tasks that have not begun are cancelled."""
    executor = ThreadPoolExecutor(_THREADS, _THREAD_NAME)
    try:
        yield executor
    except BaseException:
        # The garbage collector may end an abandoned reading in any thread, in the middle of anything: in one of these
        # threads, or while a thread starts and holds the lock without which no other one can be joined.
        executor.shutdown(wait=False, cancel_futures=True)
        raise
    executor.shutdown()


def merge_chunks(
    source: McapReader,
    chunks: Iterable[ChunkIndex],
    executor: Executor,
    decode: Decode | None = None,
    *,
    whole: bool = False,
) -> Iterator[Record]:
    """The messages of chunks in order of time; those of equal time stay in file order.

    flowrec's own chunks of a group follow each other in time. Where other programs have rewritten a file, chunks that
    overlap are read together and sorted. Raises SessionError: a chunk is damaged, or more chunks overlap than fit into
    memory.

    Parameters
    ----------
    decode : what can be done with each record in the threads, where a chunk contains few and large ones: images. It
        returns the record with a message of at most twice its size as payload, or as it was.
    whole : all chunks are wanted, so that they may be announced many at a time.
    """
    waiting = deque(_overlapping(source, sorted(chunks, key=in_time)))
    running: deque[tuple[list[ChunkIndex], Future[list[_ChunkContent]]]] = deque()
    ahead_bytes, ahead = 0, AHEAD_AT_FIRST
    announced = _Announced(source, tuple(waiting), whole)
    while waiting or running:
        begun: list[list[ChunkIndex]] = []
        while waiting and len(running) + len(begun) < ahead:
            nbytes = _size(waiting[0])
            if ahead_bytes and ahead_bytes + nbytes > _AHEAD_BYTES:
                break  # a bundle that is larger than all that may be ahead comes alone
            begun.append(waiting.popleft())
            ahead_bytes += nbytes
        announced.begin(len(begun))
        running.extend((bundle, executor.submit(_contents, source, bundle, decode)) for bundle in begun)
        ahead = min(ahead + 1, _AHEAD_CHUNKS)
        bundle, future = running.popleft()
        # A small message as an object takes more memory than as bytes: they are made for one bundle at a time.
        records = _sorted_messages(source, bundle, future.result())
        del future
        yield from records
        del records
        ahead_bytes -= _size(bundle)


class _Announced:
    """Announces bundles of chunks before they begin, in batches: few at first, more as they are read."""

    def __init__(self, source: McapReader, bundles: Sequence[list[ChunkIndex]], whole: bool) -> None:
        self._source, self._bundles, self._whole = source, bundles, whole
        self._end = self._begun = 0
        self._count = AHEAD_AT_FIRST

    def begin(self, count: int) -> None:
        """So many more begin, long before they are read; the next batch is announced where the last one ends."""
        self._begun += count
        while self._end < min(self._begun, len(self._bundles)):
            batch: list[ChunkIndex] = []
            nbytes = 0
            for bundle in self._bundles[self._end : None if self._whole else self._end + self._count]:
                batch += bundle
                nbytes += sum(chunk.chunk_length for chunk in bundle)
                self._end += 1
                if nbytes > _ANNOUNCED_BYTES:
                    break
            self._source.prefetch(batch)
            self._count = min(max(self._count, self._end // 4), _AHEAD_CHUNKS)


def _overlapping(source: McapReader, chunks: list[ChunkIndex]) -> Iterator[list[ChunkIndex]]:
    """Bundles of chunks whose times overlap, each in file order."""
    bundle: list[ChunkIndex] = []
    nbytes = end_ns = 0
    for chunk in chunks:
        if bundle and chunk.message_start_time > end_ns:
            yield sorted(bundle, key=_place)
            bundle, nbytes = [], 0
        end_ns = max(end_ns, chunk.message_end_time) if bundle else chunk.message_end_time
        bundle.append(chunk)
        nbytes += chunk.uncompressed_size  # checked before the chunk is decompressed, or at least before it is used
        if nbytes > CHUNK_LIMIT_BYTES and len(bundle) > 1:
            raise source.damage_error(chunk.chunk_start_offset, "too many chunks claim the same time")
    if bundle:
        yield sorted(bundle, key=_place)


def _size(bundle: list[ChunkIndex]) -> int:
    return sum(chunk.uncompressed_size for chunk in bundle)


def _contents(source: McapReader, bundle: list[ChunkIndex], decode: Decode | None) -> list[_ChunkContent]:
    """Content of each chunk, or its messages decoded."""
    found: list[_ChunkContent] = []
    for chunk in bundle:
        content = source.chunk(chunk)
        if decode is not None:
            with source.parsing(chunk.chunk_start_offset):
                few = len(list(itertools.islice(records_in(content), _FEW))) < _FEW
            if few:
                found.append([decode(record) for record in source.messages_in(content, chunk.chunk_start_offset)])
                continue
        found.append(content)
    return found


def _sorted_messages(source: McapReader, bundle: list[ChunkIndex], contents: list[_ChunkContent]) -> Iterator[Record]:
    records: list[Record] = []
    for place, content in zip(map(_place, bundle), contents, strict=True):
        records += content if isinstance(content, list) else source.messages_in(content, place)
        if len(records) > MESSAGES_LIMIT:
            raise source.damage_error(place, "too many messages claim the same time")
    records.sort(key=by_time)
    # What comes later is merged by the times of the index; they are not to be trusted either.
    first_ns = min(chunk.message_start_time for chunk in bundle)
    last_ns = max(chunk.message_end_time for chunk in bundle)
    if records and not first_ns <= records[0].log_ns <= records[-1].log_ns <= last_ns:
        raise source.damage_error(_place(bundle[0]), "there are messages of other times than the index tells")
    return iter(records)
