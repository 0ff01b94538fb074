"""Which camera pixels show open fluid: the chip's mask as the camera sees it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.chip import clearance_um
from flowrec.chip.calibration import Calibration
from flowrec.chip.chip import Chip

_EDGE_PX = 1.5  # a wall's bright and dark edge reaches this far into the channel


@dataclass(frozen=True, slots=True, eq=False)
class FluidView:
    """Pixels of open fluid, and pixels where the centre of a robot may be."""

    open: NDArray[np.bool_]  # (h, w)
    centres: NDArray[np.bool_]  # (h, w)
    box: tuple[int, int, int, int]  # x0, y0, x1, y1 around `centres`


@lru_cache(maxsize=4)
def fluid_view(chip: Chip, calibration: Calibration, shape: tuple[int, int], radius_px: float) -> FluidView:
    """The view of a chip (compared by identity) in an image of `shape` (rows, columns); made once."""
    scale = calibration.um_per_px / chip.um_per_px
    x, y = (value / chip.um_per_px for value in calibration.origin_um)
    # Distances interpolate smoothly where a mask would give stairs.
    wall_px = cv2.warpAffine(
        clearance_um(chip.mask, chip.um_per_px) / calibration.um_per_px,
        np.array([[scale, 0.0, x], [0.0, scale, y]]),
        (shape[1], shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=-1e3,
    )
    # A robot that touches the wall has its centre a radius away; the outline itself is only known to a pixel or so.
    centres = wall_px > max(0.4 * radius_px, 0.5)
    rows, columns = np.nonzero(centres)
    box = (0, 0, shape[1], shape[0])
    if len(rows):
        box = (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
    return FluidView(wall_px > _EDGE_PX, centres, box)
