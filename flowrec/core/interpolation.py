"""Values of a raster between its pixel centres: bilinear interpolation and the nearest pixel.

With the fractions a (along x) and b (along y) of a point in the square of four pixel centres around it,

    f = (1 - b) [(1 - a) f00 + a f01] + b [(1 - a) f10 + a f11],

where f00 is the upper left, f01 the upper right, f10 the lower left and f11 the lower right pixel. Points are (x, y) in
pixels with the centre of pixel [0, 0] at (0, 0); rasters are [row, column]. Beyond the outermost pixel centres the
value of the nearest border point holds (the point is clamped). All forms give the same bits for the same point.

Which form serves which need:

- many points, NumPy: `cells_at(points, shape)`, then `.interpolate(raster)` for the value, `.rows`, `.columns` and
  `.weights` for a linear operator, `.interpolate_known(raster)` where some pixels have no value (infinite or NaN), and
  `.inside` where a point outside the image shall count differently.
- one point in Python, without NumPy's overhead: `cell_at(x, y, shape)` for pixels and fractions.
- in a compiled kernel: `bilinear(raster, x, y)`; `corner_weights(x, y, h, w)` where several rasters are read at one
  point (the sum of four weighted pixels rounds differently from the nested form above); `bilinear_known(raster, x, y)`
  where some pixels have no value.
- the nearest pixel: `nearest_pixel(x, y, shape)` for one point, `nearest_pixels(points, shape)` for many.

Images of a camera are resampled with OpenCV (cv2.warpAffine, cv2.remap), which is faster and rounds differently.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core.declarations import Bools, Floats, Ints
from flowrec.core.system.numba_setup import compiled

LEAST_WEIGHT = 0.25  # of the pixels with a value, for a point to have one


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The four pixels around each of a number of points."""

    row: Ints  # (...) of the upper two pixels
    column: Ints  # (...) of the left two
    below: Ints  # (...) row of the lower two; that of the upper ones in a raster of one row
    right: Ints  # (...) column of the right two; that of the left ones in a raster of one column
    a: Floats  # (...) fraction 0 to 1 along x
    b: Floats  # (...) fraction 0 to 1 along y
    inside: Bools  # (...) finite, and at most half a pixel beyond the outermost pixel centres

    def interpolate(self, raster: NDArray[Any]) -> Floats:
        """(..., channels) values of a raster (h, w, channels), or (...) of one (h, w)."""
        fractions = (self.a, self.b) if raster.ndim == 2 else (self.a[..., None], self.b[..., None])
        a, b = fractions
        upper = (1.0 - a) * _gather(raster, self.row, self.column) + a * _gather(raster, self.row, self.right)
        lower = (1.0 - a) * _gather(raster, self.below, self.column) + a * _gather(raster, self.below, self.right)
        return np.asarray((1.0 - b) * upper + b * lower, np.float64)

    def interpolate_known(self, raster: NDArray[Any]) -> Floats:
        """(...) mean of the finite ones of the four pixels of a raster (h, w), by their weights.

        Infinite where the finite ones weigh less than LEAST_WEIGHT and for points that are not inside.
        """
        total, known = np.zeros(self.a.shape), np.zeros(self.a.shape)
        for k, weight in enumerate(np.moveaxis(self.weights, -1, 0)):
            values = raster[(self.below if k > 1 else self.row), (self.right if k % 2 else self.column)]
            finite = np.isfinite(values)
            total += weight * np.where(finite, values, 0.0)
            known += weight * finite
        enough = self.inside & (known >= LEAST_WEIGHT)
        return np.where(enough, total / np.maximum(known, LEAST_WEIGHT), np.inf)

    @property
    def rows(self) -> Ints:
        """(..., 4) rows of the pixels 00, 01, 10, 11."""
        return np.stack([self.row, self.row, self.below, self.below], axis=-1)

    @property
    def columns(self) -> Ints:
        """(..., 4) columns of the pixels 00, 01, 10, 11."""
        return np.stack([self.column, self.right, self.column, self.right], axis=-1)

    @property
    def weights(self) -> Floats:
        """(..., 4) weights of the pixels 00, 01, 10, 11; their sum is 1."""
        a, b = self.a, self.b
        return np.stack([(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b], axis=-1)


def _gather(raster: NDArray[Any], row: Ints, column: Ints) -> NDArray[Any]:
    """raster[row, column]; NumPy gathers pixels of several channels in a quarter of the time by one index of each."""
    if not raster.flags.c_contiguous:
        return np.asarray(raster[row, column])
    return np.asarray(raster.reshape(-1, *raster.shape[2:]).take(row * raster.shape[1] + column, 0))


def cells_at(points: Floats, shape: tuple[int, ...]) -> Cells:
    """The pixels around points (..., 2) in px, of a raster whose shape begins with (h, w)."""
    h, w = shape[:2]
    x, y = points[..., 0], points[..., 1]
    inside = (x >= -0.5) & (x <= w - 0.5) & (y >= -0.5) & (y <= h - 0.5)
    # A coordinate that is NaN has no pixel: it is replaced, and `inside` is False.
    x = np.clip(np.where(np.isnan(x), 0.0, x), 0.0, w - 1.0)
    y = np.clip(np.where(np.isnan(y), 0.0, y), 0.0, h - 1.0)
    column, row = np.minimum(x.astype(np.intp), max(w - 2, 0)), np.minimum(y.astype(np.intp), max(h - 2, 0))
    right, below = np.minimum(column + 1, w - 1), np.minimum(row + 1, h - 1)
    return Cells(row, column, below, right, x - column, y - row, inside)


def cell_at(x: float, y: float, shape: tuple[int, ...]) -> tuple[int, int, int, int, float, float]:
    """Row, column, row below, column to the right, a and b of one finite point in px, as in `Cells`."""
    row, below, b = _interval(y, shape[0])
    column, right, a = _interval(x, shape[1])
    return row, column, below, right, a, b


def _interval(at: float, count: int) -> tuple[int, int, float]:
    """The two neighbours of a finite place on an axis of `count` pixels, and how far it is from the first one.

    The control loop asks some thirty times a frame; comparisons take a third of the time of min and max.
    """
    last = count - 1
    if at <= 0.0 or last == 0:
        return 0, min(1, last), 0.0
    if at >= last:
        return last - 1, last, 1.0
    first = int(at)
    return first, first + 1, at - first


def nearest_pixel(x: float, y: float, shape: tuple[int, ...]) -> tuple[int, int]:
    """(row, column) of the pixel of a raster nearest to a finite point in px; a half is rounded to the even number."""
    h, w = shape[:2]
    return min(max(round(y), 0), h - 1), min(max(round(x), 0), w - 1)


def nearest_pixels(points: Floats, shape: tuple[int, ...]) -> tuple[Ints, Ints]:
    """Rows (...) and columns (...) of the pixels nearest to finite points (..., 2) in px, as `nearest_pixel`."""
    h, w = shape[:2]
    nearest = np.rint(points).astype(np.intp)
    return np.clip(nearest[..., 1], 0, h - 1), np.clip(nearest[..., 0], 0, w - 1)


@compiled
def bilinear(raster: NDArray[Any], x: float, y: float) -> float:
    """Value of a raster (h, w) at a point in px. The raster has at least two rows and two columns."""
    h, w = raster.shape
    x = min(max(x, 0.0), w - 1.0)
    y = min(max(y, 0.0), h - 1.0)
    i = min(int(x), w - 2)
    j = min(int(y), h - 2)
    a = x - i
    b = y - j
    upper = (1.0 - a) * raster[j, i] + a * raster[j, i + 1]
    lower = (1.0 - a) * raster[j + 1, i] + a * raster[j + 1, i + 1]
    return float((1.0 - b) * upper + b * lower)


@compiled
def corner_weights(x: float, y: float, h: int, w: int) -> tuple[int, int, float, float, float, float]:
    """Row and column of the upper left one of the four pixels around a point in px, and the weights 00, 01, 10, 11."""
    x = min(max(x, 0.0), w - 1.0)
    y = min(max(y, 0.0), h - 1.0)
    i = min(int(x), w - 2)
    j = min(int(y), h - 2)
    a = x - i
    b = y - j
    return j, i, (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b


@compiled
def bilinear_known(raster: NDArray[Any], x: float, y: float) -> float:
    """Mean of the finite ones of the four pixels of a raster (h, w) around a point in px, by their weights.

    Infinite where the finite ones weigh less than LEAST_WEIGHT and beyond the outermost pixel centres: stricter than
    `Cells.interpolate_known` by half a pixel, because nothing is known of walls and flow there.
    """
    h, w = raster.shape
    if x < 0.0 or y < 0.0 or x > w - 1.0 or y > h - 1.0:
        return math.inf
    j, i, p, q, r, s = corner_weights(x, y, h, w)
    total = 0.0
    known = 0.0
    if math.isfinite(raster[j, i]):
        total += p * raster[j, i]
        known += p
    if math.isfinite(raster[j, i + 1]):
        total += q * raster[j, i + 1]
        known += q
    if math.isfinite(raster[j + 1, i]):
        total += r * raster[j + 1, i]
        known += r
    if math.isfinite(raster[j + 1, i + 1]):
        total += s * raster[j + 1, i + 1]
        known += s
    return total / known if known >= LEAST_WEIGHT else math.inf
