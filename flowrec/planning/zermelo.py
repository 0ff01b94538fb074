"""Kernels of Zermelo's problem on rasters, in pixels and seconds: what a step costs, and whether it is clear.

A robot of speed V through the fluid that is to move along the unit direction d in a flow w crosses the ground with
    d.w + sqrt(V^2 - |w_perp|^2),
and can not where that is not positive (science.md, section 3). Rasters are float64 and C-contiguous.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.interpolation import bilinear, corner_weights
from flowrec.system.numba_setup import compiled

Raster = NDArray[np.float64]


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
def step_energy(dx: float, dy: float, wx: float, wy: float, speed: float, idle: float) -> float:
    """Least energy for a displacement (px) in a uniform flow by a robot that may swim slower than `speed`; px2/s.

    It spends idle^2 + |u|^2 per second at the speed u through the fluid: `idle` > 0 is the swimming speed that takes
    as much power as being there does. At the ground speed s a length costs (idle^2 + |s d - w|^2) / s, least for
    s = sqrt(idle^2 + |w|^2), and as near to that as |u| <= speed allows: 2 (s - d . w) where the limit does not bind.
    inf where the displacement is impossible.
    """
    distance = math.hypot(dx, dy)
    along = (dx * wx + dy * wy) / distance
    flow2 = wx * wx + wy * wy
    spare = speed * speed - flow2 + along * along
    if spare < 0.0:
        return math.inf
    root = math.sqrt(spare)
    if along + root <= 1e-9 * speed:
        return math.inf
    ground = min(max(math.sqrt(idle * idle + flow2), along - root), along + root)
    return distance * ((idle * idle + flow2) / ground + ground - 2.0 * along)


@compiled
def step_cost(dx: float, dy: float, wx: float, wy: float, speed: float, idle: float) -> float:
    """`step_energy`, or with a negative `idle` `step_time`."""
    if idle < 0.0:
        return step_time(dx, dy, wx, wy, speed)
    return step_energy(dx, dy, wx, wy, speed, idle)


@compiled
def segment_cost(
    vx: Raster,
    vy: Raster,
    speed: Raster,
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    idle: float,
    spacing: float,
) -> float:
    """Cost along a straight segment, by midpoints at most `spacing` apart."""
    n = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / spacing))
    dx = (x1 - x0) / n
    dy = (y1 - y0) / n
    if dx == 0.0 and dy == 0.0:
        return 0.0
    h, w = vx.shape
    total = 0.0
    for k in range(n):
        j, i, p, q, r, s = corner_weights(x0 + (k + 0.5) * dx, y0 + (k + 0.5) * dy, h, w)
        total += step_cost(
            dx,
            dy,
            p * vx[j, i] + q * vx[j, i + 1] + r * vx[j + 1, i] + s * vx[j + 1, i + 1],
            p * vy[j, i] + q * vy[j, i + 1] + r * vy[j + 1, i] + s * vy[j + 1, i + 1],
            p * speed[j, i] + q * speed[j, i + 1] + r * speed[j + 1, i] + s * speed[j + 1, i + 1],
            idle,
        )
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
