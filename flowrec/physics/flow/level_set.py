"""Level set of the walls on the grid, positive in fluid and negative in solid, from a mask or from a formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Floats32, Ints
from flowrec.physics.chip.chip import Walls
from flowrec.physics.flow.contour_smoothing import contour_segments

SEGMENTS_PER_GATE = 2  # straight segments of the contour from one gate to the next
REACH_PX = 0.7  # largest distance of the contour from the edges of the pixels
LEAST_REACH = 2.2  # in half subcells: one whole subcell and a margin between a face and the wall beside it
CHUNK = 200_000  # pairs of a segment and a sample in one batch, so that the arrays stay in the processor's cache
FARTHEST_PX = 0.5 * LEAST_REACH  # largest level of a pixel centre
CLEARANCE_PX = 0.1  # least distance between the contour and pixel centres, and midpoints of equal neighbours


@dataclass(frozen=True, slots=True, eq=False)
class LevelSet:
    """The wall on a grid of h x w subcells.

    `level` (2 h + 1, 2 w + 1) is sampled at the corners, edge midpoints and centres of the subcells. Near the wall it
    is the signed distance in pixels; farther away only its sign counts.
    """

    level: Floats
    staircase: bool  # the wall follows the edges of the pixels

    @property
    def T(self) -> LevelSet:  # noqa: N802 - as numpy's
        """The walls with rows and columns exchanged."""
        return LevelSet(self.level.T, self.staircase)

    def at_centres(self, k: int) -> Floats32:
        """Level (h, w) at the centres of pixels of k x k subcells, not beyond FARTHEST_PX."""
        return np.clip(self.level[k :: 2 * k, k :: 2 * k], -FARTHEST_PX, FARTHEST_PX).astype(np.float32)


def from_distance(distance: Callable[[Floats, Floats], Floats], shape: tuple[int, int], k: int) -> LevelSet:
    """Level set of a formula, to measure the solver without the error of a mask.

    Parameters
    ----------
    distance
        Signed distance to the wall, positive in fluid, of points x, y in pixels; (0, 0) is the centre of the first.
    shape
        Rows and columns of pixels, each divided into k x k subcells.
    """
    rows, columns = (np.arange(2 * size * k + 1) / (2.0 * k) - 0.5 for size in shape)
    x, y = np.meshgrid(columns, rows)
    return LevelSet(np.asarray(distance(x, y), np.float64), staircase=False)


def from_mask(mask: Bools, k: int, walls: Walls, offset_px: float = 0.0, level_px: Floats32 | None = None) -> LevelSet:
    """Walls of a mask (h, w): `pixel` follows the edges of its pixels, `smooth` the smoothest contour it allows.

    `grey` follows the zero line of `level_px` (h, w), levels of the pixel centres with the signs of the mask.
    Walls can be moved outwards by an offset, those of pixels by multiples of half a subcell.
    """
    if walls == "pixel":
        return _staircase(mask, k, offset_px)
    if walls == "smooth":
        return _smooth(mask, k, offset_px)
    assert level_px is not None
    return _between_centres(level_px, mask, k, offset_px)


def subcells(pixels: NDArray[Any], k: int) -> NDArray[Any]:
    """(h k, w k) values of pixels (h, w) on k x k parts of each."""
    return np.repeat(np.repeat(pixels, k, axis=0), k, axis=1)


def _staircase(mask: Bools, k: int, offset_px: float) -> LevelSet:
    """The edges of the pixels, moved outwards: first by whole pixels, then by half subcells."""
    whole = int(offset_px)
    fluid = subcells(_move_edges(mask, whole), 2 * k)
    fluid = _move_edges(fluid, round((offset_px - whole) * 2 * k))
    # A sample lies between four quarters of subcells: in fluid where all are fluid, on the wall where only some are.
    around = np.pad(fluid, 1, mode="edge")
    corners = [around[:-1, :-1], around[:-1, 1:], around[1:, :-1], around[1:, 1:]]
    level = np.where(np.logical_and.reduce(corners), 0.5, np.where(np.logical_or.reduce(corners), 0.0, -0.5))
    return LevelSet(level, staircase=True)


def _move_edges(mask: Bools, steps: int) -> Bools:
    """A mask whose edges are moved outwards by steps along the axes; beyond the border of the image it goes on."""
    if steps == 0:
        return mask
    if steps > 0:
        return scipy.ndimage.binary_dilation(mask, iterations=steps)
    return scipy.ndimage.binary_erosion(mask, iterations=-steps, border_value=1)


def _smooth(mask: Bools, k: int, offset_px: float) -> LevelSet:
    """Signed distance to the smoothed contour of the mask, moved outwards, computed in half subcells."""
    unit = 2 * k
    shape = (mask.shape[0] * unit + 1, mask.shape[1] * unit + 1)
    begin, end = ((points + 0.5) * unit for points in contour_segments(mask, SEGMENTS_PER_GATE))
    reach = max(LEAST_REACH, REACH_PX * unit) + abs(offset_px) * unit
    width = int(np.ceil(np.abs(end - begin).max(initial=0.0) + 2.0 * reach)) + 1
    window = np.stack(np.meshgrid(np.arange(width), np.arange(width)), axis=-1).reshape(-1, 2)
    chunk = CHUNK // len(window) + 1
    parts = [
        _distances(begin[first : first + chunk], end[first : first + chunk], window, shape, reach)
        for first in range(0, len(begin), chunk)
    ]
    # Far from the contour the pixel itself gives the sign.
    far = np.where(mask, reach, -reach)
    level = np.pad(subcells(far, unit), ((0, 1), (0, 1)), mode="edge")
    if parts:
        sample, distance, side = (np.concatenate(part) for part in zip(*parts, strict=True))
        nearest, sign = np.full(level.size, reach), np.zeros(level.size)
        np.minimum.at(nearest, sample, distance)
        # Beside a vertex two segments are nearest; the sum of their signed distances gives the side.
        closest = distance <= nearest[sample] + 1e-9
        sample = sample[closest]
        np.add.at(sign, sample, side[closest])
        flat = level.ravel()
        flat[sample] = np.copysign(nearest[sample], np.where(sign[sample] == 0.0, flat[sample], sign[sample]))
    _keep_topology(level, mask, k)
    return LevelSet(level / unit + offset_px, staircase=False)


def _between_centres(level_px: Floats32, mask: Bools, k: int, offset_px: float) -> LevelSet:
    """Levels (h, w) at the centres of the pixels, bilinear between them, moved outwards."""
    unit = 2 * k
    rows, columns = (np.arange(size * unit + 1) / unit - 0.5 for size in mask.shape)
    at = np.meshgrid(rows, columns, indexing="ij")
    level = unit * scipy.ndimage.map_coordinates(level_px.astype(np.float64), at, order=1, mode="nearest")
    _keep_topology(level, mask, k)
    return LevelSet(level / unit + offset_px, staircase=False)


def _distances(a: Floats, b: Floats, window: Ints, shape: tuple[int, int], reach: float) -> tuple[Ints, Floats, Floats]:
    """Index, distance and signed side of every sample within `reach` of the segments a to b (n, 2)."""
    corner = np.floor(np.minimum(a, b) - reach).astype(np.int64) + 1
    run = b - a
    length = np.maximum(np.hypot(run[:, 0], run[:, 1]), 1e-12)[:, None]
    u = run / length
    start = corner - a
    # Coordinates along and across the segment, of the window's corner and then of all its samples.
    along = (start * u).sum(axis=1)[:, None] + u @ window.T
    side = (start[:, 1] * u[:, 0] - start[:, 0] * u[:, 1])[:, None]  # the fluid is on the right; y points down
    side = side + np.stack([-u[:, 1], u[:, 0]], axis=1) @ window.T
    over = along - np.clip(along, 0.0, length)
    squared = side * side + over * over
    segment, place = np.nonzero(squared < reach * reach)
    at = corner[segment] + window[place]
    inside = (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])
    segment, place, at = segment[inside], place[inside], at[inside]
    return at[:, 1] * shape[1] + at[:, 0], np.sqrt(squared[segment, place]), side[segment, place]


def _keep_topology(level: Floats, mask: Bools, k: int) -> None:
    """Restore the mask's topology: pixels keep their side, and neighbours stay connected or separate."""
    unit = 2 * k
    for lines, pixels in (
        (level[k::unit], mask),  # through the centres of the pixels of each row
        (level[:, k::unit].T, mask.T),
        (level[:: level.shape[0] - 1], mask[:: max(mask.shape[0] - 1, 1)]),  # along the border
        (level[:, :: level.shape[1] - 1].T, mask[:, :: max(mask.shape[1] - 1, 1)].T),
    ):
        _clamp(lines[:, k::unit], pixels, ~pixels, k)
        fluid, solid = pixels[:, 1:] & pixels[:, :-1], ~(pixels[:, 1:] | pixels[:, :-1])
        for between in range(k + 1, k + unit):
            _clamp(lines[:, between : -k - 1 : unit], fluid, solid, k)
    solid = ~mask
    diagonal = (solid[1:, 1:] & solid[:-1, :-1]) | (solid[1:, :-1] & solid[:-1, 1:])
    corner = level[unit:-1:unit, unit:-1:unit]
    np.minimum(corner, 0.0, out=corner, where=diagonal)


def _clamp(samples: Floats, fluid: Bools, solid: Bools, k: int) -> None:
    """Keep samples of known fluid and solid on their side of the wall."""
    np.maximum(samples, CLEARANCE_PX * 2 * k, out=samples, where=fluid)
    np.minimum(samples, -CLEARANCE_PX * 2 * k, out=samples, where=solid)
