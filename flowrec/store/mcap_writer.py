"""The bytes of an MCAP file as it grows, and the summary that closes it.

Why a writer of our own: it compresses with the interpreter's lock released, so that the control loop goes on. While
images of 2448x2048 are written at 60 Hz, another thread wakes at most 0.2 ms late (p99); beside foxglove-sdk, which
holds the lock while it compresses, 8 ms, and beside mcap's Writer, which has no setting for the zstd level, 0.4 to
2 ms. foxglove-sdk needs 0.7 of the CPU time for images and 0.6 for small messages. Where images are small or few, or
come compressed, it would do (`flowrec bench store --equal`).
Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from flowrec.store.digest import added, of_record, record_of
from flowrec.system.locks import open_new

if TYPE_CHECKING:  # with it would come numpy, which those who only list files do without
    from flowrec.store.chunk import Sealed

MAGIC = b"\x89MCAP0\r\n"
_CHUNK_HEAD = struct.Struct("<BQQQQII")  # opcode, length, first and last time, size, checksum, length of the name
_SIZE = struct.Struct("<Q")
_PARTS_PER_WRITE = 1024


class McapFile:
    """An MCAP file open for appending. Every call ends with the bytes handed to the operating system.

    It is locked until it is closed, so that no other process writes it or takes it for the remains of a run.

    Raises
    ------
    OSError : from any method, when the disk refuses.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.size = 0
        self._crc = 0
        self._schemas: list[McapRecord] = []
        self._channels: list[Channel] = []
        self._chunks = bytearray()  # their indexes, as they will stand in the summary: a long run has millions
        self._chunk_count = 0
        self._attachments: list[McapRecord] = []
        self._metadata: list[McapRecord] = []
        self._counts: dict[int, int] = {}
        self._digests: dict[int, int] = {}
        self._head_digest = 0
        self._span: tuple[int, int] | None = None
        self._file = open_new(path, overwrite=overwrite)

    def start(self, profile: str, library: str) -> None:
        """Magic and header."""
        self._append(MAGIC + _bytes_of(Header(profile=profile, library=library)))

    def add(self, record: Metadata | Attachment | Schema | Channel) -> None:
        """A record outside the chunks."""
        data = _bytes_of(record)
        if isinstance(record, Schema):
            self._schemas.append(record)
        elif isinstance(record, Channel):
            self._channels.append(record)
            self._counts[record.id] = 0
            self._digests[record.id] = 0
        elif isinstance(record, Metadata):
            self._metadata.append(MetadataIndex(offset=self.size, length=len(data), name=record.name))
        else:
            self._attachments.append(
                AttachmentIndex(
                    offset=self.size,
                    length=len(data),
                    log_time=record.log_time,
                    create_time=record.create_time,
                    data_size=len(record.data),
                    name=record.name,
                    media_type=record.media_type,
                )
            )
        if isinstance(record, Metadata | Attachment):
            self._head_digest = added(self._head_digest, of_record(record))
        self._append(data)

    def add_digest(self) -> None:
        """The digest of all that was added, as the last record of its kind."""
        topics = [(channel.topic, self._counts[channel.id], self._digests[channel.id]) for channel in self._channels]
        self.add(record_of(self._head_digest, topics))

    def add_chunks(self, sealed: Iterable[Sealed]) -> None:
        """Sealed chunks with their indexes, all in one write, so that a flushed file holds whole ticks."""
        parts: list[bytes | memoryview] = []
        at = self.size
        for chunk in sealed:
            start = at
            head = _chunk_head(chunk)
            parts += (head, chunk.data)
            length, offsets = len(head) + len(chunk.data), {}
            at += length
            for index in chunk.indexes:
                parts.append(index.record())
                offsets[index.channel] = at
                at += len(parts[-1])
                self._counts[index.channel] += len(index)
                self._digests[index.channel] = added(self._digests[index.channel], index.digest)
            place = ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=at - start - length,
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
            self._chunks += _bytes_of(place)
            self._chunk_count += 1
            first, last = self._span or (chunk.message_start_time, chunk.message_end_time)
            self._span = min(first, chunk.message_start_time), max(last, chunk.message_end_time)
        self._append(*parts)

    def finish(self) -> None:
        """Data end, summary and footer; then the file is whole."""
        self._append(_bytes_of(DataEnd(data_section_crc=self._crc)))
        start = self.size
        groups: list[tuple[Opcode, bytes | bytearray]] = [
            (Opcode.SCHEMA, _all_bytes_of(self._schemas)),
            (Opcode.CHANNEL, _all_bytes_of(self._channels)),
            (Opcode.STATISTICS, _bytes_of(self._statistics())),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, _all_bytes_of(self._attachments)),
            (Opcode.METADATA_INDEX, _all_bytes_of(self._metadata)),
        ]
        summary, offsets = bytearray(), bytearray()
        for opcode, group in groups:
            if group:
                at = start + len(summary)
                offsets += _bytes_of(SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(group)))
                summary += group
        offset_start = start + len(summary)
        footer = _bytes_of(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=0))
        # The checksum covers all of the summary up to itself, the last four bytes of the footer.
        tail = bytes(summary + offsets) + footer[:-4]
        self._append(tail + zlib.crc32(tail).to_bytes(4, "little") + MAGIC)

    def sync(self) -> None:
        """Have the disk itself keep what was appended; may run beside the other methods, in a thread of its own."""
        # Without this a run would fill a file without a name until its end, and nothing would be left of it.
        if os.fstat(self._file.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, "the file was removed while it was recorded")
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file as it is; without `finish` it can only be recovered."""
        self._file.close()

    def _append(self, *parts: bytes | memoryview) -> None:
        for part in parts:
            self._crc = zlib.crc32(part, self._crc)
            self.size += len(part)
        self._put(parts)

    def _put(self, parts: Sequence[bytes | memoryview]) -> None:
        """Hand the bytes over as they lie in memory; one call takes a limited number of parts and may stop early."""
        waiting = [memoryview(part) for part in parts if len(part)]
        while waiting:
            done = os.writev(self._file.fileno(), waiting[:_PARTS_PER_WRITE])
            while waiting and done >= len(waiting[0]):
                done -= len(waiting.pop(0))
            if done:
                waiting[0] = waiting[0][done:]

    def _statistics(self) -> Statistics:
        first, last = self._span or (0, 0)
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={channel: count for channel, count in self._counts.items() if count},
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def _all_bytes_of(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(_bytes_of, records))


def _chunk_head(chunk: Sealed) -> bytes:
    """A chunk record up to its data, which would be copied twice by mcap's own builder."""
    name = chunk.compression.encode()
    length = _CHUNK_HEAD.size - 9 + len(name) + _SIZE.size + len(chunk.data)
    head = _CHUNK_HEAD.pack(
        Opcode.CHUNK,
        length,
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.uncompressed_size,
        chunk.uncompressed_crc,
        len(name),
    )
    return head + name + _SIZE.pack(len(chunk.data))
