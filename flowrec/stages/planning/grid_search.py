"""A* and Dijkstra's algorithm on the pixels, and the planners that are nothing else: fastest, shortest, the paper's.

One compiled search serves all: the neighbours are offsets, and the cost of an edge is one of three, each with its
heuristic h for the way from x to the goal:

    LENGTH       |dx|,                                              h = |goal - x|
    TRAVEL_TIME  time at ground speed, Simpson's rule over dx,      h = |goal - x| / (V + max |v|)
    PAPER        |dx| |dx / |dx| - v / V| with v where dx begins,   h = the same for goal - x

The first two heuristics are admissible and consistent. The third is not admissible.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, Ints, Route, bilinear, compiled
from flowrec.stages.planning.cost_rasters import CostRasters, Raster
from flowrec.stages.planning.free_space import FreeSpace
from flowrec.stages.planning.kernels import line_is_clear, step_time
from flowrec.stages.planning.path_refinement import refined_route
from flowrec.stages.planning.problem import Problem
from flowrec.stages.planning.route import no_route, too_fast

LENGTH, TRAVEL_TIME, PAPER = 0, 1, 2  # costs of a step, as above; numbers, because compiled code compares them


@dataclass(frozen=True, slots=True)
class AstarLength:
    """The shortest path on the pixels; the flow only times it."""

    reach_px: int

    def plan(self, problem: Problem) -> Route:
        """The route of a problem."""
        return _pixel_route(problem, LENGTH, directions(self.reach_px), self.reach_px)


@dataclass(frozen=True, slots=True)
class AstarTime:
    """The fastest path on the pixels, refined off them."""

    reach_px: int
    refine: bool

    def plan(self, problem: Problem) -> Route:
        """The route of a problem."""
        return _pixel_route(problem, TRAVEL_TIME, directions(self.reach_px), self.reach_px, self.refine)


@dataclass(frozen=True, slots=True)
class AstarPaper:
    """The paper's flow-aware A*, for comparison: its cost and its heuristic as printed, on neighbours within a radius.

    The cost stays finite (2 |dx|) against a flow as fast as the robot, and the heuristic is not admissible, so its
    routes are neither the fastest nor always possible. The paper finds the neighbours with a K-D tree; on pixels they
    are all offsets within the radius.
    """

    paper_radius_px: float
    reach_px: int  # of the shortest path, which the reason names if there is no route

    def plan(self, problem: Problem) -> Route:
        """The route of a problem."""
        return _pixel_route(problem, PAPER, offsets_within(self.paper_radius_px), self.reach_px)


def _pixel_route(problem: Problem, cost: int, offsets: Ints, reach_px: int, refine: bool = False) -> Route:
    """The route along the path of least cost; where there is none, the reason names the shortest one."""
    path = shortest_path(problem, cost, offsets)
    if path is None:
        return too_fast_route(problem, reach_px)
    path = problem.with_ends(path)
    return refined_route(problem, problem.space.cost_rasters(problem.speed), path) if refine else problem.timed(path)


def directions(reach_px: int) -> Ints:
    """(n, 2) offsets (x, y) in all distinct directions within `reach_px` pixels: 8, 16, 32 for 1, 2, 3."""
    span = range(-reach_px, reach_px + 1)
    return np.array([(a, b) for a in span for b in span if math.gcd(a, b) == 1], np.int64)


def offsets_within(radius_px: float) -> Ints:
    """(n, 2) offsets (x, y) of all pixels within a radius; 1.5 gives the 8 neighbours."""
    span = range(-math.floor(radius_px), math.floor(radius_px) + 1)
    return np.array([(a, b) for a in span for b in span if 0 < a * a + b * b <= radius_px * radius_px], np.int64)


def shortest_path(problem: Problem, cost: int, offsets: Ints) -> Floats | None:
    """(n, 2) px from the start's node to the goal's at the least cost; None if there is no path."""
    space, goal = problem.space, problem.goal.node
    spent, parent = search(space, cost, offsets, problem.speed, problem.start.node, goal)
    return backtrack(parent, goal, space.width) if np.isfinite(spent[goal]) else None


def too_fast_route(problem: Problem, reach_px: int) -> Route:
    """No route, with the place on the shortest path where the ground speed is lowest."""
    path = shortest_path(problem, LENGTH, directions(reach_px))
    assert path is not None, "free neighbours are joined by edges"
    reason = too_fast(problem.field, path * problem.space.um_per_px, problem.speed_um_s)
    return no_route(problem.method, reason)


def search(
    space: FreeSpace,
    cost: int,
    offsets: Ints,
    speed: float,
    start: int,
    goal: int = -1,
    weight: Raster | None = None,
    deviation: Raster | float = 0.0,
) -> tuple[Floats, Ints]:
    """`best_first` on a free space, for a robot of `speed` (px/s); every edge keeps the clearance `space.need`.

    `deviation` (px/s) of the speed is kept against a worse flow.
    """
    rasters = space.cost_rasters(speed, deviation)._replace(clearance=space.clearance)
    weight = np.ones_like(space.clearance) if weight is None else weight
    return best_first(rasters, weight, cost, offsets, start, goal)


def backtrack(parent: Ints, end: int, width: int) -> Floats:
    """(n, 2) points (x, y) in px from the root of the search to `end`."""
    chain = [end]
    while parent[chain[-1]] >= 0:
        chain.append(int(parent[chain[-1]]))
    nodes = np.array(chain[::-1])
    return np.column_stack([nodes % width, nodes // width]).astype(np.float64)


@compiled
def paper_cost(dx: float, dy: float, vx: float, vy: float, speed: float) -> float:
    """The paper's cost of a displacement (px) that begins in a flow (px/s): finite however fast the flow is."""
    distance = math.hypot(dx, dy)
    if distance == 0.0:
        return 0.0
    return distance * math.hypot(dx / distance - vx / speed, dy / distance - vy / speed)


