"""The table of frame encodings: how camera images are stored, and which encoding suits which camera.

Measured on one core, noise of 3 grey levels, 640x512 | 2448x2048 (ns per pixel and compression ratio), and 12 bit with
noise of 12 grey levels at 2448x2048:

    raw     0     1.00         0     1.00   uncompressed: for cameras that outrun a core
    zstd    1.1   1.70 | 1.78  3.0   1.39   foxglove.RawImage in a compressed chunk
    delta   1.9   1.89 | 1.91  5.1   1.93   a PNG of row differences, stored, in a compressed chunk: as small, quicker
    png     16    1.89 | 1.90  12.6  1.93   a PNG that is readable without decompressing a chunk
    jpeg    2.1   6.8  | 6.9   -     -      lossy: a replay reads other pixels than the tracker did; 8 bit only

Images of 10 to 16 bit are stored in 16 bit, in RawImage as mono16 (low byte first), in PNG as the standard says (high
byte first). Their depth is in the metadata of the channel.
"""

from __future__ import annotations

import functools
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Frame, Image, UsageError, pixel_type
from flowrec.store.codec import Codec, Payload, byte_field_head, cut_byte_fields, stamp_of, timestamp
from flowrec.store.schema import foxglove_schema

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">IIBBBBB")  # width, height, bits, colour type, compression, filter, interlace
_SIZE = struct.Struct(">I")
_UP = 2  # PNG's filter that stores each row as its difference from the one above
# Deflate compresses no more than 1032 pixels into one byte, baseline JPEG fewer.
_PIXELS_PER_BYTE = 1100
CAMERA_FRAME = "camera"  # coordinate frame of the images, for viewers; see viewer_scene.py
PIXELS_LIMIT = 32 << 20  # an image is in memory twice while it is decoded
_OPTIONS = {
    # Filter and strategy by which cv2's PNG is three times quicker than by default and smaller, on camera noise.
    "png": (
        cv2.IMWRITE_PNG_FILTER,
        cv2.IMWRITE_PNG_FILTER_SUB,
        cv2.IMWRITE_PNG_STRATEGY,
        cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    ),
    "jpeg": (cv2.IMWRITE_JPEG_QUALITY, 90),  # pixels are off by some grey levels
}


