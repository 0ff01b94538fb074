"""An MCAP file open for reading: checked, bounded reads; the only place that trusts nothing in the file.

mcap's own reader believes the sizes that a file declares (a file of 32 kB can then cost 1 GiB and minutes) and lets
errors of several libraries escape. Here every size is checked before it is used and every error is a SessionError.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import weakref
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from flowrec.errors import SessionError
from flowrec.store.mcap_file import MAGIC

CHUNK_LIMIT_BYTES = 1 << 30  # of one chunk before compression
_HEADER_LIMIT_BYTES = 1 << 16
_RECORDS_PER_CHUNK = 1 << 20
RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_FOOTER_BYTES = 9 + 20
_CRC = struct.Struct("<I")

# What the libraries raise on damaged bytes, as found by reading thousands of mutated files.
_DAMAGE = (
    McapError,
    DecodeError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
)


class DamageError(SessionError):
    """Bytes that make no sense; `what` says where and why, without advice."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}; `flowrec recover {path}` saves what is whole")
        self.what = what


class Record(NamedTuple):
    """One message as it lies in a chunk."""

    log_ns: int
    channel: int
    sequence: int
    payload: memoryview


@dataclass(slots=True)
class Summary:
    """What the end of the file says about the rest."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None


class Source:
    """A finished MCAP file. Reads are independent of each other and may come from several threads.

    Raises
    ------
    SessionError : on opening or reading, whatever is wrong with the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir():
            raise SessionError(f"{path}: is a directory, not a session; name a .mcap file in it (`flowrec ls {path}`)")
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except FileNotFoundError as error:
            raise SessionError(f"{path}: no such file; `flowrec ls {path.parent}` shows the sessions there") from error
        except OSError as error:
            raise SessionError(f"{path}: can not be opened ({error.strerror}); check its permissions") from error
        self.close = weakref.finalize(self, os.close, self._descriptor)
        try:
            self.size = os.fstat(self._descriptor).st_size
            self.header = self._read_header()
        except BaseException:
            self.close()
            raise

    def read(self, offset: int, length: int) -> bytes:
        """That many bytes, no fewer."""
        if not self.close.alive:
            raise SessionError(f"{self.path}: has been closed; open the session again")
        if not 0 <= offset <= offset + length <= self.size:
            raise self.damaged(offset, f"{length} bytes are announced, the file ends at {self.size}")
        try:
            data = os.pread(self._descriptor, length, offset)
            while len(data) < length:  # one call reads 2 GiB at most
                more = os.pread(self._descriptor, length - len(data), offset + len(data))
                if not more:
                    raise self.damaged(offset, "the file has become shorter while it was read")
                data += more
        except OSError as error:
            raise SessionError(f"{self.path}: can not be read at byte {offset} ({error.strerror})") from error
        return data

    def damaged(self, offset: int, why: object) -> DamageError:
        """The error for bytes that make no sense."""
        return DamageError(self.path, f"damaged at byte {offset} ({why})")

    @contextlib.contextmanager
    def parsing(self, offset: int) -> Iterator[None]:
        """Turns what a library raises on damaged bytes into a SessionError."""
        try:
            yield
        except _DAMAGE as error:
            raise self.damaged(offset, str(error) or type(error).__name__) from error

    def read_summary(self) -> Summary:
        """The summary section, checksum verified."""
        tail = self.read(max(0, self.size - _FOOTER_BYTES - len(MAGIC)), min(self.size, _FOOTER_BYTES + len(MAGIC)))
        if not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER or len(tail) != _FOOTER_BYTES + len(MAGIC):
            raise SessionError(
                f"{self.path}: was not finished (the run was killed, or the file is cut off);"
                f" `flowrec recover {self.path}` makes a whole session of it"
            )
        footer_at = self.size - len(tail)
        with self.parsing(footer_at):
            footer = Footer.read(_stream(tail[9:]))
        if footer.summary_start == 0:
            raise SessionError(f"{self.path}: has no index; `flowrec recover {self.path}` makes one")
        start = footer.summary_start
        data = self.read(start, footer_at - start)
        if footer.summary_crc and zlib.crc32(tail[: _FOOTER_BYTES - 4], zlib.crc32(data)) != footer.summary_crc:
            raise self.damaged(start, "the checksum of the index is wrong")
        summary = Summary()
        with self.parsing(start):
            for opcode, at, length in _records(data):
                _take_in(summary, opcode, data[at : at + length])
        self._check(summary, start)
        return summary

    def metadata(self, index: MetadataIndex) -> dict[str, str]:
        """One metadata record."""
        record: Metadata = self.record(index.offset, index.length, Opcode.METADATA, Metadata.read)[0]
        return dict(record.metadata)

    def attachment(self, index: AttachmentIndex) -> bytes:
        """The content of one attachment, checksum verified."""
        record, body = self.record(index.offset, index.length, Opcode.ATTACHMENT, Attachment.read)
        with self.parsing(index.offset):
            (crc,) = _CRC.unpack(body[-4:])
        if crc and zlib.crc32(body[:-4]) != crc:
            raise self.damaged(index.offset, f"the checksum of {record.name!r} is wrong")
        if len(record.data) != index.data_size:
            raise self.damaged(index.offset, f"{record.name!r} is shorter than announced")
        data: bytes = record.data
        return data

    def messages(self, index: ChunkIndex) -> list[Record]:
        """All messages of one chunk, in file order; decompressed within its declared size, checksum verified."""
        offset = index.chunk_start_offset
        chunk: Chunk = self.record(offset, index.chunk_length, Opcode.CHUNK, Chunk.read)[0]
        with self.parsing(offset):
            content = _decompressed(chunk)
            if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
                raise ValueError("the checksum of the chunk is wrong")
            view = memoryview(content)
            found: list[Record] = []
            for opcode, at, length in _records(content):
                if opcode == Opcode.MESSAGE:
                    if len(found) == _RECORDS_PER_CHUNK:
                        raise ValueError(f"more than {_RECORDS_PER_CHUNK} messages in one chunk")
                    channel, sequence, log_ns, _publish_ns = _MESSAGE_HEAD.unpack_from(content, at)
                    payload = view[at + _MESSAGE_HEAD.size : at + length]
                    found.append(Record(log_ns, channel, sequence, payload))
        return found

    def _read_header(self) -> Header:
        if self.size == 0:
            raise SessionError(f"{self.path}: is empty; nothing was recorded into it")
        if self.read(0, min(self.size, len(MAGIC))) != MAGIC:
            raise SessionError(f"{self.path}: is not an MCAP file; flowrec reads what `flowrec record` has written")
        data = self.read(len(MAGIC), min(self.size - len(MAGIC), _HEADER_LIMIT_BYTES))
        with self.parsing(len(MAGIC)):
            opcode, length = RECORD_HEAD.unpack_from(data)
            if opcode != Opcode.HEADER or length > len(data) - RECORD_HEAD.size:
                raise ValueError("no header record")
            header: Header = Header.read(_stream(data[RECORD_HEAD.size :][:length]))
        return header

    def record(self, offset: int, length: int, opcode: Opcode, parse: Callable[..., Any]) -> tuple[Any, bytes]:
        """One record of that kind and size, parsed, and its body."""
        data = self.read(offset, length)
        with self.parsing(offset):
            found, size = RECORD_HEAD.unpack_from(data)
            if found != opcode or size != length - RECORD_HEAD.size:
                raise ValueError(f"no {opcode.name.lower()} of {length} bytes here")
            body = data[RECORD_HEAD.size :]
            return parse(_stream(body)), body

    def _check(self, summary: Summary, start: int) -> None:
        counts = summary.statistics
        if counts is None:
            raise self.damaged(start, "the index has no statistics")
        pairs = (
            ("chunks", counts.chunk_count, len(summary.chunks)),
            ("channels", counts.channel_count, len(summary.channels)),
            ("attachments", counts.attachment_count, len(summary.attachments)),
            ("metadata records", counts.metadata_count, len(summary.metadata)),
        )
        for what, announced, listed in pairs:
            if announced != listed:
                raise self.damaged(start, f"{announced} {what} are announced, {listed} are listed")
        for channel in summary.channels.values():
            if channel.schema_id not in summary.schemas:
                raise self.damaged(start, f"channel {channel.topic} has no schema")


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and length of the body of each record."""
    at, end = 0, len(data)
    while at < end:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        at += RECORD_HEAD.size
        if length > end - at:
            raise ValueError(f"a record of {length} bytes where {end - at} are left")
        yield opcode, at, length
        at += length


def _decompressed(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size > CHUNK_LIMIT_BYTES:
        raise ValueError(f"a chunk of {size} bytes, more than {CHUNK_LIMIT_BYTES}")
    if chunk.compression == "":
        content: bytes = chunk.data
    elif chunk.compression == "zstd":
        # The size in zstd's own header is what the library allocates, whatever limit it is given.
        if zstandard.frame_content_size(chunk.data) not in (-1, size):
            raise ValueError("zstd announces another size than the chunk")
        # A new one each time: they are cheap, and may not be shared between threads.
        content = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size) if size else b""
    else:
        raise ValueError(f"compression {chunk.compression!r} is not known to flowrec")
    if len(content) != size:
        raise ValueError(f"{len(content)} bytes where {size} are announced")
    return content


def _take_in(summary: Summary, opcode: int, body: bytes) -> None:
    stream = _stream(body)
    if opcode == Opcode.SCHEMA:
        schema = Schema.read(stream)
        summary.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(stream)
        summary.channels[channel.id] = channel
    elif opcode == Opcode.CHUNK_INDEX:
        summary.chunks.append(ChunkIndex.read(stream))
    elif opcode == Opcode.ATTACHMENT_INDEX:
        summary.attachments.append(AttachmentIndex.read(stream))
    elif opcode == Opcode.METADATA_INDEX:
        summary.metadata.append(MetadataIndex.read(stream))
    elif opcode == Opcode.STATISTICS:
        summary.statistics = Statistics.read(stream)
