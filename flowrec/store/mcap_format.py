"""The MCAP format: magic, record layouts, limits and errors of reading, and the summary of a file.

mcap's own records take some 20 us each to parse; a session of hours has ten thousands of chunks and must open at once.
Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import functools
import io
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics

from flowrec.core import SessionError, shell_word

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of the body
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, size and checksum of the content, length of the name
ATTACHMENT_HEAD = struct.Struct("<QQI")  # log and create time, length of the name
LONG, CRC = struct.Struct("<Q"), struct.Struct("<I")
FOOTER_BYTES = RECORD_HEAD.size + 20
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")  # first and last time, offset, length, bytes of the map of channels
_CHANNEL_BYTES = 10  # channel number and the offset of its own index, which is not read
_INDEX_HEAD_BYTES, _INDEX_ENTRY_BYTES = RECORD_HEAD.size + 6, 16  # of a MessageIndex record: time and place a message
_LENGTH_AND_NAME = struct.Struct("<QI")
_SIZES = struct.Struct("<QQ")

# Size of one chunk before compression: a flow field on 1900 x 1900 pixels. Reading needs at most what a tick knows,
# such a chunk on its way into the next tick, and an image on its way: with the program itself less than 512 MB.
CHUNK_LIMIT_BYTES = 72 << 20
MESSAGES_LIMIT = 1 << 17  # held as objects at a time, some 400 bytes each
# Of schemas, channels, metadata and attachments together, each of which takes some 20 us. flowrec writes 60.
DECLARED_LIMIT = 10_000
_DECLARATIONS_KEPT = 1024  # in memory: most sessions of a folder have the same ones


# What the libraries raise on damaged bytes, as found by reading thousands of mutated files.
DAMAGE = (
    McapError,
    DecodeError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    OverflowError,
    MemoryError,
)


class ForeignError(SessionError):
    """A file that flowrec has not written, MCAP or not."""


class UnfinishedError(SessionError):
    """The end of the file is missing: the run was killed, is still going on, or the file is cut off."""


class DamageError(SessionError):
    """Bytes that can not be parsed; `what` says where and why, without advice."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}; `flowrec recover {shell_word(path)}` recovers what is intact")
        self.what = what


class Record(NamedTuple):
    """One message as it is in a chunk, `log_ns` on the session clock."""

    log_ns: int
    channel: int
    sequence: int
    payload: Any  # a memoryview, or a message where it has been decoded already


class ChannelIndex(NamedTuple):
    """The messages of one channel in a chunk: number, the sum of their digests and their MessageIndex record."""

    channel: int
    messages: int
    digest: int
    record: bytes


@dataclass(frozen=True, slots=True)
class SealedChunk:
    """The content of one chunk record, as `mcap.records.Chunk`, and the indexes that follow it.

    `data` may be a view of the builder's memory: write or detach it before that is used again.
    """

    compression: str
    data: bytes | memoryview
    message_start_time: int
    message_end_time: int
    uncompressed_crc: int
    uncompressed_size: int
    indexes: list[ChannelIndex]


