"""The momentum balance of every moving face: viscosity, depth friction, convection and pressure.

Divided by mu, in units of the cell size h and per unit of volume, the equation of a face is

    (A + f V) q + (rho h / mu) N(q) = G p^ + P p^_out,   p^ = p h / mu,   f = 12 h^2 / H^2,

where q is the flux of a face over h, its velocity times the share of it that is fluid. The rows of outlets, whose
control volume is half a cell, are halved. Pressure lives in the middles of the cells, whole or cut.

Viscosity across the flow is that of the parabola along the grid line (lines). Along the flow it is the second
difference of the velocities at one height above the grid line's row: those of the parabolas of the two grid lines
beside, or nothing at the wall, where this comes first and as near as it comes (Shortley and Weller 1938). So a plane
channel flow at any angle to the grid is balanced without error; elsewhere the balance is of second order, and of
first order at cut faces, which leaves the flow of second order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from flowrec.flow.grid import INLET, OPEN, OUTLET, WALL, Floats, Grid, Ints
from flowrec.flow.wall_stencils import lines

# A wall that is nearer, in cells, would make a face infinitely stiff.
NEAREST = 0.02

# The least volume of a cut face in its balance of momentum.
LEAST_VOLUME = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Momentum:
    """Sparse operators on the moving faces."""

    viscous: Any  # A (faces, faces), symmetric positive
    volume: Floats  # (faces,) V: 1, or 1/2 at outlets
    flux: Any  # (6 faces, faces) outward flux through the six sides of each control volume
    carried: Any  # (6 faces, faces) velocity at those sides
    gradient: Any  # G (faces, cells)
    outlet: Floats  # P (faces, openings)
    # (faces, 4) viscous drag of the image's left, right, top and bottom border per unit of its speed along x or y
    sliding: Floats

    def convection(self, moving: Floats) -> Floats:
        """N(w) (faces,): the momentum that leaves each control volume."""
        return np.asarray(((self.flux @ moving) * (self.carried @ moving)).reshape(6, -1).sum(axis=0))

    def convection_jacobian(self, moving: Floats) -> Any:
        """dN/dw (faces, faces)."""
        faces = len(self.volume)
        gather = sp.csr_array(sp.hstack([sp.eye_array(faces)] * 6))
        inner = sp.diags_array(self.carried @ moving) @ self.flux + sp.diags_array(self.flux @ moving) @ self.carried
        return gather @ inner


class _Triplets:
    """Entries of a sparse matrix, collected in pieces."""

    def __init__(self) -> None:
        self.parts: list[tuple[Ints, Ints, Floats]] = []

    def add(self, rows: Ints, columns: Ints, values: Floats | float) -> None:
        """Add values where both row and column are numbered; rows broadcast against columns."""
        there = (rows >= 0) & (columns >= 0)
        if there.all():
            part = (np.broadcast_to(rows, there.shape).ravel(), columns.ravel())
        else:
            part = (np.broadcast_to(rows, there.shape)[there], columns[there])
        self.parts.append((*part, np.broadcast_to(values, there.shape)[there].astype(np.float64)))

    def matrix(self, shape: tuple[int, int]) -> Any:
        """Sum duplicates into CSR."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        return sp.csr_array(sp.coo_array((values, (rows, columns)), shape=shape))


class _Sides:
    """A sparse matrix (6 faces, faces) of at most two entries a row: the six sides of each control volume."""

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
        matrix = sp.csr_array((self.values.ravel(), self.columns.ravel(), ends), shape=(6 * faces, faces))
        matrix.eliminate_zeros()
        return matrix


def assemble(grid: Grid) -> Momentum:
    """All operators of a grid."""
    n = grid.faces
    viscous, gradient = _Triplets(), _Triplets()
    flux, carried = _Sides(n), _Sides(n)
    volume = np.ones(n)
    share = grid.share
    into = (viscous, flux, carried, gradient)
    # The balance of v is that of u with rows and columns exchanged.
    own = (grid.kind_u, grid.number_u, grid.ends_u)
    cross = (grid.kind_v, grid.number_v, grid.ends_v)
    sliding = np.zeros((n, 4))
    _component(into, sliding[:, 2:], share, own, cross, grid.number_p, grid.level, grid.stepped)
    own, cross = ((kind.T, number.T, (ends[0].T, ends[1].T)) for kind, number, ends in (cross, own))
    _component(into, sliding[:, :2], share, own, cross, grid.number_p.T, grid.level.T, grid.stepped)
    outlet = np.zeros((n, len(grid.mouths)))
    for index, mouth in enumerate(grid.mouths):
        if mouth.kind == "outlet":
            outlet[mouth.faces, index] = mouth.inward
            volume[mouth.faces] = 0.5
    return Momentum(
        _per_flux(viscous.matrix((n, n)), share),
        volume / share,
        flux.matrix(),
        _per_flux(carried.matrix(), share),
        gradient.matrix((n, grid.cells)),
        outlet,
        sliding,
    )


