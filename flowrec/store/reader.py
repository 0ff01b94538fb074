"""Session file -> ticks."""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.records import ChunkIndex

from flowrec.errors import SessionError
from flowrec.messages import Message, Tick
from flowrec.store.codec import decode
from flowrec.store.contents import Contents
from flowrec.store.header import SessionHeader
from flowrec.store.lane import by_time, lane, threads
from flowrec.store.shapes import misfit
from flowrec.store.source import DamageError, Record
from flowrec.topics import BY_FIELD
from flowrec.units import seconds

_KEPT_MESSAGES = 64  # of restored states


class SessionReader:
    """A finished session, open for reading; several iterations may run at a time.

    Parameters
    ----------
    path : the session file.
    contents : its index, where the file has none or a wrong one (recovery.py).
    pass_over : told what is wrong with a message that makes no sense, which is then left out; without it that is
        an error.

    Attributes
    ----------
    path : the session file.
    outcome : how the run ended: `outcome`, `reason`, `ticks`, `dropped_frames`, ...; all text, may be empty.
    counts : number of messages by field of Tick, for the topics that have any.
    first_ns, last_ns : stamps of the first and the last tick; both 0 in an empty session.
    flowrec_version : of the program that wrote it.
    region : which part of most images was kept, the rest being black (region.py); None: they are whole.

    Raises
    ------
    SessionError : there is no such file, or it is no session that this flowrec can read; on reading, damage.
    """

    def __init__(
        self, path: Path | str, contents: Contents | None = None, pass_over: Callable[[str], None] | None = None
    ) -> None:
        self.path = Path(path)
        self._pass_over = pass_over
        self._contents = contents if contents is not None else Contents(self.path)
        self._source = self._contents.source
        self._fields = self._contents.fields
        self.outcome = self._contents.outcome
        self.flowrec_version = self._contents.flowrec_version
        self.region = self._contents.region
        statistics = self._contents.statistics
        self.first_ns: int = statistics.message_start_time
        self.last_ns: int = statistics.message_end_time
        counts: Counter[str] = Counter()
        for channel, count in statistics.channel_message_counts.items():
            if channel in self._fields and count:
                counts[self._fields[channel]] += count
        self.counts: dict[str, int] = dict(counts)
        self._kept: dict[tuple[int, int], Message] = {}  # oldest use first
        self._frame_channels = {channel for channel, field in self._fields.items() if field == "frame"}

    @property
    def header(self) -> SessionHeader:
        """Configuration, chip, provenance and weights, as they were written first into the file."""
        return self._contents.header

    @property
    def duration_s(self) -> float:
        """From the first tick to the last, in s."""
        return seconds(self.last_ns - self.first_ns)

    def ticks(self, start_ns: int | None = None, *, with_frames: bool = True) -> Iterator[Tick]:
        """All ticks, or those at and after `start_ns`, each with everything known by then.

        A message is new in a tick if it is another object than in the tick before. Where the recording had to
        drop an image, the tick still holds the previous one, so its frame is not new.

        Parameters
        ----------
        start_ns : the state before it is restored from the few chunks that hold it, so that starting late in a
            session gives exactly the tail of all ticks.
        with_frames : without, no image is read and `frame` is None; ticks in which nothing but a frame
            was new are left out.
        """
        tick = Tick() if start_ns is None else self._state_at(start_ns - 1, with_frames=with_frames)
        for stamp_ns, records in itertools.groupby(self._records(start_ns, with_frames), key=by_time):
            news: dict[str, Any] = {}
            for record in records:
                message = self._message(record)
                if message is not None:
                    news[self._fields[record.channel]] = message
            if news:
                tick = replace(tick, stamp_ns=stamp_ns, **news)
                yield tick

    def tick_before(self, stamp_ns: int, *, with_frames: bool = True) -> Tick:
        """The tick at or before a stamp; an empty `Tick()` before the first one.

        `tick_before(start_ns - 1)` holds the same objects as what `ticks(start_ns)` goes on from, so that a
        message of its first tick is new if and only if it is another object.
        """
        return self._state_at(stamp_ns, with_frames=with_frames)

    def messages(self, field: str) -> Iterator[Any]:
        """All messages of one topic, named by its field of Tick.

        Raises
        ------
        SessionError : no such field, or damage in the file.
        """
        if field not in BY_FIELD:
            raise SessionError(f"{self.path}: there is no topic {field!r}; the topics are {', '.join(BY_FIELD)}")
        channels = {channel for channel, name in self._fields.items() if name == field}
        with threads() as executor:
            for record in lane(self._source, self._chunks_with(channels), executor):
                if record.channel in channels:
                    message = self._message(record)
                    if message is not None:
                        yield message

    def close(self) -> None:
        """Close the file; forgotten readers close it when they are collected."""
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _message(self, record: Record) -> Message | None:
        field = self._fields[record.channel]
        try:
            schema = self._contents.schemas[record.channel]
            message = decode(BY_FIELD[field].type, record.payload, record.sequence, schema)
            wrong = misfit(message)
        except SessionError as error:
            wrong = str(error)
        if not wrong:
            return message
        wrong = f"{BY_FIELD[field].path} at {record.log_ns} ns: {wrong}"
        if self._pass_over is None:
            raise DamageError(self.path, wrong)
        self._pass_over(wrong)
        return None

    def _restored(self, record: Record) -> Message | None:
        # `tick_before(t - 1)` and what `ticks(t)` starts from are compared by identity, so they share their messages.
        key = (record.channel, record.log_ns)
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
                lanes.append(lane(self._source, frames, executor))
            for record in heapq.merge(*lanes, key=by_time):
                if record.log_ns >= start and record.channel in wanted:
                    read[record.channel] += 1
                    yield record
        if start_ns is None:
            self._compare(read)

    def _compare(self, read: Mapping[int, int]) -> None:
        """A file that has less in it than it says must not pass for a whole one."""
        for channel, count in read.items():
            announced = self._contents.statistics.channel_message_counts.get(channel, 0)
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
                (frames if only_frames else state).append(chunk)
        return state, frames

    def _chunks_with(self, channels: set[int]) -> list[ChunkIndex]:
        # A chunk without an index may hold anything.
        return [
            chunk
            for chunk in self._contents.chunks
            if not chunk.message_index_offsets or not channels.isdisjoint(chunk.message_index_offsets)
        ]

    def _state_at(self, stamp_ns: int, *, with_frames: bool) -> Tick:
        """The latest message of each topic at or before a stamp, read from as few chunks as possible."""
        channels = set(self._fields) if with_frames else set(self._fields) - self._frame_channels
        latest: dict[str, Record] = {}
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
                    latest[field_name] = record
        news: dict[str, Any] = {field: self._restored(record) for field, record in latest.items()}
        return Tick(max((record.log_ns for record in latest.values()), default=-1), **news)
