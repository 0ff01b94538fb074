"""Where the wall lies on the grid: a level whose sign tells fluid from solid, from a mask or from a formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Walls
from flowrec.flow.contour_smoothing import curves

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PIECES = 2  # straight pieces from one gate of the contour to the next
REACH_PX = 0.7  # the outline is never farther from the edges of the pixels than this
LEAST_REACH = 2.2  # in half subcells: a whole one, and a little, between a face and the wall beside it
CHUNK = 200_000  # pairs of a piece and a sample at a time, so that they stay in the cache
LEAST_PX = 0.1  # least distance between the outline and pixel centres, and middles between equal neighbours


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The wall on a grid of h x w subcells.

    `level` is sampled at the subcells' corners, at the middles of their sides and at their centres, (2 h + 1,
    2 w + 1): positive in fluid, zero on the wall, and near it the distance to it (in any unit, as only its zeros
    along straight lines between samples are used).
    """

    level: Floats
    stepped: bool  # whether the wall has the corners of pixels

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of subcells."""
        return (self.level.shape[0] - 1) // 2, (self.level.shape[1] - 1) // 2


def analytic(distance: Callable[[Floats, Floats], Floats], shape: tuple[int, int], k: int) -> Outline:
    """Outline of a formula, to measure the solver apart from the reading of masks.

    Parameters
    ----------
    distance
        Signed distance to the wall, positive in fluid, of points x, y in pixels; (0, 0) is the centre of the first.
    shape
        Rows and columns of pixels, each cut into k x k subcells.
    """
    rows, columns = (np.arange(2 * size * k + 1) / (2.0 * k) - 0.5 for size in shape)
    x, y = np.meshgrid(columns, rows)
    return Outline(np.asarray(distance(x, y), np.float64), stepped=False)


def staircase(mask: NDArray[np.bool_], k: int) -> Outline:
    """The edges of the pixels themselves."""
    fluid = np.repeat(np.repeat(mask, 2 * k, axis=0), 2 * k, axis=1)
    h, w = fluid.shape
    # Samples lie between quarters of subcells: in fluid where all four are, on the wall where some are.
    rows, columns = (np.clip(np.arange(size + 1), 0, size) for size in (h, w))
    before, after = np.maximum(rows - 1, 0), np.minimum(rows, h - 1)
    left, right = np.maximum(columns - 1, 0), np.minimum(columns, w - 1)
    corners = [fluid[np.ix_(r, c)] for r in (before, after) for c in (left, right)]
    inside = corners[0] & corners[1] & corners[2] & corners[3]
    outside = ~(corners[0] | corners[1] | corners[2] | corners[3])
    return Outline(np.where(inside, 0.5, np.where(outside, -0.5, 0.0)), stepped=True)


def outline(mask: NDArray[np.bool_], k: int, walls: Walls) -> Outline:
    """The walls of a mask: `pixel`, the edges of its pixels; `smooth`, the smoothest outline that it allows."""
    return staircase(mask, k) if walls == "pixel" else smooth(mask, k)


def smooth(mask: NDArray[np.bool_], k: int) -> Outline:
    """Signed distance, in half subcells, to the outline between the pixels (contour)."""
    unit = 2 * k
    shape = (mask.shape[0] * unit + 1, mask.shape[1] * unit + 1)
    begin, end = ((points + 0.5) * unit for points in curves(mask, PIECES))
    reach = max(LEAST_REACH, REACH_PX * unit)
    width = int(np.ceil(np.abs(end - begin).max(initial=0.0) + 2.0 * reach)) + 1
    window = np.stack(np.meshgrid(np.arange(width), np.arange(width)), axis=-1).reshape(-1, 2)
    chunk = CHUNK // len(window) + 1
    parts = [
        _seen(begin[first : first + chunk], end[first : first + chunk], window, shape, reach)
        for first in range(0, len(begin), chunk)
    ]
    # Beyond reach a pixel's own side is enough.
    whole = np.where(mask, reach, -reach)
    level = np.pad(np.repeat(np.repeat(whole, unit, axis=0), unit, axis=1), ((0, 1), (0, 1)), mode="edge")
    if parts:
        sample, distance, side = (np.concatenate(part) for part in zip(*parts, strict=True))
        nearest, sided = np.full(level.size, reach), np.zeros(level.size)
        np.minimum.at(nearest, sample, distance)
        # Beside a joint of two pieces both are nearest, and the sum of their normals tells the side.
        closest = distance <= nearest[sample] + 1e-9
        sample = sample[closest]
        np.add.at(sided, sample, side[closest])
        flat = level.ravel()
        flat[sample] = np.copysign(nearest[sample], np.where(sided[sample] == 0.0, flat[sample], sided[sample]))
    _keep(level, mask, k)
    return Outline(level, stepped=False)


def _seen(a: Floats, b: Floats, window: Ints, shape: tuple[int, int], reach: float) -> tuple[Ints, Floats, Floats]:
    """Samples (numbers), distances and signed sides of all samples within reach of pieces a to b (n, 2)."""
    corner = np.floor(np.minimum(a, b) - reach).astype(np.int64) + 1
    run = b - a
    length = np.maximum(np.hypot(run[:, 0], run[:, 1]), 1e-12)[:, None]
    u = run / length
    start = corner - a
    # Along and across the piece, for its own corner and then over the window.
    along = (start * u).sum(axis=1)[:, None] + u @ window.T
    side = (start[:, 1] * u[:, 0] - start[:, 0] * u[:, 1])[:, None]  # the fluid is on the right, y points down
    side = side + np.stack([-u[:, 1], u[:, 0]], axis=1) @ window.T
    over = along - np.clip(along, 0.0, length)
    squared = side * side + over * over
    piece, place = np.nonzero(squared < reach * reach)
    at = corner[piece] + window[place]
    inside = (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])
    piece, place, at = piece[inside], place[inside], at[inside]
    return at[:, 1] * shape[1] + at[:, 0], np.sqrt(squared[piece, place]), side[piece, place]


def _keep(level: Floats, mask: NDArray[np.bool_], k: int) -> None:
    """Give the level the mask's own topology: pixels keep their side, and neighbours stay connected or apart."""
    unit = 2 * k
    for lines, pixels in (
        (level[k::unit], mask),  # through the centres of the pixels of each row
        (level[:, k::unit].T, mask.T),
        (level[:: level.shape[0] - 1], mask[:: max(mask.shape[0] - 1, 1)]),  # along the border
        (level[:, :: level.shape[1] - 1].T, mask[:, :: max(mask.shape[1] - 1, 1)].T),
    ):
        _hold(lines[:, k::unit], pixels, ~pixels, k)
        wet, dry = pixels[:, 1:] & pixels[:, :-1], ~(pixels[:, 1:] | pixels[:, :-1])
        for between in range(k + 1, k + unit):
            _hold(lines[:, between : -k - 1 : unit], wet, dry, k)
    solid = ~mask
    crossed = (solid[1:, 1:] & solid[:-1, :-1]) | (solid[1:, :-1] & solid[:-1, 1:])
    joint = level[unit:-1:unit, unit:-1:unit]
    np.minimum(joint, 0.0, out=joint, where=crossed)


def _hold(samples: Floats, wet: NDArray[np.bool_], dry: NDArray[np.bool_], k: int) -> None:
    """Keep samples on their side."""
    np.maximum(samples, LEAST_PX * 2 * k, out=samples, where=wet)
    np.minimum(samples, -LEAST_PX * 2 * k, out=samples, where=dry)
