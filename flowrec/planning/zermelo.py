"""Kernels of Zermelo's problem on rasters, in pixels and seconds: how long a step takes, and whether it is clear.

A robot of speed V through the fluid that is to move along the unit direction d in a flow w crosses the ground with
    d.w + sqrt(V^2 - |w_perp|^2),
and can not where that is not positive (science.md, section 3). Rasters are float64 and C-contiguous.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.planning.jit import compiled

Raster = NDArray[np.float64]


@compiled
def bilinear(raster: Raster, x: float, y: float) -> float:
    """Value of a raster (h, w) at a point in pixels; outside, that of the nearest border point."""
    h, w = raster.shape
    x = min(max(x, 0.0), w - 1.0)
    y = min(max(y, 0.0), h - 1.0)
    i = min(int(x), w - 2)
    j = min(int(y), h - 2)
    a = x - i
    b = y - j
    upper = raster[j, i] * (1.0 - a) + raster[j, i + 1] * a
    lower = raster[j + 1, i] * (1.0 - a) + raster[j + 1, i + 1] * a
    return float(upper * (1.0 - b) + lower * b)


@compiled
def step_time(dx: float, dy: float, wx: float, wy: float, speed: float) -> float:
    """Time for a displacement (px) in a uniform flow (px/s) at a speed through the fluid; inf where impossible."""
    distance2 = dx * dx + dy * dy
    along = dx * wx + dy * wy
    root = along * along + (speed * speed - wx * wx - wy * wy) * distance2
    if root < 0.0:
        return math.inf
    ground = along + math.sqrt(root)
    if ground <= 1e-9 * distance2:
        return math.inf
    return distance2 / ground


@compiled
def segment_time(
    vx: Raster, vy: Raster, weight: Raster, x0: float, y0: float, x1: float, y1: float, speed: float
) -> float:
    """Weighted time along a straight segment, by midpoints at most a pixel apart."""
    n = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0)))
    dx = (x1 - x0) / n
    dy = (y1 - y0) / n
    total = 0.0
    for k in range(n):
        x = x0 + (k + 0.5) * dx
        y = y0 + (k + 0.5) * dy
        if dx != 0.0 or dy != 0.0:
            total += bilinear(weight, x, y) * step_time(dx, dy, bilinear(vx, x, y), bilinear(vy, x, y), speed)
    return total


@compiled
def lowest_clearance(clearance: Raster, x0: float, y0: float, x1: float, y1: float) -> float:
    """The least clearance (px) along a segment, looked at every quarter of a pixel."""
    n = 1 + int(4.0 * max(abs(x1 - x0), abs(y1 - y0)))
    lowest = math.inf
    for k in range(n + 1):
        t = k / n
        lowest = min(lowest, bilinear(clearance, x0 + t * (x1 - x0), y0 + t * (y1 - y0)))
    return lowest


@compiled
def line_is_clear(clearance: Raster, x0: float, y0: float, x1: float, y1: float, need: float) -> bool:
    """Whether the clearance (px) is at least `need` all along a segment."""
    return lowest_clearance(clearance, x0, y0, x1, y1) >= need