def row_differences(image: Image) -> Payload:
    """A PNG file of row differences without compression: zstd, which compresses the chunk, is ten times quicker.

    https://www.w3.org/TR/png-3/#9Filters; the stream consists of deflate's "stored" blocks, which every viewer reads.
    A filter of PNG works on single bytes, also where a pixel has two.
    """
    _refuse_empty(image)
    height, width = image.shape
    pixels = image.astype(">u2").view(np.uint8) if image.itemsize == 2 else image
    rows = np.empty((height, pixels.shape[1] + 1), np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = pixels[0]
    np.subtract(pixels[1:], pixels[:-1], out=rows[1:, 1:])
    header = _PNG_HEADER.pack(width, height, 8 * image.itemsize, 0, 0, 0, 0)
    return (
        b"".join((_PNG_MAGIC, *_png_part(b"IHDR", header))),
        *_png_part(b"IDAT", zlib.compress(rows.data, 0)),
        *_png_part(b"IEND", b""),
    )


def decode_image(data: bytes | memoryview, bits: int = 8) -> Image:
    """The pixels of a PNG or JPEG file, (h, w) grey levels, uint8 for a depth of 8 bits and uint16 for more.

    Raises ValueError: it is neither, it is coloured, its pixels have another size than those of the depth, or it claims
    more of them than its bytes or the limit allow.
    """
    data, expected = memoryview(data), pixel_type(bits)
    height, width = _shape_of(data, 8 * expected.itemsize)
    if not 0 < height * width <= min(_PIXELS_PER_BYTE * len(data), PIXELS_LIMIT):
        raise ValueError(f"an image of {width} x {height} in {len(data)} bytes")
    rows = _stored_differences(data, height, width, expected.itemsize)
    if rows is not None:
        pixels = _sums(rows)
        return pixels if expected.itemsize == 1 else pixels.view(">u2").astype(np.uint16)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError("an image that can not be decoded") from error
    if image is None or image.shape != (height, width) or image.dtype != expected:
        raise ValueError("an image that is not of grey levels, or damaged")
    return image.view(expected)


def _stored_differences(data: memoryview, height: int, width: int, itemsize: int) -> NDArray[np.uint8] | None:
    """The row differences of a PNG like those of `row_differences`, as bytes (h, w * itemsize), checksums verified.

    None for any other file.
    """
    head = _PNG_MAGIC + b"".join(_png_part(b"IHDR", _PNG_HEADER.pack(width, height, 8 * itemsize, 0, 0, 0, 0)))
    tail = b"".join(_png_part(b"IEND", b""))
    start, end = len(head) + 8, len(data) - len(tail) - 4
    if end <= start or data[: len(head)] != head or data[len(data) - len(tail) :] != tail:
        return None
    if data[len(head) : start] != _SIZE.pack(end - start) + b"IDAT":
        return None
    if zlib.crc32(data[start - 4 : end]) != _SIZE.unpack_from(data, end)[0]:
        return None
    # After zlib's head and without its own checksum: the one above covers both.
    unpacker, nbytes = zlib.decompressobj(-zlib.MAX_WBITS), height * (width * itemsize + 1)
    try:
        unpacked = unpacker.decompress(data[start + 2 : end - 4], nbytes + 1)
    except zlib.error:
        return None
    if len(unpacked) != nbytes or not unpacker.eof or unpacker.unused_data:
        return None
    rows = np.frombuffer(unpacked, np.uint8).reshape(height, width * itemsize + 1)
    return rows[:, 1:] if (rows[:, 0] == _UP).all() else None


def _sums(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Each row plus all rows above it, modulo 256; in blocks, for which numpy needs few calls."""
    height, width = rows.shape
    size = max(1, math.isqrt(height))
    count = height // size
    image = np.empty((height, width), np.uint8)
    blocks = image[: count * size].reshape(count, size, width)
    differences = rows[: count * size].reshape(count, size, width)
    blocks[:, 0] = differences[:, 0]
    for row in range(1, size):
        np.add(blocks[:, row - 1], differences[:, row], out=blocks[:, row])
    for block in range(1, count):
        blocks[block] += blocks[block - 1, -1]
    for row in range(count * size, height):
        np.add(image[row - 1], rows[row], out=image[row])
    return image


def _encode_image(file_format: str, image: Image) -> Payload:
    """A PNG file, compressed with Huffman codes, or a JPEG file."""
    _refuse_empty(image)
    try:
        return (cv2.imencode(f".{file_format}", image, _OPTIONS[file_format])[1].reshape(-1).data,)
    except cv2.error as error:
        raise ValueError(f"an image of shape {image.shape} that .{file_format} can not hold") from error


def _refuse_empty(image: Image) -> None:
    if not image.size:
        raise ValueError(f"an image of shape {image.shape}; recording.frames = zstd stores even that")


def _png_part(kind: bytes, data: bytes) -> tuple[bytes, bytes, bytes]:
    return _SIZE.pack(len(data)) + kind, data, _SIZE.pack(zlib.crc32(data, zlib.crc32(kind)))


def _shape_of(data: memoryview, pixel_bits: int) -> tuple[int, int]:
    """Height and width as the file's own head says."""
    if data[: len(_PNG_MAGIC)] == _PNG_MAGIC:
        if len(data) < 33:
            raise ValueError("a PNG without a head")
        width, height, bits, colours = _PNG_HEADER.unpack_from(data, 16)[:4]
        if (bits, colours) != (pixel_bits, 0):  # or it would take several times as much memory until that is found out
            raise ValueError(f"an image that is not of grey levels in {pixel_bits} bit")
        return height, width
    for marker, body in _jpeg_segments(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # the frame header of any kind of JPEG
            bits, height, width, colours = struct.unpack_from(">BHHB", data, body)
            if (bits, colours) != (pixel_bits, 1):
                raise ValueError(f"an image that is not of grey levels in {pixel_bits} bit")
            return height, width
    raise ValueError("neither PNG nor JPEG")


def _jpeg_segments(data: memoryview) -> Iterator[tuple[int, int]]:
    """Marker and start of the body of each segment before the pixels."""
    at = 2
    while bytes(data[:2]) == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        yield data[at + 1], at + 4
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")


_SEQUENCE_LIMIT = 2**32  # MCAP stores the sequence in 32 bit
_RAW_IMAGE_DATA, _COMPRESSED_IMAGE_DATA = 6, 2  # numbers of the fields that hold the bytes
# Up to these rates compression takes at most about a quarter and three quarters of a core, checksums included.
_DELTA_PX_S = 80e6
_ZSTD_PX_S = 400e6  # above it images are stored as they are
_WIDE_COST = 2.7  # time for a pixel of 16 bit relative to one of 8 bit


@dataclass(frozen=True, slots=True)
class FrameEncoding:
    """One row of the table."""

    name: str  # value of `recording.frames`
    compressed_chunks: bool  # whether the chunks are compressed
    lossless: bool = True  # whether the same pixels are read back
    bits: int = 8  # depth of the images

    @property
    def codec(self) -> Codec:
        """Frame <-> payload."""
        return _codec(self.name, self.bits)

    def of(self, bits: int) -> FrameEncoding:
        """The encoding for images of a depth; raises UsageError if it can not hold them."""
        if bits == self.bits:
            return self
        if not self.lossless:
            raise UsageError(f"recording.frames = {self.name!r} holds 8 bit, the camera has {bits}; set it to 'auto'")
        return replace(self, bits=bits)


def encoding_for(width_px: int, height_px: int, rate_hz: float, bits: int = 8) -> str:
    """The smallest lossless encoding that leaves most of two cores to the control loop."""
    px_s = width_px * height_px * rate_hz * (_WIDE_COST if bits > 8 else 1.0)
    return "delta" if px_s <= _DELTA_PX_S else "zstd" if px_s <= _ZSTD_PX_S else "raw"


def _raw_image(bits: int) -> Codec:
    """Frame <-> foxglove.RawImage, mono8 or mono16; Frame.index is the MCAP sequence (32 bit)."""
    schema = foxglove_schema("RawImage")
    stored = pixel_type(bits).newbyteorder("<")
    nbytes, name = stored.itemsize, f"mono{8 * stored.itemsize}"

    def encode(frame: Frame) -> Payload:
        height, width = _shape(frame, bits)
        head = schema.wire(
            timestamp=timestamp(frame.stamp_ns),
            frame_id=CAMERA_FRAME,
            width=width,
            height=height,
            encoding=name,
            step=nbytes * width,
        )
        prefix = head.SerializeToString() + byte_field_head(_RAW_IMAGE_DATA, frame.image.nbytes)
        return (prefix, frame.image.astype(stored, copy=False).reshape(-1).view(np.uint8).data)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        rest, found = cut_byte_fields(memoryview(payload), (_RAW_IMAGE_DATA,))
        parsed = schema.wire.FromString(rest)
        data = found.get(_RAW_IMAGE_DATA, parsed.data)
        shape = parsed.height, parsed.width
        size = nbytes * shape[0] * shape[1]
        if parsed.encoding != name or parsed.step != nbytes * shape[1] or len(data) != size:
            raise ValueError(f"an image of {shape[1]} x {shape[0]} {parsed.encoding!r} in {len(data)} bytes")
        image = np.frombuffer(data, stored).reshape(shape)
        # A copy where the bytes begin at an odd address, for which no kernel is compiled.
        return Frame(stamp_of(parsed), sequence, image.astype(pixel_type(bits), copy=not image.flags.aligned), bits)

    return Codec(schema, encode, decode, has_unix_time=True)


def _compressed_image(file_format: str, file_of: Callable[[Image], Payload], bits: int) -> Codec:
    """Frame <-> foxglove.CompressedImage; decodes any grey-level PNG or JPEG."""
    schema = foxglove_schema("CompressedImage")

    def encode(frame: Frame) -> Payload:
        _shape(frame, bits)
        parts = file_of(frame.image)
        stamp = timestamp(frame.stamp_ns)
        head = schema.wire(timestamp=stamp, frame_id=CAMERA_FRAME, format=file_format).SerializeToString()
        return (head + byte_field_head(_COMPRESSED_IMAGE_DATA, sum(map(len, parts))), *parts)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        rest, found = cut_byte_fields(memoryview(payload), (_COMPRESSED_IMAGE_DATA,))
        parsed = schema.wire.FromString(rest)
        image = decode_image(found.get(_COMPRESSED_IMAGE_DATA, parsed.data), bits)
        return Frame(stamp_of(parsed), sequence, image, bits)

    return Codec(schema, encode, decode, has_unix_time=True)


def _shape(frame: Frame, bits: int) -> tuple[int, int]:
    if frame.bits != bits:
        raise ValueError(f"an image of {frame.bits} bit in a session of {bits} bit; set camera.bits to {frame.bits}")
    if not 0 <= frame.index < _SEQUENCE_LIMIT:
        raise ValueError(f"frame index {frame.index} is not in 32 bit")
    if frame.image.size > PIXELS_LIMIT:
        raise ValueError(f"an image of {frame.image.size} pixels, more than {PIXELS_LIMIT}, which the reader takes")
    height, width = frame.image.shape
    return height, width


@functools.cache
def _codec(name: str, bits: int) -> Codec:
    if name in ("raw", "zstd"):
        return _raw_image(bits)
    if name == "delta":
        return _compressed_image("png", row_differences, bits)
    return _compressed_image(name, functools.partial(_encode_image, name), bits)


ENCODINGS = {
    encoding.name: encoding
    for encoding in (
        FrameEncoding("raw", compressed_chunks=False),
        FrameEncoding("zstd", compressed_chunks=True),
        FrameEncoding("delta", compressed_chunks=True),
        FrameEncoding("png", compressed_chunks=False),
        FrameEncoding("jpeg", compressed_chunks=False, lossless=False),
    )
}


def frame_codec(schema_name: str, bits: int) -> Codec:
    """The codec that decodes frames of a schema and depth, in any encoding; a RawImage's for any other schema."""
    return _codec("png" if schema_name == ENCODINGS["png"].codec.schema.name else "raw", bits)
