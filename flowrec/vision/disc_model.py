"""What the robot looks like in bright field: a dark disc within a bright rim, both softened by defocus."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flowrec.system.numba_setup import compiled

RIM_SHARE = 0.35  # brightness of the rim as a share of the disc's darkness, where nothing better is known
_STEEP = 2.2
_RIM_AT, _RIM_WIDTH = 2.0, 1.1  # in edge widths outside the outline


@compiled
def profile(s: float) -> tuple[float, float, float, float]:
    """Disc (1 inside, 0 outside) and rim at s edge widths outside the outline, and their derivatives by s."""
    disc = 1.0 / (1.0 + math.exp(min(max(_STEEP * s, -40.0), 40.0)))
    off = (s - _RIM_AT) / _RIM_WIDTH
    rim = math.exp(-off * off)
    return disc, rim, -_STEEP * disc * (1.0 - disc), -2.0 * off / _RIM_WIDTH * rim


def edge_px(radius_px: float) -> float:
    """Softness of the outline to begin with: the optics' and a share of the size, camera px."""
    return math.hypot(0.9, 0.06 * radius_px)


@lru_cache(maxsize=16)
def template(radius_px: float, step: int) -> NDArray[np.float32]:
    """The robot (n, n), n odd, in an image shrunk by `step`: disc -1, rim bright, background 0, mean 0."""
    radius, edge = radius_px / step, edge_px(radius_px) / step + 0.3 * (step > 1)
    half = math.ceil(1.15 * radius + 2.5 * edge)
    fine = 4
    axis = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    shape = np.empty((len(axis), len(axis)))
    for row, y in enumerate(axis.tolist()):
        for column, x in enumerate(axis.tolist()):
            disc, rim, _, _ = profile((math.hypot(x, y) - radius) / edge)
            shape[row, column] = RIM_SHARE * rim - disc
    binned = shape.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean(axis=(1, 3))
    pattern = np.ascontiguousarray(binned - binned.mean(), np.float32)
    pattern.flags.writeable = False
    return pattern
