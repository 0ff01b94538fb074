"""What the robot looks like in bright field: a dark disc, a bright rim, both softened by defocus."""

from __future__ import annotations

import math
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

_RIM = 0.35  # brightness of the rim, as a share of the disc's darkness
_RIM_AT = 1.22  # its radius, in radii of the disc
_REACH = 1.75  # the template ends here, in radii of the disc, beyond the rim
_SOFT_PX = 1.0  # least blur of an edge by optics and pixels


def widths_px(radius_px: float) -> tuple[float, float, float]:
    """Softness of the disc's edge, radius of the rim and its width, in pixels."""
    soft = max(_SOFT_PX, 0.12 * radius_px)
    return 0.5 * soft, _RIM_AT * radius_px, 0.6 * soft + 0.08 * radius_px


@numba.njit(cache=True)
def brightness(distance: float, radius: float, soft: float, ring_at: float, ring_width: float) -> tuple[float, float]:
    """Brightness against the background at a distance from the centre, and its derivative: -1 in the disc."""
    edge = math.exp(min((distance - radius) / soft, 50.0))
    off = (distance - ring_at) / ring_width
    ring = _RIM * math.exp(-0.5 * off * off)
    return -1.0 / (1.0 + edge) + ring, edge / (soft * (1.0 + edge) ** 2) - ring * off / ring_width


def reach_px(radius_px: float) -> int:
    """Half the side of the template: the square is 2 reach + 1 pixels wide."""
    return math.ceil(_REACH * radius_px) + 1


@lru_cache(maxsize=16)
def template(radius_px: float) -> NDArray[np.float32]:
    """The robot centred on the middle pixel of a square of 2 reach + 1 pixels a side."""
    reach = reach_px(radius_px)
    offsets = range(-reach, reach + 1)
    widths = widths_px(radius_px)
    square = [[brightness(math.hypot(x, y), radius_px, *widths)[0] for x in offsets] for y in offsets]
    return np.array(square, np.float32)
