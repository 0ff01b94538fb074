"""Viscous force of a fluid whose viscosity varies from point to point: div(2 mu D), linear in mu and in the velocity.

A viscosity belongs to the centre of each cell and to each corner. Each face with a balance of momentum has four
stresses: those to its right and left belong to cells, those below and above to corners. With a_k the parts of -lap u
of momentum.py, and b_k the same of the transposed gradient, -div (grad v)^T, the viscous force is

    sum_k mu_k a_k + (mu_k - mu_f) b_k,   mu_f = mean of the four mu_k,

so a constant viscosity gives the Newtonian operator to rounding: div (grad v)^T = 0, exactly so in the fluxes of whole
cells, where mu_f cancels and momentum is conserved. Faces that a wall cuts have no b_k: their differences would make
the viscosity of neighbours amplify each other at sharp corners, and in a flow along the wall they are zero.

The shear rate is that of the same gradients, gamma^2 = 4 u_x^2 + (u_y + v_x)^2. A corner in solid stands for the wall
where it meets the grid lines through that corner. Only the normal derivative U' of the speed along the wall exists
there: grad v = U' (n_y, -n_x) (n_x, n_y), gamma = |U'|. In a channel along the grid all stresses are exact, whatever
the fluid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy  # its sparse loads at first use, not at start-up

from flowrec.core import Bools, Floats, Ints
from flowrec.physics.flow.assembly import Triplets, averages, per_flux, scaled_rows
from flowrec.physics.flow.grid import INLET, OUTLET, WALL, Faces, Grid
from flowrec.physics.flow.level_set import LevelSet
from flowrec.physics.flow.momentum import Momentum, neighbouring_lines
from flowrec.physics.flow.wall_stencils import Profiles

# Viscosities that are closer than this, in cells, differ by their errors: their difference is taken over this distance.
SHORTEST = 0.5
# Least square sum of the weights of a normal derivative at a wall. Where the wall is flat, a grid line that crosses it
# within a cell has at least 1/4.
LEAST_WEIGHT = 0.1


@dataclass(frozen=True, eq=False)
class Stress:
    """Sparse operators on the fluxes of the faces: r stresses, m points with a viscosity, g gradients."""

    gather: Any  # (faces, r) sums the stresses of a face to its force
    strain: Any  # (r, faces) stresses per viscosity
    at: Any  # (r, m) viscosities of the stresses
    gradient: Any  # (g, faces) in velocity per cell, last those across the depth, 6 V / H
    square: Any  # (m, g) gamma^2 = square @ gradients^2
    planar: int  # number of gradients that are not across the depth
    viscous: int  # number of stresses that are not the drag of the depth
    curl: Any  # (faces, unknowns) fluxes of stream functions

    @cached_property
    def on_streams(self) -> tuple[Any, Any, Any]:
        """Operators gather, strain and gradient on stream functions; made when first used."""
        left, strain, gradient = self.curl.T @ self.gather, self.strain @ self.curl, self.gradient @ self.curl
        return left.tocsr(), strain.tocsr(), gradient.tocsr()


@dataclass(frozen=True, slots=True, eq=False)
class _Component:
    """Gradients of one component on its faces (n,), in the frame in which they are upright; matrices (n, faces)."""

    me: Ints  # numbers
    balanced: Bools  # with a balance of momentum
    along: list[Any]  # u_x to the right and to the left
    across: list[Any]  # u_y below and above
    parts: list[Any]  # a_k: to the right, to the left, below, above
    transposed: tuple[Floats, Floats]  # (n,) b_k over u_x to the right, over v_x below; the others have the other sign
    inner: list[Bools]  # whether there are cells to the right and to the left
    cells: tuple[Ints, Ints]  # their points
    corners: tuple[Ints, Ints]  # the points below and above


def assemble(momentum: Momentum, curl: Any, friction: Floats | None) -> Stress:
    """Operators of a grid; `friction` (faces,) is the factor 12 h^2 / H^2 of a shallow chip, else None."""
    grid = momentum.grid
    h, w = grid.fluid.shape
    cell = np.arange(h * w).reshape(h, w)
    corner = h * w + np.arange((h + 1) * (w + 1)).reshape(h + 1, w + 1)
    fraction = grid.open_fraction
    upright, level = momentum.profiles
    u = _component(grid.u, grid.walls, upright, cell, corner, fraction)
    v = _component(grid.v.T, grid.walls.T, level, cell.T, corner.T, fraction)
    points = h * w + corner.size
    shear, wall, mixed = _corner_gradients(grid, u, v, points)
    strain_rate = _cell_gradients(u, v, points)
    square, gradient, planar = _shear_rate(grid, cell, corner, strain_rate, shear, wall, friction, fraction)
    rows, faces, places = zip(*(_stresses(part, other) for part, other in ((u, mixed[1]), (v, mixed[0]))), strict=True)
    strain, face, place = scipy.sparse.vstack(rows, format="csr"), np.concatenate(faces), np.concatenate(places)
    viscous = len(place)
    at = scipy.sparse.csr_array((np.ones(viscous), (np.arange(viscous), place)), shape=(viscous, points))
    if friction is not None:
        # The drag of the depth, with the mean viscosity around the face.
        balanced = np.unique(face)
        around = scipy.sparse.csr_array((np.ones(viscous), (face, place)), shape=(grid.faces, points))[balanced]
        drag = scipy.sparse.csr_array(
            ((friction * momentum.volume)[balanced], (np.arange(len(balanced)), balanced)),
            shape=(len(balanced), grid.faces),
        )
        strain = scipy.sparse.vstack([strain, drag], format="csr")
        at = scipy.sparse.vstack([at, scaled_rows(1.0 / around.sum(axis=1), around)], format="csr")
        face = np.concatenate([face, balanced])
    gather = scipy.sparse.csr_array((np.ones(len(face)), (face, np.arange(len(face)))), shape=(grid.faces, len(face)))
    used = np.unique(at.indices)  # no stress needs the others
    return Stress(gather, strain, at[:, used], gradient, square[used], planar, viscous, curl)


def _component(
    faces: Faces, walls: LevelSet, profiles: Profiles, cell: Ints, corner: Ints, fraction: Floats
) -> _Component:
    """Gradients on upright faces; `cell` (h, w) and `corner` (h + 1, w + 1) are numbers of points."""
    w = cell.shape[1]
    j, i = np.nonzero(faces.kind != WALL)
    me, row, n = faces.number[j, i], profiles.place[j, i], len(fraction)
    lines = neighbouring_lines(faces, profiles, walls, j, i)

    def matrix(columns: Ints, values: Floats) -> Any:
        entries = Triplets((len(me), n))
        entries.add(np.arange(len(me))[:, None], columns, values)
        return per_flux(entries.matrix(), fraction)

    columns, along, parts = profiles.columns[row], [], []
    for side, step in enumerate((1.0, -1.0)):
        slope = lines.inner[side] * step / lines.distance[side]
        weights = slope[:, None] * np.concatenate([-lines.middle, lines.beyond[side]], axis=1)
        along.append(matrix(np.concatenate([columns, lines.columns[side]], axis=1), weights))
        parts.append(scaled_rows(-step / lines.total, along[-1]))
    half = np.where((i == 0) | (i == w), 0.5, 1.0)
    low, high = faces.low[j, i] - 0.5, faces.high[j, i] - 0.5
    length = np.maximum(high - low, SHORTEST)
    bend, mean = profiles.weights[row, 2], profiles.slope(row, 0.5 * (low + high)) / length[:, None]
    across = [matrix(columns, profiles.slope(row, end)) for end in (high, low)]
    parts += [matrix(columns, -half[:, None] * (bend + sign * mean)) for sign in (1.0, -1.0)]
    kind = faces.kind[j, i]
    whole = (kind != OUTLET) & lines.simple  # half volumes and cut faces have no transposed part
    return _Component(
        me,
        kind != INLET,
        along,
        across,
        parts,
        (whole * -1.0 / lines.total, whole * -half / length),
        lines.inner,
        (cell[j, np.minimum(i, w - 1)], cell[j, np.maximum(i - 1, 0)]),
        (corner[j + 1, i], corner[j, i]),
    )


def _mean_at(points: int, places: tuple[Ints, Ints], values: list[Any], known: list[Bools] | None) -> tuple[Any, Bools]:
    """(points, faces) means of gradients over those at the same point; and which points (points,) have one."""
    place = np.concatenate(places)
    column = np.arange(len(place)) if known is None else np.flatnonzero(np.concatenate(known))
    mean = averages(place[column], column, (points, len(place)))
    return mean @ scipy.sparse.vstack(values, format="csr"), np.diff(mean.indptr) > 0


def _cell_gradients(u: _Component, v: _Component, points: int) -> tuple[Any, Bools]:
    """(points, faces) u_x at cells, as the mean of u_x and -v_y, and where it is known."""
    (u_x, has_u), (v_y, has_v) = (_mean_at(points, part.cells, part.along, part.inner) for part in (u, v))
    count = has_u.astype(np.float64) + has_v
    return scaled_rows(1.0 / np.maximum(count, 1.0), u_x - v_y), count > 0


def _corner_gradients(grid: Grid, u: _Component, v: _Component, points: int) -> tuple[Any, Any, tuple[Any, Any]]:
    """(points, faces) u_y + v_x at corners, U' at those in solid, and (u_y, v_x)."""
    level = grid.walls.level
    (u_y, has_u), (v_x, has_v) = (_mean_at(points, part.corners, part.across, None) for part in (u, v))
    if grid.walls.staircase:
        n_x, n_y = has_v.astype(np.float64), has_u.astype(np.float64)
    else:
        n_x, n_y = np.zeros((2, points))
        n_y[grid.fluid.size :] = np.gradient(level, axis=0)[::2, ::2].ravel()
        n_x[grid.fluid.size :] = np.gradient(level, axis=1)[::2, ::2].ravel()
    length = np.maximum(np.hypot(n_x, n_y), 1e-12)
    n_x, n_y = n_x / length, n_y / length
    solid = np.zeros(points, bool)
    solid[grid.fluid.size :] = (level[::2, ::2] <= 0.0).ravel()
    # U' by least squares from u_y = U' n_y^2 and v_x = -U' n_x^2, as far as they are known.
    weight = np.maximum(has_u * n_y**4 + has_v * n_x**4, LEAST_WEIGHT)
    wall = scaled_rows(solid * n_y**2 / weight, u_y) - scaled_rows(solid * n_x**2 / weight, v_x)
    u_y = scaled_rows(~solid, u_y) + scaled_rows(n_y**2, wall)
    v_x = scaled_rows(~solid, v_x) - scaled_rows(n_x**2, wall)
    for matrix in (wall, u_y, v_x):
        matrix.eliminate_zeros()
    return u_y + v_x, wall, (u_y, v_x)


