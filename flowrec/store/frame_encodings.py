"""The table of frame encodings: how camera images are stored, and which encoding suits which camera.

Measured on one core, noise of 3 grey levels, 640x512 | 2448x2048 (ns per pixel and compression ratio):

    raw     0     1.00         uncompressed: for cameras that outrun a core
    zstd    1.1   1.70 | 1.78  foxglove.RawImage in a compressed chunk
    delta   1.9   1.89 | 1.91  a PNG of row differences, stored, in a compressed chunk: as small, eight times quicker
    png     16    1.89 | 1.90  a PNG that is readable without decompressing a chunk
    jpeg    2.1   6.8  | 6.9   lossy: a replay reads other pixels than the tracker did
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flowrec.declarations import Image
from flowrec.messages import Frame
from flowrec.store.codec import Codec, Payload, byte_field_head, cut_byte_fields, detached, stamp_of, timestamp
from flowrec.store.image_codec import PIXELS_LIMIT, decode_image, jpeg, png, row_differences
from flowrec.store.schema import foxglove_schema

_SEQUENCE_LIMIT = 2**32  # MCAP stores the sequence in 32 bit
_RAW_IMAGE_DATA, _COMPRESSED_IMAGE_DATA = 6, 2  # numbers of the fields that hold the bytes
# Up to these rates compression takes at most about a quarter and three quarters of a core, checksums included.
_DELTA_PX_S = 80e6
_ZSTD_PX_S = 400e6


@dataclass(frozen=True, slots=True)
class FrameEncoding:
    """One row of the table.

    Attributes
    ----------
    name : value of `recording.frames`.
    codec : Frame <-> payload.
    compressed_chunks : whether the chunks are compressed.
    lossless : whether the same pixels are read back.
    """

    name: str
    codec: Codec
    compressed_chunks: bool
    lossless: bool = True


def encoding_for(width_px: int, height_px: int, rate_hz: float) -> str:
    """The smallest lossless encoding that leaves most of two cores to the control loop."""
    px_s = width_px * height_px * rate_hz
    return "delta" if px_s <= _DELTA_PX_S else "zstd" if px_s <= _ZSTD_PX_S else "raw"


def _raw_image() -> Codec:
    """Frame <-> foxglove.RawImage, mono8; Frame.index is the MCAP sequence (32 bit)."""
    schema = foxglove_schema("RawImage")

    def encode(frame: Frame) -> Payload:
        height, width = _shape(frame)
        head = schema.wire(
            timestamp=timestamp(frame.stamp_ns), width=width, height=height, encoding="mono8", step=width
        )
        prefix = head.SerializeToString() + byte_field_head(_RAW_IMAGE_DATA, frame.image.nbytes)
        return (prefix, frame.image.reshape(-1).data)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        rest, found = cut_byte_fields(memoryview(payload), (_RAW_IMAGE_DATA,))
        parsed = schema.wire.FromString(rest)
        data = detached(memoryview(payload), found).get(_RAW_IMAGE_DATA, parsed.data)
        shape = parsed.height, parsed.width
        if parsed.encoding != "mono8" or parsed.step != shape[1] or len(data) != shape[0] * shape[1]:
            raise ValueError(f"an image of {shape[1]} x {shape[0]} {parsed.encoding!r} in {len(data)} bytes")
        return Frame(stamp_of(parsed), sequence, np.frombuffer(data, np.uint8).reshape(shape))

    return Codec(schema, encode, decode, _sequence, has_unix_time=True)


def _compressed_image(file_format: str, file_of: Callable[[Image], Payload]) -> Codec:
    """Frame <-> foxglove.CompressedImage; decodes any grey-level PNG or JPEG."""
    schema = foxglove_schema("CompressedImage")

    def encode(frame: Frame) -> Payload:
        _shape(frame)
        parts = file_of(frame.image)
        head = schema.wire(timestamp=timestamp(frame.stamp_ns), format=file_format).SerializeToString()
        return (head + byte_field_head(_COMPRESSED_IMAGE_DATA, sum(map(len, parts))), *parts)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        rest, found = cut_byte_fields(memoryview(payload), (_COMPRESSED_IMAGE_DATA,))
        parsed = schema.wire.FromString(rest)
        return Frame(stamp_of(parsed), sequence, decode_image(found.get(_COMPRESSED_IMAGE_DATA, parsed.data)))

    return Codec(schema, encode, decode, _sequence, has_unix_time=True)


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
        FrameEncoding("raw", _RAW, compressed_chunks=False),
        FrameEncoding("zstd", _RAW, compressed_chunks=True),
        FrameEncoding("delta", _compressed_image("png", row_differences), compressed_chunks=True),
        FrameEncoding("png", _compressed_image("png", png), compressed_chunks=False),
        FrameEncoding("jpeg", _compressed_image("jpeg", jpeg), compressed_chunks=False, lossless=False),
    )
}
# By schema: two codecs decode whatever any of the encodings has written.
FRAME_CODECS = {codec.schema.name: codec for codec in (_RAW, ENCODINGS["png"].codec)}
