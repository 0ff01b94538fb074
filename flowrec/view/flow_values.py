"""Speed, uncertainty and change of a flow as values of pixels, and its arrows: for every kind of picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, FlowField
from flowrec.physics import sample
from flowrec.view.colours import ColourScale, Table
from flowrec.view.scene import Scene

# Lengths in arrow spacings, unless stated otherwise.
_ARROWS_ACROSS_IMAGE = (28.0, 45.0)  # along its width: for wide channels, and for narrow ones
ARROWS_ACROSS_VIEW = (16.0, 21.0)  # the same in a view with other panels beside it
_ARROWS_ACROSS_CHANNEL = 2.5  # in a typical channel, within these limits
_LONGEST = 0.9  # the fastest arrow: a row of longer ones would look like one line
_FROM_WALL = 0.3  # least distance of an arrow from a wall, except in the middle of a narrow channel
_WELL_AWAY = 0.45  # from the wall
_PITCH = 0.2  # of the points that may carry an arrow


def speed(field: FlowField, mask: Bools) -> Floats:
    """(h, w) um/s, NaN in solid."""
    return np.where(mask, _length(field.velocity_um_s), np.nan)


def peak(field: FlowField) -> float:
    """The largest speed, um/s."""
    return float(_length(field.velocity_um_s).max())


def uncertainty(field: FlowField, mask: Bools) -> Floats:
    """(h, w) one standard deviation of the velocity vector, um/s, NaN in solid."""
    assert field.std_um_s is not None
    return np.where(mask, _length(field.std_um_s), np.nan)


def change(refined: FlowField, assumed: FlowField, mask: Bools) -> Floats:
    """(h, w) speed of the refined flow minus that of the assumed one, um/s, NaN in solid."""
    return speed(refined, mask) - speed(assumed, mask)


def scale_of(values: Floats, table: Table) -> ColourScale:
    """A scale for nearly all of a map; the largest half percent are corners and may saturate."""
    known = np.abs(values[np.isfinite(values)])
    return ColourScale.up_to(float(np.quantile(known, 0.995)) if known.size else 1.0, table)


def arrow_grid(scene: Scene, across: tuple[float, float] = _ARROWS_ACROSS_IMAGE) -> tuple[Floats, float]:
    """Points (n, 2) in um inside the fluid, at least one spacing apart, and the spacing in um.

    Points well away from the walls are chosen first, so a narrow channel has a row of arrows along its middle and a
    wide one several, rather than only the points of a regular grid that happen to lie in it.
    """
    chip, (image_left, _, image_right, _) = scene.chip, scene.image_bounds()
    # A border of solid makes the image's border a wall, so that no arrow extends beyond it.
    wall_px = cv2.distanceTransform(np.pad(chip.mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = (wall_px >= cv2.dilate(wall_px, np.ones((5, 5), np.uint8))) & (wall_px > 1.5)
    width_px = 2.0 * float(np.median(wall_px[ridge])) if ridge.any() else 1.0
    image_px = (image_right - image_left) * scene.calibration.um_per_px / chip.um_per_px  # of the mask
    few, many = across
    spacing = float(np.clip(width_px / _ARROWS_ACROSS_CHANNEL, image_px / many, image_px / few))
    candidates, every = ridge.copy(), slice(None, None, max(1, int(_PITCH * spacing)))
    candidates[every, every] |= wall_px[every, every] >= _FROM_WALL * spacing
    row, column = np.nonzero(candidates & chip.mask)
    free = np.ones_like(chip.mask, np.uint8)
    chosen = []
    for at in np.lexsort((row, column, -np.round(np.minimum(wall_px[row, column], _WELL_AWAY * spacing)))):
        y, x = int(row[at]), int(column[at])
        if free[y, x]:
            chosen.append((x, y))
            cv2.circle(free, (x, y), max(round(spacing) - 1, 1), 0, -1)
    return np.array(chosen, np.float64).reshape(-1, 2) * chip.um_per_px, spacing * chip.um_per_px


def flow_arrows(scene: Scene, field: FlowField, grid: tuple[Floats, float]) -> tuple[Floats, Floats, Floats]:
    """Origins (n, 2) and vectors (n, 2) in the picture plane, and speeds (n,) in um/s.

    Each arrow is centred on its point of the grid. Its length is proportional to the square root of the speed, so that
    slow branches of a network still show their direction; the colour shows the speed.
    """
    points_um, spacing_um = grid
    velocity = sample(field, points_um)
    magnitude = _length(velocity)
    fastest = float(np.quantile(magnitude, 0.99)) if len(magnitude) else 0.0
    longest = _LONGEST * scene.length_px(spacing_um)
    # Limited, so that a jet through a narrow spot does not cover its neighbours.
    relative = np.minimum(magnitude / fastest, 1.0) if fastest > 0.0 else np.zeros_like(magnitude)
    vectors = scene.directions(velocity * (longest * np.sqrt(relative) / np.maximum(magnitude, 1e-12))[:, None])
    return scene.to_plane(points_um) - 0.5 * vectors, vectors, magnitude


def _length(vectors: NDArray[np.floating]) -> Floats:
    """Length (...) of vectors (..., 2)."""
    return np.hypot(vectors[..., 0], vectors[..., 1])
