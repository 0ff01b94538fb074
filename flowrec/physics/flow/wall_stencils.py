"""Velocity profile along a grid line, from the averages over its faces and the walls that it meets.

The faces of one velocity component that lie on one grid line form a chain. Over each of them the velocity is the
parabola

    u(t) = a0 + a1 t + a2 t^2,   t = position along the line from the middle of the cell's side, in cells,

whose averages over the fluid parts of the face and of its two neighbours are the known ones. Where a wall comes before
a neighbour, the parabola has the wall's velocity there instead. A plane channel flow is such a parabola, so its viscous
force is exact on every grid line, however few faces lie between the walls and wherever the walls cut them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Ints
from flowrec.physics.flow.grid import OPEN, OUTLET, WALL, Faces, number_where
from flowrec.physics.flow.level_set import LevelSet

# Walls on both sides of a single face, closer than this many cells, would make it infinitely stiff.
NARROWEST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Parabolas of the numbered faces of one component; their coefficients are linear in the velocities of faces."""

    place: Ints  # (h, w + 1) rows of the tables below, -1 for walls
    columns: Ints  # (n, 3) numbers of the faces before, here and after on the line; -1 where a wall comes first
    weights: Floats  # (n, 3, 3) [power of t, column]: coefficients a per velocity
    border: Floats  # (n, 3, 2) the same per velocity of the image's border before and after, where that is the wall

    def value(self, rows: Ints, t: Floats) -> Floats:
        """Weights (m, 3) of the columns in the velocity at t (m,)."""
        w = self.weights[rows]
        return w[:, 0] + t[:, None] * (w[:, 1] + t[:, None] * w[:, 2])

    def slope(self, rows: Ints, t: Floats) -> Floats:
        """Weights (m, 3) of the columns in the derivative along the line at t (m,), per cell."""
        w = self.weights[rows]
        return w[:, 1] + 2.0 * t[:, None] * w[:, 2]


def line_profiles(faces: Faces, walls: LevelSet, cross: NDArray[np.int8]) -> Profiles:
    """Parabolas of the upright faces along the upright grid lines.

    Parameters
    ----------
    faces
        Upright faces (h, w + 1); `low` and `high` also of faces so nearly closed that they count as walls.
    walls
        Level set on the same orientation of the grid.
    cross
        (h + 1, w) kinds of the level faces: on the border they distinguish an outlet from a wall.
    """
    fluid = faces.kind != WALL
    j, i = np.nonzero(fluid)
    place, _ = number_where(fluid, 0)
    # Away from walls a face and both neighbours are whole, and all such faces share one parabola.
    whole = fluid & (faces.high - faces.low > 1.0 - 1e-12)
    linked = walls.level[2:-1:2, ::2] > 0.0
    plain = np.zeros(fluid.shape, bool)
    plain[1:-1] = whole[:-2] & whole[1:-1] & whole[2:] & linked[:-1] & linked[1:]
    around = np.pad(faces.number, ((1, 1), (0, 0)), constant_values=-1)
    columns = np.stack([around[j + step, i] for step in range(3)], axis=1)
    weights = np.broadcast_to(np.linalg.inv(_WHOLE_FACES), (len(j), 3, 3)).copy()
    border = np.zeros((len(j), 3, 2))
    special = np.flatnonzero(~plain[j, i])
    joined, weights[special], border[special] = _at_walls(faces, walls, cross, j[special], i[special])
    columns[special] = np.where(joined, columns[special], -1)
    return Profiles(place, columns, weights, border)


def _at_walls(faces: Faces, walls: LevelSet, cross: NDArray[np.int8], j: Ints, i: Ints) -> tuple[Bools, Floats, Floats]:
    """Mask (n, 3) of existing columns, weights and border of the faces (j, i), which walls may cut."""
    h, w = faces.kind.shape[0], faces.kind.shape[1] - 1
    low, high = faces.low, faces.high
    n = len(j)
    joined = np.ones((n, 3), bool)
    moments = np.empty((n, 3, 3))
    moments[:, 1] = _mean(low[j, i], high[j, i])
    wall_at, bordered = np.empty((n, 2)), np.zeros((n, 2), bool)
    for side, step in enumerate((-1, 1)):
        inside = (j + step >= 0) & (j + step < h)
        beyond = np.clip(j + step, 0, h - 1)
        fluid = inside & (walls.level[2 * j + 1 + step, 2 * i] > 0.0)
        neighbour = fluid & (faces.kind[beyond, i] != WALL)
        joined[:, 2 * side] = neighbour
        a, b = low[beyond, i], high[beyond, i]
        # The wall is at the end of the fluid part, or inside the nearly closed face behind it.
        hidden = np.where(fluid & ~neighbour, np.maximum(b - a, 0.0), 0.0)
        wall_at[:, side] = (low if step < 0 else high)[j, i] + step * hidden
        # The velocity does not change across an outlet.
        rim = cross[0 if step < 0 else h]
        free = ~inside & ((rim[np.maximum(i - 1, 0)] == OUTLET) | (rim[np.minimum(i, w - 1)] == OUTLET))
        bordered[:, side] = ~inside & ~free
        condition = np.where(free[:, None], _slope(wall_at[:, side]), _value(wall_at[:, side]))
        moments[:, 2 * side] = np.where(neighbour[:, None], _mean(a + step, b + step), condition)
    alone = ~joined[:, 0] & ~joined[:, 2] & (wall_at[:, 1] - wall_at[:, 0] < NARROWEST)
    moments[alone, 0] = _value(wall_at[alone, 0] - NARROWEST)
    moments[alone, 2] = _value(wall_at[alone, 1] + NARROWEST)
    inverse = np.linalg.inv(moments)
    if walls.staircase:
        for side, step in enumerate((-1, 1)):
            # Beside a convex corner of pixels half of the edge is wall. The other half borders on the closed face
            # behind it, where nothing moves.
            edge = cross[np.clip(j + (step > 0), 0, h)] == OPEN
            inner = ~joined[:, 2 * side] & (i > 0) & (i < w)
            half = inner & (edge[np.arange(n), np.maximum(i - 1, 0)] != edge[np.arange(n), np.minimum(i, w - 1)])
            through = moments[half]
            through[:, 2 * side] = _mean(low[j, i][half] + step, high[j, i][half] + step)
            inverse[half] = 0.5 * (inverse[half] + np.linalg.inv(through))
    border = np.where(bordered[:, None, :], inverse[:, :, [0, 2]], 0.0)
    return joined, np.where(joined[:, None, :], inverse, 0.0), border


def _mean(low: Floats, high: Floats) -> Floats:
    """(n, 3) averages of 1, t, t^2 from low to high along a cell's side, t = 0 in its middle."""
    a, b = low - 0.5, high - 0.5
    return np.stack([np.ones_like(a), 0.5 * (a + b), (a * a + a * b + b * b) / 3.0], axis=-1)


def _value(at: Floats) -> Floats:
    """(n, 3) values of 1, t, t^2."""
    t = at - 0.5
    return np.stack([np.ones_like(t), t, t * t], axis=-1)


def _slope(at: Floats) -> Floats:
    """(n, 3) derivatives of 1, t, t^2."""
    t = at - 0.5
    return np.stack([np.zeros_like(t), np.ones_like(t), 2.0 * t], axis=-1)


# Moments of three whole faces in a row.
_WHOLE_FACES = _mean(np.array([-1.0, 0.0, 1.0]), np.array([0.0, 1.0, 2.0]))
