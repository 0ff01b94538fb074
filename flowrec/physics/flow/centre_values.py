"""Velocity at the centres of pixels, from the fluxes through the faces around them.

The unknowns of the solver are averages over faces; a field holds values at points. On each grid line the velocity is
the parabola of wall_stencils, which has the known averages and is zero at the walls. Where the centre of a pixel is the
centre of a cell (k = 1), it is interpolated along the row from the two faces on each side, or from the wall where that
comes first (Lagrange's formula); where it is a corner of cells (k = 2, 4), the two parabolas that meet there have it.
Both are exact in a plane channel at any angle to the pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowrec.core import Bools, Floats, Ints
from flowrec.physics.flow.assembly import Triplets
from flowrec.physics.flow.grid import WALL, Faces, Grid, number_where
from flowrec.physics.flow.wall_stencils import Profiles

# A wall that is nearer than this to a face, in cells, would make its weight large.
NEAREST = 0.05


def centre_operator(grid: Grid, upright: Profiles, level: Profiles) -> Any:
    """CSR (2 n, faces): velocities of faces to x and y, in turn, at the centre of each of the n fluid pixels.

    `upright` are the profiles of the u faces, `level` those of the v faces with rows and columns exchanged.
    """
    number, count = number_where(grid.mask, 0)
    entries = Triplets((2 * count, grid.faces))
    for axis, faces, profiles, walls, pixels in (
        (0, grid.u, upright, grid.walls.level, number),
        (1, grid.v.T, level, grid.walls.level.T, number.T),
    ):
        row, column = np.nonzero(pixels >= 0)
        place = row * grid.k + grid.k // 2, column * grid.k + grid.k // 2
        out = 2 * pixels[row, column, None] + axis
        if grid.k % 2 == 0:
            _add_at_corners(entries, out, faces, profiles, *place)
        else:
            _add_at_cells(entries, out, faces, profiles, walls, *place)
    return entries.matrix()


def _add_at_corners(entries: Triplets, out: Ints, faces: Faces, profiles: Profiles, j: Ints, i: Ints) -> None:
    """Add the mean of the parabolas of the faces above and below the corner (j, i) of cells to rows `out` (m, 1)."""
    ends = [(j - 1, 0.5), (j, -0.5)]
    open_ = [faces.kind[above, i] != WALL for above, _ in ends]
    count = np.maximum(open_[0].astype(np.int64) + open_[1], 1)
    for here, (above, t) in zip(open_, ends, strict=True):
        rows = profiles.place[above, i][here]
        values = profiles.value(rows, np.full(len(rows), t)) / count[here, None]
        entries.add(out[here], profiles.columns[rows], values)


def _add_at_cells(
    entries: Triplets, out: Ints, faces: Faces, profiles: Profiles, walls: Floats, j: Ints, i: Ints
) -> None:
    """Add the interpolation along the row from the faces on both sides of the centre of cell (j, i), or from walls."""
    w = faces.kind.shape[1] - 1
    line = 2 * j + 1
    # Place along the row, face there or -1 at a wall, and whether it is a node.
    at: list[Floats] = []
    face: list[Ints] = []
    used: list[Bools] = []
    for step in (-1, 1):
        near = i + (step > 0)
        beyond = np.clip(near + step, 0, w)
        inside = (near + step >= 0) & (near + step <= w)
        here, face_here = walls[line, 2 * i + 1], walls[line, 2 * near]
        next_, face_next = walls[line, np.clip(2 * near + step, 0, 2 * w)], walls[line, 2 * beyond]
        open_near = (face_here > 0.0) & (faces.kind[j, near] != WALL)
        open_beyond = (next_ > 0.0) & (face_next > 0.0) & (faces.kind[j, beyond] != WALL)
        wall = np.where(face_here > 0.0, 0.5, 0.5 * _crossing(here, face_here))
        behind = np.where(face_next > 0.0, 1.5, 1.0 + 0.5 * _crossing(next_, face_next))
        behind = np.where(next_ > 0.0, behind, 0.5 + 0.5 * _crossing(face_here, next_))
        at += [step * np.where(open_near, 0.5, wall), step * np.maximum(behind, 0.5 + NEAREST)]
        face += [np.where(open_near, near, -1), np.where(open_near & inside & open_beyond, beyond, -1)]
        used += [np.ones(len(i), bool), open_near & inside]
    for node in range(4):
        weight = np.ones(len(i))
        for other in range(4):
            if other != node:
                apart = at[node] - at[other]
                weight *= np.where(used[other], -at[other] / np.where(apart == 0.0, 1.0, apart), 1.0)
        open_ = face[node] >= 0
        rows = profiles.place[j[open_], face[node][open_]]
        values = profiles.value(rows, np.zeros(len(rows))) * weight[open_, None]
        entries.add(out[open_], profiles.columns[rows], values)


def _crossing(fluid: Floats, solid: Floats) -> Floats:
    """Fraction, 0 to 1, of the way from a point in fluid to one in solid at which the level set is zero."""
    return np.clip(fluid / np.maximum(fluid - solid, 1e-12), 0.0, 1.0)
