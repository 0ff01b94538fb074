"""An MCAP file open for reading: checked, bounded reads; the only place that trusts nothing in the file.

mcap's own reader believes the sizes that a file declares (a file of 32 kB can then cost 1 GiB and minutes) and lets
errors of several libraries escape. Here every size is checked before it is used and every error is a SessionError.
"""

from __future__ import annotations

import contextlib
import os
import struct
import weakref
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple, cast

import zstandard
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Footer, Header, Metadata, MetadataIndex

from flowrec.errors import SessionError
from flowrec.store.mcap_index import Summary, records_of, stream_of, summary_from
from flowrec.store.mcap_writer import MAGIC

if TYPE_CHECKING:
    from flowrec.declarations import Message

# Of one chunk before compression: a flow field on 1900 x 1900 pixels. What a tick knows, such a chunk on its way into
# the next tick, and an image on its way are what reading needs at most: with the program itself less than 512 MB.
CHUNK_LIMIT_BYTES = 72 << 20
# Above so many bytes a chunk must have taken at least a thousandth of them: noise, flow and text never pack better.
_FREE_BYTES, _RATIO_LIMIT = 16 << 20, 1000
# What is read of a compressed chunk at a time, and how far back zstd may look; ours look back half a megabyte.
_AT_ONCE_BYTES, _WINDOW_LIMIT_BYTES = 8 << 20, 8 << 20
MESSAGES_LIMIT = 1 << 17  # held as objects at a time, some 400 bytes each
_HEADER_LIMIT_BYTES = 1 << 16
_SUMMARY_LIMIT_BYTES = 256 << 20  # a day of three chunks every half second needs half of it
_SMALL_LIMIT_BYTES = 4 << 20  # one record of metadata, schema or channel
_ATTACHMENT_LIMIT_BYTES = 256 << 20
RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, size and checksum of the content, length of the name
_ATTACHMENT_HEAD = struct.Struct("<QQI")  # log and create time, length of the name
_FOOTER_BYTES = 9 + 20
_LONG, _CRC = struct.Struct("<Q"), struct.Struct("<I")

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


class ForeignError(SessionError):
    """An MCAP file, or none at all, that flowrec has not written."""


class UnfinishedError(SessionError):
    """The end of the file is missing: the run was killed, goes on, or the file is cut off."""


