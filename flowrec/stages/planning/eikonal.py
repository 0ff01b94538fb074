"""Time to go from every pixel to a goal through a flow: Zermelo's eikonal equation, solved outward from the goal.

    V |grad T| = 1 + v . grad T,   T(goal) = 0

The solution T is the least time to the goal, and -grad T the best heading. The value of a pixel comes through one of
the 8 triangles of its neighbours, with T linear along the far side, in closed form. Where the flow is faster than V
some directions are impossible; their triangles give no value, and what can not reach the goal stays infinite. There a
pixel may also get a better value after it was passed on, so labels are corrected, not set (compare the ordered upwind
method of Sethian and Vladimirsky, 2003).

Lengths are pixels, times seconds.
"""

from __future__ import annotations

import heapq
import math

import numpy as np

from flowrec.core import bilinear, bilinear_known, compiled
from flowrec.stages.planning.cost_rasters import NEIGHBOUR_X, NEIGHBOUR_Y, CostRasters, Points, Raster
from flowrec.stages.planning.kernels import line_is_clear, segment_cost, step_cost, step_energy

_STEP_PX = 1.5  # of a descent
_DIRECTIONS, _BISECTIONS = 64, 5  # of a step: around the circle, then about the best of them

_EXACT_PX = 3.0  # around the goal, where the front is too curved for triangles, times are those of straight lines


@compiled
def _through_triangle(
    sign: float,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    time_a: float,
    time_b: float,
    vx: float,
    vy: float,
    speed2: float,
) -> float:
    """Time of the corner of a triangle from those of its other corners at a and b, seen from it; inf if none.

    det(a, b) = sign. With T linear, grad T = p - q t where t is the time sought; put into the equation squared,
    V^2 |grad T|^2 = (1 + v . grad T)^2, this is quadratic in t. Valid is the smallest root with 1 + v . grad T > 0
    whose characteristic, v - V grad T / |grad T|, leaves through the far side.
    """
    px = (time_a * by - time_b * ay) * sign
    py = (ax * time_b - bx * time_a) * sign
    qx = (by - ay) * sign
    qy = (ax - bx) * sign
    vq = vx * qx + vy * qy
    vp = 1.0 + vx * px + vy * py
    first = speed2 * (qx * qx + qy * qy) - vq * vq
    half = speed2 * (px * qx + py * qy) - vp * vq
    last = speed2 * (px * px + py * py) - vp * vp
    inside = half * half - first * last
    if inside < 0.0:
        return math.inf
    root = math.sqrt(inside)
    best = math.inf
    for k in range(2):
        if k == 1 and vx * vx + vy * vy < speed2:
            break  # in a flow slower than V only one solution grows away from the goal
        if abs(first) < 1e-12 * speed2:
            if abs(half) < 1e-14:
                break
            t = last / (2.0 * half)
        elif k == 0:
            t = (half + root) / first
        else:
            t = (half - root) / first
        if t <= 0.0 or t >= best:
            continue
        gx = px - qx * t
        gy = py - qy * t
        rate = 1.0 + vx * gx + vy * gy  # V |grad T|
        if rate <= 0.0:
            continue
        cx = vx * rate - speed2 * gx
        cy = vy * rate - speed2 * gy
        if (cx * by - cy * bx) * sign >= 0.0 and (ax * cy - ay * cx) * sign >= 0.0:
            best = t
    return best


@compiled
def _energy_through_triangle(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    cost_a: float,
    cost_b: float,
    vx: float,
    vy: float,
    speed: float,
    idle: float,
) -> float:
    """Energy through a triangle; without a closed form at the speed limit: golden section search along the far side.

    The cost of a displacement is convex in it, so there is one minimum.
    """
    golden = 0.6180339887498949
    low = 0.0
    high = 1.0
    s = high - golden
    t = low + golden
    at_s = cost_a + s * (cost_b - cost_a) + step_energy(ax + s * (bx - ax), ay + s * (by - ay), vx, vy, speed, idle)
    at_t = cost_a + t * (cost_b - cost_a) + step_energy(ax + t * (bx - ax), ay + t * (by - ay), vx, vy, speed, idle)
    for _ in range(12):
        # Where both are impossible the far end is nearer to what is possible: the near one is tried on its own.
        nearer = at_s < at_t
        if nearer:
            high = t
            t = s
            at_t = at_s
            s = high - golden * (high - low)
        else:
            low = s
            s = t
            at_s = at_t
            t = low + golden * (high - low)
        new = s if nearer else t
        energy = step_energy(ax + new * (bx - ax), ay + new * (by - ay), vx, vy, speed, idle)
        cost = cost_a + new * (cost_b - cost_a) + energy
        if nearer:
            at_s = cost
        else:
            at_t = cost
    return min(at_s, at_t)


