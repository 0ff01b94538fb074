"""Local refinement of a path: chords and smooth bumps along its normal, from wide to narrow, kept when they save time.

A lattice path zigzags between a few directions; this takes it to within a fraction of a percent of the local optimum
(notes/planning-control.md, section 1), and never nearer to a wall than it was or has to be.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.interpolation import bilinear
from flowrec.planning.zermelo import lowest_clearance, segment_cost
from flowrec.system.numba_setup import compiled

Points = NDArray[np.float64]
Raster = NDArray[np.float64]
SPACING_PX = 1.5  # of the points of a path
_LONGEST_PX = 12.0  # chord
_WIDEST_PX = 48.0  # half of the widest bump
_SWEEPS = 12


def relax(
    path: Points,
    clearance: Raster,
    need: float,
    vx: Raster,
    vy: Raster,
    weight: Raster,
    speed: Raster,
    idle: float = -1.0,
    spacing: float = SPACING_PX,
) -> Points:
    """A path (n, 2) in px with the same ends that takes less weighted time, its points at most `spacing` px apart.

    `speed` (h, w) is the robot's through the fluid; with `idle` > 0 it takes less energy instead (`step_energy`).

    Every part of it keeps the clearance `need` (px), or, where the given path did not, at least that of the given one.
    """
    rasters = (clearance, need, vx, vy, weight, speed, idle)
    for step in dict.fromkeys((max(spacing, SPACING_PX), spacing)):
        points = _even_steps(_pulled(path, *rasters, _LONGEST_PX), step)
        if len(points) < 2:
            return points
        widest = math.ceil(_WIDEST_PX / step)
        widths = widest // 2 ** np.arange(widest.bit_length())
        path = _bumps(points, *rasters, step, widths, _SWEEPS)
    return path


def _even_steps(path: Points, spacing: float) -> Points:
    """The same path in steps of at most `spacing`: no vertex is left out, which would cut the corners of walls."""
    lengths = np.hypot(*np.diff(path, axis=0).T)
    path = path[np.concatenate([[True], lengths > 1e-9])]
    if len(path) < 2:
        return path
    lengths = np.hypot(*np.diff(path, axis=0).T)
    counts = np.maximum(1, np.ceil(lengths / spacing - 1e-9)).astype(np.int64)
    if len(counts) == 1:
        counts = np.maximum(counts, 2)  # a single step has nothing to move
    leg = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(counts.sum()) - (np.cumsum(counts) - counts)[leg]) / counts[leg]
    return np.concatenate([path[leg] + share[:, None] * np.diff(path, axis=0)[leg], path[-1:]])


@compiled
def _pulled(
    path: Points,
    clearance: Raster,
    need: float,
    vx: Raster,
    vy: Raster,
    weight: Raster,
    speed: Raster,
    idle: float,
    longest: float,
) -> Points:
    """The path with chords wherever they cost no more and come no nearer to a wall than what they replace.

    Walls of pixels are notched: a path that hugs them follows every notch, and bumps alone do not get it off.
    """
    n = len(path)
    kept = np.empty((n, 2))
    kept[0] = path[0]
    count = 1
    i = 0
    while i < n - 1:
        best = i + 1
        lowest = need
        spent = 0.0
        for j in range(i + 1, n):
            x0, y0, x1, y1 = path[j - 1, 0], path[j - 1, 1], path[j, 0], path[j, 1]
            lowest = min(lowest, lowest_clearance(clearance, x0, y0, x1, y1))
            spent += bilinear(weight, 0.5 * (x0 + x1), 0.5 * (y0 + y1)) * segment_cost(
                vx, vy, speed, x0, y0, x1, y1, idle, 1.0
            )
            x0, y0 = path[i, 0], path[i, 1]
            if math.hypot(x1 - x0, y1 - y0) > longest:
                break
            if j > best and lowest_clearance(clearance, x0, y0, x1, y1) >= lowest - 1e-9:
                pieces = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0)))
                chord = 0.0
                for k in range(pieces):
                    a = x0 + (x1 - x0) * k / pieces
                    b = y0 + (y1 - y0) * k / pieces
                    c = x0 + (x1 - x0) * (k + 1) / pieces
                    d = y0 + (y1 - y0) * (k + 1) / pieces
                    chord += bilinear(weight, 0.5 * (a + c), 0.5 * (b + d)) * segment_cost(
                        vx, vy, speed, a, b, c, d, idle, 1.0
                    )
                if chord <= spent:
                    best = j
        kept[count] = path[best]
        count += 1
        i = best
    return kept[:count]


@compiled
def _bumps(
    path: Points,
    clearance: Raster,
    need: float,
    vx: Raster,
    vy: Raster,
    weight: Raster,
    speed: Raster,
    idle: float,
    spacing: float,
    widths: NDArray[np.int64],
    sweeps: int,
) -> Points:
    h, w = clearance.shape
    points = path.copy()
    n = len(points)
    times = np.empty(n - 1)
    floors = np.empty(n - 1)
    for k in range(n - 1):
        x0, y0, x1, y1 = points[k, 0], points[k, 1], points[k + 1, 0], points[k + 1, 1]
        times[k] = bilinear(weight, 0.5 * (x0 + x1), 0.5 * (y0 + y1)) * segment_cost(
            vx, vy, speed, x0, y0, x1, y1, idle, 1.0
        )
        floors[k] = min(need, lowest_clearance(clearance, x0, y0, x1, y1))
    moved = np.empty((2 * widths.max() + 1, 2))
    taken = np.empty(2 * widths.max())
    for width in widths:
        height = 0.17 * width * spacing
        stride = max(1, width // 2)
        for _ in range(sweeps):
            accepted = 0
            for centre in range(1, n - 1, stride):
                first = max(0, centre - width)
                last = min(n - 1, centre + width)
                tangent_x = points[centre + 1, 0] - points[centre - 1, 0]
                tangent_y = points[centre + 1, 1] - points[centre - 1, 1]
                norm = math.hypot(tangent_x, tangent_y)
                if norm < 1e-9:
                    continue
                before = times[first:last].sum()
                for sign in (-1.0, 1.0):
                    good = True
                    for k in range(first, last + 1):
                        bump = 0.5 * (1.0 + math.cos(math.pi * (k - centre) / width))
                        if k in (0, n - 1):
                            bump = 0.0  # the ends are given
                        x = points[k, 0] - sign * height * bump * tangent_y / norm
                        y = points[k, 1] + sign * height * bump * tangent_x / norm
                        # Beyond the border nothing is known of walls or flow.
                        if bump > 0.0 and (x < 0.0 or y < 0.0 or x > w - 1.0 or y > h - 1.0):
                            good = False
                            break
                        moved[k - first, 0] = x
                        moved[k - first, 1] = y
                    if not good:
                        continue
                    after = 0.0
                    for k in range(last - first):
                        x0, y0, x1, y1 = moved[k, 0], moved[k, 1], moved[k + 1, 0], moved[k + 1, 1]
                        taken[k] = bilinear(weight, 0.5 * (x0 + x1), 0.5 * (y0 + y1)) * segment_cost(
                            vx, vy, speed, x0, y0, x1, y1, idle, 1.0
                        )
                        after += taken[k]
                        if after >= before * (1.0 - 1e-7):
                            good = False
                            break
                    if not good:
                        continue
                    for k in range(last - first):
                        x0, y0, x1, y1 = moved[k, 0], moved[k, 1], moved[k + 1, 0], moved[k + 1, 1]
                        if lowest_clearance(clearance, x0, y0, x1, y1) < floors[first + k] - 1e-9:
                            good = False
                            break
                    if not good:
                        continue
                    points[first : last + 1] = moved[: last - first + 1]
                    times[first:last] = taken[: last - first]
                    accepted += 1
                    break
            # A height that hardly moves anything any more has done its work.
            if accepted * 20 * stride <= n:
                height *= 0.5
            if height < 0.02:
                break
    return points
