"""Velocity between pixel centres: cubic along rows and columns, with the walls where they are; compiled.

Bilinear interpolation cuts the top off a parabola: by 6 % on the centreline of a channel four pixels wide. So between
the two centres nearest to a place, a fraction a after the first one, the second differences C of both are added,

    f(a) = (1 - a) f0 + a f1 - a (1 - a) / 6 ((2 - a) C0 + (1 + a) C1),

which is Lagrange's cubic through four centres, first along x and then along y. Where a pixel of the four is solid, its
value is continued from the fluid beside it: by the parabola through the two next centres that is zero at the wall, or
that is zero at two walls. In solid, where the wall distance between the centres is not positive, nothing moves. All of
it is linear in the velocities, so a place has weights on the pixels around it, and a plane channel flow has no error.
"""

from __future__ import annotations

import numpy as np

from flowrec.core import Floats, Floats32, Ints, bilinear, compiled

SIZE = 8  # rows and columns of the weights: four for the cubic, and two more on each side for continued values
_BEFORE = 3  # of them before the pixel to the upper left of the place
_LEAST_DISTANCE = 0.02  # in steps, of a wall from a centre: nearer ones would need large weights; masks keep 0.1
_STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))  # right, left, ...


@compiled
def _wall_after(fluid: float, solid: float) -> float:
    """Distance of the wall from a centre in fluid on the way to one in solid, in steps."""
    return max(fluid / (fluid - solid), _LEAST_DISTANCE)


@compiled
def _is_known(wall_px: Floats32, row: int, column: int) -> bool:
    """True if a pixel has a value: it is fluid, or a neighbour is."""
    h, w = wall_px.shape
    if row < 0 or column < 0 or row >= h or column >= w:
        return False
    for j in range(max(row - 1, 0), min(row + 2, h)):
        for i in range(max(column - 1, 0), min(column + 2, w)):
            if wall_px[j, i] > 0.0:
                return True
    return False


@compiled
def _add(weights: Floats, row: int, column: int, wall_px: Floats32, j: int, i: int, weight: float) -> None:
    """Add the weight of pixel (j, i), continued from the fluid where it is solid; weights[0, 0] is (row, column)."""
    if weight == 0.0:
        return
    if wall_px[j, i] > 0.0:
        weights[j - row, i - column] += weight
        return
    h, w = wall_px.shape
    for first in (0, 4):  # from the neighbours beyond a side, or else from those beyond a corner
        total = 0.0
        for pass_ in range(2):
            for n in range(first, first + 4):
                dj, di = _STEPS[n]
                j1, i1 = j + dj, i + di
                if j1 < 0 or i1 < 0 or j1 >= h or i1 >= w or wall_px[j1, i1] <= 0.0:
                    continue
                d = _wall_after(wall_px[j1, i1], wall_px[j, i])
                if pass_ == 0:
                    total += d
                    continue
                # Where the wall is nearer, the same error of the wall matters more.
                share = weight * d / total
                j2, i2 = j1 + dj, i1 + di
                if j2 < 0 or i2 < 0 or j2 >= h or i2 >= w:
                    weights[j1 - row, i1 - column] -= share * (1.0 - d) / d
                elif wall_px[j2, i2] > 0.0:
                    weights[j1 - row, i1 - column] -= share * 2.0 * (1.0 - d) / d
                    weights[j2 - row, i2 - column] += share * (1.0 - d) / (1.0 + d)
                else:
                    e = _wall_after(wall_px[j1, i1], wall_px[j2, i2])
                    weights[j1 - row, i1 - column] -= share * (1.0 - d) * (1.0 + e) / (d * e)
        if total > 0.0:
            return


@compiled
def _line_weights(known: tuple[bool, bool, bool, bool], a: float) -> tuple[float, float, float, float]:
    """Weights of four values in a row at a fraction a between the second and the third; the outer two may be unknown.

    A second difference is left out where a value of it is unknown; the parabola of the other one then holds.
    """
    first = known[0] and known[1] and known[2]
    second = known[1] and known[2] and known[3]
    bend = a * (1.0 - a)
    if first and second:
        c0, c1 = bend * (2.0 - a) / 6.0, bend * (1.0 + a) / 6.0
    else:
        c0, c1 = (0.5 * bend if first else 0.0), (0.5 * bend if second else 0.0)
    return -c0, 1.0 - a + 2.0 * c0 - c1, a + 2.0 * c1 - c0, -c1


