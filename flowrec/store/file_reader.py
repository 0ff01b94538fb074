"""One session file -> the new messages of each tick, and the state at any time."""

from __future__ import annotations

import bisect
import functools
import heapq
import itertools
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from mcap.records import ChunkIndex

from flowrec.core import Frame, Message, SessionError, pixel_type
from flowrec.store.channels import Row, SessionContents
from flowrec.store.frame_encodings import ENCODINGS, PIXELS_LIMIT
from flowrec.store.mcap_format import DamageError, Record, Summary, lone_count
from flowrec.store.merged_chunks import AHEAD_AT_FIRST, by_time, in_time, merge_chunks, threads
from flowrec.store.write_queue import NewMessages

Cache = dict[tuple[Path, int, int], Message]  # by file, channel and time; oldest use first
_CACHED_MESSAGES = 64  # of restored states
_STATE_LIMIT_BYTES = 176 << 20  # three flow fields on the largest chip, a route to all of it and an image
_LARGE_CHUNK_BYTES = 1 << 22
_GROWTH = 2  # of an image that is decoded ahead; JPEG compresses more and is decoded when its turn comes


class FileReader(SessionContents):
    """A finished file, open for reading; several iterations may run at a time.

    Parameters
    ----------
    cache : restored messages, shared by the files of a run.
    summary : an index to be used instead of the file's own, whose end is not written yet.
    """

    def __init__(self, path: Path, cache: Cache | None = None, summary: Summary | None = None) -> None:
        super().__init__(path, summary)
        self._cache: Cache = cache if cache is not None else {}
        self._frame_channels = self._channels_of({"frame"})
        encoding = ENCODINGS.get(self.frame_encoding)
        self._lossless = encoding is None or encoding.lossless

    def new_messages(
        self, start_ns: int | None, fields: Collection[str], end_ns: int | None = None
    ) -> Iterator[tuple[int, NewMessages]]:
        """Stamp and new messages of some topics of all ticks, or of those from `start_ns` to before `end_ns`."""
        sizes: dict[str, int] = {}
        read = dict.fromkeys(self._channels_of(fields), 0)
        for stamp_ns, records in itertools.groupby(self._read(fields, start_ns or 0, end_ns), key=by_time):
            new: NewMessages = {}
            for record in records:
                field = self.fields[record.channel]
                self._limit_state(sizes, field, record)
                new[field] = self._message(record)
                read[record.channel] += 1
            yield stamp_ns, new
        for channel, count in read.items() if start_ns is None and end_ns is None else ():
            announced = self.statistics.channel_message_counts.get(channel, 0)
            if count != announced:
                path = self.channels[channel].topic
                raise DamageError(self.source.path, f"{announced} messages of {path} are announced, {count} were read")

    def announce(self, start_ns: int, fields: Collection[str], end_ns: int | None = None) -> None:
        """Announce that the state before a time and then the messages from it on are read: one round trip for a URL.

        Announced are all messages before `end_ns`, or only the first ones where `end_ns` is None.
        """
        channels = self._channels_of(fields)
        before = _likely(self._chunks_until(start_ns - 1, channels), channels, start_ns - 1)
        count = AHEAD_AT_FIRST if end_ns is None else None
        from_it = [sorted(chunks, key=in_time)[:count] for chunks in self._chunks_from(start_ns, channels, end_ns)]
        self.source.prefetch(itertools.chain(before, *from_it))

    def messages(self, field: str) -> Iterator[tuple[int, Any]]:
        """All messages of one topic, each with the stamp of its tick."""
        for record in self._read({field}, whole=True):
            yield record.log_ns, self._message(record)

    def rows(self, fields: Collection[str]) -> Iterator[tuple[int, str, Row]]:
        """Stamp of the tick, field of Tick and row of plain values of each message of some topics but the images."""
        decoders = {channel: self.row_decoder(channel) for channel in self._channels_of(fields)}
        for record in self._read(fields, whole=True):
            try:
                row = decoders[record.channel](record)
            except SessionError as error:
                raise self._damage_error(record, error) from error
            yield record.log_ns, self.fields[record.channel], row

    def stamps(self, field: str) -> list[int]:
        """The stamps of the ticks with a message of a topic, in order, from the index of the file where it has one."""
        found: list[int] = []
        for channel in self._channels_of({field}):
            chunks = self._chunks_with({channel})
            self.source.prefetch(chunks, indexes=True)
            for chunk in chunks:
                times = self.source.message_times(chunk, channel)
                if times is None:
                    times = [record.log_ns for record in self.source.messages(chunk) if record.channel == channel]
                found += times
        return sorted(found)

    def frame(self, number: int) -> Frame | None:
        """An image by its number, from its chunk alone; None where the summary does not tell which chunk that is."""
        if self._frame_numbers is None:
            return None
        firsts, chunks = self._frame_numbers
        place = bisect.bisect_right(firsts, number) - 1
        content = self.source.messages(chunks[place])
        records = sorted((each for each in content if each.channel in self._frame_channels), key=by_time)
        count = lone_count(chunks[place])
        if len(records) != count:
            why = f"{count} images are announced, the chunk has {len(records)}"
            raise self.source.damage_error(chunks[place].chunk_start_offset, why)
        return self._restore(records[number - firsts[place]])

    @functools.cached_property
    def _frame_numbers(self) -> tuple[list[int], list[ChunkIndex]] | None:
        """Chunks with images, in order of time, and the number of the first image of each."""
        chunks = sorted(self._chunks_with(self._frame_channels), key=in_time)
        counts = [lone_count(chunk) for chunk in chunks]
        overlap = any(now.message_start_time <= was.message_end_time for was, now in itertools.pairwise(chunks))
        if overlap or None in counts:
            return None
        *firsts, total = itertools.accumulate((count or 0 for count in counts), initial=0)
        announced = sum(self.statistics.channel_message_counts.get(channel, 0) for channel in self._frame_channels)
        return (firsts, chunks) if total == announced else None

    def state_at(self, stamp_ns: int, fields: Collection[str]) -> tuple[int, NewMessages]:
        """The latest message of each of these topics at or before a stamp, from as few chunks as possible.

        With the stamp of the tick that held the latest of them, -1 without any. The same message is the same object,
        however often it is asked for.
        """
        latest = self._latest(stamp_ns, self._channels_of(fields))
        state = {field: self._restore(record) for field, record in latest.items()}
        return max((record.log_ns for record in latest.values()), default=-1), state

    def _limit_state(self, sizes: dict[str, int], field: str, record: Record) -> None:
        """Note the size of the latest message of a topic; DamageError if the state at a tick has become too large.

        The limit bounds the memory that a hostile file can take.
        """
        payload = record.payload
        sizes[field] = payload.image.nbytes if isinstance(payload, Frame) else len(payload)
        if (total := sum(sizes.values())) > _STATE_LIMIT_BYTES:
            what = f"the state at {record.log_ns} ns takes {total} bytes, more than {_STATE_LIMIT_BYTES}"
            raise DamageError(self.source.path, what)

    def _message(self, record: Record) -> Any:
        if isinstance(record.payload, Message):
            return record.payload
        try:
            return self.decode(record)
        except SessionError as error:
            raise self._damage_error(record, error) from error

    def _damage_error(self, record: Record, error: SessionError) -> DamageError:
        path = self.channels[record.channel].topic
        return DamageError(self.source.path, f"{path} at {record.log_ns} ns: {error}")

    def _decoded_frame(self, record: Record) -> Record:
        """An image decoded, in a thread; where that fails, the error is raised when its turn comes."""
        if record.channel not in self._frame_channels or isinstance(record.payload, Message) or not self._lossless:
            return record
        try:
            frame = self.decode(record)
        except SessionError:
            return record
        return record._replace(payload=frame) if frame.image.nbytes <= _GROWTH * len(record.payload) else record

    def _restore(self, record: Record) -> Any:
        # `tick_before(t - 1)` and what `ticks(t)` starts from are compared by identity, so they share their messages.
        key = (self.source.path, record.channel, record.log_ns)
        self._cache[key] = message = self._cache.pop(key, None) or self._message(record)
        if len(self._cache) > _CACHED_MESSAGES:
            del self._cache[next(iter(self._cache))]
        return message

    def _read(
        self, fields: Collection[str], start_ns: int = 0, end_ns: int | None = None, *, whole: bool = False
    ) -> Iterator[Record]:
        """The messages of some topics from a time to before another, state and frames merged; `whole`: all of them."""
        wanted = self._channels_of(fields)
        state, frames = self._chunks_from(start_ns, wanted, end_ns)
        with threads() as executor:
            merged = (
                merge_chunks(self.source, state, executor, whole=whole),
                merge_chunks(self.source, frames, executor, self._decoded_frame),
            )
            for record in heapq.merge(*merged, key=by_time):
                if end_ns is not None and record.log_ns >= end_ns:
                    return
                if record.log_ns >= start_ns and record.channel in wanted:
                    yield record

    def _chunks_from(
        self, start_ns: int, channels: set[int], end_ns: int | None = None
    ) -> tuple[list[ChunkIndex], list[ChunkIndex]]:
        """Chunks of channels with messages from a time to before another: of anything but frames, of frames only."""
        state: list[ChunkIndex] = []
        frames: list[ChunkIndex] = []
        largest_bytes = PIXELS_LIMIT * pixel_type(self.frame_bits).itemsize + _LARGE_CHUNK_BYTES
        for chunk in self._chunks_with(channels):
            if chunk.message_end_time >= start_ns and (end_ns is None or chunk.message_start_time < end_ns):
                only_frames = chunk.message_index_offsets and set(chunk.message_index_offsets) <= self._frame_channels
                if only_frames and chunk.uncompressed_size > largest_bytes:
                    raise self.source.damage_error(chunk.chunk_start_offset, "images of more pixels than flowrec reads")
                (frames if only_frames else state).append(chunk)
        return state, frames

    def _chunks_until(self, stamp_ns: int, channels: set[int]) -> list[ChunkIndex]:
        """Chunks of channels that begin at or before a time, the one that ends last first."""
        chunks = [chunk for chunk in self._chunks_with(channels) if chunk.message_start_time <= stamp_ns]
        return sorted(chunks, key=lambda chunk: chunk.message_end_time, reverse=True)

    def _chunks_with(self, channels: set[int]) -> list[ChunkIndex]:
        # A chunk without an index may contain anything.
        return [
            chunk
            for chunk in self.chunks
            if not chunk.message_index_offsets or not channels.isdisjoint(chunk.message_index_offsets)
        ]

    def _channels_of(self, fields: Collection[str]) -> set[int]:
        return {channel for channel, field in self.fields.items() if field in fields}

    def _latest(self, stamp_ns: int, channels: set[int]) -> dict[str, Record]:
        latest: dict[str, Record] = {}
        sizes: dict[str, int] = {}
        chunks = self._chunks_until(stamp_ns, channels)
        self.source.prefetch(_likely(chunks, channels, stamp_ns))
        for chunk in chunks:
            end_ns = min(chunk.message_end_time, stamp_ns)
            found = channels & set(chunk.message_index_offsets) if chunk.message_index_offsets else channels
            fields = {self.fields[channel] for channel in found}
            if all(field in latest and latest[field].log_ns >= end_ns for field in fields):
                continue
            for record in self.source.messages(chunk):
                field_name = self.fields.get(record.channel)
                if field_name not in fields or field_name is None or record.log_ns > stamp_ns:
                    continue
                if field_name not in latest or latest[field_name].log_ns <= record.log_ns:
                    self._limit_state(sizes, field_name, record)
                    latest[field_name] = record
            if chunk.uncompressed_size > _LARGE_CHUNK_BYTES:  # it is not kept in memory for a few messages in it
                for name, record in latest.items():
                    latest[name] = record._replace(payload=memoryview(bytes(record.payload)))
        return latest


def _likely(chunks: list[ChunkIndex], channels: set[int], stamp_ns: int) -> list[ChunkIndex]:
    """Chunks, the latest first, that probably hold the latest message of each channel at a stamp."""
    likely: list[ChunkIndex] = []
    missing = set(channels)
    for chunk in chunks:
        found = missing & set(chunk.message_index_offsets)
        if found:
            likely.append(chunk)
        if chunk.message_end_time <= stamp_ns:  # else its messages may all be later
            missing -= found
        if not missing:
            break
    return likely
