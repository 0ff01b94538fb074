"""Writes MCAP files: appends records and chunks, and closes the file with its summary.

flowrec has a writer of its own because of the control loop: chunks are compressed with the interpreter lock released.
While images of 2448x2048 are written at 60 Hz, another thread wakes at most 0.2 ms late (p99). With foxglove-sdk,
which holds the lock while it compresses, it is 8 ms, and with mcap's Writer, which has no setting for the zstd level,
0.4 to 2 ms. foxglove-sdk needs 0.7 of the CPU time for images and 0.6 for small messages; where images are small or
few it would be sufficient. Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    Schema,
    SummaryOffset,
)

from flowrec.core import Closing, SessionError, open_new, shell_word
from flowrec.store.digest import channel_digest, digest_record, head_digest
from flowrec.store.lookup import LOOKUP_OPCODE, SMALL_BYTES, Piece, lookup_record
from flowrec.store.mcap_format import CHUNK_HEAD, LONG, MAGIC, RECORD_HEAD, SealedChunk, Summary, parse_summary

_BUFFERS_PER_WRITE = 1024  # IOV_MAX of Linux


class McapWriter(Closing):
    """An MCAP file open for appending. When a method returns, the operating system has the bytes.

    It is locked until it is closed, so that no other process writes it or takes it for the rest of a killed run. Raises
    OSError: from any method, when the disk refuses.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._file = open_new(path, overwrite=overwrite)
        self._reset()

    def _reset(self) -> None:
        self.size = 0
        self._crc = 0
        self._summary = Summary()
        self._chunks = bytearray()  # their indexes as in the summary: a long run has millions
        self._chunk_count = 0
        self._counts: Counter[int] = Counter()
        self._digests: Counter[int] = Counter()
        self._head_digest = 0
        self._pieces: list[Piece] = []  # small records outside the chunks
        self._first_ns = self._last_ns = 0

    def clear(self) -> None:
        """Remove all that was written, to begin again."""
        os.ftruncate(self._file.fileno(), 0)
        self._file.seek(0)
        self._reset()

    def start(self, profile: str, library: str) -> None:
        """Write magic and header."""
        head = MAGIC + _bytes_of(Header(profile=profile, library=library))
        self._pieces.append((0, head))
        self._append(head)

    def add(self, record: Metadata | Attachment | Schema | Channel) -> None:
        """Write a record outside the chunks."""
        data = _bytes_of(record)
        self._summary.enter(record, self.size, len(data))
        if isinstance(record, Metadata | Attachment):
            self._head_digest += head_digest(record)
            if len(data) <= SMALL_BYTES:
                self._pieces.append((self.size, data))
        self._append(data)

    def add_digest(self) -> None:
        """Write the digest of all that was added; it is the last metadata record."""
        channels, schemas = self._summary.channels, self._summary.schemas
        topics = [
            (each.topic, self._counts[n], self._digests[n], channel_digest(each, schemas.get(each.schema_id)))
            for n, each in channels.items()
        ]
        self.add(digest_record(self._head_digest, topics))

    def add_chunks(self, chunks: Iterable[SealedChunk]) -> None:
        """Write sealed chunks with their indexes, all at once, so that a flushed file holds whole ticks."""
        buffers: list[bytes | memoryview] = []
        at = self.size
        for chunk in chunks:
            start = at
            head = _chunk_head(chunk)
            buffers += (head, chunk.data)
            length, offsets = len(head) + len(chunk.data), {}
            at += length
            for index in chunk.indexes:
                buffers.append(index.record)
                offsets[index.channel] = at
                at += len(index.record)
                self._counts[index.channel] += index.messages
                self._digests[index.channel] += index.digest
            first_ns, last_ns = chunk.message_start_time, chunk.message_end_time
            self._chunks += _bytes_of(
                ChunkIndex(
                    chunk_length=length,
                    chunk_start_offset=start,
                    compression=chunk.compression,
                    compressed_size=len(chunk.data),
                    message_end_time=last_ns,
                    message_index_length=at - start - length,
                    message_index_offsets=offsets,
                    message_start_time=first_ns,
                    uncompressed_size=chunk.uncompressed_size,
                )
            )
            self._first_ns = min(self._first_ns, first_ns) if self._chunk_count else first_ns
            self._last_ns = max(self._last_ns, last_ns)
            self._chunk_count += 1
        self._append(*buffers)

    def finish(self) -> None:
        """Write data end, summary and footer; then the file is complete."""
        self._append(_bytes_of(DataEnd(data_section_crc=self._crc)))
        start = self.size
        summary, offsets = bytearray(), bytearray()
        for opcode, group in self._groups():
            if group:
                offsets += _bytes_of(SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        lookup = lookup_record(self.summary().chunks, self._pieces, bytes(summary[len(self._chunks) :]))
        offsets += _bytes_of(SummaryOffset(LOOKUP_OPCODE, start + len(summary), len(lookup)))
        summary += lookup
        offset_start = start + len(summary)
        footer = _bytes_of(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=0))
        # The checksum covers all of the summary up to itself, the last four bytes of the footer.
        tail = bytes(summary + offsets) + footer[:-4]
        self._append(tail + zlib.crc32(tail).to_bytes(4, "little") + MAGIC)

    def summary(self) -> Summary:
        """The summary of what was added so far, in Unix time, for a reader of the unfinished file."""
        return parse_summary(b"".join(group for _, group in self._groups()), self.size)

    def _groups(self) -> Iterator[tuple[Opcode, bytes | bytearray]]:
        """The records of the summary by kind; the longest one first, so that the others are at the end of the file."""
        listed = self._summary
        listed.count(self._counts, self._chunk_count, self._first_ns, self._last_ns)
        assert listed.statistics is not None
        yield Opcode.CHUNK_INDEX, self._chunks
        yield Opcode.SCHEMA, _bytes_of(*listed.schemas.values())
        yield Opcode.CHANNEL, _bytes_of(*listed.channels.values())
        yield Opcode.STATISTICS, _bytes_of(listed.statistics)
        yield Opcode.ATTACHMENT_INDEX, _bytes_of(*listed.attachments)
        yield Opcode.METADATA_INDEX, _bytes_of(*listed.metadata)

    def sync(self) -> None:
        """Force what was appended to the disk; may run in another thread than the other methods."""
        # A removed file must be an error now: else a run would fill it until its end, and nothing would be left.
        if os.fstat(self._file.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, "the file was removed while it was recorded")
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file; without `finish` it can only be recovered."""
        self._file.close()

    def _append(self, *buffers: bytes | memoryview) -> None:
        for buffer in buffers:
            self._crc = zlib.crc32(buffer, self._crc)
            self.size += len(buffer)
        self._put(buffers)

    def _put(self, buffers: Iterable[bytes | memoryview]) -> None:
        """Write buffers without copying them; one system call takes a limited number and may write fewer bytes."""
        waiting = [memoryview(buffer) for buffer in buffers if len(buffer)]
        while waiting:
            if sys.platform != "win32":
                done = os.writev(self._file.fileno(), waiting[:_BUFFERS_PER_WRITE])
            else:
                done = os.write(self._file.fileno(), waiting[0])
            while waiting and done >= len(waiting[0]):
                done -= len(waiting.pop(0))
            if done:
                waiting[0] = waiting[0][done:]


def _bytes_of(*records: McapRecord) -> bytes:
    """Records as they stand in the file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()  # type: ignore[no-untyped-call]


