"""Distance to the chip's walls in the camera's image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from flowrec.core import Bools, Floats32
from flowrec.physics import Calibration, Chip

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 in camera px, the latter two exclusive
_FAR_PX = 1e4  # distance to the walls of a chip without walls


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Distance to the walls in the camera's image, and the bounding box of the fluid."""

    distance_px: Floats32  # (h, w), negative in solid
    box: Box

    def for_shift(self, shift_px: tuple[float, float]) -> Walls:
        """The walls in an image that is shifted by `shift_px` (columns, rows)."""
        (x, y), (height, width), (x0, y0, x1, y1) = shift_px, self.distance_px.shape, self.box
        to_image = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        distance = cv2.warpAffine(self.distance_px, to_image, (width, height), borderMode=cv2.BORDER_REPLICATE)
        left, right = (min(max(each + round(x), 0), width) for each in (x0, x1))
        top, bottom = (min(max(each + round(y), 0), height) for each in (y0, y1))
        return Walls(np.asarray(distance, np.float32), (left, top, right, bottom))


def seen_walls(
    chip: Chip, calibration: Calibration, shape: tuple[int, ...], shift_px: tuple[float, float]
) -> tuple[Walls, Calibration]:
    """Walls and calibration of an image that lies `shift_px` (columns, rows) from where the calibration holds."""
    walls = walls_in_view(chip, calibration, shape)
    return (walls.for_shift(shift_px), calibration.for_shift(shift_px)) if any(shift_px) else (walls, calibration)


@lru_cache(maxsize=4)
def walls_in_view(chip: Chip, calibration: Calibration, shape: tuple[int, ...]) -> Walls:
    """Walls of a chip in an image of `shape` (rows, columns); cached by the identity of the chip."""
    height, width = shape
    scale = calibration.um_per_px / chip.um_per_px  # mask pixels per camera pixel
    to_mask = calibration.matrix / chip.um_per_px  # of (column, row, 1) in the image
    # Distances interpolate smoothly, while an interpolated mask would have stairs.
    distance = cv2.warpAffine(
        _mask_distance_px(chip.mask) / np.float32(scale),
        to_mask,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,  # a channel that the border cuts continues straight
    )
    rows, columns = chip.mask.shape
    right, down = np.arange(width), np.arange(height)[:, None]
    x, y = (row[2] + row[0] * right + row[1] * down for row in to_mask)
    fluid = (distance > 0) & (y >= -0.5) & (y <= rows - 0.5) & (x >= -0.5) & (x <= columns - 0.5)
    across, down = np.flatnonzero(fluid.any(axis=0)), np.flatnonzero(fluid.any(axis=1))
    box = (int(across[0]), int(down[0]), int(across[-1]) + 1, int(down[-1]) + 1) if len(across) else (0, 0, 0, 0)
    return Walls(np.ascontiguousarray(distance, np.float32), box)


def box_around(centre: tuple[float, float], range_px: float, box: Box) -> Box:
    """The box of a range around a centre, cut off by the sides of another box."""
    (x, y), (x0, y0, x1, y1) = centre, box
    left, top = max(math.floor(x - range_px), x0), max(math.floor(y - range_px), y0)
    return left, top, min(math.ceil(x + range_px) + 1, x1), min(math.ceil(y + range_px) + 1, y1)


def clip_box(centre: tuple[float, float], range_px: float, box: Box) -> Box:
    """`box_around` that is empty, and not turned inside out, where the range lies beyond the box."""
    x0, y0, x1, y1 = box_around(centre, min(range_px, 1e5), box)
    return x0, y0, max(x1, x0), max(y1, y0)


def _mask_distance_px(mask: Bools) -> Floats32:
    """Signed distance (h, w) to the walls of a mask in its pixels, as `clearance_um` defines it.

    It differs from `clearance_um` in the last bits: it is not rounded, and far from any wall it is finite. The two are
    kept apart because a replay compares the tracks of recorded sessions.
    """
    if mask.all():
        return np.full(mask.shape, _FAR_PX, np.float32)
    pad = 16
    fluid = np.pad(mask, pad, mode="edge").astype(np.uint8)
    inside = cv2.distanceTransform(fluid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - fluid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.where(fluid, inside - 0.5, 0.5 - outside)[pad:-pad, pad:-pad], np.float32)