def _shear_rate(
    grid: Grid,
    cell: Ints,
    corner: Ints,
    cells: tuple[Any, Bools],
    shear: Any,
    wall: Any,
    friction: Floats | None,
    fraction: Floats,
) -> tuple[Any, Any, int]:
    """Weights of the squared gradients at the points (points, g), the gradients (g, faces), how many are not speeds."""
    points, n = shear.shape
    level = grid.walls.level
    strain, known = cells
    fluid = np.concatenate([(level[1::2, 1::2] > 0.0).ravel(), (level[::2, ::2] > 0.0).ravel()])
    ends = [corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]]
    at_corner, at_cell = np.concatenate([end.ravel() for end in ends]), np.tile(cell.ravel(), 4)
    # Means over the corners of a cell that have a gradient, and over the cells in fluid around a corner.
    used = (np.diff(shear.indptr) > 0)[at_corner]
    to_cell = averages(at_cell[used], at_corner[used], (points, points))
    used = (known & fluid)[at_cell]
    to_corner = averages(at_corner[used], at_cell[used], (points, points))
    is_cell = np.arange(points) < cell.size
    open_cell, closed_cell = is_cell & fluid, is_cell & ~fluid
    one = scipy.sparse.diags_array
    by_strain = one(4.0 * open_cell) + scaled_rows(4.0 * (~is_cell & fluid), to_corner)
    by_shear = one((~is_cell & fluid).astype(float)) + scaled_rows(open_cell, to_cell)
    by_wall = one((~is_cell & ~fluid).astype(float)).tocsr()
    # A cell with its centre in solid has the mean of its corners.
    rest = scaled_rows(closed_cell, to_cell)
    rest.eliminate_zeros()
    squares = [part + rest @ part for part in (by_strain, by_shear, by_wall)]
    gradients = [strain, shear, wall]
    keep = [np.diff(part.indptr) > 0 for part in gradients]
    planar = int(sum(part.sum() for part in keep))
    if friction is not None:
        squares.append(_speeds(grid, cell, corner, fluid))
        # 6 V / H between cells at the distance h, for f = 12 h^2 / H^2.
        gradients.append(one(np.sqrt(3.0 * friction) / fraction).tocsr())
        keep.append(np.ones(n, bool))
    square = scipy.sparse.hstack(
        [part.tocsc()[:, kept] for part, kept in zip(squares, keep, strict=True)], format="csr"
    )
    gradient = scipy.sparse.vstack([part[kept] for part, kept in zip(gradients, keep, strict=True)], format="csr")
    square.eliminate_zeros()
    return square, gradient, planar


