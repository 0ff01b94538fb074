"""The centre of the robot to a fraction of a pixel, by least squares on its appearance.

The patch is modelled as a + c x + d y + b T(x - s): background with a slope, contrast b, shift s. T is known, so to
first order in s the model is linear in (a, c, d, b, b s); Gauss-Newton from the best whole pixel needs two or three
steps. T is radially symmetric: that a real robot's profile differs from it costs precision, not accuracy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from flowrec.vision.appearance import brightness, reach_px, widths_px

_POINTS = 900  # of a large patch, a regular sample of about this many pixels is as good as all
_FEWEST = 20
_STEPS = 4
_CLOSE_PX = 1e-3
_UNKNOWNS = 6


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
    stride = max(1, round(((2 * reach + 1) ** 2 / _POINTS) ** 0.5))
    points, x, y, contrast, likeness = _fit(
        image, usable, start_px[0], start_px[1], radius_px, reach, stride, *widths_px(radius_px)
    )
    return Fit((x, y), contrast, likeness) if points >= _FEWEST else None


@numba.njit(cache=True)
def _fit(
    image: NDArray[np.uint8],
    usable: NDArray[np.bool_],
    x: float,
    y: float,
    radius: float,
    reach: int,
    stride: int,
    soft: float,
    ring_at: float,
    ring_width: float,
) -> tuple[int, float, float, float, float]:
    """Gauss-Newton over the patch. Compiled: it runs on every frame, on a few hundred pixels."""
    top, left = round(y) - reach, round(x) - reach
    contrast = likeness = 0.0
    points = 0
    normal = np.empty((_UNKNOWNS, _UNKNOWNS))
    right = np.empty(_UNKNOWNS)
    row_of = np.empty(_UNKNOWNS)
    for _ in range(_STEPS):
        normal[:] = 0.0
        right[:] = 0.0
        points = 0
        total = square = 0.0
        for row in range(top, top + 2 * reach + 1, stride):
            for column in range(left, left + 2 * reach + 1, stride):
                if row < 0 or column < 0 or row >= image.shape[0] or column >= image.shape[1]:
                    continue
                if not usable[row, column]:
                    continue
                across, down = column - x, row - y
                distance = math.sqrt(across * across + down * down)
                shape, slope = brightness(distance, radius, soft, ring_at, ring_width)
                safe = max(distance, 1e-9)
                row_of[0] = 1.0
                row_of[1] = across
                row_of[2] = down
                row_of[3] = shape
                # Moving the centre right moves the disc right: dT/dcx = -T'(d) (x - cx) / d.
                row_of[4] = -slope * across / safe
                row_of[5] = -slope * down / safe
                # Grey levels about 128 keep the sums of squares small against their differences.
                grey = float(image[row, column]) - 128.0
                points += 1
                total += grey
                square += grey * grey
                for i in range(_UNKNOWNS):
                    right[i] += row_of[i] * grey
                    for j in range(i + 1):
                        normal[i, j] += row_of[i] * row_of[j]
        if points < _FEWEST:
            return points, x, y, 0.0, 0.0
        for i in range(_UNKNOWNS):
            normal[i, i] *= 1.0 + 1e-9
            for j in range(i):
                normal[j, i] = normal[i, j]
        solution = np.linalg.solve(normal, right)
        residual = square
        for i in range(_UNKNOWNS):
            residual -= 2.0 * solution[i] * right[i]
            for j in range(_UNKNOWNS):
                residual += solution[i] * normal[i, j] * solution[j]
        spread = square - total * total / points
        contrast = solution[3]
        likeness = 1.0 - residual / spread if spread > 0 else 0.0
        if contrast <= 0:
            return points, x, y, contrast, likeness
        dx, dy = solution[4] / contrast, solution[5] / contrast
        longest = max(abs(dx), abs(dy))
        if longest > 1.0:
            dx, dy = dx / longest, dy / longest
        x, y = x + dx, y + dy
        if longest < _CLOSE_PX:
            break
    return points, x, y, contrast, likeness
