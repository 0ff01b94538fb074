"""The writers that `python -m tests.perf.store` compares, and the messages that they write."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from mcap.writer import CompressionType, Writer

from flowrec.core import BY_FIELD, Applied, Estimate, Frame, Image, Message, Tick, Track, nanoseconds
from flowrec.store import SLOTS, SessionHeader, SessionWriter, WriterOptions
from flowrec.store.channels import declarations, message_codec
from flowrec.store.chunk import ChunkBuilder
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.schema import Schema
from tests.store.made_up import encode

_NOISE = 3.0  # grey levels, one sigma: a camera's at this brightness
_STEP_NS = 1_000_000
CHUNK_BYTES = 1 << 20


class Given(NamedTuple):
    """One message, and its bytes for writers that encode nothing."""

    field: str
    message: Message
    payload: bytes


Write = Callable[[Path, list[Given], int], None]  # file to make, messages to take in turn, how many


@dataclass(frozen=True, slots=True)
class Load:
    """Messages, the writers of them, and the writer that flowrec's is compared with."""

    name: str
    messages: int
    data: Callable[[], list[Given]]
    writers: tuple[str, ...]
    rival: str


def pictures(width: int, height: int, count: int = 8) -> list[Image]:
    """Grey images with darker corners and fresh noise, (h, w); a few, to be taken in turn."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-0.5 : 0.5 : height * 1j, -0.5 : 0.5 : width * 1j]
    light = 172.0 - 60.0 * (x * x + y * y)
    return [np.clip(light + rng.normal(0.0, _NOISE, light.shape), 0, 255).astype(np.uint8) for _ in range(count)]


def made_up_header() -> SessionHeader:
    """A header without meaning."""
    return SessionHeader('name = "bench"\n', b"", "", {"host": "bench"})


def ticks_of(images: Sequence[Image], count: int, rate_hz: float) -> Iterator[Tick]:
    """Ticks with an image, a track, an estimate and what the coils did."""
    for number in range(count):
        now = 10**9 + nanoseconds(number / rate_hz)
        here = np.array([number * 0.5, 100.0])
        yield Tick(
            now,
            frame=Frame(now, number, images[number % len(images)]),
            applied=Applied(now, 7.0, 0.1, 3.0, np.zeros(3), np.zeros(2)),
            track=Track(now, True, here, 0.9, 0, 4.5, np.zeros(4)),
            estimate=Estimate(now, here, np.zeros(2), np.eye(4), 1.0, here, True),
        )


def poses_given() -> list[Given]:
    """Estimates of 1 kB encoded, because of a covariance of ten states."""
    rng = np.random.default_rng(0)
    given = []
    for number, here in enumerate(np.cumsum(rng.normal(size=(4096, 2)), axis=0)):
        pose = Estimate(10**9 + number * _STEP_NS, here, rng.normal(size=2), rng.normal(size=(10, 10)), 1.0, here, True)
        given.append(Given("estimate", pose, encode(pose)))
    return given


def frames_given(width: int, height: int) -> list[Given]:
    """Camera images as foxglove.RawImage."""
    frames = [Frame(10**9 + number * _STEP_NS, number, image) for number, image in enumerate(pictures(width, height))]
    return [Given("frame", frame, encode(frame)) for frame in frames]


def _session(encoding: str) -> Write:
    """The whole SessionWriter: messages in, a finished session on the disk out."""

    def write(path: Path, data: list[Given], count: int) -> None:
        with SessionWriter(path, made_up_header(), WriterOptions(frames=encoding, block=True)) as writer:
            for number in range(count):
                given = data[number % len(data)]
                fresh: dict[str, Any] = {given.field: given.message}
                writer.write(Tick(10**9 + number * _STEP_NS, **fresh))

    return write


class Open(NamedTuple):
    """A file that is being written: `put` takes a payload and its stamp in ns."""

    put: Callable[[bytes, int], None]
    close: Callable[[], None]


Start = Callable[[Path, str, Schema], Open]  # file to make, field of the tick, schema of its messages


def own_file(path: Path, field: str, _: Schema) -> Open:
    """The MCAP file alone, without SessionWriter: bytes in, as for the other writers."""
    file, builder = McapWriter(path), ChunkBuilder()
    file.start("flowrec", "bench")
    for record in declarations(ENCODINGS["zstd"]):
        file.add(record)
    numbers, channel = itertools.count(), SLOTS[BY_FIELD[field].path].channel

    def put(payload: bytes, now_ns: int) -> None:
        builder.add(channel, next(numbers), now_ns, now_ns, (payload,))
        if builder.size >= CHUNK_BYTES:
            file.add_chunks([builder.seal()])

    def close() -> None:
        if builder.size:
            file.add_chunks([builder.seal()])
        file.finish()
        file.close()

    return Open(put, close)


def mcap_file(path: Path, _: str, schema: Schema, **options: Any) -> Open:
    """By mcap's Writer, with these options."""
    stream = path.open("wb")
    writer = Writer(stream, chunk_size=CHUNK_BYTES, **options)
    writer.start()
    channel = writer.register_channel("/x", "protobuf", writer.register_schema(schema.name, "protobuf", schema.data))

    def close() -> None:
        writer.finish()  # type: ignore[no-untyped-call]
        stream.close()

    return Open(lambda payload, now_ns: writer.add_message(channel, now_ns, payload, now_ns), close)


