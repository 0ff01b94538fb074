"""Local refinement of a path: chords, then smooth bumps along its normal from wide to narrow, kept if they cost less.

A grid path zigzags between a few directions. The refinement takes it to within a fraction of a percent of the local
optimum, and never nearer to a wall than it was or has to be.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import Floats, Ints, Route, bilinear, compiled
from flowrec.stages.planning.cost_rasters import CostRasters, Points, Raster
from flowrec.stages.planning.kernels import lowest_clearance, segment_cost
from flowrec.stages.planning.problem import Problem
from flowrec.stages.planning.route import subdivide

SPACING_PX = 1.5  # of the points of a path
_LONGEST_CHORD_PX = 12.0  # a straight piece that replaces points of a path: a channel's width or so
_WIDEST_BUMP_PX = 48.0  # half width
_SWEEPS = 12  # of a width at most; nearly always the height falls below _LEAST_HEIGHT_PX before
_FIRST_HEIGHT = 0.17  # of a bump, relative to its half width
_LEAST_HEIGHT_PX = 0.02
_ACCEPTED = 20  # the height is halved when fewer than one in so many bumps lowers the cost


def refined_route(
    problem: Problem, rasters: CostRasters, path: Points, idle_um_s: float | None = None, spacing: float = SPACING_PX
) -> Route:
    """The timed route along the refinement of a path (n, 2) px, or along the path if the refinement is impossible."""
    route = problem.timed(refine_path(path, rasters, spacing=spacing), idle_um_s)
    return route if route.reachable else problem.timed(path, idle_um_s)


def refine_path(
    path: Points, rasters: CostRasters, weight: Raster | None = None, spacing: float = SPACING_PX
) -> Points:
    """A path (n, 2) in px with the same ends and a lower cost, its points at most `spacing` px apart.

    The cost is that of `kernels.segment_cost` times `weight` (h, w), 1 if it is not given. Every part keeps the
    clearance `rasters.need`, or that of the given path where it was less.
    """
    if weight is None:
        weight = np.ones_like(rasters.clearance)
    path = np.ascontiguousarray(path)  # kernels are compiled for each layout
    for step in dict.fromkeys((max(spacing, SPACING_PX), spacing)):
        chords = _with_chords(path, rasters, weight)
        # Every vertex stays: to omit one would cut the corner of a wall. A single step would have no point to move.
        points = subdivide(chords, step, 1e-9, single_leg=2)
        if len(points) < 2:
            return points
        widest = math.ceil(_WIDEST_BUMP_PX / step)
        widths = widest // 2 ** np.arange(widest.bit_length())
        path = _with_bumps(points, rasters, weight, step, widths)
    return path


@compiled
def _cost(points: Points, legs: int, rasters: CostRasters, weight: Raster, limit: float, costs: Floats) -> float:
    """Sum of the weighted costs of the first legs of a polyline (n, 2); each is written to `costs` (legs,).

    It ends early when the sum reaches a limit.
    """
    _, _, _, vx, vy, speed, idle = rasters
    total = 0.0
    for k in range(legs):
        x0, y0, x1, y1 = points[k, 0], points[k, 1], points[k + 1, 0], points[k + 1, 1]
        middle = bilinear(weight, 0.5 * (x0 + x1), 0.5 * (y0 + y1))
        costs[k] = middle * segment_cost(vx, vy, speed, idle, x0, y0, x1, y1, 1.0)
        total += costs[k]
        if total >= limit:
            break
    return total


@compiled
def _legs(points: Points, rasters: CostRasters, weight: Raster) -> tuple[Floats, Floats]:
    """Cost (n - 1,) of each leg of a polyline (n, 2), and the clearance (n - 1,) that its successor must keep."""
    costs = np.empty(len(points) - 1)
    floors = np.empty(len(points) - 1)
    for k in range(len(costs)):
        _cost(points[k:], 1, rasters, weight, math.inf, costs[k:])
        x0, y0, x1, y1 = points[k, 0], points[k, 1], points[k + 1, 0], points[k + 1, 1]
        floors[k] = min(rasters.need, lowest_clearance(rasters.clearance, x0, y0, x1, y1))
    return costs, floors


@compiled
def _with_chords(path: Points, rasters: CostRasters, weight: Raster) -> Points:
    """The path with chords wherever they cost no more and come no nearer to a wall than what they replace.

    Walls of pixels are notched: a path along them follows every notch, and bumps alone do not smooth it.
    """
    n = len(path)
    clearance = rasters.clearance
    chord = np.empty((math.ceil(_LONGEST_CHORD_PX) + 1, 2))
    chord_costs = np.empty(len(chord))
    costs, floors = _legs(path, rasters, weight)
    kept = np.empty((n, 2))
    kept[0, 0], kept[0, 1] = path[0, 0], path[0, 1]
    count = 1
    i = 0
    while i < n - 1:
        best = i + 1
        lowest = rasters.need
        spent = 0.0
        for j in range(i + 1, n):
            lowest = min(lowest, floors[j - 1])
            spent += costs[j - 1]
            x0, y0, x1, y1 = path[i, 0], path[i, 1], path[j, 0], path[j, 1]
            length = math.hypot(x1 - x0, y1 - y0)
            if length > _LONGEST_CHORD_PX:
                break
            if j > best and lowest_clearance(clearance, x0, y0, x1, y1) >= lowest - 1e-9:
                legs = max(1, math.ceil(length))
                for k in range(legs + 1):
                    chord[k, 0] = x0 + (x1 - x0) * k / legs
                    chord[k, 1] = y0 + (y1 - y0) * k / legs
                if _cost(chord, legs, rasters, weight, math.inf, chord_costs) <= spent:
                    best = j
        kept[count, 0], kept[count, 1] = path[best, 0], path[best, 1]
        count += 1
        i = best
    return kept[:count]


@compiled
def _with_bumps(path: Points, rasters: CostRasters, weight: Raster, spacing: float, widths: Ints) -> Points:
    """The path (n, 2) with its points shifted along the normal by cosine bumps of half widths `widths`, in points.

    The widest comes first. A bump is kept if it lowers the cost; the height is halved when hardly any does.
    """
    clearance = rasters.clearance
    h, w = clearance.shape
    points = path.copy()
    n = len(points)
    costs, floors = _legs(points, rasters, weight)
    moved = np.empty((2 * widths[0] + 1, 2))
    new_costs = np.empty(2 * widths[0])
    for width in widths:
        height = _FIRST_HEIGHT * width * spacing
        stride = max(1, width // 2)
        for _ in range(_SWEEPS):
            accepted = 0
            for centre in range(1, n - 1, stride):
                first = max(0, centre - width)
                last = min(n - 1, centre + width)
                tangent_x = points[centre + 1, 0] - points[centre - 1, 0]
                tangent_y = points[centre + 1, 1] - points[centre - 1, 1]
                norm = math.hypot(tangent_x, tangent_y)
                if norm < 1e-9:
                    continue
                limit = 0.0
                for k in range(first, last):
                    limit += costs[k]
                limit *= 1.0 - 1e-7
                for sign in (-1.0, 1.0):
                    good = True
                    for k in range(first, last + 1):
                        bump = 0.5 * (1.0 + math.cos(math.pi * (k - centre) / width))
                        if k in (0, n - 1):
                            bump = 0.0  # the ends are given
                        x = points[k, 0] - sign * height * bump * tangent_y / norm
                        y = points[k, 1] + sign * height * bump * tangent_x / norm
                        moved[k - first, 0] = x
                        moved[k - first, 1] = y
                        # Beyond the border nothing is known of walls or flow.
                        if bump > 0.0 and (x < 0.0 or y < 0.0 or x > w - 1.0 or y > h - 1.0):
                            good = False
                            break
                    good = good and _cost(moved, last - first, rasters, weight, limit, new_costs) < limit
                    for k in range(last - first):
                        if not good:
                            break
                        x0, y0, x1, y1 = moved[k, 0], moved[k, 1], moved[k + 1, 0], moved[k + 1, 1]
                        good = lowest_clearance(clearance, x0, y0, x1, y1) >= floors[first + k] - 1e-9
                    if good:
                        for k in range(last - first):
                            costs[first + k] = new_costs[k]
                        for k in range(last - first + 1):
                            points[first + k, 0], points[first + k, 1] = moved[k, 0], moved[k, 1]
                        accepted += 1
                        break
            if accepted * _ACCEPTED * stride <= n:
                height *= 0.5
            if height < _LEAST_HEIGHT_PX:
                break
    return points
