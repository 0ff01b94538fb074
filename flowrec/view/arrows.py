"""A flow field as arrows that do not crowd: where they stand and how long they are."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import FlowField
from flowrec.view.scene import Scene

_ALONG = (28.0, 45.0)  # arrows along the width of the image: where channels are wide, and where they are narrow
_ACROSS = 2.5  # arrows abreast in a typical channel, within these limits
_LONGEST = 0.9  # the fastest arrow, in spacings: a row of longer ones reads as one line
_FROM_WALL = 0.3  # no arrow stands nearer to a wall, in spacings, unless in the middle of a narrow channel
_WELL_AWAY = 0.45  # from the wall, in spacings
_PITCH = 0.2  # of the points that may carry an arrow, in spacings


def arrow_grid(scene: Scene) -> tuple[NDArray[np.float64], float]:
    """Points (n, 2) in um inside the fluid, nowhere nearer than a spacing, and the spacing in um.

    What lies well away from the walls is filled first: a narrow channel gets a row of arrows along its middle, a wide
    one several, and none only those points of a grid that happen to hit it.
    """
    chip, left_right = scene.chip, scene.image_bounds()[::2]
    # A ring of solid counts the image's border as wall, so that no arrow sticks out of it.
    wall_px = cv2.distanceTransform(np.pad(chip.mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = (wall_px >= cv2.dilate(wall_px, np.ones((5, 5), np.uint8))) & (wall_px > 1.5)
    width_px = 2.0 * float(np.median(wall_px[ridge])) if ridge.any() else 1.0
    image_px = (left_right[1] - left_right[0]) * scene.calibration.um_per_px / chip.um_per_px  # of the mask
    spacing = float(np.clip(width_px / _ACROSS, image_px / _ALONG[1], image_px / _ALONG[0]))
    allowed = ridge | (wall_px >= _FROM_WALL * spacing)
    pitch = max(1, int(_PITCH * spacing))
    row, column = np.nonzero(allowed & chip.mask)
    chosen = (row % pitch == 0) & (column % pitch == 0) | ridge[row, column]
    row, column = row[chosen], column[chosen]
    free = np.ones_like(chip.mask, np.uint8)
    points = []
    for at in np.lexsort((row, column, -np.round(np.minimum(wall_px[row, column], _WELL_AWAY * spacing)))):
        y, x = int(row[at]), int(column[at])
        if free[y, x]:
            points.append((x, y))
            cv2.circle(free, (x, y), max(round(spacing) - 1, 1), 0, -1)
    return np.array(points, np.float64).reshape(-1, 2) * chip.um_per_px, spacing * chip.um_per_px


def flow_arrows(
    scene: Scene, field: FlowField, grid: tuple[NDArray[np.float64], float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Origins (n, 2) and vectors (n, 2) in the picture plane, and speeds (n,) in um/s.

    Each arrow is centred on its point of the grid and points where the flow goes. Its length goes as the root of the
    speed, so that the slow branches of a network still show their direction; how fast they are, the colour says.
    """
    points_um, spacing_um = grid
    velocity = sample(field, points_um)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    peak = float(np.quantile(speed, 0.99)) if len(speed) else 0.0
    longest = _LONGEST * scene.length_px(spacing_um)
    # Capped: a jet through a narrow spot must not paint over its neighbours.
    length = longest * np.sqrt(np.minimum(speed / peak, 1.0)) if peak > 0.0 else np.zeros_like(speed)
    vectors = velocity * (length / np.maximum(speed, 1e-12))[:, None]
    return scene.to_plane(points_um) - 0.5 * vectors, vectors, speed
