"""Channels drawn as centrelines with a width: a pixel is fluid when its centre lies within."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray


def smooth_curve(points: ArrayLike, steps: int = 24) -> NDArray[np.float64]:
    """A Catmull-Rom curve (n, 2) through points (m, 2), with `steps` pieces between two of them."""
    given = np.asarray(points, np.float64)
    ends = (2 * given[:1] - given[1:2], given, 2 * given[-1:] - given[-2:-1])
    p = np.concatenate(ends)
    t = np.linspace(0.0, 1.0, steps, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.concatenate((*pieces, given[-1:]))


def curve_length(curve: NDArray[np.float64]) -> float:
    """Length of a polyline (n, 2)."""
    return float(np.hypot(*np.diff(curve, axis=0).T).sum())


def draw_channel(gap: NDArray[np.float64], curve: NDArray[np.float64], width: float) -> None:
    """Lower `gap` (h, w), the distance of pixel centres to the nearest channel (negative inside), to this channel's.

    Curve (n, 2) and width in pixels. Only pixels within the channel and a little around it are touched.
    """
    height, breadth = gap.shape
    reach = 0.5 * width + 3.0
    for (ax, ay), (bx, by) in zip(curve[:-1].tolist(), curve[1:].tolist(), strict=True):
        left, right = max(math.floor(min(ax, bx) - reach), 0), min(math.ceil(max(ax, bx) + reach) + 1, breadth)
        top, bottom = max(math.floor(min(ay, by) - reach), 0), min(math.ceil(max(ay, by) + reach) + 1, height)
        if left >= right or top >= bottom:
            continue
        x, y = np.meshgrid(np.arange(left, right) - ax, np.arange(top, bottom) - ay)
        dx, dy = bx - ax, by - ay
        along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        window = gap[top:bottom, left:right]
        np.minimum(window, np.hypot(x - along * dx, y - along * dy) - 0.5 * width, out=window)
