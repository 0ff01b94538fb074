"""Repetitions at the end of a file, so that few requests open it at a URL and look things up in it.

The lookup record is the last record of the summary section. The index of 10 GB of small images has 3 MB, nearly all of
which is the list of chunks, and the head of a file is at its other end; each would be another request. So the record
repeats the list of chunks, as columns of differences in a tenth of its size, and the records of the head: all that
opens a file is within its last half megabyte. The opcode is one that the specification of MCAP leaves to applications,
so readers of other programs pass over it. The record: CRC-32 of what stands between the list of chunks and the record,
and of the record; then, as zstd: number of chunks, length of a JSON text, that text, eight columns of 64 bits, the
repeated records. The text lists compression and channels of each kind of chunk, and offset and length of the records.

The gathered copies are attachments. Small messages are written between images, twice a second, so that a killed run
keeps them; all poses of a session are then as many ranges. When a file is complete, attachments repeat these ranges
next to each other, 2 % of a file: the chunks of the state, their message indexes, and those of the images. Which ranges
these are follows from the index, and a checksum of them is in the names of the attachments: where another program has
rewritten the file, its copies are of nothing, and are passed over. The bytes are complemented, so that who searches a
damaged file for chunks does not find them twice. The copies are outside the digest.

A file without either is read where its records stand. `check` compares both with what they repeat.
"""

from __future__ import annotations

import bisect
import itertools
import json
import struct
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, ChunkIndex, SummaryOffset

from flowrec.store.byte_source import open_bytes
from flowrec.store.mcap_format import CRC, RECORD_HEAD, Summary, records_in, stream_of

# From 0x80 on, opcodes are free for applications (https://mcap.dev/spec).
LOOKUP_OPCODE = 0xF1
SMALL_BYTES = 1 << 16  # of a record that is repeated; weights of networks are larger
_HEAD = struct.Struct("<QI")  # number of chunks, bytes of the JSON text
_COLUMNS, _ENTRY_BYTES = 8, 8
_LEVEL = 9
_LIMIT_BYTES = 128 << 20

Piece = tuple[int, bytes]  # offset in the file, and the bytes from there on

_PREFIX = "gathered/"
_MEDIA_TYPE = "application/octet-stream"
_PIECE_BYTES = 32 << 20  # of one attachment, which readers of other programs hold in memory
_IMAGES_BYTES, _IMAGES_SHARE = 1 << 20, 4  # with fewer images, or few beside the state, nothing is copied
_OF_IMAGES = "lossless"  # in the metadata of the images' channel alone
_COMPLEMENT = bytes(255 - value for value in range(256))

Range = tuple[int, int]  # offset in the file and number of bytes


def lookup_record(chunks: Sequence[ChunkIndex], pieces: Sequence[Piece], between: bytes) -> bytes:
    """The record of a list of chunks and of pieces of the head; `between` stands between that list and the record."""
    kinds: dict[tuple[str, tuple[int, ...]], int] = {}
    rows = []
    last_ns = end = 0
    for chunk in chunks:
        kind = kinds.setdefault((chunk.compression, tuple(chunk.message_index_offsets)), len(kinds))
        first_ns, start, length = chunk.message_start_time, chunk.chunk_start_offset, chunk.chunk_length
        lasts_ns, besides = chunk.message_end_time - first_ns, length - chunk.compressed_size
        index_bytes, size = chunk.message_index_length, chunk.uncompressed_size
        rows.append((first_ns - last_ns, lasts_ns, start - end, length, index_bytes, besides, size, kind))
        last_ns, end = first_ns, start + length + index_bytes
    text = json.dumps([list(kinds), [(at, len(data)) for at, data in pieces]]).encode()
    columns = b"".join(array("q", column).tobytes() for column in zip(*rows, strict=True))
    content = b"".join((_HEAD.pack(len(rows), len(text)), text, columns, *(data for _, data in pieces)))
    body = zstandard.ZstdCompressor(level=_LEVEL).compress(content)
    body = CRC.pack(zlib.crc32(body, zlib.crc32(between))) + body
    return RECORD_HEAD.pack(LOOKUP_OPCODE, len(body)) + body