def _speeds(grid: Grid, cell: Ints, corner: Ints, fluid: Bools) -> Any:
    """(points, faces) weights of the squared velocities of faces in the squared speed at points in fluid."""
    entries = Triplets((len(fluid), grid.faces))
    for number, cells, corners in ((grid.u.number, cell, corner), (grid.v.number.T, cell.T, corner.T)):
        for place, faces in (
            (cells, number[:, :-1]),
            (cells, number[:, 1:]),
            (corners[1:], number),
            (corners[:-1], number),
        ):
            entries.add(np.where(fluid[place], place, -1), faces, 0.5)
    return entries.matrix()


def _stresses(part: _Component, other: Any) -> tuple[Any, Ints, Ints]:
    """Stresses per viscosity (4 n, faces), their faces and their points; `other` is the cross gradient at corners."""
    along, across = part.transposed
    transposed = [
        scaled_rows(along, part.along[0]),
        scaled_rows(-along, part.along[1]),
        scaled_rows(across, other[part.corners[0]]),
        scaled_rows(-across, other[part.corners[1]]),
    ]
    mean = 0.25 * (transposed[0] + transposed[1] + transposed[2] + transposed[3])
    rows = [(own + extra - mean)[part.balanced] for own, extra in zip(part.parts, transposed, strict=True)]
    places = np.concatenate([place[part.balanced] for place in (*part.cells, *part.corners)])
    return scipy.sparse.vstack(rows, format="csr"), np.tile(part.me[part.balanced], 4), places
