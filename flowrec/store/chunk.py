"""One MCAP chunk being filled: messages of one group, compressed together when it is sealed."""

from __future__ import annotations

import struct
import zlib

import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, MessageIndex

from flowrec.store.form import Payload

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FIXED_PART = 22  # bytes of a message record besides its payload
# Noise does not compress: level 1 gets the same 1.2 to 1.6 of a camera image as higher ones, five times quicker.
_ZSTD_LEVEL = 1


class ChunkBuilder:
    """Collects messages in order of time; `seal` empties it."""

    def __init__(self) -> None:
        self.size = 0  # bytes before compression
        self._parts: list[bytes | memoryview] = []
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._first_ns = self._last_ns = 0
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, payload: Payload) -> None:
        """Append one message; its payload must not change before the chunk is sealed."""
        if not self._parts:
            self._first_ns = log_ns
        self._last_ns = log_ns
        self._index.setdefault(channel, []).append((log_ns, self.size))
        length = _FIXED_PART + sum(map(len, payload))
        self._parts.append(_MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel, sequence, log_ns, publish_ns))
        self._parts.extend(payload)
        self.size += 9 + length

    def seal(self) -> tuple[Chunk, list[MessageIndex]]:
        """The finished chunk with the index of each channel; the interpreter is free while it is compressed."""
        content = b"".join(self._parts)
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(content),
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        indexes = [MessageIndex(channel, records) for channel, records in self._index.items()]
        self.size, self._parts, self._index = 0, [], {}
        return chunk, indexes
