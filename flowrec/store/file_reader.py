"""One session file -> what is new in each of its ticks; reader.py makes ticks of it."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.records import ChunkIndex

from flowrec.declarations import Message, shape_error
from flowrec.errors import SessionError
from flowrec.messages import Frame
from flowrec.store.chunk_stream import by_time, lane, threads
from flowrec.store.codec import decode
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.image_codec import PIXELS_LIMIT
from flowrec.store.mcap_reader import DamageError, Record
from flowrec.store.schema_check import Contents
from flowrec.topics import BY_FIELD

Kept = dict[tuple[Path, int, int], Message]  # by file, channel and time; oldest use first
News = dict[str, Any]  # messages by field of Tick
_KEPT_MESSAGES = 64  # of restored states
_KNOWN_LIMIT_BYTES = 176 << 20  # three flow fields on the largest chip, a route to all of it and an image
_LARGE_CHUNK_BYTES = 1 << 22
_GROWTH = 2  # of an image that is decoded ahead; JPEG packs more and is decoded when its turn comes


class _Known:
    """How much all that is known in a tick takes: bounded, whatever a file says."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._nbytes: dict[str, int] = {}
        self._total = 0

    def add(self, field: str, record: Record) -> None:
        """Take note of the latest message of a topic."""
        payload = record.payload
        nbytes = payload.image.nbytes if isinstance(payload, Frame) else len(payload)  # type: ignore[arg-type]
        self._total += nbytes - self._nbytes.get(field, 0)
        self._nbytes[field] = nbytes
        if self._total > _KNOWN_LIMIT_BYTES:
            what = f"all that is known at {record.log_ns} ns takes {self._total} bytes, more than {_KNOWN_LIMIT_BYTES}"
            raise DamageError(self._path, what)


def _detached(record: Record) -> Record:
    """The record without the chunk that it lies in."""
    payload = record.payload
    return record._replace(payload=memoryview(bytes(payload))) if isinstance(payload, memoryview) else record


