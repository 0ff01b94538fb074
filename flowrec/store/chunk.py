"""One MCAP chunk being filled: messages of one group, sealed together."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import zstandard
from mcap.opcode import Opcode

from flowrec.store.digest import added, of_message
from flowrec.store.form import Payload

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FIXED_PART = 22  # bytes of a message record besides its payload
# Noise does not compress: level 1 gets the same 1.2 to 1.6 of a camera image as higher ones, five times quicker.
_ZSTD_LEVEL = 1
_INDEX_HEAD = struct.Struct("<BQHI")  # opcode, length, channel, bytes of the entries
_KEPT_BYTES = 32 << 20  # of memory from chunk to chunk
_LARGE_BYTES = 1 << 16  # from here on numpy copies, which leaves the interpreter free meanwhile


@dataclass(frozen=True, slots=True)
class ChannelIndex:
    """Where the messages of one channel are in a chunk: log time and offset in turn; and their digest (digest.py)."""

    channel: int
    entries: array[int]
    digest: int

    def __len__(self) -> int:
        return len(self.entries) // 2

    def record(self) -> bytes:
        """As an MCAP MessageIndex; mcap's own takes 4 us for each message."""
        data = np.array(self.entries, "<u8").tobytes()
        length = _INDEX_HEAD.size - 9 + len(data)
        return _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, length, self.channel, len(data)) + data


@dataclass(frozen=True, slots=True)
class Sealed:
    """What goes into one chunk record, as `mcap.records.Chunk`, and the indexes that follow it.

    `data` may lie in the builder's memory: it is to be written, or `kept`, before the builder is used again.
    """

    compression: str
    data: bytes | memoryview
    message_start_time: int
    message_end_time: int
    uncompressed_crc: int
    uncompressed_size: int
    indexes: list[ChannelIndex]


def kept(sealed: Iterable[Sealed]) -> list[Sealed]:
    """Chunks whose bytes are their own."""
    return [replace(chunk, data=bytes(chunk.data)) for chunk in sealed]


class ChunkBuilder:
    """Collects messages in order of time; `seal` empties it.

    The memory is kept from chunk to chunk: a new one for each image costs as much as copying the image.

    Parameters
    ----------
    compressed : with zstd; otherwise the chunk is stored as it is, for what is compressed already.
    """

    def __init__(self, *, compressed: bool = True) -> None:
        self.size = 0  # bytes before compression
        self._memory = bytearray(1 << 18)
        self._index: dict[int, array[int]] = {}
        self._digests: dict[int, int] = {}
        self._first_ns = self._last_ns = 0
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL) if compressed else None

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, payload: Payload) -> None:
        """Append a copy of one message."""
        if not self.size:
            self._first_ns = log_ns
        self._last_ns = log_ns
        index = self._index.get(channel)
        if index is None:
            index = self._index[channel] = array("Q")
        index.extend((log_ns, self.size))
        length = _FIXED_PART + sum(map(len, payload))
        end = self.size + 9 + length
        if end > len(self._memory):
            # A new one, with the old content: the growth of a bytearray would refuse while somebody looks at it.
            grown = bytearray(end + min(end, _KEPT_BYTES) // 4)
            grown[: self.size] = memoryview(self._memory)[: self.size]
            self._memory = grown
        _MESSAGE_HEAD.pack_into(self._memory, self.size, Opcode.MESSAGE, length, channel, sequence, log_ns, publish_ns)
        at = self.size + _MESSAGE_HEAD.size
        for part in payload:
            if len(part) < _LARGE_BYTES:
                self._memory[at : at + len(part)] = part
            else:
                np.copyto(np.frombuffer(self._memory, np.uint8, len(part), at), np.frombuffer(part, np.uint8))
            at += len(part)
        content = memoryview(self._memory)[self.size + _MESSAGE_HEAD.size : end]
        self._digests[channel] = added(self._digests.get(channel, 0), of_message(sequence, log_ns, content))
        self.size = end

    def seal(self) -> Sealed:
        """The finished chunk; the interpreter is free while it is compressed."""
        content = memoryview(self._memory)[: self.size]
        sealed = Sealed(
            compression="zstd" if self._compressor else "",
            data=self._compressor.compress(content) if self._compressor else content,
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=self.size,
            indexes=[
                ChannelIndex(channel, entries, self._digests[channel]) for channel, entries in self._index.items()
            ],
        )
        self.size, self._index, self._digests = 0, {}, {}
        if len(self._memory) > _KEPT_BYTES and self._compressor:
            self._memory = bytearray(1 << 18)  # a flow field comes once a minute
        return sealed
