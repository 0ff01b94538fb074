"""A small session taken apart, so that it can be put together wrongly: with every checksum, length and index right.

Written from the specification (https://mcap.dev/spec) alone, independently of the writer in store/.
"""

from __future__ import annotations

import struct
import typing
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder

from flowrec.core import TOPICS, Message, message_fields
from flowrec.core.declarations import array_fields
from flowrec.physics import load_chip
from flowrec.stages import ResolvedConfig, load_config
from flowrec.stages.resolve import resolve
from flowrec.store import SLOTS, session_header
from flowrec.store.channels import FRAMES, STATE, declarations, message_codec
from flowrec.store.codec import encode_record
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.session_metadata import header_records

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
TICKS, TICKS_PER_CHUNK = 6, 2
PERIOD_NS = 33_333_333
_HEIGHT, _WIDTH = 12, 16


@dataclass(frozen=True, slots=True)
class Sent:
    """One message of a chunk."""

    channel: int
    sequence: int
    log_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Piece:
    """One chunk. What is not None is told instead of the truth."""

    messages: tuple[Sent, ...]
    compression: str = "zstd"
    told_size: int | None = None
    told_crc: int | None = None
    told_times: tuple[int, int] | None = None
    packed: bytes | None = None


@dataclass(frozen=True, slots=True)
class Draft:
    """A session in parts: records before the chunks as (opcode, body), chunks, records after them."""

    head: tuple[tuple[int, bytes], ...]
    pieces: tuple[Piece, ...]
    tail: tuple[tuple[int, bytes], ...]
    # Both take and give records as (opcode, body): the index as it is to be written, and all that stands before it.
    change_index: Callable[[list[tuple[int, bytes]]], list[tuple[int, bytes]]] | None = field(default=None)

    def build(self) -> bytes:
        """The file."""
        file = bytearray(MAGIC + record(HEADER, text("flowrec") + text("flowrec fuzz")))
        listed: list[tuple[int, bytes]] = []
        counts: dict[int, int] = {}
        span: list[int] = []
        for opcode, body in self.head:
            _append(file, listed, opcode, body)
        for piece in self.pieces:
            _append_piece(file, listed, counts, span, piece)
        for opcode, body in self.tail:
            _append(file, listed, opcode, body)
        file += record(DATA_END, struct.pack("<I", zlib.crc32(file)))
        index = self.index(listed, counts, span)
        if self.change_index is not None:
            index = self.change_index(index)
        start = len(file)
        file += b"".join(record(opcode, body) for opcode, body in index)
        file += struct.pack("<BQQQ", FOOTER, 20, start, 0)
        file += struct.pack("<I", zlib.crc32(file[start:])) + MAGIC
        return bytes(file)

    def index(
        self, listed: list[tuple[int, bytes]], counts: dict[int, int], span: list[int]
    ) -> list[tuple[int, bytes]]:
        """The records of a sound index over what is listed, with so many messages by channel, between these times."""
        declared = [part for part in self.head if part[0] in (SCHEMA, CHANNEL)]
        schemas, channels = ({body[:2] for opcode, body in declared if opcode == kind} for kind in (SCHEMA, CHANNEL))
        attachments, metadata, chunks = (
            sum(opcode == kind for opcode, _ in listed) for kind in (ATTACHMENT_INDEX, METADATA_INDEX, CHUNK_INDEX)
        )
        statistics = struct.pack(
            "<QHIIIIQQ",
            sum(counts.values()), len(schemas), len(channels), attachments, metadata, chunks,
            min(span, default=0), max(span, default=0),
        )  # fmt: skip
        pairs = b"".join(struct.pack("<HQ", channel, count) for channel, count in counts.items())
        return [*declared, (STATISTICS, statistics + struct.pack("<I", len(pairs)) + pairs), *listed]


def with_sound_index(data: bytes) -> bytes:
    """The file with the checksum of its index made right again, whatever has been done to the index."""
    tail = 20 + len(MAGIC)
    if len(data) < tail + 9:
        return data
    (start,) = struct.unpack_from("<Q", data, len(data) - tail)
    if not 0 < start < len(data):
        return data
    crc = zlib.crc32(data[start : -4 - len(MAGIC)])
    return data[: -4 - len(MAGIC)] + struct.pack("<I", crc) + data[-len(MAGIC) :]


def record(opcode: int, body: bytes) -> bytes:
    """One record."""
    return struct.pack("<BQ", opcode, len(body)) + body


def text(words: str) -> bytes:
    """Text after its length."""
    data = words.encode()
    return struct.pack("<I", len(data)) + data


