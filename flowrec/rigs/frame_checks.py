"""What is checked of every frame on its arrival from a camera, before any stage sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.errors import RigError
from flowrec.messages import Frame
from flowrec.pipeline import Inputs

_ROW_STEP = 16  # of these rows a camera's noise changes some pixel in every image


class Arrivals:
    """Refuses images of another size than the settings say, and finds images that repeat the one before.

    `image_shape` is (height, width) in pixels.
    """

    def __init__(self, image_shape: tuple[int, int]) -> None:
        self._shape = image_shape
        self._last: Frame | None = None
        self._since_ns = 0

    def check(self, arrived: Inputs) -> Inputs:
        """The inputs with `applied.image_since_ns` filled in.

        Raises
        ------
        RigError : the image has another size.
        """
        frame = arrived.frame
        if frame is None:
            return arrived
        if frame.image.shape != self._shape:
            height, width = frame.image.shape
            raise RigError(
                f"frame {frame.index}: an image of {width} x {height} pixels, where camera.width_px x camera.height_px "
                f"= {self._shape[1]} x {self._shape[0]} is expected; set them, or the camera's region of interest"
            )
        if self._last is None or not _same(self._last, frame):
            self._since_ns = arrived.stamp_ns
        self._last = frame
        return replace(arrived, applied=replace(arrived.applied, image_since_ns=self._since_ns))


def _same(one: Frame, other: Frame) -> bool:
    """Whether two images are equal. A few rows are compared first, so that a new image costs microseconds."""
    a, b = one.image, other.image
    return np.array_equal(a[::_ROW_STEP], b[::_ROW_STEP]) and np.array_equal(a, b)
