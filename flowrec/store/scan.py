"""Rebuilds the index of a file that has none, or a wrong one, from its records, front to back.

Records that can not be parsed or fail their checksum are left out. After a record with an impossible length the next
chunk is searched for by its byte pattern.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from flowrec.core import SessionError
from flowrec.store.digest import message_digest
from flowrec.store.lookup import LOOKUP_OPCODE
from flowrec.store.mcap_format import CHUNK_HEAD, CHUNK_LIMIT_BYTES, DECLARED_LIMIT, MAGIC, RECORD_HEAD, Record, Summary
from flowrec.store.mcap_reader import McapReader
from flowrec.store.session_metadata import CONFIG_FILE, OUTCOME

# The chunks that flowrec writes: a head, then `zstd`, or no name and the size of the content once more.
_CHUNK_PATTERN = re.compile(rb"(?s)(?=\x06.{24}(.{8}).{4}(?:\x04\x00\x00\x00zstd|\x00\x00\x00\x00\1))")
_PATTERN_BYTES = RECORD_HEAD.size + CHUNK_HEAD.size + 16
_WINDOW_BYTES = 1 << 20
_TRIES = 8  # how often, on average, a damaged byte may be read
_SEQUENCES = 2**32  # a sequence number of MCAP has 32 bits
_DECLARING = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_TIMES_DECLARED = 2  # in the file and in its index

Visit = Callable[[ChunkIndex, list[Record]], None]


class SequenceGap(NamedTuple):
    """Messages of one channel that are missing before a time, by their sequence numbers."""

    before_ns: int
    messages: int


@dataclass(slots=True)
class Scan:
    """The index of the intact records, and what was lost.

    Attributes
    ----------
    summary : index of everything intact, its times on the session clock.
    lost_bytes : skipped before the end of the run; a missing or damaged index after it is no loss.
    first_lost : offset of the first of them.
    gaps : by channel.
    ended : the outcome of the run was found, which is written after its last message.
    counts : number of messages by channel.
    first, last : time of the first and the last message in the file and offset of its chunk, by channel.
    sums : of the digests of the messages, by channel, where they are wanted.
    chunks_passed : that were not read, because only the declarations were wanted.
    """

    source: McapReader
    _visit: Visit | None = None
    _start_unix_ns: int | None = None  # as the index has it; None: no digests are wanted
    summary: Summary = field(default_factory=Summary)
    lost_bytes: int = 0
    first_lost: int = 0
    gaps: dict[int, list[SequenceGap]] = field(default_factory=dict)
    ended: bool = False
    counts: Counter[int] = field(default_factory=Counter)
    first: dict[int, tuple[int, int]] = field(default_factory=dict)
    last: dict[int, tuple[int, int]] = field(default_factory=dict)
    sums: Counter[int] = field(default_factory=Counter)
    chunks_passed: int = 0
    _sequences: dict[int, int] = field(default_factory=dict)

    def add(self, opcode: int, offset: int, length: int) -> bool:
        """Enter one record; False when it is damaged."""
        source = self.source
        try:
            if opcode == Opcode.CHUNK:
                self._add_chunk(offset, length)
            elif opcode in _DECLARING:
                found = source.record(offset, length, Opcode(opcode))
                with source.parsing(offset):
                    if opcode == Opcode.ATTACHMENT and found.name == CONFIG_FILE:
                        source.set_start(found.log_time)
                    self.summary.enter(found, offset, length)
                self.ended = self.ended or (opcode == Opcode.METADATA and found.name == OUTCOME)
        except SessionError:
            return False
        return True

    def lose(self, offset: int, nbytes: int) -> None:
        """Note bytes that were skipped."""
        if not self.ended:
            self.first_lost = self.first_lost if self.lost_bytes else offset
            self.lost_bytes += nbytes

    def close(self) -> None:
        """Complete the summary."""
        summary = self.summary
        for channel in list(summary.channels.values()):
            if channel.schema_id not in summary.schemas:
                del summary.channels[channel.id]
        first_ns = min((chunk.message_start_time for chunk in summary.chunks), default=0)
        last_ns = max((chunk.message_end_time for chunk in summary.chunks), default=0)
        summary.count(self.counts, len(summary.chunks), first_ns, last_ns)

    def _add_chunk(self, offset: int, length: int) -> None:
        content = self.source.content(offset, length)
        records = self.source.messages_in(content, offset)
        if not records:
            return
        place = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression="zstd",
            compressed_size=length,
            # The times in the head of a chunk are under no checksum; those of its messages are.
            message_end_time=max(record.log_ns for record in records),
            message_index_length=0,
            message_index_offsets={record.channel: 0 for record in records},
            message_start_time=min(record.log_ns for record in records),
            uncompressed_size=len(content),
        )
        self.summary.chunks.append(place)
        if self._visit is not None:
            self._visit(place, records)
        for log_ns, channel, sequence, payload in records:
            missing = (sequence - self._sequences.get(channel, -1) - 1) % _SEQUENCES
            if missing:
                self.gaps.setdefault(channel, []).append(SequenceGap(log_ns, missing))
            self._sequences[channel] = sequence
            self.counts[channel] += 1
            self.last[channel] = at = (log_ns, offset)
            self.first.setdefault(channel, at)
            if self._start_unix_ns is not None:
                self.sums[channel] += message_digest(sequence, log_ns + self._start_unix_ns, payload)


def scan(
    source: McapReader,
    visit: Visit | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    digests: bool = False,
    heads_only: bool = False,
) -> Scan:
    """Read all of a file and index its intact records; one chunk is in memory at a time.

    Raises SessionError: the file can not be read.

    Parameters
    ----------
    visit : receives place and messages of every intact chunk, in file order.
    progress : receives the byte up to which the file has been read.
    digests : sum up the digests of the messages.
    heads_only : pass over the content of chunks: only what is declared outside them is found.
    """
    source.read_originals()
    found = Scan(source, visit, source.start_unix_ns if digests else None)
    at = len(MAGIC)
    # What looks like a chunk after damage may be none, and overlap the next one: the cost of trying is bounded.
    allowance_bytes = _TRIES * source.size + _WINDOW_BYTES
    declared = 0
    while at < source.size:
        if progress is not None:
            progress(at)
        opcode, end = extent_of(source, at)
        declared += opcode in _DECLARING
        if declared > _TIMES_DECLARED * DECLARED_LIMIT:
            raise source.damage_error(at, f"more than {_TIMES_DECLARED * DECLARED_LIMIT} records besides chunks")
        if end and heads_only and opcode == Opcode.CHUNK:
            found.chunks_passed += 1
            at = end
            continue
        if end and found.add(opcode, at, end - at):
            if opcode == Opcode.FOOTER:
                break
            at = end
            continue
        allowance_bytes -= end - at if end else RECORD_HEAD.size
        if allowance_bytes < 0:
            found.lose(at, source.size - at)
            break
        # A damaged record between intact ones is skipped; else its length is not to be trusted either.
        length_is_sound = end and (end == source.size or extent_of(source, end)[1])
        following = end if length_is_sound else _next_chunk(source, at + 1)
        found.lose(at, following - at)
        at = following
    found.close()
    return found


def extent_of(source: McapReader, at: int) -> tuple[int, int]:
    """Opcode and end of the record at an offset; the end is 0 where no whole record can be."""
    if at + RECORD_HEAD.size > source.size:
        return 0, 0
    opcode, length = RECORD_HEAD.unpack(source.read(at, RECORD_HEAD.size))
    end = at + RECORD_HEAD.size + length
    known = Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode == LOOKUP_OPCODE
    return (opcode, end) if known and end <= source.size else (0, 0)


def _next_chunk(source: McapReader, start: int) -> int:
    """Offset of the next thing that looks like a chunk, the end of the file where there is none."""
    while start < source.size:
        window = source.read(start, min(source.size - start, _WINDOW_BYTES + _PATTERN_BYTES))
        for match in _CHUNK_PATTERN.finditer(window):
            _, length = RECORD_HEAD.unpack_from(window, match.start())
            size = CHUNK_HEAD.unpack_from(window, match.start() + RECORD_HEAD.size)[2]
            at = start + match.start()
            if size <= CHUNK_LIMIT_BYTES and length <= source.size - at - RECORD_HEAD.size:
                return at
        start += _WINDOW_BYTES
    return source.size
