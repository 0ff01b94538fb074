"""The momentum balance of every moving face: viscosity, depth friction, convection and pressure.

Integrated over control volumes of one cell (half a cell at an outlet's border) and divided by mu, in units of the
cell size h, the equation of a face is

    (A + f V) w + (rho h / mu) N(w) = G p^ + P p^_out,   p^ = p h / mu,   f = 12 h^2 / H^2,

with the face velocities w. Walls are met half edge by half edge: beside a face lies half of each of two cross
faces, and each half is open (neighbour one cell away), a wall (half a cell away) or an opening.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from flowrec.flow.grid import INLET, OPEN, OUTLET, WALL, Floats, Grid, Ints

# The nearest and farthest wall that a ghost value may see, in cells: a vanishing distance would freeze the face.
NEAREST, FARTHEST = 0.25, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Momentum:
    """Sparse operators on the moving faces."""

    viscous: Any  # A (faces, faces), symmetric positive
    volume: Floats  # (faces,) V: 1, or 1/2 at outlets
    flux: Any  # (6 faces, faces) outward flux through the six sides of each control volume
    carried: Any  # (6 faces, faces) velocity at those sides
    gradient: Any  # G (faces, cells)
    outlet: Floats  # P (faces, openings)

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
        """Add values where both row and column are numbered."""
        there = (rows >= 0) & (columns >= 0)
        self.parts.append((rows[there], columns[there], np.broadcast_to(values, rows.shape)[there].astype(np.float64)))

    def matrix(self, shape: tuple[int, int]) -> Any:
        """Sum duplicates into CSR."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        return sp.csr_array(sp.coo_array((values, (rows, columns)), shape=shape))


def assemble(grid: Grid) -> Momentum:
    """All operators of a grid."""
    n = grid.faces
    viscous, flux, carried, gradient = _Triplets(), _Triplets(), _Triplets(), _Triplets()
    volume = np.ones(n)
    distance = grid.distance
    # The balance of v is that of u with rows and columns exchanged.
    _component(
        (viscous, flux, carried, gradient),
        n,
        (grid.kind_u, grid.number_u),
        (grid.kind_v, grid.number_v),
        grid.number_p,
        distance,
    )
    _component(
        (viscous, flux, carried, gradient),
        n,
        (grid.kind_v.T, grid.number_v.T),
        (grid.kind_u.T, grid.number_u.T),
        grid.number_p.T,
        None if distance is None else distance.T,
    )
    outlet = np.zeros((n, len(grid.mouths)))
    for index, mouth in enumerate(grid.mouths):
        if mouth.kind == "outlet":
            outlet[mouth.faces, index] = mouth.inward
            volume[mouth.faces] = 0.5
    return Momentum(
        viscous.matrix((n, n)),
        volume,
        flux.matrix((6 * n, n)),
        carried.matrix((6 * n, n)),
        gradient.matrix((n, grid.cells)),
        outlet,
    )


def _component(
    into: tuple[_Triplets, _Triplets, _Triplets, _Triplets],
    n: int,
    own: tuple[NDArray[np.int8], Ints],
    cross: tuple[NDArray[np.int8], Ints],
    cells: Ints,
    distance: Floats | None,
) -> None:
    """Balance of the faces (h, w + 1) that are crossed along the columns; `cross` are the other faces (h + 1, w)."""
    viscous, flux, carried, gradient = into
    kind, number = own
    cross_kind, cross_number = cross
    w = cells.shape[1]
    j, i = np.nonzero((kind != WALL) & (kind != INLET))
    me = number[j, i]

    def at(array: NDArray[Any], rows: Ints, columns: Ints, outside: int) -> NDArray[Any]:
        inside = (rows >= 0) & (rows < array.shape[0]) & (columns >= 0) & (columns < array.shape[1])
        return np.where(inside, array[np.where(inside, rows, 0), np.where(inside, columns, 0)], outside)

    for side, step in enumerate((1, -1)):
        # Along the flow: the side lies in the middle of a cell, or on an outlet's border, where nothing changes.
        inner = (i + step >= 0) & (i + step <= w)
        neighbour = at(number, j, i + step, -1)
        reach = np.ones(len(j))
        if distance is not None:
            walled = inner & (neighbour < 0)
            reach[walled] = np.clip(_along(distance, j, i, step)[walled], 0.5, FARTHEST)
        viscous.add(me, me, inner / reach)
        viscous.add(me, neighbour, -1.0)
        rows = side * n + me
        half = np.where(inner, 0.5, 1.0)
        for part in (flux, carried):
            weight = half * step if part is flux else half
            part.add(rows, me, weight)
            part.add(rows, neighbour, weight)
        cell = at(cells, j, i if step > 0 else i - 1, -1)
        gradient.add(me, cell, -float(step))
    for above, step in enumerate((1, -1)):
        beyond_row = j + (step > 0)
        neighbour = at(number, j + step, i, -1)
        reach = np.full(len(j), 0.5)
        if distance is not None:
            reach = np.clip(_beside(distance, j, i, step), NEAREST, FARTHEST)
        for share, column in enumerate((i - 1, i)):
            beyond = at(cross_kind, beyond_row, column, -1)
            passing = at(cross_number, beyond_row, column, -1)
            opened = beyond == OPEN
            viscous.add(me, me, 0.5 * (opened + np.isin(beyond, (WALL, INLET)) / reach))
            viscous.add(np.where(opened, me, -1), neighbour, -0.5)
            rows = (2 + 2 * above + share) * n + me
            flux.add(rows, passing, 0.5 * step)
            carried.add(rows, me, np.where(opened, 0.5, 1.0 * (beyond == OUTLET)))
            carried.add(np.where(opened, rows, -1), neighbour, 0.5)


def _at_faces(distance: Floats, j: Ints, i: Ints) -> Floats:
    """Wall distance at the faces (j, i), the mean of the two cells beside; `distance` has a ring of one cell."""
    return np.asarray(0.5 * (distance[j + 1, i] + distance[j + 1, i + 1]))


def _beside(distance: Floats, j: Ints, i: Ints, step: int) -> Floats:
    """How far the wall is from the faces across the columns, in cells, from the distance here and one cell on."""
    here = _at_faces(distance, j, i)
    there = _at_faces(distance, np.clip(j + step, -1, distance.shape[0] - 2), i)
    return _crossing(here, there, 0.5)


def _along(distance: Floats, j: Ints, i: Ints, step: int) -> Floats:
    """The same along the columns."""
    here = _at_faces(distance, j, i)
    there = _at_faces(distance, j, np.clip(i + step, 0, distance.shape[1] - 2))
    return _crossing(here, there, 1.0)


def _crossing(here: Floats, there: Floats, otherwise: float) -> Floats:
    """Zero of the straight line through both distances, in cells; `otherwise` where it does not fall."""
    fall = here - there
    return np.where(fall > 1e-3, here / np.maximum(fall, 1e-3), otherwise)
