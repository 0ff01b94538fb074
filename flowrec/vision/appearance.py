"""What the robot looks like in bright field: a dark disc, a bright rim, both softened by defocus."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

_RIM = 0.35  # brightness of the rim, as a share of the disc's darkness
_RIM_AT = 1.22  # its radius, in radii of the disc
_REACH = 1.75  # the template ends here, in radii of the disc, beyond the rim
_SOFT_PX = 1.0  # least blur of an edge by optics and pixels


def profile(distance_px: NDArray[np.float64], radius_px: float) -> NDArray[np.float64]:
    """Brightness against the background at a distance from the centre: -1 in the disc, positive on the rim."""
    soft = max(_SOFT_PX, 0.12 * radius_px)
    disc = -1.0 / (1.0 + np.exp((distance_px - radius_px) / (0.5 * soft)))
    ring = _RIM * np.exp(-0.5 * ((distance_px - _RIM_AT * radius_px) / (0.6 * soft + 0.08 * radius_px)) ** 2)
    return disc + ring


def reach_px(radius_px: float) -> int:
    """Half the side of the template: the square is 2 reach + 1 pixels wide."""
    return math.ceil(_REACH * radius_px) + 1


@lru_cache(maxsize=16)
def template(radius_px: float) -> NDArray[np.float32]:
    """The robot centred on the middle pixel of a square of 2 reach + 1 pixels a side."""
    reach = reach_px(radius_px)
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    return profile(np.hypot(*np.meshgrid(offsets, offsets)), radius_px).astype(np.float32)
