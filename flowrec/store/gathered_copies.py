"""Copies of what lookups read, gathered at the end of a file: at a URL one request reads what takes hundreds elsewhere.

Small messages are written between images, twice a second, so that a killed run keeps them; all poses of a session are
then as many ranges. When a file is complete, attachments repeat these ranges next to each other, 2 % of a file: the
chunks of the state, their message indexes, and those of the images. Which ranges these are follows from the index, and
a checksum of them is in the names of the attachments: where another program has rewritten the file, its copies are of
nothing, and are passed over.

The bytes are complemented, so that who searches a damaged file for chunks does not find them twice. The copies are
outside the digest; a file without them is read where its records stand. `check` compares them with the records.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.records import Attachment

from flowrec.store.byte_source import open_bytes
from flowrec.store.mcap_format import CRC, Summary

_PREFIX = "gathered/"
_MEDIA_TYPE = "application/octet-stream"
_PIECE_BYTES = 32 << 20  # of one attachment, which readers of other programs hold in memory
_IMAGES_BYTES, _IMAGES_SHARE = 1 << 20, 4  # fewer images, or few beside the state, are no obstacle
_OF_IMAGES = "lossless"  # in the metadata of the images' channel alone
_COMPLEMENT = bytes(255 - value for value in range(256))

Range = tuple[int, int]  # offset in the file and number of bytes


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
    with contextlib.closing(open_bytes(path)) as source:
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
