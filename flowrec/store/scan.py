"""The index of a file that has none, or whose index is not to be trusted: made from its records, front to back.

What does not parse, or fails its checksum, is left out. After a record whose length makes no sense the next chunk is
looked for by its shape.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from flowrec.errors import SessionError
from flowrec.store.mcap_index import DECLARED_LIMIT, Summary, declare
from flowrec.store.mcap_reader import CHUNK_LIMIT_BYTES, RECORD_HEAD, Record, Source
from flowrec.store.mcap_writer import MAGIC
from flowrec.store.metadata import CONFIG_FILE, OUTCOME

_CHUNK_HEAD = struct.Struct("<BQQQQI")  # opcode, length, first and last time, size and checksum of the content
_HEAD_BYTES = _CHUNK_HEAD.size + 16
# The chunks that flowrec writes: a head, then `zstd`, or no name and the size of the content once more.
_CHUNK_SHAPE = re.compile(rb"(?s)(?=\x06.{24}(.{8}).{4}(?:\x04\x00\x00\x00zstd|\x00\x00\x00\x00\1))")
_WINDOW_BYTES = 1 << 20
_TRIES = 8  # how often, on average, a damaged byte may be looked at
_SEQUENCES = 2**32
_DECLARING = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_TIMES_DECLARED = 2  # in the file and in its index


Visit = Callable[[int, list[Record]], None]


class Lost(NamedTuple):
    """Bytes of the file that are not to be used."""

    offset: int
    nbytes: int


class Gap(NamedTuple):
    """Messages of one channel that are missing before a time, told by their sequence numbers."""

    before_ns: int
    messages: int


@dataclass(slots=True)
class Scan:
    """What was found.

    Attributes
    ----------
    summary : index of everything intact.
    lost : what was passed over before the end of the run; a missing or damaged index after it is no loss.
    gaps : by channel.
    last_ns : time of the last message, by channel.
    ended : the outcome of the run was found, which is written after its last message.
    visit : told offset and messages of every sound chunk, in file order.
    """

    summary: Summary = field(default_factory=Summary)
    lost: list[Lost] = field(default_factory=list)
    gaps: dict[int, list[Gap]] = field(default_factory=dict)
    last_ns: dict[int, int] = field(default_factory=dict)
    ended: bool = False
    visit: Visit | None = None
    _counts: dict[int, int] = field(default_factory=dict)
    _sequences: dict[int, int] = field(default_factory=dict)

    def take(self, source: Source, opcode: int, offset: int, length: int) -> bool:
        """Enter one record; False when it is damaged."""
        try:
            if opcode == Opcode.CHUNK:
                self._take_chunk(source, offset, length)
            elif opcode == Opcode.SCHEMA:
                schema: Schema = source.record(offset, length, Opcode.SCHEMA, Schema.read)
                with source.parsing(offset):
                    declare(self.summary.schemas, schema)
            elif opcode == Opcode.CHANNEL:
                channel: Channel = source.record(offset, length, Opcode.CHANNEL, Channel.read)
                with source.parsing(offset):
                    declare(self.summary.channels, channel)
            elif opcode == Opcode.METADATA:
                metadata: Metadata = source.record(offset, length, Opcode.METADATA, Metadata.read)
                self.summary.metadata.append(MetadataIndex(offset=offset, length=length, name=metadata.name))
                self.ended = self.ended or metadata.name == OUTCOME
            elif opcode == Opcode.ATTACHMENT:
                self._take_attachment(source, offset, length)
        except SessionError:
            return False
        return True

    @property
    def undeclared(self) -> int:
        """Messages of channels whose declaration was not found, or is damaged."""
        return sum(count for channel, count in self._counts.items() if channel not in self.summary.channels)

    def lose(self, offset: int, nbytes: int) -> None:
        """Pass over some bytes."""
        if not self.ended:
            self.lost.append(Lost(offset, nbytes))

    def close(self) -> None:
        """Complete the summary."""
        summary = self.summary
        for channel in list(summary.channels.values()):
            if channel.schema_id not in summary.schemas:
                del summary.channels[channel.id]
        summary.statistics = Statistics(
            attachment_count=len(summary.attachments),
            channel_count=len(summary.channels),
            channel_message_counts=self._counts,
            chunk_count=len(summary.chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in summary.chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in summary.chunks), default=0),
            metadata_count=len(summary.metadata),
            schema_count=len(summary.schemas),
        )

    def _take_chunk(self, source: Source, offset: int, length: int) -> None:
        index = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression="zstd",
            compressed_size=length,
            message_end_time=0,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=0,
            uncompressed_size=0,
        )
        content = source.content(offset, length)
        records = source.messages_in(content, offset)
        if not records:
            return
        # The times in the head of a chunk are under no checksum; those of its messages are.
        index.message_start_time = min(record.log_ns for record in records)
        index.message_end_time = max(record.log_ns for record in records)
        index.message_index_offsets = {record.channel: 0 for record in records}
        index.uncompressed_size = len(content)
        self.summary.chunks.append(index)
        if self.visit is not None:
            self.visit(offset, records)
        for log_ns, channel, sequence, _ in records:
            missing = (sequence - self._sequences.get(channel, -1) - 1) % _SEQUENCES
            if missing:
                self.gaps.setdefault(channel, []).append(Gap(log_ns, missing))
            self._sequences[channel] = sequence
            self._counts[channel] = self._counts.get(channel, 0) + 1
            self.last_ns[channel] = max(log_ns, self.last_ns.get(channel, 0))

    def _take_attachment(self, source: Source, offset: int, length: int) -> None:
        found = source.attachment_at(offset, length)
        if found.name == CONFIG_FILE:
            with source.parsing(offset):
                source.start_at(found.log_ns)
        self.summary.attachments.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                log_time=found.log_ns,
                create_time=found.create_ns,
                data_size=len(found.data),
                name=found.name,
                media_type=found.media_type,
            )
        )


def scan(source: Source, visit: Visit | None = None, progress: Callable[[int], None] | None = None) -> Scan:
    """Read a whole file and note what is intact; one chunk is in memory at a time.

    Parameters
    ----------
    visit : told offset and messages of every sound chunk, in file order.
    progress : told up to which byte the file has been read.

    Raises
    ------
    SessionError : the disk does not give the bytes.
    """
    found = Scan(visit=visit)
    at = len(MAGIC)
    # What has the shape of a chunk after damage may be none, and lie over the next one: the price of trying is bounded.
    patience_bytes = _TRIES * source.size + _WINDOW_BYTES
    declared = 0
    while at < source.size:
        if progress is not None:
            progress(at)
        opcode, end = _extent(source, at)
        declared += opcode in _DECLARING
        if declared > _TIMES_DECLARED * DECLARED_LIMIT:
            raise source.damaged(at, f"more than {_TIMES_DECLARED * DECLARED_LIMIT} records besides chunks")
        if end and found.take(source, opcode, at, end - at):
            if opcode == Opcode.FOOTER:
                break
            at = end
            continue
        patience_bytes -= end - at if end else RECORD_HEAD.size
        if patience_bytes < 0:
            found.lose(at, source.size - at)
            break
        # A damaged record between sound ones is passed over; else its length is not to be trusted either.
        sound = end and (end == source.size or _extent(source, end)[1])
        following = end if sound else _next_chunk(source, at + 1)
        found.lose(at, following - at)
        at = following
    found.close()
    return found


def _extent(source: Source, at: int) -> tuple[int, int]:
    """Opcode and end of the record at an offset; the end is 0 where no whole record can be."""
    if at + RECORD_HEAD.size > source.size:
        return 0, 0
    opcode, length = RECORD_HEAD.unpack(source.read(at, RECORD_HEAD.size))
    end = at + RECORD_HEAD.size + length
    known = Opcode.HEADER <= opcode <= Opcode.DATA_END
    return (opcode, end) if known and end <= source.size else (0, 0)


def _next_chunk(source: Source, start: int) -> int:
    """Offset of the next thing that has the shape of a chunk, the end of the file where there is none."""
    while start < source.size:
        window = source.read(start, min(source.size - start, _WINDOW_BYTES + _HEAD_BYTES))
        for shape in _CHUNK_SHAPE.finditer(window):
            _, length, _, _, size, _ = _CHUNK_HEAD.unpack_from(window, shape.start())
            at = start + shape.start()
            if size <= CHUNK_LIMIT_BYTES and length <= source.size - at - RECORD_HEAD.size:
                return at
        start += _WINDOW_BYTES
    return source.size
