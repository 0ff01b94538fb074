"""Short texts as masks of grey levels, for pictures that OpenCV draws, by Pillow's own font.

OpenCV's fonts are outlines without a micro sign; Pillow's has none either, so it is a u with a descender.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

Mask = NDArray[np.uint8]
_DIGITS = "0123456789"
_LONGEST = 200  # characters
_MICRO = "µ"
_STEM, _TAIL = 0.05, 0.15  # width and length of its descender, over the height of letters


@lru_cache(maxsize=8)
def _font(height_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(height_px)


@lru_cache(maxsize=512)
def text_mask(text: str, height_px: int) -> Mask:
    """A text (h, w) on one line, 255 in letters; all texts of one height have one baseline and the same h."""
    font = _font(height_px)
    shown = text[:_LONGEST].replace(_MICRO, "u")
    width = max(int(np.ceil(font.getlength(shown))), 1)
    picture = Pillow.new("L", (width, round(1.3 * height_px)), 0)
    draw = ImageDraw.Draw(picture)
    draw.text((0, 0), shown, fill=255, font=font)
    for place in (n for n, letter in enumerate(text[: len(shown)]) if letter == _MICRO):
        left, top, _, bottom = font.getbbox("u")
        stem = font.getlength(shown[:place]) + left + 0.5
        tail = (stem, 0.5 * (top + bottom), stem + _STEM * height_px, bottom + _TAIL * height_px)
        draw.rectangle(tuple(map(round, tail)), fill=255)
    mask: Mask = np.asarray(picture)
    return mask


def clock_mask(text: str, height_px: int) -> Mask:
    """Mask of a text that changes all the time: every digit is as wide as the widest, so nothing jumps."""
    widest = max(text_mask(digit, height_px).shape[1] for digit in _DIGITS)
    parts = []
    for letter in text:
        mask = text_mask(letter, height_px)
        missing = widest - mask.shape[1] if letter in _DIGITS else 0
        parts.append(np.pad(mask, ((0, 0), (missing // 2, missing - missing // 2))) if missing else mask)
    return np.hstack(parts)
