"""The writers that `python -m tests.perf.store` compares, and the messages that they write."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from mcap.writer import CompressionType, Writer

from flowrec.core.declarations import Image, Message
from flowrec.core.messages import Applied, Estimate, Frame, Track
from flowrec.core.topics import BY_FIELD, Tick
from flowrec.core.units import nanoseconds
from flowrec.store.channels import SLOTS, declarations, message_codec
from flowrec.store.chunk import ChunkBuilder
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.session_file import WriterOptions
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.writer import SessionWriter
from tests.store.made_up import encode

_NOISE = 3.0  # grey levels, one sigma: a camera's at this brightness
_STEP_NS = 1_000_000
_CHUNK_BYTES = 1 << 20  # as the bare writers have it


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


def _file(path: Path, data: list[Given], count: int) -> None:
    """The MCAP file alone, without SessionWriter: bytes in, as for the other writers."""
    slot = SLOTS[BY_FIELD[data[0].field].path]
    file, builder = McapWriter(path), ChunkBuilder()
    file.start("flowrec", "bench")
    for record in declarations(ENCODINGS["zstd"]):
        file.add(record)
    for n in range(count):
        now = 10**9 + n * _STEP_NS
        builder.add(slot.channel, n, now, now, (data[n % len(data)].payload,))
        if builder.size >= _CHUNK_BYTES:
            file.add_chunks([builder.seal()])
    file.add_chunks([builder.seal()])
    file.finish()
    file.close()


def _mcap(compression: CompressionType) -> Write:
    def write(path: Path, data: list[Given], count: int) -> None:
        schema = message_codec(type(data[0].message)).schema
        with path.open("wb") as stream:
            writer = Writer(stream, compression=compression)
            writer.start()
            number = writer.register_schema(schema.name, "protobuf", schema.data)
            channel = writer.register_channel("/x", "protobuf", number)
            for n in range(count):
                now = 10**9 + n * _STEP_NS
                writer.add_message(channel, now, data[n % len(data)].payload, now, n)
            writer.finish()  # type: ignore[no-untyped-call]

    return write


def _foxglove(options: MCAPWriteOptions, file_of: Callable[[Given], bytes] = lambda given: given.payload) -> Write:
    def write(path: Path, data: list[Given], count: int) -> None:
        schema = message_codec(type(data[0].message)).schema
        context = foxglove.Context()
        writer = foxglove.open_mcap(path, context=context, writer_options=options)
        described = foxglove.Schema(name=schema.name, encoding="protobuf", data=schema.data)
        channel = foxglove.Channel("/x", message_encoding="protobuf", schema=described, context=context)
        for n in range(count):
            channel.log(file_of(data[n % len(data)]), log_time=10**9 + n * _STEP_NS)
        writer.close()

    return write


def _png(given: Given) -> bytes:
    """PNG by cv2 with its defaults."""
    assert isinstance(given.message, Frame)
    return cv2.imencode(".png", given.message.image)[1].tobytes()


_UNPACKED = MCAPWriteOptions(compression=None)
WRITERS: dict[str, Write] = {
    **{f"flowrec, {encoding}": _session(encoding) for encoding in ("raw", "zstd", "delta", "png", "jpeg")},
    "flowrec, bytes": _file,
    "mcap, zstd": _mcap(CompressionType.ZSTD),
    "mcap, none": _mcap(CompressionType.NONE),
    "foxglove-sdk, zstd": _foxglove(MCAPWriteOptions(compression=MCAPCompression.Zstd)),
    "foxglove-sdk, zstd 1": _foxglove(MCAPWriteOptions(compression=MCAPCompression.Zstd, compression_level=1)),
    "foxglove-sdk, none": _foxglove(_UNPACKED),
    "foxglove-sdk, png": _foxglove(_UNPACKED, _png),
}

_RIVAL = "foxglove-sdk, zstd 1"  # at our level
_RIVALS = ("foxglove-sdk, zstd", _RIVAL, "foxglove-sdk, none")
LOADS = (
    Load(
        "1 kB poses",
        60_000,
        poses_given,
        ("flowrec, zstd", "flowrec, bytes", "mcap, zstd", *_RIVALS),
        _RIVAL,
    ),
    Load(
        "640x512",
        400,
        lambda: frames_given(640, 512),
        (
            *("flowrec, delta", "flowrec, zstd", "flowrec, png", "flowrec, jpeg"),
            *("mcap, zstd", "foxglove-sdk, png", *_RIVALS),
        ),
        _RIVAL,
    ),
    Load(
        "2448x2048",
        80,
        lambda: frames_given(2448, 2048),
        (
            *("flowrec, zstd", "flowrec, delta", "flowrec, raw"),
            *("mcap, zstd", "mcap, none", *_RIVALS),
        ),
        _RIVAL,
    ),
)
