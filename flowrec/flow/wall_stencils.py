"""The flow along one grid line, from the averages over its faces and the walls that it meets.

The faces of one component that lie on one grid line follow each other like beads. Over each of them the velocity is
the parabola

    u(t) = a0 + a1 t + a2 t^2,   t = place along the line from the middle of the cell's side, in cells,

whose means over the fluid parts of the face and of its two neighbours are theirs; where a wall comes first, the
parabola has the wall's velocity there instead. A plane channel flow is such a parabola, so its viscous force is
exact on every grid line, however few faces lie between the walls and wherever these cut them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.flow.grid import OPEN, OUTLET, WALL, Floats, Ints

# Walls on both sides of a single face, closer than this many cells, would make it infinitely stiff.
NARROWEST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Parabolas of the numbered faces of one component; coefficients are linear in the velocities of faces."""

    place: Ints  # (h, w + 1) rows of the tables below, -1 for walls
    columns: Ints  # (n, 3) numbers of the faces before, here and after on the line; -1 where a wall comes first
    weights: Floats  # (n, 3, 3) [power of t, column]: coefficients a per velocity
    border: Floats  # (n, 3, 2) the same per velocity of the image's border before and after, where that is the wall

    def value(self, rows: Ints, t: Floats) -> Floats:
        """Weights (m, 3) of the columns in the velocity at t (m,)."""
        w = self.weights[rows]
        return np.asarray(w[:, 0] + t[:, None] * (w[:, 1] + t[:, None] * w[:, 2]))

    def slope(self, rows: Ints, t: Floats) -> Floats:
        """Weights (m, 3) of the columns in its derivative along the line at t (m,)."""
        w = self.weights[rows]
        return np.asarray(w[:, 1] + 2.0 * t[:, None] * w[:, 2])


def lines(
    kind: NDArray[np.int8],
    number: Ints,
    ends: tuple[Floats, Floats],
    level: Floats,
    cross: NDArray[np.int8],
    stepped: bool,
) -> Lines:
    """Parabolas of the faces (h, w + 1) on the upright grid lines.

    Parameters
    ----------
    kind, number, ends
        (h, w + 1) of the faces as in Grid; `ends` also of faces so nearly shut that they count as walls.
    level
        (2 h + 1, 2 w + 1) as in Outline.
    cross
        (h + 1, w) kinds of the other faces: on the border they tell an outlet from a wall.
    stepped
        As in Outline.
    """
    faces = kind != WALL
    j, i = np.nonzero(faces)
    place = np.full(kind.shape, -1, np.int64)
    place[j, i] = np.arange(len(j))
    # In the open a face and both neighbours are whole, and all such faces share one parabola.
    whole = faces & (ends[1] - ends[0] > 1.0 - 1e-12)
    linked = level[2:-1:2, ::2] > 0.0
    plain = np.zeros(kind.shape, bool)
    plain[1:-1] = whole[:-2] & whole[1:-1] & whole[2:] & linked[:-1] & linked[1:]
    around = np.pad(number, ((1, 1), (0, 0)), constant_values=-1)
    columns = np.stack([around[j + step, i] for step in range(3)], axis=1)
    weights = np.broadcast_to(np.linalg.inv(_OPEN), (len(j), 3, 3)).copy()
    border = np.zeros((len(j), 3, 2))
    special = np.flatnonzero(~plain[j, i])
    joined, weights[special], border[special] = _special(kind, ends, level, cross, stepped, j[special], i[special])
    columns[special] = np.where(joined, columns[special], -1)
    return Lines(place, columns, weights, border)


def _special(
    kind: NDArray[np.int8],
    ends: tuple[Floats, Floats],
    level: Floats,
    cross: NDArray[np.int8],
    stepped: bool,
    j: Ints,
    i: Ints,
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Whether each column is there (n, 3), weights and border of faces (j, i) that walls may cut; else as `lines`."""
    h, w = kind.shape[0], kind.shape[1] - 1
    low, high = ends
    n = len(j)
    joined = np.ones((n, 3), bool)
    moments = np.empty((n, 3, 3))
    moments[:, 1] = _mean(low[j, i], high[j, i])
    walls, bordered = np.empty((n, 2)), np.zeros((n, 2), bool)
    for side, step in enumerate((-1, 1)):
        inside = (j + step >= 0) & (j + step < h)
        beyond = np.clip(j + step, 0, h - 1)
        wet = inside & (level[2 * j + 1 + step, 2 * i] > 0.0)
        next_ = wet & (kind[beyond, i] != WALL)
        joined[:, 2 * side] = next_
        a, b = low[beyond, i], high[beyond, i]
        # The wall is at the end of the fluid part, or hides in the nearly shut face behind it.
        hidden = np.where(wet & ~next_, np.maximum(b - a, 0.0), 0.0)
        walls[:, side] = (low if step < 0 else high)[j, i] + step * hidden
        # Nothing changes across an outlet.
        rim = cross[0 if step < 0 else h]
        free = ~inside & ((rim[np.maximum(i - 1, 0)] == OUTLET) | (rim[np.minimum(i, w - 1)] == OUTLET))
        bordered[:, side] = ~inside & ~free
        there = np.where(free[:, None], _slope(walls[:, side]), _point(walls[:, side]))
        moments[:, 2 * side] = np.where(next_[:, None], _mean(a + step, b + step), there)
    alone = ~joined[:, 0] & ~joined[:, 2] & (walls[:, 1] - walls[:, 0] < NARROWEST)
    moments[alone, 0], moments[alone, 2] = _point(walls[alone, 0] - NARROWEST), _point(walls[alone, 1] + NARROWEST)
    inverse = np.linalg.inv(moments)
    if stepped:
        for side, step in enumerate((-1, 1)):
            # Beside a convex corner of pixels half of the edge is wall, and through the other half shows the shut
            # face behind it, where nothing moves.
            edge = cross[np.clip(j + (step > 0), 0, h)] == OPEN
            inner = ~joined[:, 2 * side] & (i > 0) & (i < w)
            half = inner & (edge[np.arange(n), np.maximum(i - 1, 0)] != edge[np.arange(n), np.minimum(i, w - 1)])
            through = moments[half]
            through[:, 2 * side] = _mean(low[j, i][half] + step, high[j, i][half] + step)
            inverse[half] = 0.5 * (inverse[half] + np.linalg.inv(through))
    border = np.where(bordered[:, None, :], inverse[:, :, [0, 2]], 0.0)
    return joined, np.where(joined[:, None, :], inverse, 0.0), border


def _mean(low: Floats, high: Floats) -> Floats:
    """(n, 3) means of 1, t, t^2 from low to high along a cell's side, t = 0 in its middle."""
    a, b = low - 0.5, high - 0.5
    return np.stack([np.ones_like(a), 0.5 * (a + b), (a * a + a * b + b * b) / 3.0], axis=-1)


def _point(at: Floats) -> Floats:
    """(n, 3) values of 1, t, t^2."""
    t = at - 0.5
    return np.stack([np.ones_like(t), t, t * t], axis=-1)


def _slope(at: Floats) -> Floats:
    """(n, 3) derivatives of 1, t, t^2."""
    t = at - 0.5
    return np.stack([np.zeros_like(t), np.ones_like(t), 2.0 * t], axis=-1)


# Three whole faces in the open.
_OPEN = _mean(np.array([-1.0, 0.0, 1.0]), np.array([0.0, 1.0, 2.0]))