def place_of_lookup(offsets: bytes, summary_at: int, footer_at: int) -> tuple[int, int, int] | None:
    """Begin of what follows the list of chunks, offset and length of the lookup record; None where there is none.

    Parameters
    ----------
    offsets : the summary offset section.
    summary_at, footer_at : begin of the summary section, and of the footer.

    Raises
    ------
    ValueError, struct.error, mcap.exceptions.McapError : it is damaged.
    """
    groups = [SummaryOffset.read(stream_of(offsets[at : at + length])) for _, at, length in records_in(offsets)]
    places = {group.group_opcode: (group.group_start, group.group_length) for group in groups}
    if LOOKUP_OPCODE not in places:
        return None
    begin = sum(places.get(Opcode.CHUNK_INDEX, (summary_at, 0)))
    at, nbytes = places[LOOKUP_OPCODE]
    if not footer_at - _LIMIT_BYTES < begin <= at <= at + nbytes <= footer_at:
        raise ValueError("the groups of the index are not where it says")
    return begin, at, nbytes


def parse_lookup(body: bytes, between: bytes, data_end: int) -> tuple[list[ChunkIndex], list[Piece]]:
    """The chunks and the pieces that a record repeats.

    Raises
    ------
    ValueError, TypeError, struct.error, zstandard.ZstdError : it is damaged, or lists what is not in `data_end` bytes.
    """
    (crc,) = CRC.unpack_from(body)
    data = body[CRC.size :]
    if zlib.crc32(data, zlib.crc32(between)) != crc:
        raise ValueError("the checksum of the lookup record is wrong")
    if not 0 < zstandard.frame_content_size(data) <= _LIMIT_BYTES:
        raise ValueError("a lookup record of another size than can be")
    content = zstandard.ZstdDecompressor().decompress(data)
    count, text_bytes = _HEAD.unpack_from(content)
    begin = _HEAD.size + text_bytes
    end = begin + count * _COLUMNS * _ENTRY_BYTES
    kinds, places = json.loads(content[_HEAD.size : begin])
    ends = list(itertools.accumulate((length for _, length in places), initial=end))
    if ends[-1] != len(content) or any(length < 0 for _, length in places):
        raise ValueError("a lookup record of another length than announced")
    pieces = [(at, content[ends[number] : ends[number + 1]]) for number, (at, _) in enumerate(places)]
    values = array("q", content[begin:end])
    columns = (values[number * count : (number + 1) * count] for number in range(_COLUMNS))
    return _chunks(zip(*columns, strict=True), kinds, data_end), pieces


def _chunks(rows: Iterable[tuple[int, ...]], kinds: Sequence[tuple[str, list[int]]], data_end: int) -> list[ChunkIndex]:
    shared = [(str(name), dict.fromkeys(map(int, channels), 0)) for name, channels in kinds]
    found = []
    begin_ns = end = listed_bytes = 0
    for first_ns, lasts_ns, gap, length, index_bytes, besides, size, kind in rows:
        begin_ns, start = begin_ns + first_ns, end + gap
        end = start + length + index_bytes
        listed_bytes += length
        if min(begin_ns, lasts_ns, start, index_bytes, length - 1, size, kind) < 0 or listed_bytes > data_end:
            raise ValueError("the chunks that are listed do not fit into the file")
        name, channels = shared[kind]
        ends_ns, packed = begin_ns + lasts_ns, length - besides
        found.append(ChunkIndex(length, start, name, packed, ends_ns, index_bytes, channels, begin_ns, size))
    return found


def is_copy(attachment: str) -> bool:
    """True if an attachment of this name holds copies."""
    return attachment.startswith(_PREFIX)


