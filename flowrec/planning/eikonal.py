"""Time to go from everywhere to a goal through a flow: Zermelo's eikonal equation, marched outward from the goal.

    V |grad T| = 1 + v . grad T,   T(goal) = 0

is what the least time T from each point to the goal obeys (science.md, section 3). It is solved on the pixels: the
value of a pixel comes through one of the 8 triangles of its neighbours in which its way to the goal begins, with T
linear along the far side, in closed form. Against a flow faster than V some ways are not possible; those triangles
give nothing, so what can not reach the goal stays at infinity. Where the robot drifts faster than it swims, a pixel
may get a better value after it was passed on: labels are corrected, not set (compare Sethian and Vladimirsky, 2003).

-grad T is the best heading anywhere. Lengths are pixels here, times seconds; rasters float64 and C-contiguous.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.interpolation import bilinear, bilinear_known
from flowrec.planning.cost_rasters import Terrain
from flowrec.planning.zermelo import line_is_clear, segment_cost, step_cost, step_energy
from flowrec.system.numba_setup import compiled

Points = NDArray[np.float64]
Raster = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EXACT_PX = 3.0  # around the goal, where the front is too curved for triangles, times are those of straight ways
_RING_X = np.array([1, 1, 0, -1, -1, -1, 0, 1], np.int64)
_RING_Y = np.array([0, 1, 1, 1, 0, -1, -1, -1], np.int64)

# In the band that is nearer to the walls than the robot should be, a pixel of clearance that is lacking costs so many
# times what a pixel takes in still fluid: there -grad T leads out of the band, within some 20 degrees of straight.
_BAND_TOLL = 3.0
_LEAST_TOLL = 0.05  # px
# A step between neighbours that costs more than swimming so many pixels lies between two places that only a
# passage too narrow for the robot connects.
_TORN_PX = 30.0


def time_field(terrain: Terrain, goal: Points) -> Raster:
    """(h, w) seconds from each free pixel to a goal (2,) in px; inf where it can not be reached.

    Where energy counts it is energy, px2/s, by the same march with its own cost (`zermelo.step_energy`).
    """
    times = np.full(terrain.free.shape, np.inf)
    _march(
        terrain.free,
        terrain.clearance,
        terrain.need,
        terrain.vx,
        terrain.vy,
        terrain.speed,
        terrain.idle,
        float(goal[0]),
        float(goal[1]),
        _EXACT_PX,
        times,
    )
    return times


def with_band(times: Raster, free: Mask, clearance: Raster, need: float, speed: float) -> Raster:
    """The same times (h, w) with the fluid nearer to the walls than `free`, where -grad T leads back to `free`.

    Layer by layer from the free pixels: the worst of the neighbours one layer nearer to them, plus a toll for every
    pixel of clearance that is lacking. So no way through the band is ever worth it, and where two free regions meet
    in a passage too narrow it is closed.
    """
    band = times.copy()
    _fill_band(band, free, clearance, need, _BAND_TOLL / speed, _TORN_PX / speed)
    # Beyond the border nothing is known, and no camera looks: half a pixel of it counts as lacking.
    half = 0.5 * _BAND_TOLL / speed
    for edge, inner in ((band[0], band[1]), (band[-1], band[-2]), (band[:, 0], band[:, 1]), (band[:, -1], band[:, -2])):
        np.maximum(edge, inner + half, out=edge, where=np.isfinite(edge) & np.isfinite(inner))
    return band


def descend(terrain: Terrain, times: Raster, start: Points, goal: Points) -> Points | None:
    """(n, 2) the fastest way from a start (2,) to the goal (2,) of `times`, px, steps of 1.5; None if it gets stuck.

    Each step is the one on a circle after which, with the time it takes, the least time is left: it also crosses
    the kinks of T, where slopes mislead.
    """
    path = _descend(
        times,
        terrain.clearance,
        terrain.need,
        terrain.vx,
        terrain.vy,
        terrain.speed,
        terrain.idle,
        float(start[0]),
        float(start[1]),
        float(goal[0]),
        float(goal[1]),
    )
    return path if len(path) else None


@compiled
def _through_triangle(
    sign: float,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    time_a: float,
    time_b: float,
    wx: float,
    wy: float,
    speed2: float,
) -> float:
    """Time of the corner of a triangle from those of its other corners at a and b, seen from it; inf if none.

    det(a, b) = sign. With T linear, grad T = p - q t where t is the time sought; put into the equation squared,
    V^2 |grad T|^2 = (1 + w . grad T)^2, this is quadratic in t. Valid is the smallest root with 1 + w . grad T > 0
    whose characteristic, w - V grad T / |grad T|, leaves through the far side.
    """
    px = (time_a * by - time_b * ay) * sign
    py = (ax * time_b - bx * time_a) * sign
    qx = (by - ay) * sign
    qy = (ax - bx) * sign
    wq = wx * qx + wy * qy
    wp = 1.0 + wx * px + wy * py
    first = speed2 * (qx * qx + qy * qy) - wq * wq
    half = speed2 * (px * qx + py * qy) - wp * wq
    last = speed2 * (px * px + py * py) - wp * wp
    inside = half * half - first * last
    if inside < 0.0:
        return math.inf
    root = math.sqrt(inside)
    best = math.inf
    for k in range(2):
        if k == 1 and wx * wx + wy * wy < speed2:
            break  # slower than the robot, the equation has one solution that grows away from the goal
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
        rate = 1.0 + wx * gx + wy * gy  # V |grad T|
        if rate <= 0.0:
            continue
        cx = wx * rate - speed2 * gx
        cy = wy * rate - speed2 * gy
        if (cx * by - cy * bx) * sign >= 0.0 and (ax * cy - ay * cx) * sign >= 0.0:
            best = t
    return best


@compiled
def _push(keys: NDArray[np.float64], nodes: NDArray[np.int64], size: int, key: float, node: int) -> int:
    """Add to a binary heap of `size` entries; its new size."""
    k = size
    while k > 0:
        above = (k - 1) >> 1
        if keys[above] <= key:
            break
        keys[k] = keys[above]
        nodes[k] = nodes[above]
        k = above
    keys[k] = key
    nodes[k] = node
    return size + 1


@compiled
def _pop(keys: NDArray[np.float64], nodes: NDArray[np.int64], size: int) -> int:
    """Take the least entry from a binary heap of `size` entries; its new size."""
    size -= 1
    key = keys[size]
    node = nodes[size]
    k = 0
    while True:
        below = 2 * k + 1
        if below >= size:
            break
        if below + 1 < size and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        keys[k] = keys[below]
        nodes[k] = nodes[below]
        k = below
    keys[k] = key
    nodes[k] = node
    return size


@compiled
def _searched_triangle(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    cost_a: float,
    cost_b: float,
    wx: float,
    wy: float,
    speed: float,
    idle: float,
) -> float:
    """The same for energy, which has no closed form at the speed limit: golden section over the far side.

    The cost of a displacement is convex in it, so there is one least value.
    """
    golden = 0.6180339887498949
    low = 0.0
    high = 1.0
    s = high - golden
    t = low + golden
    at_s = cost_a + s * (cost_b - cost_a) + step_energy(ax + s * (bx - ax), ay + s * (by - ay), wx, wy, speed, idle)
    at_t = cost_a + t * (cost_b - cost_a) + step_energy(ax + t * (bx - ax), ay + t * (by - ay), wx, wy, speed, idle)
    for _ in range(12):
        # Where both are impossible the far end is nearer to what is possible: the near one is tried on its own.
        if at_s < at_t:
            high = t
            t = s
            at_t = at_s
            s = high - golden * (high - low)
            x = ax + s * (bx - ax)
            y = ay + s * (by - ay)
            at_s = cost_a + s * (cost_b - cost_a) + step_energy(x, y, wx, wy, speed, idle)
        else:
            low = s
            s = t
            at_s = at_t
            t = low + golden * (high - low)
            x = ax + t * (bx - ax)
            y = ay + t * (by - ay)
            at_t = cost_a + t * (cost_b - cost_a) + step_energy(x, y, wx, wy, speed, idle)
    return min(at_s, at_t)


@compiled
def _march(
    free: Mask,
    clearance: Raster,
    need: float,
    vx: Raster,
    vy: Raster,
    speed: Raster,
    idle: float,
    goal_x: float,
    goal_y: float,
    exact: float,
    times: Raster,
) -> None:
    h, w = free.shape
    size = 0
    room = 1 << 14
    keys = np.empty(room)
    nodes = np.empty(room, np.int64)
    # Near a goal that is itself too near to a wall, its own clearance is all that can be asked.
    near = min(need, bilinear(clearance, goal_x, goal_y)) - 1e-9
    for b in range(max(0, math.floor(goal_y - exact)), min(h, math.ceil(goal_y + exact) + 1)):
        for a in range(max(0, math.floor(goal_x - exact)), min(w, math.ceil(goal_x + exact) + 1)):
            if (
                free[b, a]
                and math.hypot(a - goal_x, b - goal_y) <= exact
                and line_is_clear(clearance, float(a), float(b), goal_x, goal_y, near)
            ):
                t = segment_cost(vx, vy, speed, float(a), float(b), goal_x, goal_y, idle, 0.25)
                if t < math.inf:
                    times[b, a] = t
                    size = _push(keys, nodes, size, t, b * w + a)
    while size > 0:
        key = keys[0]
        node = nodes[0]
        size = _pop(keys, nodes, size)
        j = node // w
        i = node - j * w
        if key > times[j, i]:
            continue
        for k in range(8):
            a = i + _RING_X[k]
            b = j + _RING_Y[k]
            if a < 0 or b < 0 or a >= w or b >= h or not free[b, a]:
                continue
            known = times[b, a]
            if known <= key:
                continue
            # Seen from the neighbour, the node lies in the opposite direction of the ring.
            back = (k + 4) & 7
            ax = float(_RING_X[back])
            ay = float(_RING_Y[back])
            wx = vx[b, a]
            wy = vy[b, a]
            own = speed[b, a]
            best = key + step_cost(
                ax, ay, 0.5 * (wx + vx[j, i]), 0.5 * (wy + vy[j, i]), 0.5 * (own + speed[j, i]), idle
            )
            for turn in range(2):
                other = (back + 1) & 7 if turn == 0 else (back + 7) & 7
                c = a + _RING_X[other]
                d = b + _RING_Y[other]
                if c < 0 or d < 0 or c >= w or d >= h:
                    continue
                beside = times[d, c]
                if beside >= min(best, known):
                    continue
                mean = 0.5 * own + 0.25 * (speed[j, i] + speed[d, c])
                mx = 0.5 * wx + 0.25 * (vx[j, i] + vx[d, c])
                my = 0.5 * wy + 0.25 * (vy[j, i] + vy[d, c])
                if idle > 0.0:
                    bx = float(_RING_X[other])
                    by = float(_RING_Y[other])
                    best = min(best, _searched_triangle(ax, ay, bx, by, key, beside, mx, my, mean, idle))
                    continue
                t = _through_triangle(
                    1.0 if turn == 0 else -1.0,
                    ax,
                    ay,
                    float(_RING_X[other]),
                    float(_RING_Y[other]),
                    key,
                    beside,
                    mx,
                    my,
                    mean * mean,
                )
                best = min(best, t)
            if best < known * (1.0 - 1e-10):
                times[b, a] = best
                if size + 1 >= room:
                    more_keys = np.empty(2 * room)
                    more_nodes = np.empty(2 * room, np.int64)
                    more_keys[:size] = keys[:size]
                    more_nodes[:size] = nodes[:size]
                    keys = more_keys
                    nodes = more_nodes
                    room *= 2
                size = _push(keys, nodes, size, best, b * w + a)


@compiled
def _fill_band(times: Raster, free: Mask, clearance: Raster, need: float, toll: float, torn: float) -> None:
    h, w = free.shape
    fluid = clearance > 0.0
    layer = np.full(h * w, -1, np.int64)
    queue = np.empty(h * w, np.int64)
    tail = 0
    for j in range(h):
        for i in range(w):
            if not free[j, i]:
                continue
            layer[j * w + i] = 0
            if not math.isfinite(times[j, i]):
                continue
            for k in range(8):
                a = i + _RING_X[k]
                b = j + _RING_Y[k]
                if 0 <= a < w and 0 <= b < h and fluid[b, a] and not free[b, a]:
                    queue[tail] = j * w + i
                    tail += 1
                    break
    border = tail
    head = 0
    while head < tail:
        node = queue[head]
        head += 1
        j = node // w
        i = node - j * w
        for k in range(8):
            a = i + _RING_X[k]
            b = j + _RING_Y[k]
            if a < 0 or b < 0 or a >= w or b >= h or not fluid[b, a] or layer[b * w + a] >= 0:
                continue
            # Between two solid pixels that touch at their corners there is no way.
            if not fluid[j, a] and not fluid[b, i]:
                continue
            layer[b * w + a] = layer[node] + 1
            queue[tail] = b * w + a
            tail += 1
    for m in range(border, tail):
        node = queue[m]
        j = node // w
        i = node - j * w
        # Neighbours along the axes first: a diagonal one is also farther up or down the channel.
        for diagonal in range(2):
            worst = -1.0
            for k in range(diagonal, 8, 2):
                a = i + _RING_X[k]
                b = j + _RING_Y[k]
                if a < 0 or b < 0 or a >= w or b >= h or layer[b * w + a] != layer[node] - 1:
                    continue
                if (fluid[j, a] or fluid[b, i]) and math.isfinite(times[b, a]):
                    deeper = max(min(clearance[b, a], need) - clearance[j, i], _LEAST_TOLL)
                    worst = max(worst, times[b, a] + toll * deeper)
            if worst >= 0.0:
                times[j, i] = worst
                break
    closed = np.zeros(tail, np.bool_)
    for m in range(border, tail):
        node = queue[m]
        j = node // w
        i = node - j * w
        for k in range(8):
            a = i + _RING_X[k]
            b = j + _RING_Y[k]
            if 0 <= a < w and 0 <= b < h and math.isfinite(times[b, a]) and abs(times[b, a] - times[j, i]) > torn:
                closed[m] = fluid[j, a] or fluid[b, i]
                if closed[m]:
                    break
    for m in range(border, tail):
        if closed[m]:
            node = queue[m]
            times[node // w, node - (node // w) * w] = math.inf


@compiled
def _descend(
    times: Raster,
    clearance: Raster,
    need: float,
    vx: Raster,
    vy: Raster,
    speed: Raster,
    idle: float,
    x: float,
    y: float,
    goal_x: float,
    goal_y: float,
) -> Points:
    h, w = times.shape
    radius = 1.5
    ways = 64
    most = 4 * (h + w) + h * w // 4
    points = np.empty((most, 2))
    points[0, 0] = x
    points[0, 1] = y
    n = 1
    left = math.inf
    near = min(need, bilinear(clearance, goal_x, goal_y)) - 1e-9
    while n < most - 1:
        if (
            math.hypot(goal_x - x, goal_y - y) <= 2.0 * radius
            and line_is_clear(clearance, x, y, goal_x, goal_y, near)
            and math.isfinite(segment_cost(vx, vy, speed, x, y, goal_x, goal_y, idle, 0.25))
        ):
            points[n, 0] = goal_x
            points[n, 1] = goal_y
            return points[: n + 1]
        best = math.inf
        angle = 0.0
        # All around, then ever closer to the best way found.
        for k in range(ways + 10):
            if k < ways:
                tried = 2.0 * math.pi * k / ways
            else:
                if best == math.inf:
                    break
                if k % 2 == 0:
                    middle = angle
                step = 2.0 * math.pi / ways * 0.5 ** (1 + (k - ways) // 2)
                tried = middle + (step if k % 2 == 0 else -step)
            dx = radius * math.cos(tried)
            dy = radius * math.sin(tried)
            t = bilinear_known(times, x + dx, y + dy)
            if t >= left or t >= best:
                continue
            mx = x + 0.5 * dx
            my = y + 0.5 * dy
            t += step_cost(dx, dy, bilinear(vx, mx, my), bilinear(vy, mx, my), bilinear(speed, mx, my), idle)
            if t < best and line_is_clear(clearance, x, y, x + dx, y + dy, need):
                best = t
                angle = tried
        if best == math.inf:
            # On the ridge of an oblique channel the bilinear clearance dips between pixels that touch.
            column = round(x)
            row = round(y)
            for b in range(max(0, row - 1), min(h, row + 2)):
                for a in range(max(0, column - 1), min(w, column + 2)):
                    dx = a - x
                    dy = b - y
                    if times[b, a] >= left or math.hypot(dx, dy) < 0.5:
                        continue
                    t = times[b, a] + segment_cost(vx, vy, speed, x, y, float(a), float(b), idle, 0.75)
                    if t < best:
                        best = t
                        next_x = float(a)
                        next_y = float(b)
            if best == math.inf:
                return points[:0]
            x = next_x
            y = next_y
        else:
            x += radius * math.cos(angle)
            y += radius * math.sin(angle)
        left = bilinear_known(times, x, y)
        points[n, 0] = x
        points[n, 1] = y
        n += 1
    return points[:0]