@dataclass(slots=True)
class Summary:
    """The summary section of a file.

    The `message_index_offsets` of a chunk tell which channels are in it; the offsets themselves are not kept.
    `file_bytes`: size of the file that it was read from, 0 for one that still grows.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None
    file_bytes: int = 0

    def enter(self, record: Schema | Channel | Metadata | Attachment, offset: int, length: int) -> None:
        """Enter a record outside the chunks, which stands at a place in the file.

        Raises ValueError: another schema or channel has the same number.
        """
        if isinstance(record, Metadata):
            self.metadata.append(MetadataIndex(offset, length, record.name))
        elif isinstance(record, Attachment):
            times, size = (record.log_time, record.create_time), len(record.data)
            self.attachments.append(AttachmentIndex(offset, length, *times, size, record.name, record.media_type))
        else:
            self.declare((record,))

    def declare(self, records: Iterable[Schema | Channel]) -> None:
        """Enter schemas and channels. Raises ValueError: two that differ have the same number."""
        for record in records:
            known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
            if known.setdefault(record.id, record) != record:
                raise ValueError(f"{type(record).__name__.lower()} {record.id} is declared twice, differently")

    def count(self, counts: Mapping[int, int], chunks: int, first_ns: int, last_ns: int) -> None:
        """Set the statistics: messages by channel, number of chunks and their times."""
        self.statistics = Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(counts),
            chunk_count=chunks,
            message_count=sum(counts.values()),
            message_end_time=last_ns,
            message_start_time=first_ns,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

    def to_session_clock(self, start_unix_ns: int) -> None:
        """Turn the Unix times of the chunks into stamps of a session that started at `start_unix_ns`.

        Raises ValueError: a chunk is before the start.
        """
        if not self.chunks or not start_unix_ns:
            return
        assert self.statistics is not None  # parse_summary has checked that, and that its times are those of the chunks
        self.statistics.message_start_time -= start_unix_ns
        self.statistics.message_end_time -= start_unix_ns
        if self.statistics.message_start_time < 0:
            raise ValueError("a chunk begins before the session")
        for chunk in self.chunks:
            chunk.message_start_time -= start_unix_ns
            chunk.message_end_time -= start_unix_ns


def parse_summary(data: bytes, data_end: int, chunks: Sequence[ChunkIndex] = ()) -> Summary:
    """The summary from its bytes, and chunks that these do not list; what it lists lies before `data_end` in the file.

    Raises
    ------
    ValueError, struct.error, mcap.exceptions.McapError : it is damaged, or contradicts itself or the file.
    """
    summary = Summary(chunks=list(chunks))
    interned: dict[tuple[bytes, bytes], dict[int, int]] = {}
    declarations: list[Schema | Channel] = []
    listed_bytes = declared = 0
    for opcode, at, length in records_in(data):
        if opcode == Opcode.CHUNK_INDEX:
            chunk = _chunk_index(data, at, at + length, interned)
            # Checked here, so that an invalid list does not fill the memory first.
            listed_bytes += chunk.chunk_length
            if listed_bytes > data_end or not chunk.chunk_length:
                raise ValueError("the chunks that are listed do not fit into the file")
            summary.chunks.append(chunk)
            continue
        declared += 1
        if declared > DECLARED_LIMIT:
            raise ValueError(f"more than {DECLARED_LIMIT} records besides chunks")
        body = data[at : at + length]
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declarations.append(_declaration(opcode, body))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            summary.attachments.append(AttachmentIndex.read(stream_of(body)))
        elif opcode == Opcode.METADATA_INDEX:
            summary.metadata.append(MetadataIndex.read(stream_of(body)))
        elif opcode == Opcode.STATISTICS:
            summary.statistics = Statistics.read(stream_of(body))
    summary.declare(declarations)
    _check_places(summary, data_end)
    _check_counts(summary)
    return summary


@functools.lru_cache(_DECLARATIONS_KEPT)
def _declaration(opcode: int, body: bytes) -> Schema | Channel:
    """A schema or channel; nobody changes it, and most sessions of a folder declare the same ones."""
    return (Schema if opcode == Opcode.SCHEMA else Channel).read(stream_of(body))


def lone_count(chunk: ChunkIndex) -> int | None:
    """Number of messages of a chunk of one channel, from the size of its index; None of others, or without an index."""
    count, rest = divmod(chunk.message_index_length - _INDEX_HEAD_BYTES, _INDEX_ENTRY_BYTES)
    return count if len(chunk.message_index_offsets) == 1 and not rest and count >= 0 else None


def records_in(data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and length of the body of each record.

    Raises
    ------
    ValueError, struct.error : a record that does not end within the data.
    """
    at, end = 0, len(data)
    while at < end:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        at += RECORD_HEAD.size
        if length > end - at:
            raise ValueError(f"a record of {length} bytes where {end - at} are left")
        yield opcode, at, length
        at += length


def stream_of(data: bytes | memoryview) -> ReadDataStream:
    """Stream from which mcap's records parse themselves."""
    return ReadDataStream(io.BytesIO(data))


def _chunk_index(data: bytes, at: int, end: int, interned: dict[tuple[bytes, bytes], dict[int, int]]) -> ChunkIndex:
    first_ns, last_ns, offset, length, map_bytes = _CHUNK_INDEX_HEAD.unpack_from(data, at)
    at += _CHUNK_INDEX_HEAD.size
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


def _check_places(summary: Summary, end: int) -> None:
    """Raise ValueError if two listed records overlap: with overlaps a small file could list endless data."""
    indexes: list[AttachmentIndex | MetadataIndex] = [*summary.attachments, *summary.metadata]
    places = [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in summary.chunks]
    places += [(index.offset, index.length) for index in indexes]
    reached = len(MAGIC)
    for offset, length in sorted(places):
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
