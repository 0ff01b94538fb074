"""A robot that follows -grad T through a flow, integrated as it moves: judges a time to go without any planner."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.interpolation import bilinear
from flowrec.messages import FlowField, Route
from flowrec.system.numba_setup import compiled

Raster = NDArray[np.float64]
_STEP_PX = 0.1


def drive(
    route: Route,
    flow: FlowField,
    start_um: NDArray[np.float64],
    goal_um: NDArray[np.float64],
    speed_um_s: float,
    within_um: float,
    at_most_s: float,
) -> tuple[float, NDArray[np.float64]]:
    """When the robot comes within a distance of the goal, inf if it does not in time; and its way (n, 2) in um.

    dx/dt = -V grad T / |grad T| + v by Heun's method; where T is not known the last heading is kept.
    """
    px = flow.um_per_px
    vx, vy = (np.ascontiguousarray(flow.velocity_um_s[..., c], np.float64) / px for c in (0, 1))
    x, y = (float(value) / px for value in start_um)
    gx, gy = (float(value) / px for value in goal_um)
    assert route.time_to_go_s is not None
    times = np.ascontiguousarray(route.time_to_go_s, np.float64)
    closer = px / (route.time_to_go_um_per_px or px)
    arrival, path = _drive(times, closer, vx, vy, x, y, gx, gy, speed_um_s / px, within_um / px, at_most_s)
    return arrival, path * px


@compiled
def _heading(times: Raster, x: float, y: float) -> tuple[float, float]:
    """The direction of -grad T from the pixels around a point; (0, 0) where too few are known."""
    h, w = times.shape
    i = min(max(int(x), 0), w - 2)
    j = min(max(int(y), 0), h - 2)
    a = min(max(x - i, 0.0), 1.0)
    b = min(max(y - j, 0.0), 1.0)
    gx = gy = wx = wy = 0.0
    for k in range(2):
        if math.isfinite(times[j + k, i]) and math.isfinite(times[j + k, i + 1]):
            share = b if k else 1.0 - b
            gx += share * (times[j + k, i + 1] - times[j + k, i])
            wx += share
        if math.isfinite(times[j, i + k]) and math.isfinite(times[j + 1, i + k]):
            share = a if k else 1.0 - a
            gy += share * (times[j + 1, i + k] - times[j, i + k])
            wy += share
    gx = gx / wx if wx > 0.0 else 0.0
    gy = gy / wy if wy > 0.0 else 0.0
    size = math.hypot(gx, gy)
    return (-gx / size, -gy / size) if size > 0.0 else (0.0, 0.0)


@compiled
def _drive(
    times: Raster,
    closer: float,
    vx: Raster,
    vy: Raster,
    x: float,
    y: float,
    goal_x: float,
    goal_y: float,
    speed: float,
    within: float,
    at_most: float,
) -> tuple[float, NDArray[np.float64]]:
    h, w = vx.shape
    path = np.empty((20000, 2))
    count = 0
    elapsed = 0.0
    hx = hy = 0.0
    n = 0
    while elapsed < at_most:
        if n % 10 == 0 and count < len(path):
            path[count, 0] = x
            path[count, 1] = y
            count += 1
        n += 1
        gap = math.hypot(goal_x - x, goal_y - y)
        if gap <= within:
            return elapsed, path[:count]
        fx, fy = _heading(times, closer * x, closer * y)
        if fx != 0.0 or fy != 0.0:
            hx, hy = fx, fy
        ux = speed * hx + bilinear(vx, x, y)
        uy = speed * hy + bilinear(vy, x, y)
        dt = _STEP_PX / (speed + math.hypot(ux, uy))
        px = x + dt * ux
        py = y + dt * uy
        fx, fy = _heading(times, closer * px, closer * py)
        if fx == 0.0 and fy == 0.0:
            fx, fy = hx, hy
        x += 0.5 * dt * (ux + speed * fx + bilinear(vx, px, py))
        y += 0.5 * dt * (uy + speed * fy + bilinear(vy, px, py))
        elapsed += dt
        if x < -0.5 or y < -0.5 or x > w - 0.5 or y > h - 0.5:
            break
    return math.inf, path[:count]