@compiled
def time_field(rasters: CostRasters, goal: Points) -> Raster:
    """(h, w) seconds from each free pixel to a goal (2,) in px; inf where it can not be reached.

    With `rasters.idle` > 0 it is the energy to go, px2/s (`kernels.step_energy`), by the same scheme.
    """
    free, _, _, vx, vy, speed, idle = rasters
    h, w = free.shape
    times = np.full((h, w), np.inf)
    heap = _start_at_goal(rasters, goal, times)
    while len(heap) > 0:
        key, node = heapq.heappop(heap)
        j = node // w
        i = node - j * w
        if key > times[j, i]:
            continue
        for k in range(8):
            a = i + NEIGHBOUR_X[k]
            b = j + NEIGHBOUR_Y[k]
            if a < 0 or b < 0 or a >= w or b >= h or not free[b, a]:
                continue
            known = times[b, a]
            if known <= key:
                continue
            # Seen from the neighbour, the node lies in the opposite direction.
            back = (k + 4) & 7
            ax = float(NEIGHBOUR_X[back])
            ay = float(NEIGHBOUR_Y[back])
            own_x = vx[b, a]
            own_y = vy[b, a]
            own = speed[b, a]
            best = key + step_cost(
                ax, ay, 0.5 * (own_x + vx[j, i]), 0.5 * (own_y + vy[j, i]), 0.5 * (own + speed[j, i]), idle
            )
            for turn in range(2):
                other = (back + 1) & 7 if turn == 0 else (back + 7) & 7
                bx = float(NEIGHBOUR_X[other])
                by = float(NEIGHBOUR_Y[other])
                c = a + NEIGHBOUR_X[other]
                d = b + NEIGHBOUR_Y[other]
                if c < 0 or d < 0 or c >= w or d >= h:
                    continue
                beside = times[d, c]
                if beside >= min(best, known):
                    continue
                mean = 0.5 * own + 0.25 * (speed[j, i] + speed[d, c])
                mx = 0.5 * own_x + 0.25 * (vx[j, i] + vx[d, c])
                my = 0.5 * own_y + 0.25 * (vy[j, i] + vy[d, c])
                if idle > 0.0:
                    t = _energy_through_triangle(ax, ay, bx, by, key, beside, mx, my, mean, idle)
                else:
                    sign = 1.0 if turn == 0 else -1.0
                    t = _through_triangle(sign, ax, ay, bx, by, key, beside, mx, my, mean * mean)
                best = min(best, t)
            if best < known * (1.0 - 1e-10):
                times[b, a] = best
                heapq.heappush(heap, (best, b * w + a))
    return times


@compiled
def _start_at_goal(rasters: CostRasters, goal: Points, times: Raster) -> list[tuple[float, int]]:
    """Set `times` (h, w) within _EXACT_PX of a goal (2,) by straight lines; returns the heap of (time, node)."""
    free, clearance, need, vx, vy, speed, idle = rasters
    h, w = free.shape
    goal_x, goal_y = goal
    heap = [(0.0, 0) for _ in range(0)]
    # Near a goal that is itself too near to a wall, its own clearance is all that can be asked.
    near = min(need, bilinear(clearance, goal_x, goal_y)) - 1e-9
    for b in range(max(0, math.floor(goal_y - _EXACT_PX)), min(h, math.ceil(goal_y + _EXACT_PX) + 1)):
        for a in range(max(0, math.floor(goal_x - _EXACT_PX)), min(w, math.ceil(goal_x + _EXACT_PX) + 1)):
            if (
                free[b, a]
                and math.hypot(a - goal_x, b - goal_y) <= _EXACT_PX
                and line_is_clear(clearance, float(a), float(b), goal_x, goal_y, near)
            ):
                t = segment_cost(vx, vy, speed, idle, float(a), float(b), goal_x, goal_y, 0.25)
                if t < math.inf:
                    times[b, a] = t
                    heapq.heappush(heap, (t, b * w + a))
    return heap


