"""Grey levels of images as files hold them. A movie in colour is refused unless a channel was chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Image, MovieError, pixel_type

CHANNELS = ("red", "green", "blue", "grey")


def refuse_colour(path: Path, index: int) -> MovieError:
    """The error for a movie in colour."""
    begin = f"{path}: image {index} is in colour"
    if index:
        return MovieError(
            f"{begin} and those before it are grey; is the file damaged there? Else set movie.channel=grey"
        )
    return MovieError(f"{begin}; choose what is used with --set movie.channel=grey (or red, green, blue)")


def refuse_other_type(path: Path, dtype: np.dtype[Any]) -> None:
    """MovieError for pixels that are no whole numbers of 8 or 16 bit."""
    if dtype.newbyteorder("=") not in (np.uint8, np.uint16):
        raise MovieError(
            f"{path}: holds {dtype} pixels; grey levels of 8 or 16 bit can be kept exactly: export the movie as these"
        )


def grey_image(array: NDArray[Any], channel: str | None, bits: int, path: Path, index: int) -> Image:
    """Grey levels (h, w) of an image (h, w) or, red first, (h, w, 3 or 4).

    A colour image whose channels are equal is grey. `grey` is the luma of ITU-R BT.601, rounded. Raises MovieError:
    colour without a choice, pixels that are no whole numbers of 8 or 16 bit, levels of more than `bits`.
    """
    dtype = pixel_type(bits)
    refuse_other_type(path, array.dtype)
    array = array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
    if array.ndim == 3 and array.shape[2] in (3, 4):
        red, green, blue = (array[..., c] for c in range(3))
        if channel is None or channel == "grey":
            same = np.array_equal(red, green) and np.array_equal(red, blue)
            if not same and channel is None:
                raise refuse_colour(path, index)
            array = red if same else cv2.cvtColor(np.ascontiguousarray(array[..., :3]), cv2.COLOR_RGB2GRAY)
        else:
            array = (red, green, blue)[CHANNELS.index(channel)]
    elif array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim != 2:
        raise MovieError(f"{path}: image {index} has the shape {array.shape}; height x width is expected")
    if bits < 8 * array.dtype.itemsize and int(array.max(initial=0)) >> bits:
        raise MovieError(
            f"{path}: image {index} has a grey level of {array.max()}, more than {bits} bit hold; set movie.bits to "
            "the depth of the camera"
        )
    return np.ascontiguousarray(array.astype(dtype, copy=False))
