"""The flow between the pixel centres."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.messages import FlowField


def sample(field: FlowField, points_um: ArrayLike) -> NDArray[np.float64]:
    """Velocity (..., 2) in um/s at points (..., 2) in um: bilinear, zero outside the mask's image.

    Within the outer half pixel the border's values hold. One point takes a few microseconds, for use in a loop.
    """
    points = np.asarray(points_um, np.float64)
    velocity = field.velocity_um_s
    if points.ndim == 1:
        return np.array(_one(velocity, float(points[0]) / field.um_per_px, float(points[1]) / field.um_per_px))
    h, w = velocity.shape[:2]
    x, y = points[..., 0] / field.um_per_px, points[..., 1] / field.um_per_px
    inside = (x >= -0.5) & (x <= w - 0.5) & (y >= -0.5) & (y <= h - 0.5)
    x = np.clip(np.where(inside, x, 0.0), 0.0, w - 1.0)
    y = np.clip(np.where(inside, y, 0.0), 0.0, h - 1.0)
    column, row = np.minimum(x.astype(np.intp), max(w - 2, 0)), np.minimum(y.astype(np.intp), max(h - 2, 0))
    right, below = np.minimum(column + 1, w - 1), np.minimum(row + 1, h - 1)
    a, b = (x - column)[..., None], (y - row)[..., None]
    upper = (1.0 - a) * velocity[row, column] + a * velocity[row, right]
    lower = (1.0 - a) * velocity[below, column] + a * velocity[below, right]
    return np.asarray(np.where(inside[..., None], (1.0 - b) * upper + b * lower, 0.0), np.float64)


def _one(velocity: NDArray[np.float32], x: float, y: float) -> tuple[float, float]:
    """The same at one point (x, y) in pixels, in the same order of operations, without numpy's overhead."""
    h, w = velocity.shape[:2]
    if not (-0.5 <= x <= w - 0.5 and -0.5 <= y <= h - 0.5):
        return 0.0, 0.0
    x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
    column, row = min(math.floor(x), max(w - 2, 0)), min(math.floor(y), max(h - 2, 0))
    right, below = min(column + 1, w - 1), min(row + 1, h - 1)
    a, b = x - column, y - row
    item = velocity.item
    vx, vy = (
        (1.0 - b) * ((1.0 - a) * item(row, column, c) + a * item(row, right, c))
        + b * ((1.0 - a) * item(below, column, c) + a * item(below, right, c))
        for c in (0, 1)
    )
    return vx, vy