class DamageError(SessionError):
    """Bytes that make no sense; `what` says where and why, without advice."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}; `flowrec recover {path}` saves what is whole")
        self.what = what


class Record(NamedTuple):
    """One message as it lies in a chunk, `log_ns` on the session clock."""

    log_ns: int
    channel: int
    sequence: int
    payload: memoryview | Message  # a message where it has been decoded already


class AttachmentBody(NamedTuple):
    """One attachment as it lies in the file."""

    log_ns: int
    create_ns: int
    name: str
    media_type: str
    data: memoryview


class Source:
    """A finished MCAP file. Reads are independent of each other and may come from several threads.

    Attributes
    ----------
    start_unix_ns : of the session (header.py), as soon as somebody has read it; log times are told less by it.

    Raises
    ------
    SessionError : on opening or reading, whatever is wrong with the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start_unix_ns = 0
        if path.is_dir():
            raise SessionError(f"{path}: is a directory, not a session; name a .mcap file in it (`flowrec ls {path}`)")
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except FileNotFoundError as error:
            raise SessionError(f"{path}: no such file; `flowrec ls {path.parent}` shows the sessions there") from error
        except ValueError as error:  # a name with a NUL, which only another file can have given
            raise SessionError(f"{path}: is not the name of a file") from error
        except OSError as error:
            raise SessionError(f"{path}: can not be opened ({error.strerror}); check its permissions") from error
        self.close = weakref.finalize(self, os.close, self._descriptor)
        try:
            self.size = os.fstat(self._descriptor).st_size
            self.header = self._read_header()
        except BaseException:
            self.close()
            raise

    def start_at(self, unix_ns: int) -> None:
        """Set `start_unix_ns`.

        Raises
        ------
        ValueError : it is no time.
        """
        if unix_ns >= 1 << 63:
            raise ValueError(f"a session that starts at {unix_ns} ns of Unix time")
        self.start_unix_ns = unix_ns

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
        """The summary section, checksum verified; nothing in it lies outside the file or over something else."""
        tail = self.read(max(0, self.size - _FOOTER_BYTES - len(MAGIC)), min(self.size, _FOOTER_BYTES + len(MAGIC)))
        if not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER or len(tail) != _FOOTER_BYTES + len(MAGIC):
            raise UnfinishedError(
                f"{self.path}: was not finished (the run was killed, or the file is cut off);"
                f" `flowrec recover {self.path}` makes a whole session of it"
            )
        footer_at = self.size - len(tail)
        with self.parsing(footer_at):
            footer = Footer.read(stream_of(tail[9:]))
        if footer.summary_start == 0:
            raise UnfinishedError(f"{self.path}: has no index; `flowrec recover {self.path}` makes one")
        start = footer.summary_start
        if footer_at - start > _SUMMARY_LIMIT_BYTES:
            raise self.damaged(start, f"an index of {footer_at - start} bytes, more than {_SUMMARY_LIMIT_BYTES}")
        data = self.read(start, footer_at - start)
        if footer.summary_crc and zlib.crc32(tail[: _FOOTER_BYTES - 4], zlib.crc32(data)) != footer.summary_crc:
            raise self.damaged(start, "the checksum of the index is wrong")
        with self.parsing(start):
            return summary_from(data, len(MAGIC), start)

    def metadata(self, index: MetadataIndex) -> dict[str, str]:
        """One metadata record."""
        body = self.body(index.offset, index.length, Opcode.METADATA)
        with self.parsing(index.offset):
            record: Metadata = Metadata.read(stream_of(body))
        return dict(record.metadata)

    def attachment(self, index: AttachmentIndex) -> bytes:
        """The content of one attachment, checksum verified."""
        found = self.attachment_at(index.offset, index.length)
        if len(found.data) != index.data_size or found.name != index.name:
            raise self.damaged(index.offset, f"{found.name!r} is not what the index tells of it")
        return bytes(found.data)

    def attachment_at(self, offset: int, length: int) -> AttachmentBody:
        """One attachment, checksum verified."""
        body = self.body(offset, length, Opcode.ATTACHMENT)
        with self.parsing(offset):
            log_ns, create_ns, name_bytes = _ATTACHMENT_HEAD.unpack_from(body)
            name, at = _text(body, _ATTACHMENT_HEAD.size, name_bytes)
            media_type, at = _text(body, at + 4, *_CRC.unpack_from(body, at))
            (size,) = _LONG.unpack_from(body, at)
            data, at = body[at + 8 : at + 8 + size], at + 8 + size
            if at + 4 != len(body):
                raise ValueError(f"{name!r} is not as long as announced")
            (crc,) = _CRC.unpack_from(body, at)
            if crc and zlib.crc32(body[:at]) != crc:
                raise ValueError(f"the checksum of {name!r} is wrong")
        return AttachmentBody(log_ns, create_ns, name, media_type, data)

    def content(self, offset: int, length: int) -> bytes | memoryview:
        """What is in a chunk: decompressed within our limits, whatever it announces; checksum verified."""
        self._check_size(offset, length, Opcode.CHUNK)
        whole = length <= _AT_ONCE_BYTES
        body = self.body(offset, length, Opcode.CHUNK) if whole else memoryview(self.read(offset, _AT_ONCE_BYTES))[9:]
        with self.parsing(offset):
            _, _, size, crc, name_bytes = _CHUNK_HEAD.unpack_from(body)
            compression, at = _text(body, _CHUNK_HEAD.size, name_bytes)
            begin = at + _LONG.size
            if _LONG.unpack_from(body, at)[0] != length - RECORD_HEAD.size - begin:
                raise ValueError("the chunk is not as long as announced")
            if not whole and _can_be_streamed(body[begin:], compression):
                content: bytes | memoryview = self._streamed(
                    offset + RECORD_HEAD.size + begin, offset + length, body[begin:], size
                )
            else:
                body = body if whole else self.body(offset, length, Opcode.CHUNK)
                content = _decompressed(body[begin:], compression, size)
            if crc and zlib.crc32(content) != crc:
                raise ValueError("the checksum of the chunk is wrong")
        return content

    def _streamed(self, start: int, end: int, begin: memoryview, size: int) -> memoryview:
        """What zstd has packed into the bytes from `start` to `end`, of which `begin` are the first: piece by piece."""
        _refuse_bomb(size, end - start)
        _refuse_other_size(begin, size)
        content = memoryview(bytearray(size))
        unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_LIMIT_BYTES)
        at = 0
        with unpacker.stream_reader(cast(IO[bytes], _Pieces(self, start, end))) as stream:
            while at < size and (count := stream.readinto(content[at:])):
                at += count
            if at < size or stream.read(1):
                raise ValueError(f"{at} bytes or more where {size} are announced")
        return content.toreadonly()

    def chunk(self, index: ChunkIndex) -> bytes | memoryview:
        """`content` of a chunk of the index, of the size that the index tells."""
        content = self.content(index.chunk_start_offset, index.chunk_length)
        if len(content) != index.uncompressed_size:
            raise self.damaged(index.chunk_start_offset, "the chunk has another size than the index tells")
        return content

    def messages_in(self, content: bytes | memoryview, offset: int) -> list[Record]:
        """The messages in the content of the chunk at an offset, in file order."""
        view = memoryview(content)
        found: list[Record] = []
        with self.parsing(offset):
            for opcode, at, length in records_of(content):
                if opcode == Opcode.MESSAGE:
                    if len(found) == MESSAGES_LIMIT:
                        raise ValueError(f"more than {MESSAGES_LIMIT} messages in one chunk")
                    if length < _MESSAGE_HEAD.size:
                        raise ValueError(f"a message of {length} bytes")
                    channel, sequence, log_ns, _publish_ns = _MESSAGE_HEAD.unpack_from(content, at)
                    if log_ns < self.start_unix_ns:
                        raise ValueError("a message from before the session")
                    payload = view[at + _MESSAGE_HEAD.size : at + length]
                    found.append(Record(log_ns - self.start_unix_ns, channel, sequence, payload))
        return found

    def messages(self, index: ChunkIndex) -> list[Record]:
        """All messages of one chunk, in file order."""
        return self.messages_in(self.chunk(index), index.chunk_start_offset)

    def _read_header(self) -> Header:
        if self.size == 0:
            raise ForeignError(f"{self.path}: is empty; nothing was recorded into it")
        if self.read(0, min(self.size, len(MAGIC))) != MAGIC:
            raise ForeignError(f"{self.path}: is not an MCAP file; flowrec reads what `flowrec record` has written")
        data = self.read(len(MAGIC), min(self.size - len(MAGIC), _HEADER_LIMIT_BYTES))
        with self.parsing(len(MAGIC)):
            opcode, length = RECORD_HEAD.unpack_from(data)
            if opcode != Opcode.HEADER or length > len(data) - RECORD_HEAD.size:
                raise ValueError("no header record")
            header: Header = Header.read(stream_of(data[RECORD_HEAD.size :][:length]))
        return header

    def body(self, offset: int, length: int, opcode: Opcode) -> memoryview:
        """What follows the head of a record of that kind and whole length."""
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
            raise self.damaged(offset, f"a {opcode.name.lower()} of {length} bytes, more than {limit}")

    def record(self, offset: int, length: int, opcode: Opcode, parse: Callable[..., Any]) -> Any:
        """One small record of that kind and whole length, parsed."""
        body = self.body(offset, length, opcode)
        with self.parsing(offset):
            return parse(stream_of(body))


