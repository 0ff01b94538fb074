"""Messages of ticks -> sealed MCAP chunks: encoding, grouping and compression. Knows neither file nor thread.

The messages of a group (channels.py) are collected in one chunk, the unit of compression and of reading.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from operator import attrgetter

import numpy as np
import zstandard
from mcap.opcode import Opcode

from flowrec.core import FIXED, Frame, SessionError, TopicTable
from flowrec.store.channels import FRAMES, GROUPS, STATE, VIEW, slots_of
from flowrec.store.codec import Encoded, Payload, encode_record
from flowrec.store.digest import message_digest
from flowrec.store.frame_encodings import FrameEncoding
from flowrec.store.mcap_format import CHUNK_LIMIT_BYTES, MESSAGE_HEAD, RECORD_HEAD, ChannelIndex, SealedChunk
from flowrec.store.roi import WindowCutter
from flowrec.store.write_queue import Entry

_CHUNK_BYTES = {FRAMES: 1 << 20, STATE: 1 << 18, VIEW: 1 << 18}  # a chunk is sealed beyond
# A message must leave room in the largest chunk that is read for what surrounds it.
_MESSAGE_LIMIT_BYTES = CHUNK_LIMIT_BYTES - (1 << 20)
# Noise does not compress: level 1 gets the same 1.2 to 1.6 of a camera image as higher ones, five times quicker.
_ZSTD_LEVEL = 1
_INDEX_HEAD = struct.Struct("<HI")  # channel, bytes of the entries
_MEMORY_BYTES = 1 << 18  # of a new chunk
_REUSED_BYTES = 32 << 20  # larger memory is released after a chunk
_LARGE_BYTES = 1 << 16  # numpy copies larger parts, because it releases the interpreter lock

_size_of = attrgetter("size")
Sink = Callable[[list[SealedChunk]], None]


def copy_chunks(chunks: Iterable[SealedChunk]) -> list[SealedChunk]:
    """Chunks that own their bytes."""
    return [replace(chunk, data=bytes(chunk.data)) for chunk in chunks]


class MessageIndexes:
    """Places and digests of the messages of a chunk, by channel; all times are those in the file."""

    def __init__(self) -> None:
        self._entries: dict[int, array[int]] = {}
        self._digests: Counter[int] = Counter()

    def add(self, channel: int, sequence: int, log_ns: int, at: int, payload: memoryview) -> None:
        """Enter a message that begins at a byte of the content."""
        entries = self._entries.get(channel)
        if entries is None:
            entries = self._entries[channel] = array("Q")
        entries.extend((log_ns, at))  # as in a MessageIndex
        self._digests[channel] += message_digest(sequence, log_ns, payload)

    def channel_indexes(self) -> list[ChannelIndex]:
        """The indexes with their MessageIndex records; mcap's own records take 4 us for each message."""
        found = []
        for channel, entries in self._entries.items():
            data = np.array(entries, "<u8").tobytes()
            body = _INDEX_HEAD.pack(channel, len(data)) + data
            record = RECORD_HEAD.pack(Opcode.MESSAGE_INDEX, len(body)) + body
            found.append(ChannelIndex(channel, len(entries) // 2, self._digests[channel], record))
        return found


class ChunkBuilder:
    """Collects messages in order of time; `seal` empties it.

    The memory is reused from chunk to chunk: a new one for each image costs as much as copying the image. `compressed`:
    with zstd; otherwise the chunk is stored as it is, for content that is compressed already.
    """

    def __init__(self, *, compressed: bool = True) -> None:
        self.size = 0  # bytes before compression
        self._memory = bytearray(_MEMORY_BYTES)
        self._indexes = MessageIndexes()
        self._first_ns = self._last_ns = 0
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL) if compressed else None

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, payload: Payload) -> None:
        """Append a copy of one message."""
        if not self.size:
            self._first_ns = log_ns
        self._last_ns = log_ns
        body_at = self.size + RECORD_HEAD.size
        payload_at = body_at + MESSAGE_HEAD.size
        end = payload_at + sum(map(len, payload))
        if end > len(self._memory):
            # A new buffer with the old content: a bytearray can not grow while a view of it exists.
            grown = bytearray(end + min(end, _REUSED_BYTES) // 4)
            grown[: self.size] = memoryview(self._memory)[: self.size]
            self._memory = grown
        RECORD_HEAD.pack_into(self._memory, self.size, Opcode.MESSAGE, end - body_at)
        MESSAGE_HEAD.pack_into(self._memory, body_at, channel, sequence, log_ns, publish_ns)
        at = payload_at
        for part in payload:
            if len(part) < _LARGE_BYTES:
                self._memory[at : at + len(part)] = part
            else:
                np.copyto(np.frombuffer(self._memory, np.uint8, len(part), at), np.frombuffer(part, np.uint8))
            at += len(part)
        self._indexes.add(channel, sequence, log_ns, self.size, memoryview(self._memory)[payload_at:end])
        self.size = end

    def seal(self) -> SealedChunk:
        """The finished chunk; the interpreter lock is released while it is compressed."""
        content = memoryview(self._memory)[: self.size]
        chunk = SealedChunk(
            compression="zstd" if self._compressor else "",
            data=self._compressor.compress(content) if self._compressor else content,
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=self.size,
            indexes=self._indexes.channel_indexes(),
        )
        self.size, self._indexes = 0, MessageIndexes()
        if len(self._memory) > _REUSED_BYTES and self._compressor:
            self._memory = bytearray(_MEMORY_BYTES)  # a flow field comes once a minute
        return chunk


class ChunkEncoder:
    """Collects the messages of ticks in chunks by group, and encodes their images.

    Parameters
    ----------
    encoding : of the frames.
    sink : receives sealed chunks and must not keep views of them after it returns. May be replaced between calls.
    start_unix_ns : Unix time of stamp 0, which is added to all times that MCAP and foxglove's schemas hold.
    topics : those of the run.

    Attributes
    ----------
    start_unix_ns : may be set before anything is added.
    sequences : the next sequence number by topic, for topics whose messages do not give their own.
    """

    def __init__(self, encoding: FrameEncoding, sink: Sink, start_unix_ns: int, topics: TopicTable = FIXED) -> None:
        self.sink = sink
        self.sequences: Counter[str] = Counter()
        self.start_unix_ns = start_unix_ns
        self._encoding = encoding
        self._cutter = WindowCutter()
        self._topics, self._slots = topics.by_field, slots_of(topics)
        self._builders = {
            group: ChunkBuilder(compressed=encoding.compressed_chunks or group != FRAMES) for group in GROUPS
        }

    @property
    def size(self) -> int:
        """Bytes in chunks that are not sealed yet, before compression."""
        return sum(map(_size_of, self._builders.values()))

    def add(self, entry: Entry) -> None:
        """Take the messages of one tick; pass full chunks to `sink`.

        Raises SessionError: an image that can not be encoded; and what `sink` raises.
        """
        for field, message in entry.messages.items():
            if isinstance(message, Frame):
                frame = message if entry.window is None else self._cutter.cut(message, entry.window)
                encoded = encode_record(frame, self._encoding.codec, self.start_unix_ns)  # the builder copies it
            else:
                encoded = message
            self.append(self._topics[field].path, entry.stamp_ns, encoded)
        self.seal_full()

    def seal_full(self) -> None:
        """Pass the chunks that are full to `sink`."""
        full = [builder for group, builder in self._builders.items() if builder.size >= _CHUNK_BYTES[group]]
        if full:
            self.sink([builder.seal() for builder in full])

    def seal(self, groups: Iterable[str] = GROUPS) -> None:
        """Pass the chunks that are not full to `sink`, too."""
        filled = [self._builders[group] for group in groups if self._builders[group].size]
        if filled:
            self.sink([builder.seal() for builder in filled])

    def append(self, path: str, log_ns: int, encoded: Encoded) -> None:
        """Take one message of a topic."""
        publish_ns, sequence, payload = encoded
        if sequence is None:
            sequence = self.sequences[path]
            self.sequences[path] = (sequence + 1) % 2**32
        slot = self._slots[path]
        size = sum(map(len, payload))
        if size > _MESSAGE_LIMIT_BYTES:
            raise SessionError(f"a message of {path} has {size} bytes, more than a chunk may hold; use a smaller chip")
        builder = self._builders[slot.group]
        if builder.size and builder.size + size > _MESSAGE_LIMIT_BYTES:
            self.sink([builder.seal()])
        # The stamp itself is in the payload; MCAP has no time before zero.
        publish_unix_ns = max(0, publish_ns + self.start_unix_ns)
        builder.add(slot.channel, sequence, log_ns + self.start_unix_ns, publish_unix_ns, payload)
