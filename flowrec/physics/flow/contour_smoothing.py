"""Smoothest contour that a mask allows.

A mask only says that the wall passes between two neighbouring pixel centres of which one is fluid and one is solid.
Each such pair is a gate, and the contour has one point near each gate. Of all curves through the gates this is the one
whose curvature changes least and that stays closest to the midpoints of the gates:

    min  int l^6 (d kappa / ds)^2 + d^2 ds,   kappa = curvature, d = distance from the midpoints.

The length l is reduced step by step where the curve would miss gates, since the wall bends there. Straight walls and
circles have no cost, so an oblique wall comes out straight whatever the length of its steps, and neither channels nor
islands shrink. The gates leave an uncertainty that nothing can remove: at a slope of p / q pixels they determine a
straight wall to 1 / (2 sqrt(p^2 + q^2)) pixels, which is 0.35 at 45 degrees.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # its linalg loads at first use, not at start-up

from flowrec.core import Bools, Floats, Ints

STIFFNESS_PX = 8.0  # l of a wall that stays in its gates: wobbles shorter than about 2 pi l come from the mask's steps
SOFTENING = 16.0  # divides l^6 around gates that the curve misses
SOFTENED = 2  # number of gates on either side of a missed one
SLACK_PX = 0.05  # a gate is missed by more than this
ITERATIONS = 8  # each a linear problem about the points of the one before
FARTHEST_PX = 0.6  # largest offset from the midpoint of a gate; the gate ends at half a pixel
GATES_PER_STIFFNESS = 8  # at least, on a closed wall
BLUR = 4  # passes of the kernel 1 2 1 over the tangents of the last iterate
SHORTEST_PX = 0.3  # least distance of two points along the wall
WRAP = 32  # number of gates by which a closed wall is continued at both ends
BEYOND_PX = 2.0  # length of the straight continuation beyond the image's border
LARGEST_SHIFT_PX = 0.25  # of a closed wall, so that it encloses the area of its pixels

STEP = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # x, y of the directions right, down, left, up


@dataclass(frozen=True, slots=True, eq=False)
class Gates:
    """Pairs of neighbouring pixels on both sides of a wall, in order along the walls with the fluid on the right."""

    middle: Floats  # (n, 2) x, y in pixels; (0, 0) is the centre of the first pixel
    inward: Floats  # (n, 2) unit vector from solid to fluid
    wall: Ints  # (n,) number of the wall, ascending
    closed: Bools  # (walls,) whether the wall returns to its first gate; else it ends at the image's border


def find_gates(mask: Bools) -> Gates:
    """Gates of a mask. Fluid pixels that touch at corners only are not connected."""
    h, w = mask.shape
    down, across = mask[1:], mask[:, 1:]
    parts = []  # (row, column) of the edge's begin on the pixels' corners, and its direction
    for direction, (edge, begin) in enumerate(
        (
            (~mask[:-1] & down, (1, 0)),
            (mask[:, :-1] & ~across, (0, 1)),
            (mask[:-1] & ~down, (1, 1)),
            (~mask[:, :-1] & across, (1, 1)),
        )
    ):
        r, c = np.nonzero(edge)
        parts.append((r + begin[0], c + begin[1], np.full_like(r, direction)))
    row, column, way = (np.concatenate(part) for part in zip(*parts, strict=True))
    leaving = np.full(((h + 1) * (w + 1), 4), -1, np.int64)
    leaving[row * (w + 1) + column, way] = np.arange(len(row))
    end = (row + STEP[way, 1]) * (w + 1) + column + STEP[way, 0]
    # Where four edges meet, a turn to the right stays with the same fluid pixel.
    right, ahead, left = (leaving[end, (way + turn) % 4] for turn in (1, 0, 3))
    after = np.where(right >= 0, right, np.where(ahead >= 0, ahead, left))
    order, wall, closed = _order_edges(after)
    begin_xy = np.stack([column, row], axis=1) - 0.5
    inward = STEP[(way + 1) % 4].astype(np.float64)
    return Gates((begin_xy + 0.5 * STEP[way])[order], inward[order], wall, closed)


def _order_edges(after: Ints) -> tuple[Ints, Ints, Bools]:
    """Order of the edges along their walls, the number of the wall of each, and which walls are closed.

    `after` (n,) is the edge that follows each edge, -1 at the image's border. A closed wall begins at its first edge.
    """
    before = np.full_like(after, -1)
    before[after[after >= 0]] = np.flatnonzero(after >= 0)
    following, preceding = after.tolist(), before.tolist()
    order: dict[int, int] = {}  # number of the wall by edge
    closed: list[bool] = []
    for first in range(len(after)):
        if first in order:
            continue
        edge = first
        while preceding[edge] not in (-1, first):
            edge = preceding[edge]
        closed.append(preceding[edge] == first)
        edge = first if closed[-1] else edge
        while edge >= 0 and edge not in order:
            order[edge] = len(closed) - 1
            edge = following[edge]
    return np.array([*order], np.int64), np.array([*order.values()], np.int64), np.array(closed, np.bool_)


def contour_segments(mask: Bools, per_gate: int) -> tuple[Floats, Floats]:
    """Straight segments of the contour: begins and ends (n, 2), x, y in pixels, with the fluid on their right.

    The curve from one gate to the next is divided into `per_gate` segments. Walls that end at the image's border are
    continued in a straight line.
    """
    crossed = find_gates(mask)
    n = len(crossed.wall)
    if n == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    point = _smoothest(crossed)
    size = np.bincount(crossed.wall)
    first = np.cumsum(size) - size
    last = first + size - 1
    before, after = np.arange(n) - 1, np.arange(n) + 1
    closed = crossed.closed
    before[first], after[last] = np.where(closed, last, first), np.where(closed, first, last)
    knots, tangent = _cubic(point, before, after, per_gate)
    # The area of a closed wall is that of its pixels. The correction matters for small islands.
    along = crossed.inward[:, [1, 0]] * [1.0, -1.0]
    wanted = _enclosed_areas(crossed.middle, crossed.middle + along, crossed.wall)
    found = sum(_enclosed_areas(a, b, crossed.wall) for a, b in itertools.pairwise(knots))
    around = np.bincount(crossed.wall, np.hypot(*(point[after] - point).T))
    # Both areas are positive where the fluid is inside.
    shift = np.where(
        closed, np.clip((wanted - found) / np.maximum(around, 1e-9), -LARGEST_SHIFT_PX, LARGEST_SHIFT_PX), 0.0
    )
    outward = tangent[:, [1, 0]] * [1.0, -1.0]
    point = point + shift[crossed.wall, None] * outward
    knots, tangent = _cubic(point, before, after, per_gate)
    on = after != np.arange(n)
    begins, ends = [knots[:-1, on].reshape(-1, 2)], [knots[1:, on].reshape(-1, 2)]
    open_ = ~closed
    begins += [point[first[open_]] - BEYOND_PX * tangent[first[open_]], point[last[open_]]]
    ends += [point[first[open_]], point[last[open_]] + BEYOND_PX * tangent[last[open_]]]
    return np.concatenate(begins), np.concatenate(ends)


def smooth_contours(mask: Bools) -> Iterator[tuple[Floats, bool]]:
    """Points (n, 2) x, y in pixels on each wall, in order with the fluid on the right; and whether it is closed."""
    crossed = find_gates(mask)
    if not len(crossed.wall):
        return
    point = _smoothest(crossed)
    for wall, closed in enumerate(crossed.closed.tolist()):
        yield point[crossed.wall == wall], closed


def _enclosed_areas(a: Floats, b: Floats, wall: Ints) -> Floats:
    """Signed areas (walls,) enclosed by the segments a to b (n, 2): the shoelace formula."""
    return np.asarray(0.5 * np.bincount(wall, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))


def _cubic(point: Floats, before: Ints, after: Ints, per_gate: int) -> tuple[Floats, Floats]:
    """Knots (per_gate + 1, n, 2) of the curve from each point to the next, and its unit tangents (n, 2) at the points.

    The tangent is that of the circle through a point and its two neighbours; the curve is the cubic Hermite spline.
    """
    back, ahead = point - point[before], point[after] - point
    sb, sa = (np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)[:, None] for d in (back, ahead))
    tangent = back / sb * sa + ahead / sa * sb
    lone = (sb[:, 0] < 1e-8) | (sa[:, 0] < 1e-8)
    tangent[lone] = (back / sb + ahead / sa)[lone]
    tangent /= np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)[:, None]
    u = np.linspace(0.0, 1.0, per_gate + 1)[:, None, None]
    swing = u * (1.0 - u) * sa * ((1.0 - u) * tangent - u * tangent[after])
    straight = u * u * (3.0 - 2.0 * u) * ahead
    return point + straight + swing, tangent


def _smoothest(crossed: Gates) -> Floats:
    """Points (n, 2) of the contour, one near each gate: x, y in pixels."""
    size = np.bincount(crossed.wall)
    start = np.cumsum(size) - size
    wrap = np.where(crossed.closed, WRAP, 0)
    long = size + 2 * wrap
    offset = np.cumsum(long) - long
    wall = np.repeat(np.arange(len(size)), long)
    k = np.arange(long.sum()) - offset[wall] - wrap[wall]
    source = start[wall] + k % size[wall]
    own = (k >= 0) & (k < size[wall])
    # A closed wall of few gates bends at each of them, so it must be less stiff.
    stiffness = np.where(crossed.closed, np.minimum(STIFFNESS_PX, size / GATES_PER_STIFFNESS), STIFFNESS_PX)
    relaxed = _relax(crossed.middle[source], crossed.inward[source], wall, stiffness[wall])
    result = np.empty_like(crossed.middle)
    result[source[own]] = relaxed[own]
    return result


def _relax(middle: Floats, inward: Floats, wall: Ints, stiffness: Floats) -> Floats:
    """Points (n, 2) near the midpoints of gates on open walls, for an initial stiffness length l (n,) in pixels.

    Each point is a midpoint moved along the normal of the wall. d kappa / ds is the third divided difference over four
    points in the direction of the normal. Normals and distances are those of the last iterate, so every iteration is
    a banded linear least-squares problem.
    """
    n = len(wall)
    if n < 4:
        return middle
    same = wall[:-1] == wall[1:]
    whole = wall[:-3] == wall[3:]  # four gates in a row on one wall
    point = middle
    weight = stiffness[1:-2] ** 6
    for _ in range(ITERATIONS):
        run = np.diff(point, axis=0) * same[:, None]
        tangent = run
        for _ in range(BLUR):
            smooth = 2.0 * tangent
            smooth[1:] += tangent[:-1]
            smooth[:-1] += tangent[1:]
            tangent = smooth * same[:, None]
        tangent = _unit(tangent)
        length = np.maximum((run * tangent).sum(axis=1), SHORTEST_PX)
        normal = _across(tangent[1:-1])
        both = np.zeros((n, 2))
        both[:-1] += tangent
        both[1:] += tangent
        normals = _across(_unit(both))
        knots = np.zeros((n - 3, 4))
        knots[:, 1:] = np.cumsum([length[:-2], length[1:-1], length[2:]], axis=0).T
        # Residual i is jacobian[i] @ offsets + target[i], with the offsets along the normals of points i to i + 3.
        jacobian, target = np.empty_like(knots), np.zeros(len(knots))
        scale = 6.0 * np.sqrt(weight * length[1:-1]) * whole
        for m in range(4):
            here = slice(m, n - 3 + m)
            divided = scale / np.prod([knots[:, m] - knots[:, o] for o in range(4) if o != m], axis=0)
            jacobian[:, m] = divided * (normals[here] * normal).sum(axis=1)
            target += divided * (middle[here] * normal).sum(axis=1)
        bands, right = np.zeros((4, n)), np.zeros(n)
        bands[0, :-1] += 0.5 * length * same
        bands[0, 1:] += 0.5 * length * same
        bands[0] = np.maximum(bands[0], 0.1)
        for m in range(4):
            right[m : n - 3 + m] -= jacobian[:, m] * target
            for o in range(m, 4):
                bands[o - m, m : n - 3 + m] += jacobian[:, m] * jacobian[:, o]
        offset = np.clip(scipy.linalg.solveh_banded(bands, right, lower=True), -FARTHEST_PX, FARTHEST_PX)
        point = middle + offset[:, None] * normals
        missed = np.abs(offset) > 0.5 * np.abs((inward * normals).sum(axis=1)) + SLACK_PX
        near = np.convolve(missed, np.ones(2 * SOFTENED + 1), "same") > 0.0
        weight = np.where(near[1:-2] | near[2:-1], weight / SOFTENING, weight)
    return point


def _unit(vector: Floats) -> Floats:
    """Vectors (n, 2) scaled to length 1, or 0 where they vanish."""
    return vector / np.maximum(np.hypot(vector[:, 0], vector[:, 1]), 1e-9)[:, None]


def _across(vector: Floats) -> Floats:
    """Vectors (n, 2) turned by a right angle, from x to y."""
    return np.stack([-vector[:, 1], vector[:, 0]], axis=1)
