"""Grey-level images as PNG and JPEG files, and back within bounds.

Writing is for the recorder's thread: everything slow in here leaves the interpreter free.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import cv2
import numpy as np

from flowrec.messages import Image
from flowrec.store.form import Payload

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">IIBBBBB")  # width, height, bits, colour type, compression, filter, interlace
_SIZE = struct.Struct(">I")
_UP = 2  # PNG's filter that stores each row as its difference from the one above
_JPEG_QUALITY = 90
# Deflate packs no more than 1032 into one byte, baseline JPEG fewer pixels: more are a bomb.
_PIXELS_PER_BYTE = 1100
# Filter and strategy by which cv2's PNG is three times quicker than by default and smaller, on camera noise.
_PNG_OPTIONS = (
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_SUB,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)


def png(image: Image) -> Payload:
    """A PNG file, packed with Huffman codes."""
    return (_encoded(".png", image, _PNG_OPTIONS),)


def jpeg(image: Image) -> Payload:
    """A JPEG file of quality 90; its pixels are off by some grey levels."""
    return (_encoded(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY)),)


def row_differences(image: Image) -> Payload:
    """A PNG file of row differences that nobody has packed yet: zstd, which packs the chunk, does so ten times quicker.

    https://www.w3.org/TR/png-3/#9Filters; the stream inside is deflate's "stored" kind, which every viewer reads.
    """
    _refuse_empty(image)
    height, width = image.shape
    rows = np.empty((height, width + 1), np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = image[0]
    np.subtract(image[1:], image[:-1], out=rows[1:, 1:])
    header = _PNG_HEADER.pack(width, height, 8, 0, 0, 0, 0)
    return (
        b"".join((_PNG_MAGIC, *_png_part(b"IHDR", header))),
        *_png_part(b"IDAT", zlib.compress(rows.data, 0)),
        *_png_part(b"IEND", b""),
    )


def picture(data: bytes) -> Image:
    """The pixels of a PNG or JPEG file, (h, w) grey levels.

    Raises
    ------
    ValueError : it is none, it is coloured, or it claims more pixels than its bytes can hold.
    """
    height, width = _shape_of(data)
    if not 0 < height * width <= _PIXELS_PER_BYTE * len(data):
        raise ValueError(f"an image of {width} x {height} in {len(data)} bytes")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError("an image that can not be decoded") from error
    if image is None or image.shape != (height, width) or image.dtype != np.uint8:
        raise ValueError("an image that is not of grey levels, or damaged")
    pixels: Image = image.view(np.uint8)
    return pixels


def _encoded(kind: str, image: Image, options: tuple[int, ...]) -> memoryview:
    _refuse_empty(image)
    try:
        return cv2.imencode(kind, image, options)[1].reshape(-1).data
    except cv2.error as error:
        raise ValueError(f"an image of shape {image.shape} that {kind} can not hold") from error


def _refuse_empty(image: Image) -> None:
    if not image.size:
        raise ValueError(f"an image of shape {image.shape}; recording.frames = zstd stores even that")


def _png_part(kind: bytes, data: bytes) -> tuple[bytes, bytes, bytes]:
    return _SIZE.pack(len(data)) + kind, data, _SIZE.pack(zlib.crc32(data, zlib.crc32(kind)))


def _shape_of(data: bytes) -> tuple[int, int]:
    """Height and width as the file's own head says."""
    if data.startswith(_PNG_MAGIC):
        if len(data) < 33:
            raise ValueError("a PNG without a head")
        width, height = _PNG_HEADER.unpack_from(data, 16)[:2]
        return height, width
    for marker, body in _jpeg_segments(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # the frame header of any kind of JPEG
            height, width = struct.unpack_from(">xHH", data, body)
            return height, width
    raise ValueError("neither PNG nor JPEG")


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Marker and start of the body of each segment before the pixels."""
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        yield data[at + 1], at + 4
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