def _per_flux(per_velocity: Any, share: Floats) -> Any:
    """A matrix that acts on velocities, made to act on fluxes."""
    per_velocity.data /= share[per_velocity.indices]
    return per_velocity


Faces = tuple[NDArray[np.int8], Ints, tuple[Floats, Floats]]


def _component(
    into: tuple[_Triplets, _Sides, _Sides, _Triplets],
    sliding: Floats,
    share: Floats,
    own: Faces,
    cross: Faces,
    cells: Ints,
    level: Floats,
    stepped: bool,
) -> None:
    """Balance of the faces (h, w + 1) that are crossed along the columns; `cross` are the other faces (h + 1, w)."""
    viscous, flux, carried, gradient = into
    kind, number, (low, high) = own
    cross_kind, cross_number, _ = cross
    w = cells.shape[1]
    table = lines(kind, number, own[2], level, cross_kind, stepped)
    j, i = np.nonzero((kind != WALL) & (kind != INLET))
    me = number[j, i]
    row = table.place[j, i]
    half_volume = np.where((i == 0) | (i == w), 0.5, 1.0)

    # With a rim of nothing all around, so that neighbours can be asked for anywhere.
    numbers, cross_kinds, cross_numbers, around = (
        np.pad(array.astype(np.int64), 1, constant_values=-1) for array in (number, cross_kind, cross_number, cells)
    )

    # Across the flow: u_yy = 2 a2 of the parabola on the grid line.
    viscous.add(me[:, None], table.columns[row], -2.0 * half_volume[:, None] * table.weights[row, 2])
    sliding[me] = 2.0 * half_volume[:, None] * table.border[row, 2]
    # Along the flow, at the height t of the middle of the fluid part.
    t = 0.5 * (low + high)[j, i] - 0.5
    here = _level(level, j, i, t)
    whole = high - low > 1.0 - 1e-12
    inner, line, reach, simple = [], [], [], whole[j, i].copy()
    for step in (1, -1):
        inside = (i + step >= 0) & (i + step <= w)
        beyond = np.clip(i + step, 0, w)
        there = _level(level, j, beyond, t)
        open_ = inside & (kind[j, beyond] != WALL) & (there > 0.0)
        line.append(np.where(open_, table.place[j, beyond], -1))
        inner.append(inside)
        distance = np.where(there > 0.0, 1.0, here / np.maximum(here - there, 1e-12))
        reach.append(np.where(open_, 1.0, np.clip(distance, NEAREST, 1.0)))
        simple &= ~inside | (open_ & whole[j, beyond]) | (~open_ & (reach[-1] == 1.0))
    total = np.where(inner[0] & inner[1], 0.5 * (reach[0] + reach[1]), 1.0)
    cut = ~simple
    own_middle = table.value(row[cut], t[cut])
    for side, step in enumerate((1, -1)):
        factor = inner[side] / (total * reach[side])
        seen = simple & (line[side] >= 0)
        # Where nothing is cut, means over whole faces do for points.
        viscous.add(me[simple], me[simple], factor[simple])
        viscous.add(me[seen], table.columns[line[side][seen], 1], -factor[seen])
        viscous.add(me[cut, None], table.columns[row[cut]], factor[cut, None] * own_middle)
        seen = cut & (line[side] >= 0)
        there = table.value(line[side][seen], t[seen])
        viscous.add(me[seen, None], table.columns[line[side][seen]], -factor[seen, None] * there)
        gradient.add(me, around[j + 1, i + (step > 0)], -float(step))

    scale = 1.0 / np.maximum(share[me], LEAST_VOLUME)
    for side, step in enumerate((1, -1)):
        # The side lies in the middle of a cell, or on an outlet's border, where nothing changes.
        neighbour = numbers[j + 1, i + 1 + step]
        half = np.where(inner[side], 0.5, 1.0)
        for entry, column in enumerate((me, neighbour)):
            flux.put(side, me, entry, column, half * step * scale)
            carried.put(side, me, entry, column, half)
    for above, step in enumerate((1, -1)):
        neighbour = numbers[j + 1 + step, i + 1]
        for behind in range(2):
            side = 2 + 2 * above + behind
            place = (j + 1 + (step > 0), i + behind)
            opened = cross_kinds[place] == OPEN
            flux.put(side, me, 0, cross_numbers[place], 0.5 * step * scale)
            carried.put(side, me, 0, me, np.where(opened, 0.5, 1.0 * (cross_kinds[place] == OUTLET)))
            carried.put(side, me, 1, neighbour, 0.5 * opened)


def _level(level: Floats, j: Ints, i: Ints, t: Floats) -> Floats:
    """Level on the upright faces (j, i) at t, straight between their ends and their middle."""
    middle = level[2 * j + 1, 2 * i]
    end = np.where(t < 0.0, level[2 * j, 2 * i], level[2 * j + 2, 2 * i])
    return np.asarray(middle + 2.0 * np.abs(t) * (end - middle))