@compiled
def best_first(
    rasters: CostRasters, weight: Raster, cost: int, offsets: Ints, start: int, goal: int
) -> tuple[Floats, Ints]:
    """Paths of least cost from `start` until `goal` is reached, or to everywhere if `goal` is negative.

    Nodes are flat indices of free pixels (h, w). Edges lead to the pixels at `offsets` (n, 2) that are free and in a
    clear line; their cost is multiplied by the mean `weight` (h, w) >= 1 of their ends. No node is expanded twice.

    Returns
    -------
    cost (h*w,), inf where not reached, and the parent (h*w,) of each node, -1 where there is none.
    """
    free, clearance, need, vx, vy, speed, _ = rasters
    h, w = free.shape
    spent = np.full(h * w, np.inf)
    parent = np.full(h * w, -1, np.int64)
    closed = np.zeros(h * w, np.bool_)
    fastest = _fastest_over_ground(vx, vy, speed) if cost == TRAVEL_TIME else 1.0  # of the heuristic
    goal_j = goal // w
    goal_i = goal - goal_j * w
    spent[start] = 0.0
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
        for k in range(len(offsets)):
            di = offsets[k, 0]
            dj = offsets[k, 1]
            a = i + di
            b = j + dj
            if a < 0 or b < 0 or a >= w or b >= h or not free[b, a]:
                continue
            other = b * w + a
            if closed[other]:
                continue
            length = math.hypot(di, dj)
            # Neighbours that touch are always joined, although the bilinear clearance dips between them on the ridge of
            # an oblique channel. A longer edge is clear without a look at it if its ends have half its length to
            # spare, because the clearance changes by at most a pixel per pixel.
            if length > 1.5 and min(clearance[j, i], clearance[b, a]) < need + 0.5 * length:
                # The paper's edges have no direction: their lines are sampled from the lower node.
                if cost == PAPER and other < node:
                    clear = line_is_clear(clearance, float(a), float(b), float(i), float(j), need)
                else:
                    clear = line_is_clear(clearance, float(i), float(j), float(a), float(b), need)
                if not clear:
                    continue
            edge = _edge_cost(vx, vy, speed, cost, i, j, di, dj)
            through = spent[node] + 0.5 * (weight[j, i] + weight[b, a]) * edge
            if through < spent[other]:
                spent[other] = through
                parent[other] = node
                ahead = 0.0  # least cost from there to the goal
                if goal >= 0 and cost == PAPER:
                    ahead = paper_cost(goal_i - a, goal_j - b, vx[b, a], vy[b, a], speed[b, a])
                elif goal >= 0:
                    ahead = math.hypot(goal_i - a, goal_j - b) / fastest
                heapq.heappush(heap, (through + ahead, other))
    return spent, parent


@compiled
def _fastest_over_ground(vx: Raster, vy: Raster, speed: Raster) -> float:
    """Upper bound in px/s: the fastest flow plus the robot's highest speed."""
    h, w = vx.shape
    fastest, own = 0.0, -math.inf
    for j in range(h):
        for i in range(w):
            fastest = max(fastest, math.hypot(vx[j, i], vy[j, i]))
            own = max(own, speed[j, i])
    return own + fastest


@compiled
def _edge_cost(vx: Raster, vy: Raster, speed: Raster, cost: int, i: int, j: int, di: int, dj: int) -> float:
    """Cost of the edge from pixel (i, j) to (i + di, j + dj); the travel time by Simpson's rule."""
    if cost == TRAVEL_TIME:
        x = i + 0.5 * di
        y = j + 0.5 * dj
        middle = step_time(di, dj, bilinear(vx, x, y), bilinear(vy, x, y), bilinear(speed, x, y))
        first = step_time(di, dj, vx[j, i], vy[j, i], speed[j, i])
        last = step_time(di, dj, vx[j + dj, i + di], vy[j + dj, i + di], speed[j + dj, i + di])
        return (first + 4.0 * middle + last) / 6.0
    if cost == PAPER:
        return paper_cost(di, dj, vx[j, i], vy[j, i], speed[j, i])
    return math.hypot(di, dj)
