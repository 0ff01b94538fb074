"""Pictures by OpenCV: the camera's images for people to look at, and lines, arrows and letters on them.

Pictures are (h, w, 3) in BGR. Lines have a dark rim: they are seen on light and on dark.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import NS_PER_S, Floats, Floats32, Image, Ints
from flowrec.store import nonzero_window
from flowrec.view.colours import SOLID, Rgb

Picture = NDArray[np.uint8]
NOMINAL_PX = 640.0  # width of an image that sizes of drawings are meant for; they grow with the image
SUBPIXEL_BITS = 4  # coordinates of OpenCV's lines are given in 1/16 px
_DIMMING = 0.6  # factor on an older image, which shows that it is older
_RIM = 0.75  # opacity of the rim
_TRAIL_S = 4.0
_FAR_PX = 1e5  # beyond it nothing is drawn
_HEAD = 0.45  # length of an arrow's head over that of the arrow
_HEAD_PX = (2.5, 6.0)  # least and largest, in widths of its line
_ANGLE = np.linspace(0.0, 2.0 * np.pi, 33)
CIRCLE: Floats = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], 1)
CROSS: tuple[Floats, Floats] = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]])


class WindowCompleter:
    """Completes one image after the other where only a region was recorded (store/roi.py)."""

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


class Trail:
    """The way of the last seconds, by points that are at least `step_px` apart."""

    def __init__(self, step_px: float) -> None:
        self._step_px = step_px
        self._points: deque[tuple[int, Floats]] = deque()

    def add(self, stamp_ns: int, point: Floats) -> list[Floats]:
        """The points of the trail after another one (2,)."""
        kept = self._points
        if not kept or math.dist(kept[-1][1], point) >= self._step_px:
            kept.append((stamp_ns, point))
        while kept and stamp_ns - kept[0][0] > _TRAIL_S * NS_PER_S:
            kept.popleft()
        return [each for _, each in kept]


class Layer:
    """Lines that stay for many images, as colours with opacities.

    `shape`: rows and columns.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._ink = np.zeros((*shape, 4), np.float32)  # BGR times opacity, and opacity

    def lines(self, lines: Iterable[Floats], heads: Iterable[Floats], colour: Rgb, width_px: float) -> None:
        """Polylines, each (n, 2) as x, y, and polygons that are filled."""
        polylines = [to_fixed_point(each) for each in lines if drawable(each)]
        polygons = [to_fixed_point(each) for each in heads]
        for shade, rim, opacity in ((SOLID, 2.0, _RIM), (colour, 0.0, 1.0)):
            mask = np.zeros(self._ink.shape[:2], np.uint8)
            width = max(round(width_px + rim), 1)
            cv2.polylines(mask, polylines, False, 255, width, cv2.LINE_AA, SUBPIXEL_BITS)
            for each in polygons:
                cv2.fillPoly(mask, [each], 255, cv2.LINE_AA, SUBPIXEL_BITS)
            if rim:
                cv2.polylines(mask, polygons, True, 255, round(rim), cv2.LINE_AA, SUBPIXEL_BITS)
            self._mix(mask, shade, opacity)

    def blend(self, grey: NDArray[np.uint8], picture: Picture) -> None:
        """Draw the lines in a picture (h, w, 3) of an image (h, w); no line is added afterwards."""
        where, ink = self._finished
        levels = grey.reshape(-1, 1)[where]
        picture.reshape(-1, 3)[where] = (levels * (1.0 - ink[:, 3:]) + ink[:, :3] + 0.5).astype(np.uint8)

    @functools.cached_property
    def _finished(self) -> tuple[Ints, Floats32]:
        """Places of the pixels that have lines, and their ink."""
        where = np.flatnonzero(self._ink[..., 3])
        return where, self._ink.reshape(-1, 4)[where]

    def _mix(self, mask: NDArray[np.uint8], colour: Rgb, opacity: float) -> None:
        inked = np.flatnonzero(mask)  # a few percent of the pixels
        alpha = mask.reshape(-1)[inked, None] * np.float32(opacity / 255.0)
        ink = self._ink.reshape(-1, 4)
        ink[inked] = ink[inked] * (1.0 - alpha) + alpha * np.array([*bgr(colour), 1.0], np.float32)


def arrows(begins: Floats, ends: Floats, width_px: float) -> tuple[list[Floats], list[Floats]]:
    """Shafts and heads, for `Layer.lines`, of arrows from `begins` to `ends`, both (n, 2)."""
    lengths = np.hypot(*(ends - begins).T)
    shown = [drawable(each) for each in zip(begins, ends, strict=True)] & (lengths > 0.0)
    begins, ends, lengths = begins[shown], ends[shown], lengths[shown, None]
    along = (ends - begins) / lengths
    head = np.clip(_HEAD * lengths, *np.multiply(_HEAD_PX, width_px))
    across = 0.45 * head * np.column_stack((-along[:, 1], along[:, 0]))
    bases = ends - head * along
    return list(np.stack((begins, bases), 1)), list(np.stack((ends, bases + across, bases - across), 1))


def draw_outline(picture: Picture, line: Floats, colour: Rgb, width_px: float) -> None:
    """A polyline (n, 2) that is drawn for one image only."""
    for shade, rim in ((SOLID, 1.0), (colour, 0.0)):
        width = max(round(width_px + rim), 1)
        cv2.polylines(picture, [to_fixed_point(line)], False, bgr(shade), width, cv2.LINE_AA, SUBPIXEL_BITS)


def restore(picture: Picture, clean: Picture, centre: Floats, radius_px: float) -> None:
    """Put the pixels of `clean` back within a circle."""
    mask = np.zeros(picture.shape[:2], np.uint8)
    x, y, radius = np.rint(np.array([*centre, radius_px]) * (1 << SUBPIXEL_BITS)).astype(int).tolist()
    cv2.circle(mask, (x, y), radius, 255, cv2.FILLED, cv2.LINE_8, SUBPIXEL_BITS)
    cv2.copyTo(clean, mask, picture)


def to_fixed_point(points: Floats) -> NDArray[np.int32]:
    """Points (n, 2) in 1/16 px, as OpenCV takes them."""
    return np.rint(points * (1 << SUBPIXEL_BITS)).astype(np.int32).reshape(-1, 1, 2)


def drawable(points: ArrayLike) -> bool:
    """True if all points are finite, and not absurdly far away."""
    return bool((np.abs(np.asarray(points, np.float64)) < _FAR_PX).all())  # NaN is not below


def bgr(colour: Rgb) -> Rgb:
    """OpenCV's order of colours."""
    return colour[2], colour[1], colour[0]