def descend(rasters: CostRasters, times: Raster, start: Points, goal: Points) -> Points | None:
    """(n, 2) px, the fastest path from a start (2,) to the goal (2,) of `times` in steps of 1.5; None if it gets stuck.

    Each step goes to the point of a circle where the time of the step and the time to go have the least sum. Unlike the
    gradient this also crosses the kinks of T.
    """
    path = _descend(rasters, times, start, goal)
    return path if len(path) else None


@compiled
def _descend(rasters: CostRasters, times: Raster, start: Points, goal: Points) -> Points:
    """See `descend`; (0, 2) if it gets stuck."""
    x, y = start
    goal_x, goal_y = goal
    _, clearance, need, vx, vy, speed, idle = rasters
    h, w = times.shape
    most = 4 * (h + w) + h * w // 4
    points = np.empty((most, 2))
    points[0, 0] = x
    points[0, 1] = y
    n = 1
    left = math.inf
    near = min(need, bilinear(clearance, goal_x, goal_y)) - 1e-9
    while n < most - 1:
        if (
            math.hypot(goal_x - x, goal_y - y) <= 2.0 * _STEP_PX
            and line_is_clear(clearance, x, y, goal_x, goal_y, near)
            and math.isfinite(segment_cost(vx, vy, speed, idle, x, y, goal_x, goal_y, 0.25))
        ):
            points[n, 0] = goal_x
            points[n, 1] = goal_y
            return points[: n + 1]
        angle = _best_direction(rasters, times, x, y, left)
        if math.isfinite(angle):
            x += _STEP_PX * math.cos(angle)
            y += _STEP_PX * math.sin(angle)
        else:
            # On the ridge of an oblique channel the bilinear clearance dips between free pixels that touch.
            x, y = _best_pixel(rasters, times, x, y, left)
            if not math.isfinite(x):
                return points[:0]
        left = bilinear_known(times, x, y)
        points[n, 0] = x
        points[n, 1] = y
        n += 1
    return points[:0]


@compiled
def _best_direction(rasters: CostRasters, times: Raster, x: float, y: float, left: float) -> float:
    """Angle in rad of the best clear step of _STEP_PX from (x, y) to where the time is below `left`; inf if none."""
    _, clearance, need, vx, vy, speed, idle = rasters
    best = math.inf
    angle = math.inf
    middle = 0.0
    for k in range(_DIRECTIONS + 2 * _BISECTIONS):
        if k < _DIRECTIONS:
            tried = 2.0 * math.pi * k / _DIRECTIONS
        else:
            if best == math.inf:
                break
            if k % 2 == 0:
                middle = angle
            step = 2.0 * math.pi / _DIRECTIONS * 0.5 ** (1 + (k - _DIRECTIONS) // 2)
            tried = middle + (step if k % 2 == 0 else -step)
        dx = _STEP_PX * math.cos(tried)
        dy = _STEP_PX * math.sin(tried)
        t = bilinear_known(times, x + dx, y + dy)
        if t >= left or t >= best:
            continue
        mx = x + 0.5 * dx
        my = y + 0.5 * dy
        t += step_cost(dx, dy, bilinear(vx, mx, my), bilinear(vy, mx, my), bilinear(speed, mx, my), idle)
        if t < best and line_is_clear(clearance, x, y, x + dx, y + dy, need):
            best = t
            angle = tried
    return angle


@compiled
def _best_pixel(rasters: CostRasters, times: Raster, x: float, y: float, left: float) -> tuple[float, float]:
    """The best pixel (x, y) around a point whose time is below `left`; inf if there is none."""
    _, _, _, vx, vy, speed, idle = rasters
    h, w = times.shape
    best = math.inf
    best_x = math.inf
    best_y = math.inf
    column = round(x)
    row = round(y)
    for b in range(max(0, row - 1), min(h, row + 2)):
        for a in range(max(0, column - 1), min(w, column + 2)):
            if times[b, a] >= left or math.hypot(a - x, b - y) < 0.5:
                continue
            t = times[b, a] + segment_cost(vx, vy, speed, idle, x, y, float(a), float(b), 0.75)
            if t < best:
                best = t
                best_x = float(a)
                best_y = float(b)
    return best_x, best_y
