"""Where in the image the robot can be: the chip's walls as the camera sees them, computed once per view."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.chip import clearance_um
from flowrec.chip.calibration import Calibration
from flowrec.chip.chip import Chip


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Signed distance to the walls in camera pixels, and what follows from it for a robot of one size."""

    distance_px: NDArray[np.float32]  # (h, w) negative in solid
    inside: NDArray[np.bool_]  # (h, w) within the rectangle of the chip's mask
    box: tuple[int, int, int, int]  # x0, y0, x1, y1 around all fluid in the image

    def open(self, x0: int, y0: int, x1: int, y1: int, margin_px: float) -> NDArray[np.float32] | None:
        """1 where a region is farther than the margin from the walls and 0 elsewhere; None when it is 1 throughout."""
        far = self.distance_px[y0:y1, x0:x1] > margin_px
        return None if far.all() else far.astype(np.float32)

    def reachable(self, x0: int, y0: int, x1: int, y1: int, clearance_px: float) -> NDArray[np.bool_]:
        """True where the centre of a robot may be."""
        return (self.distance_px[y0:y1, x0:x1] >= clearance_px) & self.inside[y0:y1, x0:x1]


_Key = tuple[int, float, Calibration, tuple[int, int]]
_CACHE: dict[_Key, tuple[weakref.ref[NDArray[np.bool_]], Walls]] = {}
_CACHE_SIZE = 4  # a few views at most: each holds an image of floats


def walls_in_view(chip: Chip, calibration: Calibration, shape: tuple[int, int]) -> Walls:
    """Walls of a chip in a camera image of shape (h, w); the latest few are remembered by the mask's identity."""
    key = (id(chip.mask), chip.um_per_px, calibration, shape)
    known = _CACHE.get(key)
    # An id may be taken again by another array once the first is gone.
    if known is not None and known[0]() is chip.mask:
        return known[1]
    walls = _look(chip, calibration, shape)
    if len(_CACHE) >= _CACHE_SIZE:
        _CACHE.pop(next(iter(_CACHE)), None)
    _CACHE[key] = (weakref.ref(chip.mask), walls)
    return walls


def _look(chip: Chip, calibration: Calibration, shape: tuple[int, int]) -> Walls:
    height, width = shape
    mask_px = calibration.um_per_px / chip.um_per_px  # mask pixels per camera pixel
    x0, y0 = np.asarray(calibration.origin_um) / chip.um_per_px
    clearance = np.minimum(clearance_um(chip.mask, chip.um_per_px), 1e6) / calibration.um_per_px
    distance = cv2.warpAffine(
        clearance.astype(np.float32),
        np.array([[mask_px, 0.0, x0], [0.0, mask_px, y0]]),
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,  # a channel cut by the border goes on straight
    )
    x = x0 + mask_px * np.arange(width)
    y = y0 + mask_px * np.arange(height)
    rows, columns = chip.mask.shape
    inside = ((y >= -0.5) & (y <= rows - 0.5))[:, None] & ((x >= -0.5) & (x <= columns - 0.5))[None]
    fluid = inside & (distance > 0)
    across, down = np.flatnonzero(fluid.any(axis=0)), np.flatnonzero(fluid.any(axis=1))
    box = (int(across[0]), int(down[0]), int(across[-1]) + 1, int(down[-1]) + 1) if len(across) else (0, 0, 0, 0)
    return Walls(np.asarray(distance, np.float32), inside, box)
