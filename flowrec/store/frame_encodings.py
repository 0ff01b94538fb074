"""How camera frames travel: which schema, packed by whom, and which way suits which camera.

Measured on one core, noise of 3 grey levels, 640x512 | 2448x2048 (`flowrec bench store`, ns per pixel and ratio):

    raw     0     1.00         as it is: for cameras that outrun a core
    zstd    1.1   1.70 | 1.78  foxglove.RawImage in a packed chunk
    delta   1.9   1.89 | 1.91  a PNG of row differences, not packed, in a packed chunk: as small, eight times quicker
    png     16    1.89 | 1.90  a PNG that needs no unpacking of the chunk
    jpeg    2.1   6.8  | 6.9   not lossless: what is read back differs from what the tracker saw
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.declarations import Image
from flowrec.messages import Frame
from flowrec.store.form import Codec, Payload
from flowrec.store.image_codec import PIXELS_LIMIT, jpeg, picture, png, row_differences
from flowrec.store.schema import Schema, foxglove_schema
from flowrec.store.standard import stamp_of, timestamp
from flowrec.store.wire import cut_out, head_of, own

RAW_IMAGE, COMPRESSED_IMAGE = "foxglove.RawImage", "foxglove.CompressedImage"
_SEQUENCE_LIMIT = 2**32  # MCAP keeps the sequence in 32 bit
_RAW_IMAGE_DATA, _COMPRESSED_IMAGE_DATA = 6, 2  # numbers of the fields that hold the bytes
# Up to here packing takes at most about a quarter and three quarters of a core, the checksums included.
_DELTA_PX_S = 80e6
_ZSTD_PX_S = 400e6


@dataclass(frozen=True, slots=True)
class FrameEncoding:
    """One way.

    Attributes
    ----------
    name : as in `recording.frames`.
    codec : Frame <-> payload.
    packed : whether the chunks are compressed.
    lossless : whether the same bytes come back.
    """

    name: str
    codec: Codec
    packed: bool
    lossless: bool = True


def encoding_for(width_px: int, height_px: int, rate_hz: float) -> str:
    """The lossless encoding that leaves most of two cores to the control loop and is the smallest of those."""
    px_s = width_px * height_px * rate_hz
    return "delta" if px_s <= _DELTA_PX_S else "zstd" if px_s <= _ZSTD_PX_S else "raw"


def _raw_image() -> Codec:
    """Frame <-> foxglove.RawImage, mono8; Frame.index is the MCAP sequence (32 bit)."""
    schema = foxglove_schema("RawImage")
    wire = schema.wire

    def encode(frame: Frame) -> Payload:
        height, width = _shape(frame)
        head = wire(timestamp=timestamp(frame.stamp_ns), width=width, height=height, encoding="mono8", step=width)
        # The image goes to the compressor as it lies in memory: protobuf would copy it three times, holding the GIL.
        prefix = head.SerializeToString() + head_of(_RAW_IMAGE_DATA, frame.image.nbytes)
        return (prefix, frame.image.reshape(-1).data)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        rest, found = cut_out(memoryview(payload), (_RAW_IMAGE_DATA,))
        parsed = wire.FromString(rest)
        found = own(memoryview(payload), found)
        shape, data = (parsed.height, parsed.width), found.get(_RAW_IMAGE_DATA, parsed.data)
        if parsed.encoding != "mono8" or parsed.step != shape[1] or len(data) != shape[0] * shape[1]:
            raise ValueError(f"an image of {shape[1]} x {shape[0]} {parsed.encoding!r} in {len(data)} bytes")
        return Frame(stamp_of(parsed), sequence, np.frombuffer(data, np.uint8).reshape(shape))

    return Codec(schema, encode, decode, _sequence)


def _compressed_image(file_format: str, file_of: Callable[[Image], Payload]) -> Codec:
    """Frame <-> foxglove.CompressedImage; any PNG or JPEG is read, whoever made it."""
    schema: Schema = foxglove_schema("CompressedImage")
    wire: Any = schema.wire

    def encode(frame: Frame) -> Payload:
        _shape(frame)
        parts = file_of(frame.image)
        head = wire(timestamp=timestamp(frame.stamp_ns), format=file_format).SerializeToString()
        return (head + head_of(_COMPRESSED_IMAGE_DATA, sum(map(len, parts))), *parts)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        rest, found = cut_out(memoryview(payload), (_COMPRESSED_IMAGE_DATA,))
        parsed = wire.FromString(rest)
        return Frame(stamp_of(parsed), sequence, picture(found.get(_COMPRESSED_IMAGE_DATA, parsed.data)))

    return Codec(schema, encode, decode, _sequence)


def _shape(frame: Frame) -> tuple[int, int]:
    if frame.image.size > PIXELS_LIMIT:
        raise ValueError(f"an image of {frame.image.size} pixels, more than {PIXELS_LIMIT}, which the reader takes")
    height, width = frame.image.shape
    return height, width


def _sequence(frame: Frame) -> int:
    if not 0 <= frame.index < _SEQUENCE_LIMIT:
        raise ValueError(f"frame index {frame.index} is not in 32 bit")
    return frame.index


_RAW = _raw_image()
ENCODINGS = {
    encoding.name: encoding
    for encoding in (
        FrameEncoding("raw", _RAW, packed=False),
        FrameEncoding("zstd", _RAW, packed=True),
        FrameEncoding("delta", _compressed_image("png", row_differences), packed=True),
        FrameEncoding("png", _compressed_image("png", png), packed=False),
        FrameEncoding("jpeg", _compressed_image("jpeg", jpeg), packed=False, lossless=False),
    )
}
# By the name of the schema: what is needed to read any of them.
FRAME_CODECS = {RAW_IMAGE: _RAW, COMPRESSED_IMAGE: ENCODINGS["png"].codec}
