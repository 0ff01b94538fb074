"""The mask of a chip in a PNG image, as grey levels; and the images that are refused, since they are no clear mask."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import ChipError

MAX_PIXELS = 3_600_000  # the flow field of a larger mask exceeds the largest chunk that a session may have
FLUID = 128  # grey level of fluid, at least
# A mask is black and white, but for the blurred edges of its channels.
_BLACK, _WHITE, _MOST_BETWEEN, _MOST_LEVELS = 32, 223, 0.25, 32
_PNG_HEAD = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_COLOUR_TYPE = 25  # place of the byte in the file
_MAY_BE_TRANSPARENT = (3, 4, 6)  # colour types: palette, grey and RGB with alpha


def greys_of_png(png_bytes: bytes, fluid: str, where: str, between: bool) -> NDArray[np.uint8]:
    """(h, w) grey levels, fluid is bright; `between`: walls may lie between pixel centres.

    Raises ChipError, in one line, for what is no PNG image, or no mask.
    """
    grey = None
    if png_bytes.startswith(_PNG_HEAD) and len(png_bytes) >= len(_PNG_HEAD) + 8:
        # The size in the header is checked before the image is decoded: a small file could demand gigabytes.
        width, height = struct.unpack_from(">II", png_bytes, len(_PNG_HEAD))
        if width * height > MAX_PIXELS:
            raise ChipError(f"{where}: a mask of {width} x {height} pixels; at most {MAX_PIXELS} are possible")
        grey = _decode(png_bytes, cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise ChipError(f"{where}: the mask is no PNG image, or a damaged one; save it again as 8-bit grey")
    _refuse_transparent(png_bytes, where)
    brightest = int(grey.max())
    if 0 < brightest < FLUID:
        raise ChipError(
            f"{where}: no pixel of the mask is bright: the brightest is {brightest} of 255, and fluid is {FLUID} or "
            "more; save it as 8-bit grey with 0 and 255"
        )
    part = 0.0 if between else float(((grey > _BLACK) & (grey < _WHITE)).mean())
    if part > _MOST_BETWEEN and len(np.unique(grey)) > _MOST_LEVELS:
        raise ChipError(
            f"{where}: a photograph, not a mask: {100 * part:.0f} % of its pixels are neither black nor white; "
            f"flowrec calibrate chip {where} --um-per-px UM -o CHIP.toml makes the mask of it"
        )
    return np.asarray(255 - grey if fluid == "dark" else grey, np.uint8)


def _refuse_transparent(png_bytes: bytes, where: str) -> None:
    """Raise ChipError for an image with transparent pixels: under them is any colour, which nobody sees."""
    if png_bytes[_COLOUR_TYPE] not in _MAY_BE_TRANSPARENT:
        return
    image = _decode(png_bytes, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        return
    opaque = np.iinfo(image.dtype).max
    count = int((image[..., 3] <= opaque // 2).sum())
    if count:
        raise ChipError(
            f"{where}: {count} pixels of the mask are transparent: fluid or wall? Save it without transparency, "
            "white on black"
        )


def _decode(png_bytes: bytes, how: int) -> NDArray[Any] | None:
    """The image, or None of a damaged one."""
    try:
        return cv2.imdecode(np.frombuffer(png_bytes, np.uint8), how)
    except cv2.error:  # a header that promises an impossible image
        return None