class _Pieces:
    """Bytes of a file, read when they are asked for."""

    def __init__(self, source: Source, start: int, end: int) -> None:
        self._source, self._at, self._end = source, start, end

    def read(self, count: int) -> bytes:
        """The next bytes, at most so many."""
        data = self._source.read(self._at, min(count, self._end - self._at))
        self._at += len(data)
        return data


_LIMIT_BYTES = {Opcode.CHUNK: CHUNK_LIMIT_BYTES + (1 << 16), Opcode.ATTACHMENT: _ATTACHMENT_LIMIT_BYTES}


def _text(body: memoryview, at: int, nbytes: int) -> tuple[str, int]:
    """Text at a place, and the place after it."""
    if nbytes > len(body) - at:
        raise ValueError(f"a text of {nbytes} bytes where {len(body) - at} are left")
    return str(body[at : at + nbytes], "utf-8"), at + nbytes


def _refuse_bomb(size: int, nbytes: int) -> None:
    if size > CHUNK_LIMIT_BYTES:
        raise ValueError(f"a chunk of {size} bytes, more than {CHUNK_LIMIT_BYTES}")
    if size > _FREE_BYTES and size > _RATIO_LIMIT * nbytes:
        raise ValueError(f"a chunk that unpacks {nbytes} bytes to {size}")


def _refuse_other_size(data: memoryview, size: int) -> None:
    # The size in zstd's own header is what the library allocates, whatever limit it is given.
    if zstandard.frame_content_size(data) not in (-1, size):
        raise ValueError("zstd announces another size than the chunk")


def _can_be_streamed(begin: memoryview, compression: str) -> bool:
    """Whether unpacking piece by piece needs little memory besides what comes out."""
    return compression == "zstd" and zstandard.get_frame_parameters(begin).window_size <= _WINDOW_LIMIT_BYTES


def _decompressed(data: memoryview, compression: str, size: int) -> bytes | memoryview:
    _refuse_bomb(size, len(data))
    if compression == "":
        content: bytes | memoryview = data
    elif compression == "zstd":
        _refuse_other_size(data, size)
        # A new one each time: they are cheap, and may not be shared between threads.
        content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""
    else:
        raise ValueError(f"compression {compression!r} is not known to flowrec")
    if len(content) != size:
        raise ValueError(f"{len(content)} bytes where {size} are announced")
    return content
