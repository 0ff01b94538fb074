"""The index at the end of a file, parsed within bounds.

mcap's own records take some 20 us each; a session of hours has ten thousands of chunks and must open at once.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, MetadataIndex, Schema, Statistics

_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_PLACE = struct.Struct("<QQQQI")  # first and last time, offset, length, bytes of the map of channels
_CHANNEL_BYTES = 10  # channel number and the offset of its own index, which nobody needs
_LENGTH_AND_NAME = struct.Struct("<QI")
_SIZES = struct.Struct("<QQ")

# Of schemas, channels, metadata and attachments together, each of which takes some 20 us. Ours have 60.
DECLARED_LIMIT = 10_000

_Declared = TypeVar("_Declared", Schema, Channel)


@dataclass(slots=True)
class Summary:
    """What the end of the file says about the rest.

    The `message_index_offsets` of a chunk tell which channels are in it; the offsets themselves are not kept.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None

    def set_back(self, start_ns: int) -> None:
        """Turn the times of the chunks, which are Unix times, into stamps of a session that started at `start_ns`.

        Raises
        ------
        ValueError : one is before the start.
        """
        if not self.chunks or not start_ns:
            return
        assert self.statistics is not None  # summary_from has seen to it, and that its times are those of the chunks
        self.statistics.message_start_time -= start_ns
        self.statistics.message_end_time -= start_ns
        if self.statistics.message_start_time < 0:
            raise ValueError("a chunk begins before the session")
        for chunk in self.chunks:
            chunk.message_start_time -= start_ns
            chunk.message_end_time -= start_ns

    def places(self) -> Iterator[tuple[int, int]]:
        """Offset and length of everything that is listed."""
        for chunk in self.chunks:
            yield chunk.chunk_start_offset, chunk.chunk_length
        for attachment in self.attachments:
            yield attachment.offset, attachment.length
        for metadata in self.metadata:
            yield metadata.offset, metadata.length


def summary_from(data: bytes, data_start: int, data_end: int) -> Summary:
    """The summary in its bytes; what it lists lies between `data_start` and `data_end` of the file.

    Raises
    ------
    ValueError, struct.error, mcap.exceptions.McapError : it is damaged, or contradicts itself or the file.
    """
    summary = Summary()
    interned: dict[tuple[bytes, bytes], dict[int, int]] = {}
    listed_bytes = declared = 0
    for opcode, at, length in records_of(data):
        if opcode == Opcode.CHUNK_INDEX:
            chunk = _chunk_index(data, at, at + length, interned)
            # At once, so that a list of nonsense does not fill the memory first.
            listed_bytes += chunk.chunk_length
            if listed_bytes > data_end or not chunk.chunk_length:
                raise ValueError("the chunks that are listed do not fit into the file")
            summary.chunks.append(chunk)
        else:
            declared += 1
            if declared > DECLARED_LIMIT:
                raise ValueError(f"more than {DECLARED_LIMIT} records besides chunks")
            _take_in(summary, opcode, data[at : at + length])
    _check_places(summary, data_start, data_end)
    _check_counts(summary)
    return summary


def records_of(data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and length of the body of each record.

    Raises
    ------
    ValueError, struct.error : a record that does not end within the data.
    """
    at, end = 0, len(data)
    while at < end:
        opcode, length = _RECORD_HEAD.unpack_from(data, at)
        at += _RECORD_HEAD.size
        if length > end - at:
            raise ValueError(f"a record of {length} bytes where {end - at} are left")
        yield opcode, at, length
        at += length


def stream_of(data: bytes | memoryview) -> ReadDataStream:
    """What mcap's records parse themselves from."""
    return ReadDataStream(io.BytesIO(data))


def declare(known: dict[int, _Declared], record: _Declared) -> None:
    """Enter a schema or channel.

    Raises
    ------
    ValueError : another one has the same number.
    """
    if known.setdefault(record.id, record) != record:
        raise ValueError(f"{type(record).__name__.lower()} {record.id} is declared twice, differently")


def _chunk_index(data: bytes, at: int, end: int, interned: dict[tuple[bytes, bytes], dict[int, int]]) -> ChunkIndex:
    first_ns, last_ns, offset, length, map_bytes = _CHUNK_PLACE.unpack_from(data, at)
    at += _CHUNK_PLACE.size
    rest = at + map_bytes
    if map_bytes % _CHANNEL_BYTES or rest + _LENGTH_AND_NAME.size > end:
        raise ValueError("the index of a chunk is damaged")
    # Most chunks hold the same channels, so they share one table of them.
    key = data[at:rest:_CHANNEL_BYTES], data[at + 1 : rest : _CHANNEL_BYTES]
    channels = interned.get(key)
    if channels is None:
        channels = interned[key] = {low | high << 8: 0 for low, high in zip(*key, strict=True)}
    index_bytes, name_bytes = _LENGTH_AND_NAME.unpack_from(data, rest)
    rest += _LENGTH_AND_NAME.size
    if rest + name_bytes + _SIZES.size != end:
        raise ValueError("the index of a chunk is damaged")
    compressed, size = _SIZES.unpack_from(data, rest + name_bytes)
    if first_ns > last_ns:
        raise ValueError("a chunk ends before it begins")
    return ChunkIndex(
        length, offset, str(data[rest : rest + name_bytes], "utf-8"), compressed, last_ns, index_bytes, channels,
        first_ns, size,
    )  # fmt: skip


def _take_in(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == Opcode.SCHEMA:
        declare(summary.schemas, Schema.read(stream_of(body)))
    elif opcode == Opcode.CHANNEL:
        declare(summary.channels, Channel.read(stream_of(body)))
    elif opcode == Opcode.ATTACHMENT_INDEX:
        summary.attachments.append(AttachmentIndex.read(stream_of(body)))
    elif opcode == Opcode.METADATA_INDEX:
        summary.metadata.append(MetadataIndex.read(stream_of(body)))
    elif opcode == Opcode.STATISTICS:
        summary.statistics = Statistics.read(stream_of(body))


def _check_places(summary: Summary, start: int, end: int) -> None:
    """Each thing at a place of its own: else a small file could be read for ever."""
    reached = start
    for offset, length in sorted(summary.places()):
        if offset < reached:
            raise ValueError(f"what is listed at byte {offset} lies over something else")
        reached = offset + length
    if reached > end:
        raise ValueError(f"what is listed reaches to byte {reached}, the index begins at {end}")


def _check_counts(summary: Summary) -> None:
    counts = summary.statistics
    if counts is None:
        raise ValueError("the index has no statistics")
    pairs = (
        ("chunks", counts.chunk_count, len(summary.chunks)),
        ("channels", counts.channel_count, len(summary.channels)),
        ("attachments", counts.attachment_count, len(summary.attachments)),
        ("metadata records", counts.metadata_count, len(summary.metadata)),
    )
    for what, announced, listed in pairs:
        if announced != listed:
            raise ValueError(f"{announced} {what} are announced, {listed} are listed")
    if summary.chunks:
        first_ns = min(chunk.message_start_time for chunk in summary.chunks)
        last_ns = max(chunk.message_end_time for chunk in summary.chunks)
        if (first_ns, last_ns) != (counts.message_start_time, counts.message_end_time):
            raise ValueError("the times of the statistics are not those of the chunks")
    elif counts.message_count:
        raise ValueError(f"{counts.message_count} messages are announced, and no chunk is listed")
    for channel in summary.channels.values():
        if channel.schema_id not in summary.schemas:
            raise ValueError(f"channel {channel.topic!r} has no schema")