class FileReader:
    """A finished file, open for reading; several iterations may run at a time.

    Parameters
    ----------
    path : the file.
    contents : its index, where the file has none or a wrong one (recovery.py).
    pass_over : told what is wrong with a message that makes no sense, which is then left out; without it that is
        an error.
    kept : restored messages, shared by the files of a run.

    Attributes
    ----------
    path : the file.
    contents : its index.

    Raises
    ------
    SessionError : there is no such file, or it is no session that this flowrec can read; on reading, damage.
    """

    def __init__(
        self,
        path: Path,
        contents: Contents | None = None,
        pass_over: Callable[[str], None] | None = None,
        kept: Kept | None = None,
    ) -> None:
        self.path = path
        self._pass_over = pass_over
        self.contents = contents if contents is not None else Contents(path)
        self._source = self.contents.source
        self._fields = self.contents.fields
        self._kept: Kept = kept if kept is not None else {}
        self._frame_channels = self._channels_of({"frame"})
        encoding = ENCODINGS.get(self.contents.frame_encoding)
        self._lossless = encoding is None or encoding.lossless

    def news(self, start_ns: int | None, *, with_frames: bool) -> Iterator[tuple[int, News]]:
        """Stamp and new messages of all ticks, or of those at and after `start_ns`."""
        known = _Known(self.path)
        for stamp_ns, records in itertools.groupby(self._records(start_ns, with_frames), key=by_time):
            news: News = {}
            for record in records:
                field = self._fields[record.channel]
                known.add(field, record)
                message = self._message(record)
                if message is not None:
                    news[field] = message
            if news:
                yield stamp_ns, news

    def messages(self, field: str) -> Iterator[tuple[int, Any]]:
        """All messages of one topic, each with the stamp of its tick."""
        channels = self._channels_of({field})
        with threads() as executor:
            for record in lane(self._source, self._chunks_with(channels), executor, self._ready):
                if record.channel in channels:
                    message = self._message(record)
                    if message is not None:
                        yield record.log_ns, message

    def state_at(self, stamp_ns: int, fields: Collection[str]) -> tuple[int, News]:
        """The latest message of each of these topics at or before a stamp, from as few chunks as possible.

        With the stamp of the tick that held the latest of them, -1 without any. The same message is the same object,
        however often it is asked for.
        """
        latest = self._latest(stamp_ns, self._channels_of(fields))
        news = {field: message for field, record in latest.items() if (message := self._restored(record)) is not None}
        return max((record.log_ns for record in latest.values()), default=-1), news

    def close(self) -> None:
        """Close the file; forgotten readers close it when they are collected."""
        self._source.close()

    def _message(self, record: Record) -> Message | None:
        if isinstance(record.payload, Message):
            return record.payload
        field = self._fields[record.channel]
        try:
            schema = self.contents.schemas[record.channel]
            message = decode(BY_FIELD[field].type, record.payload, record.sequence, schema, self._source.start_unix_ns)
            wrong = shape_error(message)
        except SessionError as error:
            wrong = str(error)
        if not wrong:
            return message
        wrong = f"{BY_FIELD[field].path} at {record.log_ns} ns: {wrong}"
        if self._pass_over is None:
            raise DamageError(self.path, wrong)
        self._pass_over(wrong)
        return None

    def _ready(self, record: Record) -> Record:
        """An image decoded, in a thread; where that fails, what is wrong is told when its turn comes."""
        if record.channel not in self._frame_channels or isinstance(record.payload, Message) or not self._lossless:
            return record
        try:
            schema = self.contents.schemas[record.channel]
            frame = decode(Frame, record.payload, record.sequence, schema, self._source.start_unix_ns)
        except SessionError:
            return record
        sound = not shape_error(frame) and frame.image.nbytes <= _GROWTH * len(record.payload)
        return record._replace(payload=frame) if sound else record

    def _restored(self, record: Record) -> Message | None:
        # `tick_before(t - 1)` and what `ticks(t)` starts from are compared by identity, so they share their messages.
        key = (self.path, record.channel, record.log_ns)
        message = self._kept.pop(key, None) or self._message(record)
        if message is None:
            return None
        self._kept[key] = message
        if len(self._kept) > _KEPT_MESSAGES:
            del self._kept[next(iter(self._kept))]
        return message

    def _records(self, start_ns: int | None, with_frames: bool) -> Iterator[Record]:
        """The messages of known topics from a time on, state and frames merged."""
        start = 0 if start_ns is None else start_ns
        state, frames = self._lanes(start)
        wanted = set(self._fields) if with_frames else set(self._fields) - self._frame_channels
        read = dict.fromkeys(wanted, 0)
        with threads() as executor:
            lanes = [lane(self._source, state, executor)]
            if with_frames:
                lanes.append(lane(self._source, frames, executor, self._ready))
            for record in heapq.merge(*lanes, key=by_time):
                if record.log_ns >= start and record.channel in wanted:
                    read[record.channel] += 1
                    yield record
        if start_ns is None:
            self._compare(read)

    def _compare(self, read: Mapping[int, int]) -> None:
        """A file that has less in it than it says must not pass for a whole one."""
        for channel, count in read.items():
            announced = self.contents.statistics.channel_message_counts.get(channel, 0)
            if count != announced:
                path = BY_FIELD[self._fields[channel]].path
                raise DamageError(self.path, f"{announced} messages of {path} are announced, {count} were read")

    def _lanes(self, start_ns: int) -> tuple[list[ChunkIndex], list[ChunkIndex]]:
        """Chunks that reach beyond a time: those with anything but frames, and those with frames only."""
        state: list[ChunkIndex] = []
        frames: list[ChunkIndex] = []
        for chunk in self._chunks_with(set(self._fields)):
            if chunk.message_end_time >= start_ns:
                only_frames = chunk.message_index_offsets and set(chunk.message_index_offsets) <= self._frame_channels
                if only_frames and chunk.uncompressed_size > PIXELS_LIMIT + _LARGE_CHUNK_BYTES:
                    raise self._source.damaged(chunk.chunk_start_offset, "images of more pixels than flowrec reads")
                (frames if only_frames else state).append(chunk)
        return state, frames

    def _chunks_with(self, channels: set[int]) -> list[ChunkIndex]:
        # A chunk without an index may hold anything.
        return [
            chunk
            for chunk in self.contents.chunks
            if not chunk.message_index_offsets or not channels.isdisjoint(chunk.message_index_offsets)
        ]

    def _channels_of(self, fields: Collection[str]) -> set[int]:
        return {channel for channel, field in self._fields.items() if field in fields}

    def _latest(self, stamp_ns: int, channels: set[int]) -> dict[str, Record]:
        latest: dict[str, Record] = {}
        known = _Known(self.path)
        for chunk in sorted(self._chunks_with(channels), key=lambda chunk: chunk.message_end_time, reverse=True):
            if chunk.message_start_time > stamp_ns:
                continue
            reach_ns = min(chunk.message_end_time, stamp_ns)
            held = channels & set(chunk.message_index_offsets) if chunk.message_index_offsets else channels
            fields = {self._fields[channel] for channel in held}
            if all(field in latest and latest[field].log_ns >= reach_ns for field in fields):
                continue
            for record in self._source.messages(chunk):
                field_name = self._fields.get(record.channel)
                if field_name not in fields or field_name is None or record.log_ns > stamp_ns:
                    continue
                if field_name not in latest or latest[field_name].log_ns <= record.log_ns:
                    known.add(field_name, record)
                    latest[field_name] = record
            if chunk.uncompressed_size > _LARGE_CHUNK_BYTES:  # which is not kept for the sake of a few messages in it
                latest = {field: _detached(record) for field, record in latest.items()}
        return latest
