"""Momentum balance of every face with flow: viscosity, depth friction, convection and pressure.

Divided by mu, in units of the cell size h and per unit of volume, the equation of a face is

    (A + f V) q + (rho h / mu) N(q) = G p^ + P p^_out,   p^ = p h / mu,   f = 12 h^2 / H^2,

where q is the flux of a face over h: its velocity times its open fraction. The rows of outlets, whose control volume is
half a cell, are halved. Pressure is defined in the centres of the cells, whole or cut.

Viscosity across the flow is that of the parabola along the grid line (wall_stencils). Viscosity along the flow is the
second difference of the velocities at one height above the grid line's row: those of the parabolas of the two
neighbouring grid lines, or zero at the wall where the wall is nearer (Shortley and Weller 1938). A plane channel flow
at any angle to the grid is balanced without error. Elsewhere the balance is of second order, and of first order at cut
faces, which leaves the flow of second order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy  # its sparse loads at first use, not at start-up

from flowrec.core import Bools, Floats, Ints
from flowrec.physics.flow.assembly import Triplets, per_flux
from flowrec.physics.flow.centre_values import centre_operator
from flowrec.physics.flow.grid import INLET, OPEN, OUTLET, WALL, Faces, Grid
from flowrec.physics.flow.level_set import LevelSet
from flowrec.physics.flow.linear_solver import Factors, factorise
from flowrec.physics.flow.wall_stencils import Profiles, line_profiles

# A wall that is nearer than this, in cells, would make a face infinitely stiff.
NEAREST = 0.02

# Least volume of a cut face in its balance of momentum.
LEAST_VOLUME = 0.25


@dataclass(frozen=True, eq=False)
class Momentum:
    """Sparse operators on the fluxes of the faces."""

    grid: Grid
    viscous: Any  # A (faces, faces)
    volume: Floats  # (faces,) V: 1, or 1/2 at outlets, over the open fraction
    side_flux: Any  # (6 faces, faces) outward flux through the six sides of each control volume
    side_velocity: Any  # (6 faces, faces) velocity at those sides
    gradient: Any  # G (faces, cells)
    outlet: Floats  # P (faces, openings)
    centre: Any  # (2 n, faces) velocity at the centres of the n fluid pixels: x and y of each in turn
    # (faces, 4) viscous drag of the image's left, right, top and bottom border per unit of its speed along x or y
    sliding: Floats
    profiles: tuple[Profiles, Profiles]  # of the u faces, and of the v faces with rows and columns exchanged

    def convection(self, flux: Floats) -> Floats:
        """N(q) (faces,): the momentum that leaves each control volume."""
        return ((self.side_flux @ flux) * (self.side_velocity @ flux)).reshape(6, -1).sum(axis=0)

    def convection_jacobian(self, flux: Floats) -> Any:
        """dN/dq (faces, faces)."""
        gather = scipy.sparse.csr_array(scipy.sparse.hstack([scipy.sparse.eye_array(len(self.volume))] * 6))
        by_flux = scipy.sparse.diags_array(self.side_velocity @ flux) @ self.side_flux
        by_velocity = scipy.sparse.diags_array(self.side_flux @ flux) @ self.side_velocity
        return gather @ (by_flux + by_velocity)

    @cached_property
    def poisson(self) -> tuple[Any, Factors]:
        """Transposed gradient (cells, faces) of the free faces, and factors of the Laplacian; made when first used."""
        free = np.ones(self.grid.faces)
        for faces in (self.grid.u, self.grid.v):
            free[faces.number[faces.kind == INLET]] = 0.0
        gradient = scipy.sparse.diags_array(free) @ self.gradient
        laplacian = gradient.T @ gradient
        if not any(opening.kind == "outlet" for opening in self.grid.openings):
            # In a closed box the level of the pressure is free: that of the first cell is set to 0.
            laplacian = laplacian + scipy.sparse.coo_array(([1.0], ([0], [0])), shape=laplacian.shape)
        return gradient.T.tocsr(), factorise(laplacian)


class _Sides:
    """A sparse matrix (6 faces, faces) with at most two entries a row: the six sides of each control volume."""

    def __init__(self, faces: int) -> None:
        self.columns = np.zeros((6, faces, 2), np.int64)
        self.values = np.zeros((6, faces, 2))

    def put(self, side: int, rows: Ints, entry: int, columns: Ints, values: Floats | float) -> None:
        """Set entry 0 or 1 of some rows of a side where the column is numbered."""
        self.columns[side, rows, entry] = np.maximum(columns, 0)
        self.values[side, rows, entry] = values * (columns >= 0)

    def matrix(self) -> Any:
        """CSR."""
        faces = self.columns.shape[1]
        ends = np.arange(0, 12 * faces + 1, 2)
        matrix = scipy.sparse.csr_array((self.values.ravel(), self.columns.ravel(), ends), shape=(6 * faces, faces))
        matrix.eliminate_zeros()
        return matrix


@dataclass(slots=True)
class _Operators:
    """The matrices under assembly; see Momentum."""

    viscous: Triplets
    side_flux: _Sides
    side_velocity: _Sides
    gradient: Triplets


def assemble(grid: Grid) -> Momentum:
    """All operators of a grid."""
    n = grid.faces
    fraction = grid.open_fraction
    operators = _Operators(Triplets((n, n)), _Sides(n), _Sides(n), Triplets((n, grid.cells)))
    sliding = np.zeros((n, 4))
    upright = _add_component(operators, sliding[:, 2:], grid.u, grid.v, grid.number_p, grid.walls)
    # The balance of v is that of u with rows and columns exchanged.
    level = _add_component(operators, sliding[:, :2], grid.v.T, grid.u.T, grid.number_p.T, grid.walls.T)
    volume, outlet = np.ones(n), np.zeros((n, len(grid.openings)))
    for index, opening in enumerate(grid.openings):
        if opening.kind == "outlet":
            outlet[opening.faces, index] = opening.inward
            volume[opening.faces] = 0.5
    return Momentum(
        grid,
        per_flux(operators.viscous.matrix(), fraction),
        volume / fraction,
        operators.side_flux.matrix(),
        per_flux(operators.side_velocity.matrix(), fraction),
        operators.gradient.matrix(),
        outlet,
        per_flux(centre_operator(grid, upright, level), fraction),
        sliding,
        (upright, level),
    )


def _add_component(
    operators: _Operators, sliding: Floats, own: Faces, cross: Faces, cells: Ints, walls: LevelSet
) -> Profiles:
    """Add the balance of upright faces `own` (h, w + 1), and return their profiles; `cross` are the level faces."""
    kind = own.kind
    w = cells.shape[1]
    profiles = line_profiles(own, walls, cross.kind)
    j, i = np.nonzero((kind != WALL) & (kind != INLET))
    me = own.number[j, i]
    row = profiles.place[j, i]
    half_volume = np.where((i == 0) | (i == w), 0.5, 1.0)

    # With a margin of -1, so that neighbours can be looked up everywhere.
    numbers, cross_kinds, cross_numbers, around = (
        np.pad(array.astype(np.int64), 1, constant_values=-1) for array in (own.number, cross.kind, cross.number, cells)
    )

    # Across the flow: u_yy = 2 a2 of the parabola on the grid line.
    operators.viscous.add(me[:, None], profiles.columns[row], -2.0 * half_volume[:, None] * profiles.weights[row, 2])
    sliding[me] = 2.0 * half_volume[:, None] * profiles.border[row, 2]
    # Along the flow, at the height t of the middle of the fluid part.
    lines = neighbouring_lines(own, profiles, walls, j, i)
    unused = lines.simple[:, None] & [True, False, True]  # columns without a weight
    columns = np.where(unused, -1, profiles.columns[row])
    for side, step in enumerate((1, -1)):
        factor = (lines.inner[side] / (lines.total * lines.distance[side]))[:, None]
        operators.viscous.add(me[:, None], columns, factor * lines.middle)
        operators.viscous.add(me[:, None], np.where(unused, -1, lines.columns[side]), -factor * lines.beyond[side])
        operators.gradient.add(me, around[j + 1, i + (step > 0)], -float(step))

    scale = 1.0 / np.maximum((own.high - own.low)[j, i], LEAST_VOLUME)
    for side, step in enumerate((1, -1)):
        # The side is in the middle of a cell, or on the border at an outlet, where the velocity does not change.
        neighbour = numbers[j + 1, i + 1 + step]
        half = np.where(lines.inner[side], 0.5, 1.0)
        for entry, column in enumerate((me, neighbour)):
            operators.side_flux.put(side, me, entry, column, half * step * scale)
            operators.side_velocity.put(side, me, entry, column, half)
    for above, step in enumerate((1, -1)):
        neighbour = numbers[j + 1 + step, i + 1]
        for behind in range(2):
            side = 2 + 2 * above + behind
            place = (j + 1 + (step > 0), i + behind)
            opened = cross_kinds[place] == OPEN
            operators.side_flux.put(side, me, 0, cross_numbers[place], 0.5 * step * scale)
            operators.side_velocity.put(side, me, 0, me, np.where(opened, 0.5, 1.0 * (cross_kinds[place] == OUTLET)))
            operators.side_velocity.put(side, me, 1, neighbour, 0.5 * opened)
    return profiles


@dataclass(frozen=True, slots=True, eq=False)
class NeighbouringLines:
    """Neighbours to the right and to the left, in this order, of upright faces (n,), at the height t of each face."""

    simple: Bools  # (n,) no wall cuts these faces: averages over whole faces can stand for point values
    total: Floats  # (n,) distance between the middles of both ways; 1 on the border
    middle: Floats  # (n, 3) weights of the face's own profile in the velocity in the middle of its fluid part
    inner: list[Bools]  # (n,) not beyond the image's border
    distance: list[Floats]  # (n,) to the face there or to the wall, in cells
    columns: list[Ints]  # (n, 3) faces in the profile there; -1 where a wall comes first
    beyond: list[Floats]  # (n, 3) their weights in the velocity there


def neighbouring_lines(own: Faces, profiles: Profiles, walls: LevelSet, j: Ints, i: Ints) -> NeighbouringLines:
    """Find the neighbours of the upright faces (j, i)."""
    w = own.kind.shape[1] - 1
    t = 0.5 * (own.low + own.high)[j, i] - 0.5
    here = _level_at(walls.level, j, i, t)
    whole = own.high - own.low > 1.0 - 1e-12
    inner, rows, distance, simple = [], [], [], whole[j, i].copy()
    for step in (1, -1):
        inside = (i + step >= 0) & (i + step <= w)
        beyond = np.clip(i + step, 0, w)
        there = _level_at(walls.level, j, beyond, t)
        open_ = inside & (own.kind[j, beyond] != WALL) & (there > 0.0)
        rows.append(np.where(open_, profiles.place[j, beyond], -1))
        inner.append(inside)
        to_wall = np.where(there > 0.0, 1.0, here / np.maximum(here - there, 1e-12))
        distance.append(np.where(open_, 1.0, np.clip(to_wall, NEAREST, 1.0)))
        simple &= ~inside | (open_ & whole[j, beyond]) | (~open_ & (distance[-1] == 1.0))
    middle, *others = (
        np.where(simple[:, None], [0.0, 1.0, 0.0], profiles.value(row, t)) for row in (profiles.place[j, i], *rows)
    )
    return NeighbouringLines(
        simple,
        np.where(inner[0] & inner[1], 0.5 * (distance[0] + distance[1]), 1.0),
        middle,
        inner,
        distance,
        [np.where(row[:, None] >= 0, profiles.columns[row], -1) for row in rows],
        others,
    )


def _level_at(level: Floats, j: Ints, i: Ints, t: Floats) -> Floats:
    """Level on the upright faces (j, i) at height t, linear between their ends and their midpoint."""
    middle = level[2 * j + 1, 2 * i]
    end = np.where(t < 0.0, level[2 * j, 2 * i], level[2 * j + 2, 2 * i])
    return middle + 2.0 * np.abs(t) * (end - middle)
