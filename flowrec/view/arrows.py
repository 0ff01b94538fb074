"""A flow field as arrows that do not crowd: where they stand and how long they are."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import FlowField
from flowrec.view.scene import Scene

_SPACING_PX = 20.0  # of the camera, where the channels are wide enough for it
_ACROSS = 3.0  # arrows abreast in a typical channel
_LONGEST = 0.9  # the fastest arrow, in spacings: a row of longer ones reads as one line
_FROM_WALL = 0.3  # no arrow stands nearer to a wall, in spacings


def arrow_grid(scene: Scene) -> tuple[NDArray[np.float64], float]:
    """Points (n, 2) in um inside the fluid, and their spacing in um."""
    chip = scene.chip
    # A ring of solid counts the image's border as wall, so that no arrow sticks out of it.
    wall_px = cv2.distanceTransform(np.pad(chip.mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = wall_px[(wall_px >= cv2.dilate(wall_px, np.ones((5, 5), np.uint8))) & (wall_px > 1.5)]
    width_um = 2.0 * float(np.median(ridge)) * chip.um_per_px if ridge.size else chip.um_per_px
    spacing_um = max(
        min(_SPACING_PX * scene.calibration.um_per_px, width_um / _ACROSS),
        width_um / 8.0,  # a coarse camera must not fill a wide channel with hair
        0.02 * max(chip.size_um) / 3.0,
    )
    h, w = chip.mask.shape
    x, y = np.meshgrid(
        np.arange(0.5 * spacing_um, w * chip.um_per_px, spacing_um),
        np.arange(0.5 * spacing_um, h * chip.um_per_px, spacing_um),
    )
    x[1::2] += 0.5 * spacing_um  # staggered, so that the grid does not look like the channel's own pattern
    points = np.stack([x.ravel(), y.ravel()], 1)
    column, row = np.clip(np.rint(points / chip.um_per_px).astype(np.intp), 0, (w - 1, h - 1)).T
    inside = wall_px[row, column] * chip.um_per_px >= _FROM_WALL * spacing_um
    return points[inside], spacing_um


def flow_arrows(
    scene: Scene, field: FlowField, grid: tuple[NDArray[np.float64], float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Origins (n, 2) and vectors (n, 2) in the picture plane, and speeds (n,) in um/s.

    Each arrow is centred on its point of the grid and points where the flow goes.
    """
    points_um, spacing_um = grid
    velocity = sample(field, points_um)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    peak = float(np.quantile(speed, 0.99)) if len(speed) else 0.0
    longest = _LONGEST * scene.length_px(spacing_um)
    vectors = velocity * (longest / peak) if peak > 0.0 else np.zeros_like(velocity)
    # A jet through a narrow spot must not paint over its neighbours.
    length = np.hypot(vectors[:, 0], vectors[:, 1])
    vectors = vectors * np.where(length > longest, longest / np.maximum(length, 1e-12), 1.0)[:, None]
    return scene.to_plane(points_um) - 0.5 * vectors, vectors, speed
