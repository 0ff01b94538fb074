"""An MCAP file open for reading: every size is checked and every read is bounded.

mcap's own reader trusts the sizes that a file declares (a file of 32 kB can then cost 1 GiB and minutes) and lets
errors of several libraries escape. Here every size is checked before it is used and every error is a SessionError.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, cast

import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)

from flowrec.core import MOVIE_FILES, Closing, shell_word
from flowrec.store.byte_source import open_bytes
from flowrec.store.lookup import GatheredCopies, Piece, complement, parse_lookup, place_of_lookup
from flowrec.store.mcap_format import (
    ATTACHMENT_HEAD,
    CHUNK_HEAD,
    CHUNK_LIMIT_BYTES,
    CRC,
    DAMAGE,
    FOOTER_BYTES,
    LONG,
    MAGIC,
    MESSAGE_HEAD,
    MESSAGES_LIMIT,
    RECORD_HEAD,
    DamageError,
    ForeignError,
    Record,
    Summary,
    UnfinishedError,
    parse_summary,
    records_in,
    stream_of,
)

# A larger chunk must be stored in at least a thousandth of its size: noise, flow and text never compress better.
_FREE_BYTES, _RATIO_LIMIT = 16 << 20, 1000
# What is read of a compressed chunk at a time, and the largest zstd window; flowrec writes half a megabyte.
_AT_ONCE_BYTES, _WINDOW_LIMIT_BYTES = 8 << 20, 8 << 20
_HEADER_LIMIT_BYTES = 1 << 16
_SUMMARY_LIMIT_BYTES = 256 << 20  # a day of three chunks every half second needs half of it
# Longest gap that is read in vain to save a request: between copies, and between images whose state has copies.
_COPIES_GAP_BYTES, _IMAGES_GAP_BYTES = 1 << 20, 256 << 10
_SMALL_LIMIT_BYTES = 4 << 20  # one record of metadata, schema or channel
_PARSED: dict[Opcode, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
_LIMIT_BYTES = {Opcode.CHUNK: CHUNK_LIMIT_BYTES + (1 << 16), Opcode.ATTACHMENT: 256 << 20}

# Programs that read what is taken for a session, by suffix; else flowrec has no use for it.
_READ_BY = {
    **dict.fromkeys(MOVIE_FILES, "flowrec import makes a session of a movie"),
    ".rrd": "flowrec view shows a recording for Rerun",
    ".parquet": "flowrec find searches a catalog, flowrec report shows a sweep",
    ".toml": "flowrec record makes a session by a configuration",
}


class McapReader(Closing):
    """An MCAP file. Reads are independent of each other and may come from several threads.

    `start_unix_ns`: Unix time of stamp 0 of the session, as soon as it has been read; log times are reduced by it.
    Raises SessionError: on opening or reading, for every fault of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.start_unix_ns = path, 0
        self._bytes = open_bytes(path)
        self.size = self._bytes.size
        self._summary: Summary | None = None  # that was read to find the copies
        self._pieces: list[Piece] = []
        self._copies: GatheredCopies | None = None
        try:
            if self._bytes.is_far:
                self._find_copies()
            self.header = self._read_header()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the bytes."""
        self._bytes.close()

    def set_start(self, unix_ns: int) -> None:
        """Set `start_unix_ns`. Raises ValueError: it is no time."""
        if unix_ns >= 1 << 63:
            raise ValueError(f"a session that starts at {unix_ns} ns of Unix time")
        self.start_unix_ns = unix_ns

    def read(self, offset: int, length: int) -> bytes:
        """Exactly that many bytes."""
        if not 0 <= offset <= offset + length <= self.size:
            raise self.damage_error(offset, f"{length} bytes are announced, the file ends at {self.size}")
        for first, known in self._pieces:
            if first <= offset and offset + length <= first + len(known):
                return known[offset - first : offset - first + length]
        copy = self._copies.place_of(offset, length) if self._copies is not None else None
        data = self._bytes.read(offset if copy is None else copy, length)
        if len(data) < length:
            raise self.damage_error(offset, "the file has become shorter while it was read")
        return data if copy is None else complement(data)

    def read_originals(self) -> None:
        """Read every record where it stands from now on, none from its copy."""
        self._copies, self._pieces = None, []

    def prefetch(self, chunks: Iterable[ChunkIndex], *, indexes: bool = False) -> None:
        """Announce that these chunks, or the indexes after them, will be read soon: one round trip for a URL."""
        if not self._bytes.is_far:
            return
        ends = ((chunk, chunk.chunk_start_offset + chunk.chunk_length) for chunk in chunks)
        if indexes:
            wanted = [(end, chunk.message_index_length) for chunk, end in ends]
        else:
            wanted = [(chunk.chunk_start_offset, chunk.chunk_length) for chunk, _ in ends]
        copies: list[tuple[int, int]] = []
        elsewhere: list[tuple[int, int]] = []
        for offset, length in wanted:
            copy = self._copies.place_of(offset, length) if self._copies is not None else None
            if copy is None:
                elsewhere.append((offset, length))
            else:
                copies.append((copy, length))
        self._bytes.prefetch(copies, _COPIES_GAP_BYTES)
        self._bytes.prefetch(elsewhere, _IMAGES_GAP_BYTES if copies else None)

    def _find_copies(self) -> None:
        """Read what a file at a URL repeats at its end for those who read it there."""
        with contextlib.suppress(DamageError, UnfinishedError):  # raised again where the index is wanted
            footer, footer_at, tail = self._footer()
            found = self._lookup(footer, footer_at)
            self._summary, self._pieces = found or (self._long_summary(footer, footer_at, tail), [])
            self._copies = GatheredCopies(self._summary)

    def damage_error(self, offset: int, why: object) -> DamageError:
        """The error for bytes that can not be parsed."""
        return DamageError(self.path, f"damaged at byte {offset} ({why})")

    @contextlib.contextmanager
    def parsing(self, offset: int) -> Iterator[None]:
        """Turns any error that a library raises on damaged bytes into a SessionError."""
        try:
            yield
        except DAMAGE as error:
            raise self.damage_error(offset, str(error) or type(error).__name__) from error

    def read_summary(self, known: Summary | None = None) -> Summary:
        """The summary section, checksum verified, or a known one; nothing in it lies outside the file or overlaps."""
        kept, self._summary = self._summary, None  # once, because who asks changes it
        return known or kept or self._long_summary(*self._footer())

    def lookup_agrees(self) -> bool:
        """False if the lookup record repeats something else than what other programs read."""
        footer, footer_at, tail = self._footer()
        try:
            found = self._lookup(footer, footer_at)
        except DamageError:
            return False
        if found is None:
            return True
        short, pieces = found
        same = all(self.read(offset, len(data)) == data for offset, data in pieces)
        return same and short.chunks == self._long_summary(footer, footer_at, tail).chunks

    def _footer(self) -> tuple[Footer, int, bytes]:
        """The footer, its offset, and the bytes from there on."""
        tail = self.read(max(0, self.size - FOOTER_BYTES - len(MAGIC)), min(self.size, FOOTER_BYTES + len(MAGIC)))
        if not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER or len(tail) != FOOTER_BYTES + len(MAGIC):
            raise UnfinishedError(
                f"{self.path}: was not finished (the run was killed, or the file is cut off);"
                f" `flowrec recover {shell_word(self.path)}` makes a complete session of it"
            )
        footer_at = self.size - len(tail)
        with self.parsing(footer_at):
            footer = Footer.read(stream_of(tail[9:]))
        if footer.summary_start == 0:
            raise UnfinishedError(f"{self.path}: has no index; `flowrec recover {shell_word(self.path)}` makes one")
        return footer, footer_at, tail

    def _long_summary(self, footer: Footer, footer_at: int, tail: bytes) -> Summary:
        start = footer.summary_start
        if footer_at - start > _SUMMARY_LIMIT_BYTES:
            raise self.damage_error(start, f"an index of {footer_at - start} bytes, more than {_SUMMARY_LIMIT_BYTES}")
        data = self.read(start, footer_at - start)
        if footer.summary_crc and zlib.crc32(tail[: FOOTER_BYTES - 4], zlib.crc32(data)) != footer.summary_crc:
            raise self.damage_error(start, "the checksum of the index is wrong")
        with self.parsing(start):
            return parse_summary(data, start)

    def _lookup(self, footer: Footer, footer_at: int) -> tuple[Summary, list[Piece]] | None:
        """Summary and records of the head, by the lookup record at the end of the file; None where there is none."""
        offsets_at, begin = footer.summary_offset_start, footer.summary_start
        if not 0 < offsets_at < footer_at < offsets_at + _SMALL_LIMIT_BYTES:
            return None
        with self.parsing(offsets_at):
            place = place_of_lookup(self.read(offsets_at, footer_at - offsets_at), begin, footer_at)
            if place is None:
                return None
            between_at, at, nbytes = place
            between = self.read(between_at, at - between_at)
            chunks, pieces = parse_lookup(self.read(at, nbytes)[RECORD_HEAD.size :], between, begin)
            return parse_summary(between, begin, chunks), pieces

    def metadata(self, index: MetadataIndex) -> dict[str, str]:
        """One metadata record."""
        return dict(self.record(index.offset, index.length, Opcode.METADATA).metadata)

    def attachment(self, index: AttachmentIndex) -> bytes:
        """The content of one attachment, checksum verified."""
        found = self.record(index.offset, index.length, Opcode.ATTACHMENT)
        if len(found.data) != index.data_size or found.name != index.name:
            raise self.damage_error(index.offset, f"{found.name!r} is not what the index describes")
        return bytes(found.data)

    def record(self, offset: int, length: int, opcode: Opcode) -> Any:
        """One record outside the chunks, parsed; `length` includes its head. The checksum of an attachment is verified.

        The data of an attachment is a view, because a copy may be large.
        """
        body = self.body(offset, length, opcode)
        with self.parsing(offset):
            if opcode != Opcode.ATTACHMENT:
                return _PARSED[opcode].read(stream_of(body))
            log_ns, create_ns, name_bytes = ATTACHMENT_HEAD.unpack_from(body)
            name, at = _text(body, ATTACHMENT_HEAD.size, name_bytes)
            media_type, at = _text(body, at + 4, *CRC.unpack_from(body, at))
            (size,) = LONG.unpack_from(body, at)
            data, at = body[at + 8 : at + 8 + size], at + 8 + size
            if at + 4 != len(body):
                raise ValueError(f"{name!r} is not as long as announced")
            (crc,) = CRC.unpack_from(body, at)
            if crc and zlib.crc32(body[:at]) != crc:
                raise ValueError(f"the checksum of {name!r} is wrong")
            return Attachment(create_ns, log_ns, name, media_type, data)  # type: ignore[arg-type]

    def content(self, offset: int, length: int) -> bytes | memoryview:
        """The content of a chunk, decompressed within the limits, checksum verified."""
        self._check_size(offset, length, Opcode.CHUNK)
        whole = length <= _AT_ONCE_BYTES
        body = self.body(offset, length, Opcode.CHUNK) if whole else memoryview(self.read(offset, _AT_ONCE_BYTES))[9:]
        with self.parsing(offset):
            _, _, size, crc, name_bytes = CHUNK_HEAD.unpack_from(body)
            compression, at = _text(body, CHUNK_HEAD.size, name_bytes)
            data = body[at + LONG.size :]
            (nbytes,) = LONG.unpack_from(body, at)
            if nbytes != length - RECORD_HEAD.size - at - LONG.size:
                raise ValueError("the chunk is not as long as announced")
            if size > CHUNK_LIMIT_BYTES:
                raise ValueError(f"a chunk of {size} bytes, more than {CHUNK_LIMIT_BYTES}")
            if size > _FREE_BYTES and size > _RATIO_LIMIT * nbytes:
                raise ValueError(f"a chunk that unpacks {nbytes} bytes to {size}")
            packed = compression == "zstd"
            # The library allocates the size in zstd's own header, also beyond the limit that it is given.
            if packed and zstandard.frame_content_size(data) not in (-1, size):
                raise ValueError("zstd announces another size than the chunk")
            # Streamed decompression needs little memory besides its output, if the window is not large.
            if packed and not whole and zstandard.get_frame_parameters(data).window_size <= _WINDOW_LIMIT_BYTES:
                content: bytes | memoryview = self._decompress_stream(offset + length - nbytes, offset + length, size)
            else:
                data = data if whole else self.body(offset, length, Opcode.CHUNK)[at + LONG.size :]
                content = _decompress(data, compression, size)
            if crc and zlib.crc32(content) != crc:
                raise ValueError("the checksum of the chunk is wrong")
        return content

    def _decompress_stream(self, start: int, end: int, size: int) -> memoryview:
        """The zstd frame from byte `start` to `end`, decompressed in small steps."""
        content = memoryview(bytearray(size))
        unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_LIMIT_BYTES)
        at = 0
        with unpacker.stream_reader(cast(IO[bytes], _Range(self, start, end))) as stream:
            while at < size and (count := stream.readinto(content[at:])):
                at += count
            if at < size or stream.read(1):
                raise ValueError(f"{at} bytes or more where {size} are announced")
        return content.toreadonly()

    def chunk(self, index: ChunkIndex) -> bytes | memoryview:
        """`content` of a chunk of the index, of the size that the index gives."""
        content = self.content(index.chunk_start_offset, index.chunk_length)
        if len(content) != index.uncompressed_size:
            raise self.damage_error(index.chunk_start_offset, "the chunk has another size than the index says")
        return content

    def messages_in(self, content: bytes | memoryview, offset: int) -> list[Record]:
        """The messages in the content of the chunk at an offset, in file order."""
        view = memoryview(content)
        found: list[Record] = []
        with self.parsing(offset):
            for opcode, at, length in records_in(content):
                if opcode == Opcode.MESSAGE:
                    if len(found) == MESSAGES_LIMIT:
                        raise ValueError(f"more than {MESSAGES_LIMIT} messages in one chunk")
                    if length < MESSAGE_HEAD.size:
                        raise ValueError(f"a message of {length} bytes")
                    channel, sequence, log_ns, _publish_ns = MESSAGE_HEAD.unpack_from(content, at)
                    if log_ns < self.start_unix_ns:
                        raise ValueError("a message from before the session")
                    payload = view[at + MESSAGE_HEAD.size : at + length]
                    found.append(Record(log_ns - self.start_unix_ns, channel, sequence, payload))
        return found

    def message_times(self, index: ChunkIndex, channel: int) -> list[int] | None:
        """The times on the session clock of a chunk's messages of a channel; None if the file has no index of them."""
        at, nbytes = index.chunk_start_offset + index.chunk_length, index.message_index_length
        if not nbytes or nbytes > _SMALL_LIMIT_BYTES:
            return None
        data = self.read(at, nbytes)
        with self.parsing(at):
            for opcode, begin, length in records_in(data):
                if opcode == Opcode.MESSAGE_INDEX and int.from_bytes(data[begin : begin + 2], "little") == channel:
                    found = MessageIndex.read(stream_of(data[begin : begin + length]))
                    return [log_ns - self.start_unix_ns for log_ns, _ in found.records]
        return None

    def messages(self, index: ChunkIndex) -> list[Record]:
        """All messages of one chunk, in file order."""
        return self.messages_in(self.chunk(index), index.chunk_start_offset)

    def _read_header(self) -> Header:
        if self.size == 0:
            raise ForeignError(f"{self.path}: is empty; nothing was recorded into it")
        if self.read(0, min(self.size, len(MAGIC))) != MAGIC:
            meant = _READ_BY.get(self.path.suffix.lower(), "flowrec reads what `flowrec record` has written")
            raise ForeignError(f"{self.path}: is not an MCAP file; {meant}")
        at = len(MAGIC) + RECORD_HEAD.size
        with self.parsing(len(MAGIC)):
            opcode, length = RECORD_HEAD.unpack(self.read(len(MAGIC), min(self.size - len(MAGIC), RECORD_HEAD.size)))
            if opcode != Opcode.HEADER or length > min(self.size - at, _HEADER_LIMIT_BYTES):
                raise ValueError("no header record")
            header: Header = Header.read(stream_of(self.read(at, length)))
        return header

    def body(self, offset: int, length: int, opcode: Opcode) -> memoryview:
        """The body of a record with that opcode; `length` includes the head of the record."""
        self._check_size(offset, length, opcode)
        data = self.read(offset, length)
        with self.parsing(offset):
            found, size = RECORD_HEAD.unpack_from(data)
            if found != opcode or size != length - RECORD_HEAD.size:
                raise ValueError(f"no {opcode.name.lower()} of {length} bytes here")
        return memoryview(data)[RECORD_HEAD.size :]

    def _check_size(self, offset: int, length: int, opcode: Opcode) -> None:
        limit = _LIMIT_BYTES.get(opcode, _SMALL_LIMIT_BYTES)
        if length > limit:
            raise self.damage_error(offset, f"a {opcode.name.lower()} of {length} bytes, more than {limit}")


class _Range:
    """A range of a file as a stream."""

    def __init__(self, reader: McapReader, start: int, end: int) -> None:
        self._reader, self._at, self._end = reader, start, end

    def read(self, count: int) -> bytes:
        """The next bytes, at most `count`."""
        data = self._reader.read(self._at, min(count, self._end - self._at))
        self._at += len(data)
        return data


def _text(body: memoryview, at: int, nbytes: int) -> tuple[str, int]:
    """Text at a place, and the place after it."""
    if nbytes > len(body) - at:
        raise ValueError(f"a text of {nbytes} bytes where {len(body) - at} are left")
    return str(body[at : at + nbytes], "utf-8"), at + nbytes


def _decompress(data: memoryview, compression: str, size: int) -> bytes | memoryview:
    if compression == "":
        content: bytes | memoryview = data
    elif compression == "zstd":
        # A new one each time: they are cheap, and may not be shared between threads.
        content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""
    else:
        raise ValueError(f"compression {compression!r} is not known to flowrec")
    if len(content) != size:
        raise ValueError(f"{len(content)} bytes where {size} are announced")
    return content