@compiled
def fill_weights(wall_px: Floats32, x: float, y: float, weights: Floats) -> tuple[int, int]:
    """Weights (SIZE, SIZE) of the pixels around a place in px; returns the row and column of weights[0, 0].

    `weights` is zero before. The raster has at least two rows and two columns. All weights in solid and beyond the
    raster are zero.
    """
    h, w = wall_px.shape
    x = min(max(x, 0.0), w - 1.0)
    y = min(max(y, 0.0), h - 1.0)
    i = min(int(x), w - 2)
    j = min(int(y), h - 2)
    row, column = j - _BEFORE, i - _BEFORE
    if bilinear(wall_px, x, y) <= 0.0:
        return row, column
    across = np.zeros(4)
    known = np.zeros((4, 4), np.bool_)
    for n in range(4):
        for m in range(4):
            known[n, m] = _is_known(wall_px, j - 1 + n, i - 1 + m)
    # A row counts where its two middle values are known.
    rows = (
        known[0, 1] and known[0, 2],
        known[1, 1] or known[1, 2],
        known[2, 1] or known[2, 2],
        known[3, 1] and known[3, 2],
    )
    across[0], across[1], across[2], across[3] = _line_weights(rows, y - j)
    for n in range(4):
        if across[n] != 0.0:
            along = _line_weights((known[n, 0], known[n, 1], known[n, 2], known[n, 3]), x - i)
            for m in range(4):
                if along[m] != 0.0:
                    _add(weights, row, column, wall_px, j - 1 + n, i - 1 + m, across[n] * along[m])
    return row, column


@compiled
def velocity_at(velocity: Floats32, wall_px: Floats32, x: float, y: float) -> tuple[float, float]:
    """Velocity at a place in px, of values (h, w, 2) at pixel centres. Bilinear for a `wall_px` of no pixels.

    Beyond the outermost centres the value of the nearest place between them holds.
    """
    if wall_px.size == 0:
        return bilinear(velocity[:, :, 0], x, y), bilinear(velocity[:, :, 1], x, y)
    h, w = wall_px.shape
    weights = np.zeros((SIZE, SIZE))
    row, column = fill_weights(wall_px, x, y, weights)
    vx = 0.0
    vy = 0.0
    for n in range(max(0, -row), min(SIZE, h - row)):
        for m in range(max(0, -column), min(SIZE, w - column)):
            weight = weights[n, m]
            if weight != 0.0:
                vx += weight * velocity[row + n, column + m, 0]
                vy += weight * velocity[row + n, column + m, 1]
    return vx, vy


@compiled
def velocities_at(velocity: Floats32, wall_px: Floats32, points: Floats) -> Floats:
    """Velocities (n, 2) at points (n, 2) in px; zero where a point is not finite or half a pixel beyond all centres."""
    h, w = velocity.shape[:2]
    found = np.zeros((len(points), 2))
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        if x >= -0.5 and y >= -0.5 and x <= w - 0.5 and y <= h - 0.5:
            found[n, 0], found[n, 1] = velocity_at(velocity, wall_px, x, y)
    return found


@compiled
def stencils_at(wall_px: Floats32, points: Floats) -> Floats:
    """Weights (n, SIZE, SIZE) of the pixels around points (n, 2) in px; [0, 0] is _BEFORE before the upper left one."""
    weights = np.zeros((len(points), SIZE, SIZE))
    for n in range(len(points)):
        fill_weights(wall_px, points[n, 0], points[n, 1], weights[n])
    return weights


def pixel_weights(wall_px: Floats32, points: Floats) -> tuple[Ints, Floats]:
    """Pixels (n, m), as indices row by row, and weights (n, m) whose sum over pixels is the velocity at points (n, 2).

    The first of the pixels is the nearest one. Points are in px and inside the raster.
    """
    h, w = wall_px.shape
    walls = np.ascontiguousarray(wall_px).view()
    walls.flags.writeable = False  # as those of a message are: the kernels are compiled for one kind
    weights = stencils_at(walls, np.ascontiguousarray(points, np.float64))
    corner = np.minimum(np.clip(points, 0.0, [w - 1.0, h - 1.0]).astype(np.intp), [max(w - 2, 0), max(h - 2, 0)])
    columns, rows = (corner[:, axis, None] - _BEFORE + np.arange(SIZE) for axis in (0, 1))
    pixels = np.clip(rows, 0, h - 1)[:, :, None] * w + np.clip(columns, 0, w - 1)[:, None, :]
    pixels, weights = (values.reshape(len(points), SIZE * SIZE) for values in (pixels, weights))
    # The nearest first, then those with a weight; the columns that nobody needs are left out.
    nearest = np.clip(np.rint(points), 0, [w - 1, h - 1]).astype(np.intp)
    place = np.argmax(pixels == (nearest[:, 1] * w + nearest[:, 0])[:, None], axis=1)
    rank = np.where(weights != 0.0, 1, 2)
    rank[np.arange(len(points)), place] = 0
    order = np.argsort(rank, axis=1, kind="stable")[:, : max(int((rank < 2).sum(axis=1).max(initial=1)), 1)]
    return np.take_along_axis(pixels, order, axis=1), np.take_along_axis(weights, order, axis=1)
