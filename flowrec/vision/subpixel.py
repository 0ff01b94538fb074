"""The centre of the robot to a fraction of a pixel, by least squares on its appearance.

The patch is modelled as a + c x + d y + b T(x - s): background with a slope, contrast b, shift s. T is known, so to
first order in s the model is linear in (a, c, d, b, b s); Gauss-Newton from the best whole pixel needs two or three
steps. T is radially symmetric: that a real robot's profile differs from it costs precision, not accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.vision.appearance import profile, reach_px

_POINTS = 900  # of a large patch, a regular sample of about this many pixels is as good as all
_STEPS = 4
_CLOSE_PX = 1e-3


@dataclass(frozen=True, slots=True)
class Fit:
    """Centre in pixels (column, row), contrast in grey levels, and the share of the patch's variance explained."""

    centre_px: tuple[float, float]
    contrast: float
    likeness: float


def fit_centre(
    image: NDArray[np.uint8], usable: NDArray[np.bool_], start_px: tuple[float, float], radius_px: float
) -> Fit | None:
    """Fit the robot near `start_px` (column, row), on `usable` pixels only; None where too few are usable.

    Parameters
    ----------
    image, usable : (h, w) grey levels, and which of them show open fluid rather than a wall
    """
    reach = reach_px(radius_px)
    x0, y0 = (round(value) for value in start_px)
    left, top = max(0, x0 - reach), max(0, y0 - reach)
    right, bottom = min(image.shape[1], x0 + reach + 1), min(image.shape[0], y0 + reach + 1)
    stride = max(1, round(((2 * reach + 1) ** 2 / _POINTS) ** 0.5))
    cut = (slice(top, bottom, stride), slice(left, right, stride))
    rows, columns = np.nonzero(usable[cut])
    if len(rows) < 20:
        return None
    grey = image[cut][rows, columns].astype(np.float64)
    x = left + stride * columns.astype(np.float64)
    y = top + stride * rows.astype(np.float64)
    cx, cy = start_px
    step = 0.05
    contrast = likeness = 0.0
    spread = float(((grey - grey.mean()) ** 2).sum()) or 1.0
    for _ in range(_STEPS):
        distance = np.hypot(x - cx, y - cy)
        shape = profile(distance, radius_px)
        slope = (profile(distance + step, radius_px) - shape) / step
        safe = np.maximum(distance, 1e-9)
        # dT/dcx = -T'(d) (x - cx)/d: moving the centre right moves the disc right.
        design = np.column_stack(
            (np.ones_like(x), x - cx, y - cy, shape, -slope * (x - cx) / safe, -slope * (y - cy) / safe)
        )
        normal = design.T @ design
        normal[np.diag_indices(6)] *= 1.0 + 1e-9
        solution = np.linalg.solve(normal, design.T @ grey)
        residual = grey - design @ solution
        contrast = float(solution[3])
        likeness = 1.0 - float((residual**2).sum()) / spread
        if contrast <= 0:
            return Fit((cx, cy), contrast, likeness)
        dx, dy = float(solution[4]) / contrast, float(solution[5]) / contrast
        longest = max(abs(dx), abs(dy), 1e-12)
        limit = min(1.0, 1.0 / longest)
        cx, cy = cx + limit * dx, cy + limit * dy
        if longest < _CLOSE_PX:
            break
    return Fit((cx, cy), contrast, likeness)
