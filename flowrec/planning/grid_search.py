"""A* and Dijkstra on the pixels themselves: neighbours are fixed offsets, costs are computed as they are needed."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from flowrec.interpolation import bilinear
from flowrec.planning.zermelo import line_is_clear, step_time
from flowrec.system.numba_setup import compiled

Raster = NDArray[np.float64]


def directions(reach: int) -> NDArray[np.int64]:
    """(n, 2) steps (x, y) in all distinct directions within `reach` pixels: 8, 16, 32 for reach 1, 2, 3."""
    span = range(-reach, reach + 1)
    return np.array([(a, b) for a in span for b in span if math.gcd(a, b) == 1], np.int64)


@compiled
def search(
    free: NDArray[np.bool_],
    clearance: Raster,
    need: float,
    vx: Raster,
    vy: Raster,
    weight: Raster,
    steps: NDArray[np.int64],
    start: int,
    goal: int,
    speed: float,
    timed: bool,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cheapest ways from `start` until `goal` is reached, or everywhere when `goal` is negative.

    Nodes are flat indices of free pixels (h, w). An edge costs its exact travel time at `speed` px/s (Simpson's
    rule over the edge) or, untimed, its length in px; times the mean `weight` (>= 1) of its ends. The heuristic is
    the straight way at the fastest ground speed anywhere, |goal - x| / (V + max |v|): admissible and consistent.

    Returns
    -------
    cost (h*w,), inf where not reached, and the parent (h*w,) of each node, -1 where there is none.
    """
    h, w = free.shape
    cost = np.full(h * w, np.inf)
    parent = np.full(h * w, -1, np.int64)
    closed = np.zeros(h * w, np.bool_)
    pace = 1.0
    if timed:
        fastest = 0.0
        for j in range(h):
            for i in range(w):
                fastest = max(fastest, math.hypot(vx[j, i], vy[j, i]))
        pace = speed + fastest
    goal_j = goal // w
    goal_i = goal - goal_j * w
    cost[start] = 0.0
    heap = [(0.0, start)]
    while len(heap) > 0:
        _, node = heapq.heappop(heap)
        if closed[node]:
            continue
        closed[node] = True
        if node == goal:
            break
        j = node // w
        i = node - j * w
        for k in range(len(steps)):
            di = steps[k, 0]
            dj = steps[k, 1]
            a = i + di
            b = j + dj
            if a < 0 or b < 0 or a >= w or b >= h or not free[b, a]:
                continue
            other = b * w + a
            if closed[other]:
                continue
            length = math.hypot(di, dj)
            # Pixels that touch are joined by what they are, though on the ridge of an oblique channel the bilinear
            # clearance dips between them; a longer step is looked at unless its ends leave no doubt: clearance
            # changes by at most a pixel per pixel.
            if (
                length > 1.5
                and min(clearance[j, i], clearance[b, a]) < need + 0.5 * length
                and not line_is_clear(clearance, i, j, a, b, need)
            ):
                continue
            edge = length
            if timed:
                x = i + 0.5 * di
                y = j + 0.5 * dj
                middle = step_time(di, dj, bilinear(vx, x, y), bilinear(vy, x, y), speed)
                first = step_time(di, dj, vx[j, i], vy[j, i], speed)
                last = step_time(di, dj, vx[b, a], vy[b, a], speed)
                edge = (first + 4.0 * middle + last) / 6.0
            through = cost[node] + 0.5 * (weight[j, i] + weight[b, a]) * edge
            if through < cost[other]:
                cost[other] = through
                parent[other] = node
                ahead = 0.0
                if goal >= 0:
                    ahead = math.hypot(goal_i - a, goal_j - b) / pace
                heapq.heappush(heap, (through + ahead, other))
    return cost, parent


def backtrack(parent: NDArray[np.int64], end: int, width: int) -> NDArray[np.float64]:
    """(n, 2) points (x, y) in px from the root of the search to `end`."""
    chain = [end]
    while parent[chain[-1]] >= 0:
        chain.append(int(parent[chain[-1]]))
    nodes = np.array(chain[::-1])
    return np.column_stack([nodes % width, nodes // width]).astype(np.float64)
