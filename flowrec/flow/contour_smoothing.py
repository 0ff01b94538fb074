"""The smoothest outline that a mask allows.

A mask is a sample: all it tells is that a wall passes between two neighbouring pixel centres, one in fluid and one in
solid. Each such pair is a gate, and the outline has one point near each. Among all curves that is taken whose
curvature changes least and which keeps nearest to the middles of the gates,

    min  int l^6 (d kappa / ds)^2 + d^2 ds,   kappa = curvature, d = distance from the middles,

with a length l that is made smaller, step by step, where the curve would leave the gates: there the wall bends.
Straight walls and circles cost nothing, so an oblique wall comes out straight however long its steps, and neither
channels nor islands shrink. What the gates leave open nobody can know: at a slope of p / q pixels the place of a
straight wall is known to 1 / (2 sqrt(p^2 + q^2)) pixels, which is 0.35 at 45 degrees.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.sparse.csgraph import connected_components

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STIFFNESS_PX = 8.0  # l of a wall that keeps to its gates: wobbles shorter than about 2 pi l are steps of the mask
SOFTENING = 16.0  # of l^6, around gates that are missed
SOFTENED = 2  # gates to either side of a missed one
SLACK_PX = 0.05  # a gate is missed by more than that
ITERATIONS = 8
FARTHEST_PX = 0.6  # from the middle of a gate; half a pixel is its end
GATES_PER_STIFFNESS = 8  # at least, of a closed wall
BLUR = 4  # passes of 1 2 1 over the directions of the last approximation
SHORTEST_PX = 0.3  # least distance of two points along the wall
WRAP = 32  # closed walls are continued around by this many gates
BEYOND_PX = 2.0  # walls go straight on beyond the image's border
LARGEST_SHIFT_PX = 0.25  # of a closed wall, towards the area of its pixels


@dataclass(frozen=True, slots=True, eq=False)
class Gates:
    """Pairs of neighbouring pixels on both sides of a wall, in order along the walls with the fluid on the right."""

    middle: Floats  # (n, 2) x, y in pixels; (0, 0) is the centre of the first pixel
    inward: Floats  # (n, 2) unit vector from solid to fluid
    wall: Ints  # (n,) number of the wall, ascending
    closed: NDArray[np.bool_]  # (walls,) whether it returns to its first gate; else it ends at the image's border


def gates(mask: NDArray[np.bool_]) -> Gates:
    """Gates of a mask. Fluid pixels that touch at corners only are not connected."""
    h, w = mask.shape
    edges = []  # (row, column) of the edge's begin on the pixels' corners, and its direction (right, down, left, up)
    r, c = np.nonzero(~mask[:-1] & mask[1:])
    edges.append((r + 1, c, np.zeros_like(r)))
    r, c = np.nonzero(mask[:, :-1] & ~mask[:, 1:])
    edges.append((r, c + 1, np.ones_like(r)))
    r, c = np.nonzero(mask[:-1] & ~mask[1:])
    edges.append((r + 1, c + 1, np.full_like(r, 2)))
    r, c = np.nonzero(~mask[:, :-1] & mask[:, 1:])
    edges.append((r + 1, c + 1, np.full_like(r, 3)))
    row, column, way = (np.concatenate(part) for part in zip(*edges, strict=True))
    step = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # x, y of the directions
    n = len(row)
    leaving = np.full(((h + 1) * (w + 1), 4), -1, np.int64)
    leaving[row * (w + 1) + column, way] = np.arange(n)
    end = (row + step[way, 1]) * (w + 1) + column + step[way, 0]
    # Where four edges meet, turning right stays with the same fluid pixel.
    right, ahead, left = (leaving[end, (way + turn) % 4] for turn in (1, 0, 3))
    after = np.where(right >= 0, right, np.where(ahead >= 0, ahead, left))
    order, wall, closed = _ordered(after)
    begin = np.stack([column, row], axis=1) - 0.5
    inward = step[(way + 1) % 4].astype(np.float64)
    return Gates((begin + 0.5 * step[way])[order], inward[order], wall, closed)


def _ordered(after: Ints) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """Order of edges along their walls, the wall of each, and which walls are closed."""
    n = len(after)
    if n == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool)
    edge = np.arange(n)
    linked = after >= 0
    count, wall = connected_components(
        sp.coo_array((np.ones(linked.sum(), bool), (edge[linked], after[linked])), shape=(n, n)), directed=False
    )
    closed = np.ones(count, bool)
    closed[wall[~linked]] = False
    # A closed wall is cut before its first edge.
    _, first = np.unique(wall, return_index=True)
    follow = np.where(linked, after, edge)
    cut = closed[wall] & (follow == first[wall])
    follow[cut] = edge[cut]
    # Steps to the end of the wall, by doubling.
    left, jump = (follow != edge).astype(np.int64), follow
    while (jump[jump] != jump).any():
        left = left + left[jump]
        jump = jump[jump]
    order = np.lexsort((-left, wall))
    return order, wall[order].astype(np.int64), closed


def curves(mask: NDArray[np.bool_], pieces: int) -> tuple[Floats, Floats]:
    """Straight pieces of the outline: begins and ends (n, 2), x, y in pixels, with the fluid on their right.

    Each stretch from one gate to the next is cut into `pieces`; walls that end at the image's border go straight on.
    """
    crossed = gates(mask)
    n = len(crossed.wall)
    if n == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    point = smoothest(crossed)
    size = np.bincount(crossed.wall)
    first = np.cumsum(size) - size
    last = first + size - 1
    before, after = np.arange(n) - 1, np.arange(n) + 1
    closed = crossed.closed
    before[first], after[last] = np.where(closed, last, first), np.where(closed, first, last)
    knots, tangent = _cubic(point, before, after, pieces)
    # What a closed wall encloses is known: its pixels. It matters where there are few.
    along = crossed.inward[:, [1, 0]] * [1.0, -1.0]
    wanted = _enclosed(crossed.middle, crossed.middle + along, crossed.wall)
    found = sum(_enclosed(a, b, crossed.wall) for a, b in itertools.pairwise(knots))
    around = np.bincount(crossed.wall, np.hypot(*(point[after] - point).T))
    # Both areas count positive where the fluid is inside.
    shift = np.where(
        closed, np.clip((wanted - found) / np.maximum(around, 1e-9), -LARGEST_SHIFT_PX, LARGEST_SHIFT_PX), 0.0
    )
    outward = tangent[:, [1, 0]] * [1.0, -1.0]
    point = point + shift[crossed.wall, None] * outward
    knots, tangent = _cubic(point, before, after, pieces)
    on = after != np.arange(n)
    begins, ends = [knots[:-1, on].reshape(-1, 2)], [knots[1:, on].reshape(-1, 2)]
    open_ = ~closed
    begins += [point[first[open_]] - BEYOND_PX * tangent[first[open_]], point[last[open_]]]
    ends += [point[first[open_]], point[last[open_]] + BEYOND_PX * tangent[last[open_]]]
    return np.concatenate(begins), np.concatenate(ends)


def _enclosed(a: Floats, b: Floats, wall: Ints) -> Floats:
    """Areas (walls,) under the pieces a to b (n, 2)."""
    return np.asarray(0.5 * np.bincount(wall, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))


def _cubic(point: Floats, before: Ints, after: Ints, pieces: int) -> tuple[Floats, Floats]:
    """Knots (pieces + 1, n, 2) of the curve from each point to the next, and its unit tangents (n, 2) there.

    The tangent is that of the circle through a point and its neighbours, and the curve the cubic between two.
    """
    back, ahead = point - point[before], point[after] - point
    sb, sa = (np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)[:, None] for d in (back, ahead))
    tangent = back / sb * sa + ahead / sa * sb
    lone = (sb[:, 0] < 1e-8) | (sa[:, 0] < 1e-8)
    tangent[lone] = (back / sb + ahead / sa)[lone]
    tangent /= np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)[:, None]
    u = np.linspace(0.0, 1.0, pieces + 1)[:, None, None]
    swing = u * (1.0 - u) * sa * ((1.0 - u) * tangent - u * tangent[after])
    straight = u * u * (3.0 - 2.0 * u) * ahead
    return np.asarray(point + straight + swing), tangent


def smoothest(crossed: Gates) -> Floats:
    """Points (n, 2) of the outline, one beside each gate: x, y in pixels."""
    n = len(crossed.wall)
    if n == 0:
        return np.zeros((0, 2))
    size = np.bincount(crossed.wall)
    start = np.cumsum(size) - size
    wrap = np.where(crossed.closed, WRAP, 0)
    long = size + 2 * wrap
    offset = np.cumsum(long) - long
    wall = np.repeat(np.arange(len(size)), long)
    k = np.arange(long.sum()) - offset[wall] - wrap[wall]
    source = start[wall] + k % size[wall]
    own = (k >= 0) & (k < size[wall])
    # A closed wall of few gates bends at each of them.
    stiffness = np.where(crossed.closed, np.minimum(STIFFNESS_PX, size / GATES_PER_STIFFNESS), STIFFNESS_PX)
    relaxed = _relax(crossed.middle[source], crossed.inward[source], wall, stiffness[wall])
    result = np.empty((n, 2))
    result[source[own]] = relaxed[own]
    return result


def _relax(middle: Floats, inward: Floats, wall: Ints, stiffness: Floats) -> Floats:
    """Points (n, 2) beside the middles of gates on open walls, for a stiffness l (n,) to begin with.

    Each point is its middle moved along the normal of the wall. d kappa / ds is the third divided difference over
    four points in the direction of the normal; normals and distances are those of the last approximation, so that
    every step is a banded least-squares problem.
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
        # Row i: jacobian @ offsets + target, offsets along the normals of points i to i + 3.
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
        offset = np.clip(solveh_banded(bands, right, lower=True), -FARTHEST_PX, FARTHEST_PX)
        point = middle + offset[:, None] * normals
        missed = np.abs(offset) > 0.5 * np.abs((inward * normals).sum(axis=1)) + SLACK_PX
        near = np.convolve(missed, np.ones(2 * SOFTENED + 1), "same") > 0.0
        weight = np.where(near[1:-2] | near[2:-1], weight / SOFTENING, weight)
    return point


def _unit(vector: Floats) -> Floats:
    """Vectors (n, 2) of length 1, or 0 where they vanish."""
    return np.asarray(vector / np.maximum(np.hypot(vector[:, 0], vector[:, 1]), 1e-9)[:, None])


def _across(vector: Floats) -> Floats:
    """Vectors (n, 2) turned by a right angle."""
    return np.stack([-vector[:, 1], vector[:, 0]], axis=1)