def foxglove_file(path: Path, _: str, schema: Schema, **options: Any) -> Open:
    """By foxglove-sdk, with these options."""
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context, writer_options=MCAPWriteOptions(**options))
    described = foxglove.Schema(name=schema.name, encoding="protobuf", data=schema.data)
    channel = foxglove.Channel("/x", message_encoding="protobuf", schema=described, context=context)

    def close() -> None:
        writer.close()
        _ = context  # the channel lives as long as this

    return Open(lambda payload, now_ns: channel.log(payload, log_time=now_ns), close)


def _bytes(start: Start) -> Write:
    def write(path: Path, data: list[Given], count: int) -> None:
        file = start(path, data[0].field, message_codec(type(data[0].message)).schema)
        for number in range(count):
            file.put(data[number % len(data)].payload, 10**9 + number * _STEP_NS)
        file.close()

    return write


_ZSTD = MCAPCompression.Zstd
WRITERS: dict[str, Write] = {
    **{f"flowrec, {encoding}": _session(encoding) for encoding in ("raw", "zstd", "delta", "png", "jpeg")},
    "flowrec, bytes": _bytes(own_file),
    "mcap, zstd": _bytes(partial(mcap_file, compression=CompressionType.ZSTD)),
    "mcap, none": _bytes(partial(mcap_file, compression=CompressionType.NONE)),
    "foxglove-sdk, zstd": _bytes(partial(foxglove_file, compression=_ZSTD)),
    "foxglove-sdk, zstd 1": _bytes(partial(foxglove_file, compression=_ZSTD, compression_level=1)),
    "foxglove-sdk, none": _bytes(partial(foxglove_file, compression=None)),
}

_RIVAL = "foxglove-sdk, zstd 1"  # at our level
_RIVALS = ("foxglove-sdk, zstd", _RIVAL, "foxglove-sdk, none")
_SIZES = ("flowrec, zstd", "flowrec, delta")
LOADS = (
    Load("1 kB poses", 60_000, poses_given, ("flowrec, zstd", "flowrec, bytes", "mcap, zstd", *_RIVALS), _RIVAL),
    Load(
        "640x512",
        400,
        partial(frames_given, 640, 512),
        (*_SIZES, "flowrec, png", "flowrec, jpeg", "mcap, zstd", *_RIVALS),
        _RIVAL,
    ),
    Load(
        "2448x2048",
        80,
        partial(frames_given, 2448, 2048),
        (*_SIZES, "flowrec, raw", "mcap, zstd", "mcap, none", *_RIVALS),
        _RIVAL,
    ),
)
