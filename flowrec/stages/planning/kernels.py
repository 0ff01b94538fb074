"""Kernels of Zermelo's problem on rasters: the cost of a straight step, and the clearance along it.

A robot of speed V through the fluid that moves along the unit vector d in a flow v has the ground speed
    s = d . v + sqrt(V^2 - |v_perp|^2),
and can not move along d where s is not positive (Zermelo 1931). Lengths are pixels, times seconds.
"""

from __future__ import annotations

import math

from flowrec.core import Floats, bilinear, compiled, corner_weights
from flowrec.stages.planning.cost_rasters import Raster


@compiled
def step_time(dx: float, dy: float, vx: float, vy: float, speed: float) -> float:
    """Time (s) of a displacement (px) in a uniform flow (px/s) at a speed through the fluid; inf if impossible."""
    distance2 = dx * dx + dy * dy
    along = dx * vx + dy * vy
    root = along * along + (speed * speed - vx * vx - vy * vy) * distance2
    if root < 0.0:
        return math.inf
    ground = along + math.sqrt(root)
    if ground <= 1e-9 * distance2:
        return math.inf
    return distance2 / ground


@compiled
def step_energy(dx: float, dy: float, vx: float, vy: float, speed: float, idle: float) -> float:
    """Least energy (px2/s) of a displacement (px) in a uniform flow (px/s) at a speed of at most `speed`.

    The power is idle^2 + |u|^2 at the speed u through the fluid: at u = `idle` > 0 swimming takes as much power as
    everything else. At the ground speed s a length costs (idle^2 + |s d - v|^2) / s, which is least at
    s = sqrt(idle^2 + |v|^2); s is limited to the values that |u| <= speed allows. Infinite if the step is impossible.
    """
    distance = math.hypot(dx, dy)
    along = (dx * vx + dy * vy) / distance
    flow2 = vx * vx + vy * vy
    spare = speed * speed - flow2 + along * along
    if spare < 0.0:
        return math.inf
    root = math.sqrt(spare)
    if along + root <= 1e-9 * speed:
        return math.inf
    ground = min(max(math.sqrt(idle * idle + flow2), along - root), along + root)
    return distance * ((idle * idle + flow2) / ground + ground - 2.0 * along)


@compiled
def step_cost(dx: float, dy: float, vx: float, vy: float, speed: float, idle: float) -> float:
    """`step_energy`, or `step_time` for a negative `idle`."""
    if idle < 0.0:
        return step_time(dx, dy, vx, vy, speed)
    return step_energy(dx, dy, vx, vy, speed, idle)


@compiled
def segment_cost(
    vx: Raster, vy: Raster, speed: Raster, idle: float, x0: float, y0: float, x1: float, y1: float, spacing: float
) -> float:
    """Cost of a straight segment (px) by the midpoint rule, midpoints at most `spacing` px apart."""
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
def lowest_clearance(clearance: Floats, x0: float, y0: float, x1: float, y1: float) -> float:
    """The least clearance (px) along a segment (px), sampled at least every quarter of a pixel."""
    n = 1 + int(4.0 * max(abs(x1 - x0), abs(y1 - y0)))
    lowest = math.inf
    for k in range(n + 1):
        t = k / n
        lowest = min(lowest, bilinear(clearance, x0 + t * (x1 - x0), y0 + t * (y1 - y0)))
    return lowest


@compiled
def line_is_clear(clearance: Floats, x0: float, y0: float, x1: float, y1: float, need: float) -> bool:
    """True if the clearance (px) is at least `need` all along a segment (px)."""
    return lowest_clearance(clearance, x0, y0, x1, y1) >= need