@cache
def small_draft() -> Draft:
    """A dozen ticks with a message of every topic, in a head that is real; always the same bytes."""
    config = load_config()
    chip = load_chip(config.chip)
    said = session_header(_plain(resolve(config, chip)), chip)
    facts = {"flowrec": "0", "wall_time": "2026-01-01T00:00:00+00:00", "wall_ns": "1", "monotonic_ns": "1"}
    records: list[Any] = [
        *header_records(replace(said, provenance=facts, start_unix_ns=0)),
        *declarations(ENCODINGS["zstd"]),
    ]
    head = tuple(_parts(records))
    rng = np.random.default_rng(0)
    sent: dict[str, list[list[Sent]]] = {group: [] for group in (FRAMES, STATE)}
    for number in range(TICKS):
        stamp_ns = 1_000_000_000 + number * PERIOD_NS
        for chunks in sent.values():
            if number % TICKS_PER_CHUNK == 0:
                chunks.append([])
        for topic in TOPICS:
            message = made_up(topic.type, stamp_ns, number, rng)
            _, sequence, payload = encode_record(message, message_codec(topic.type))
            slot = SLOTS[topic.path]
            sent[slot.group][-1].append(
                Sent(slot.channel, number if sequence is None else sequence, stamp_ns, b"".join(payload))
            )
    pieces = tuple(
        Piece(tuple(sent[group][number])) for number in range(TICKS // TICKS_PER_CHUNK) for group in (FRAMES, STATE)
    )
    outcome = text("flowrec.outcome") + packed_map({"outcome": "reached", "ticks": str(TICKS), "dropped_frames": "0"})
    return Draft(head, pieces, ((METADATA, outcome),))


# Numbers that do mean something: `flowrec check` looks at them.
_COUNTS_OF_FAULTS = "dropped_frames wall_jumps passed_over duplicates disordered resets jumps triggers reconnections"
_UNTROUBLED = {"rate": 1.0, "unit": 0.0, "bits": 8} | dict.fromkeys(_COUNTS_OF_FAULTS.split(), 0)


def made_up(kind: type[Message], stamp_ns: int, number: int, rng: np.random.Generator) -> Message:
    """A message of some type with shapes that fit and numbers that mean nothing."""
    lengths = {"h": _HEIGHT, "w": _WIDTH, "n": 5, "m": 3, "k": 4, "o": 2, "p": 6, "q": 2, "coils": 3}
    shapes = {each.name: each.shape.lengths for each in message_fields(kind) if each.shape is not None}
    arrays = dict(array_fields(kind))
    values: dict[str, Any] = {}
    for name, hint in typing.get_type_hints(kind).items():
        if name in arrays:
            shape = [length if isinstance(length, int) else lengths[length] for length in shapes[name]]
            values[name] = (100.0 * rng.random(shape)).astype(arrays[name])
        else:
            made = {int: number, float: 1.5, float | None: None, int | None: number, bool: True, str: "words"}
            values[name] = made[hint]
    values |= {name: value for name, value in _UNTROUBLED.items() if name in values}
    return kind(**{**values, "stamp_ns": stamp_ns})


def _plain(config: ResolvedConfig) -> ResolvedConfig:
    return replace(config, recording=replace(config.recording, anonymous=True))


def _parts(records: list[Any]) -> Iterator[tuple[int, bytes]]:
    for item in records:
        builder = RecordBuilder()
        item.write(builder)
        data: bytes = builder.end()  # type: ignore[no-untyped-call]
        yield data[0], data[9:]


def packed_map(pairs: dict[str, str]) -> bytes:
    data = b"".join(text(key) + text(value) for key, value in pairs.items())
    return struct.pack("<I", len(data)) + data


def _append(file: bytearray, listed: list[tuple[int, bytes]], opcode: int, body: bytes) -> None:
    listed += listing_of(opcode, body, len(file))
    file += record(opcode, body)


def listing_of(opcode: int, body: bytes, offset: int) -> list[tuple[int, bytes]]:
    """What the index tells of a record that lies at an offset; nothing but of attachments and metadata."""
    length = 9 + len(body)
    if opcode == METADATA:
        (size,) = struct.unpack_from("<I", body)
        return [(METADATA_INDEX, struct.pack("<QQ", offset, length) + body[: 4 + size])]
    if opcode == ATTACHMENT:
        (size,) = struct.unpack_from("<I", body, 16)
        (media,) = struct.unpack_from("<I", body, 20 + size)
        after_media = 24 + size + media
        place = struct.pack("<QQ", offset, length) + body[:16] + body[after_media : after_media + 8]
        return [(ATTACHMENT_INDEX, place + body[16:after_media])]
    return []


def _append_piece(
    file: bytearray, listed: list[tuple[int, bytes]], counts: dict[int, int], span: list[int], piece: Piece
) -> None:
    content = bytearray()
    indexes: dict[int, bytes] = {}
    for sent in piece.messages:
        indexes[sent.channel] = indexes.get(sent.channel, b"") + struct.pack("<QQ", sent.log_ns, len(content))
        counts[sent.channel] = counts.get(sent.channel, 0) + 1
        content += record(
            MESSAGE, struct.pack("<HIQQ", sent.channel, sent.sequence, sent.log_ns, sent.log_ns) + sent.payload
        )
    times = [sent.log_ns for sent in piece.messages] or [0]
    first_ns, last_ns = piece.told_times or (min(times), max(times))
    span += [first_ns, last_ns]
    packed = piece.packed
    if packed is None:
        packed = zstandard.ZstdCompressor(level=1).compress(bytes(content)) if piece.compression else bytes(content)
    size = len(content) if piece.told_size is None else piece.told_size
    crc = zlib.crc32(content) if piece.told_crc is None else piece.told_crc
    start = len(file)
    body = struct.pack("<QQQI", first_ns, last_ns, size, crc) + text(piece.compression)
    file += record(CHUNK, body + struct.pack("<Q", len(packed)) + packed)
    length = len(file) - start
    offsets = b""
    for channel, entries in indexes.items():
        offsets += struct.pack("<HQ", channel, len(file))
        file += record(MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)) + entries)
    place = struct.pack("<QQQQI", first_ns, last_ns, start, length, len(offsets)) + offsets
    place += struct.pack("<Q", len(file) - start - length) + text(piece.compression)
    listed.append((CHUNK_INDEX, place + struct.pack("<QQ", len(packed), size)))
