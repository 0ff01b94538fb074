"""The last record of the summary section: all that opens a file at a URL, within the last half megabyte of the file.

The index of 10 GB of small images has 3 MB, nearly all of which is the list of chunks, and the head of a file is at its
other end; each would be another request. So the last record of the summary repeats the list of chunks, as columns of
differences in a tenth of its size, and the records of the head. Its opcode is one that the specification of MCAP leaves
to applications, so readers of other programs pass over it. `check` compares it with what it repeats.

The record: CRC-32 of what stands between the list of chunks and the record, and of the record; then, as zstd: number of
chunks, length of a JSON text, that text, eight columns of 64 bits, the repeated records. The text lists compression and
channels of each kind of chunk, and offset and length of the records.
"""

from __future__ import annotations

import itertools
import json
import struct
import zlib
from array import array
from collections.abc import Iterable, Sequence

import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, SummaryOffset

from flowrec.store.mcap_format import CRC, RECORD_HEAD, records_in, stream_of

# From 0x80 on, opcodes are free for applications (https://mcap.dev/spec).
LOOKUP_OPCODE = 0xF1
SMALL_BYTES = 1 << 16  # of a record that is repeated; weights of networks are larger
_HEAD = struct.Struct("<QI")  # number of chunks, bytes of the JSON text
_COLUMNS, _ENTRY_BYTES = 8, 8
_LEVEL = 9
_LIMIT_BYTES = 128 << 20

Piece = tuple[int, bytes]  # offset in the file, and the bytes from there on


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
