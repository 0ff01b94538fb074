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
import scipy.sparse as sp
from numpy.typing import NDArray

from flowrec.physics.flow.contour_smoothing import Floats, Ints
from flowrec.physics.flow.grid import WALL, Faces, Grid
from flowrec.physics.flow.wall_stencils import Profiles

# A wall that is nearer than this to a face, in cells, would make its weight large.
NEAREST = 0.05

_Entries = tuple[Ints, Ints, Floats]  # pixels (m,), faces (m, columns), weights per velocity of a face (m, columns)


def centre_operator(grid: Grid, upright: Profiles, level: Profiles) -> Any:
    """CSR (2 n, faces): velocities of faces to x and y, in turn, at the centre of each of the n fluid pixels.

    `upright` are the profiles of the u faces, `level` those of the v faces with rows and columns exchanged.
    """
    number = np.full(grid.mask.shape, -1, np.int64)
    number[grid.mask] = np.arange(np.count_nonzero(grid.mask))
    walls = grid.walls.level
    parts = []
    for axis, part in enumerate(
        (
            _component(grid.u, upright, walls, grid.k, number),
            _component(grid.v.T, level, walls.T, grid.k, number.T),
        )
    ):
        for pixels, columns, values in part:
            rows = np.broadcast_to(2 * pixels[:, None] + axis, columns.shape)
            known = columns >= 0
            parts.append((rows[known], columns[known], values[known]))
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return sp.csr_array((values, (rows, columns)), shape=(2 * int(number.max(initial=-1) + 1), grid.faces))


def _component(faces: Faces, profiles: Profiles, walls: Floats, k: int, number: Ints) -> list[_Entries]:
    """Entries of the velocity that flows through upright faces."""
    row, column = np.nonzero(number >= 0)
    pixels, j, i = number[row, column], row * k + k // 2, column * k + k // 2
    if k % 2 == 0:
        return _at_corners(faces, profiles, pixels, j, i)
    return _at_cells(faces, profiles, walls, pixels, j, i)


def _at_corners(faces: Faces, profiles: Profiles, pixels: Ints, j: Ints, i: Ints) -> list[_Entries]:
    """Mean of the parabolas of the faces above and below the corner (j, i) of cells."""
    ends = [(j - 1, 0.5), (j, -0.5)]
    open_ = [faces.kind[above, i] != WALL for above, _ in ends]
    count = np.maximum(open_[0].astype(np.int64) + open_[1], 1)
    found = []
    for here, (above, t) in zip(open_, ends, strict=True):
        rows = profiles.place[above, i][here]
        values = profiles.value(rows, np.full(len(rows), t)) / count[here, None]
        found.append((pixels[here], profiles.columns[rows], values))
    return found


def _at_cells(faces: Faces, profiles: Profiles, walls: Floats, pixels: Ints, j: Ints, i: Ints) -> list[_Entries]:
    """Interpolation along the row from the faces on both sides of the centre of cell (j, i), or from walls."""
    w = faces.kind.shape[1] - 1
    line = 2 * j + 1
    # Place along the row, face there or -1 at a wall, and whether it is a node.
    at: list[Floats] = []
    face: list[Ints] = []
    used: list[NDArray[np.bool_]] = []
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
    found: list[_Entries] = []
    for node in range(4):
        weight = np.ones(len(i))
        for other in range(4):
            if other != node:
                apart = at[node] - at[other]
                weight *= np.where(used[other], -at[other] / np.where(apart == 0.0, 1.0, apart), 1.0)
        open_ = face[node] >= 0
        rows = profiles.place[j[open_], face[node][open_]]
        values = profiles.value(rows, np.zeros(len(rows))) * weight[open_, None]
        found.append((pixels[open_], profiles.columns[rows], values))
    return found


def _crossing(fluid: Floats, solid: Floats) -> Floats:
    """Fraction, 0 to 1, of the way from a point in fluid to one in solid at which the level set is zero."""
    return np.asarray(np.clip(fluid / np.maximum(fluid - solid, 1e-12), 0.0, 1.0))
