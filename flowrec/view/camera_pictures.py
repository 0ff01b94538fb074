"""The camera's images for people to look at: as JPEG, and completed where only a region was recorded (store/roi.py)."""

from __future__ import annotations

import cv2
import numpy as np

from flowrec.core import Image
from flowrec.store import nonzero_window

_DIMMING = 0.6  # factor on the older image, which shows that it is older


class WindowCompleter:
    """Completes one image after the other."""

    def __init__(self) -> None:
        self._complete: Image | None = None  # the last image without a region, and the same dimmed
        self._dimmed: Image | None = None

    def complete(self, image: Image) -> Image:
        """A recorded region (h, w) within the last complete image, which is dimmed."""
        x0, y0, x1, y1 = nonzero_window(image)
        if (x0, y0) == (0, 0) and (y1, x1) == image.shape:
            self._complete, self._dimmed = image, None
            return image
        if self._complete is None or self._complete.shape != image.shape:
            return image
        if self._dimmed is None:
            self._dimmed = (_DIMMING * self._complete).astype(image.dtype)
        completed = self._dimmed.copy()
        completed[y0:y1, x0:x1] = image[y0:y1, x0:x1]
        return completed


def encode_jpeg(image: Image, bits: int, quality: int) -> bytes:
    """An image (h, w) of that many bits as JPEG, of its upper 8 bits."""
    if bits > 8:
        image = (image >> (bits - 8)).astype(np.uint8)
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return jpeg.tobytes()