def _chunk_head(chunk: SealedChunk) -> bytes:
    """A chunk record up to its data, which would be copied twice by mcap's own builder."""
    name = chunk.compression.encode()
    head = CHUNK_HEAD.pack(
        chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size, chunk.uncompressed_crc, len(name)
    )
    head += name + LONG.pack(len(chunk.data))
    return RECORD_HEAD.pack(Opcode.CHUNK, len(head) + len(chunk.data)) + head


class FileError(SessionError):
    """A file that can not be written; the text names it and says what to do."""


def new_mcap(path: Path, *, overwrite: bool) -> McapWriter:
    """Begin a file; raises FileError where it can not be made."""
    try:
        return McapWriter(path, overwrite=overwrite)
    except OSError as error:
        raise not_writable(path, error) from error


@contextlib.contextmanager
def disk_errors(path: Path, *, kept: bool = True) -> Iterator[None]:
    """Turns an OSError of writing the file into a FileError that says what to do; `kept`: a file that fails stays."""
    try:
        yield
    except FileNotFoundError as error:
        raise FileError(
            f"{path}: no longer exists: the file or its directory was removed or renamed during the recording"
        ) from error
    except OSError as error:
        what, first = f"writing failed ({error.strerror})", "see to the disk and its connection"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            what, first = "the disk is full", "free some space"
        elif error.errno == errno.EFBIG:
            what, first = "no file may be larger here", "record in parts (recording.split_mb)"
        then = (
            f"then `flowrec recover {shell_word(path)}` saves what was recorded"
            if kept
            else "then try again; nothing is left"
        )
        raise FileError(f"{path}: {what}; {first}, {then}") from error


def not_writable(path: Path, error: OSError) -> FileError:
    """The error for a file that can not be made."""
    if isinstance(error, FileNotFoundError):
        return FileError(f"{path.parent}: no such directory; make it, or choose another place with --out")
    if isinstance(error, BlockingIOError):
        return FileError(f"{path}: is being written by another process just now; choose another name with --out")
    if isinstance(error, FileExistsError):  # since its name was looked at
        return FileError(f"{path}: was made by another process meanwhile; choose another name with --out")
    return FileError(f"{path}: can not be made ({error.strerror}); choose another place with --out")