class GatheredCopies:
    """Places of the copies in a file; none where it has none, or other ones than its index tells.

    `pieces`: ranges that are copied, and the offset of the first copy, by attachment.
    """

    def __init__(self, listed: Summary) -> None:
        places = sorted((each for each in listed.attachments if is_copy(each.name)), key=lambda each: each.offset)
        self.pieces: list[tuple[list[Range], int]] = []
        if places:
            expected = list(_pieces(_ranges(listed)))
            described = [(name, _size(ranges)) for name, ranges in expected]
            if described == [(each.name, each.data_size) for each in places]:
                begins = (each.offset + each.length - CRC.size - each.data_size for each in places)
                self.pieces = [(ranges, begin) for (_, ranges), begin in zip(expected, begins, strict=True)]
        self._places = sorted(
            (offset, offset + length, at)
            for ranges, begin in self.pieces
            for (offset, length), at in zip(ranges, _starts(ranges, begin), strict=False)
        )

    def place_of(self, offset: int, length: int) -> int | None:
        """The offset of the copy of a range; None where there is none."""
        number = bisect.bisect_right(self._places, (offset, 1 << 63, 0)) - 1
        if number < 0:
            return None
        first, end, at = self._places[number]
        return at + offset - first if offset + length <= end else None

    def wrong(self, read: Callable[[int, int], bytes]) -> int:
        """Number of ranges that differ from their copies.

        `read`: reads the file where its records stand, by offset and length.
        """
        wrong = 0
        for ranges, begin in self.pieces:
            copies = read(begin, _size(ranges))
            for (offset, length), at in zip(ranges, _starts(ranges, 0), strict=False):
                wrong += read(offset, length) != complement(copies[at : at + length])
        return wrong


def complement(data: bytes) -> bytes:
    """Bytes of a copy from those of the file, and back."""
    return data.translate(_COMPLEMENT)


def gather(path: Path, listed: Summary, start_unix_ns: int) -> Iterator[Attachment]:
    """The copies of a file that holds all but them, its digest and its index.

    Raises SessionError: the file can not be read back.

    Parameters
    ----------
    listed : its index, with Unix times.
    start_unix_ns : Unix time of stamp 0.
    """
    with open_bytes(path) as source:
        for name, ranges in _pieces(_ranges(listed)):
            data = b"".join(complement(source.read(offset, length)) for offset, length in ranges)
            yield Attachment(start_unix_ns, start_unix_ns, name, _MEDIA_TYPE, data)


def _ranges(listed: Summary) -> list[Range]:
    """The ranges that lookups read, in the order of their copies; none where there are few images."""
    frames = {number for number, channel in listed.channels.items() if _OF_IMAGES in channel.metadata}
    views = {number for number, channel in listed.channels.items() if channel.metadata.get("role") == "view"}
    state: list[Range] = []
    indexes: list[Range] = []
    of_frames: list[Range] = []
    images_bytes = 0
    for chunk in listed.chunks:
        inside = chunk.message_index_offsets.keys()
        if not inside or not views.isdisjoint(inside):
            continue
        index = (chunk.chunk_start_offset + chunk.chunk_length, chunk.message_index_length)
        if inside <= frames:
            of_frames.append(index)
            images_bytes += chunk.chunk_length
        else:
            state.append((chunk.chunk_start_offset, chunk.chunk_length))
            indexes.append(index)
    if images_bytes < max(_IMAGES_BYTES, _IMAGES_SHARE * _size(state)):
        return []
    return [*state, *indexes, *of_frames]


def _pieces(ranges: list[Range]) -> Iterator[tuple[str, list[Range]]]:
    """Name of each attachment and the ranges in it."""
    code = zlib.crc32(struct.pack(f"<{2 * len(ranges)}Q", *itertools.chain(*ranges)))
    number = begin = nbytes = 0
    for place, (_, length) in enumerate(ranges):
        if nbytes and nbytes + length > _PIECE_BYTES:
            yield f"{_PREFIX}{number:03d}-{code:08x}", ranges[begin:place]
            number, begin, nbytes = number + 1, place, 0
        nbytes += length
    if ranges:
        yield f"{_PREFIX}{number:03d}-{code:08x}", ranges[begin:]


def _starts(ranges: list[Range], begin: int) -> Iterator[int]:
    return itertools.accumulate((length for _, length in ranges), initial=begin)


def _size(ranges: list[Range]) -> int:
    return sum(length for _, length in ranges)
