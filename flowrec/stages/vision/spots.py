"""Small round bodies in an image: local extrema of a difference of two blurs (Crocker and Grier 1996; Lowe 2004).

A body of radius r is brightest in the difference of a Gaussian of sigma = r / sqrt(2) and one of 1.6 sigma. An extremum
counts if it exceeds the noise of that difference, a median over the fluid, and if the ratio of its principal curvatures
is small: that of an edge, as of a wall, is large (Lowe 2004, section 4.1). The parabola through its neighbours places
it within the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowrec.core import Bools, Floats, Image, Ints
from flowrec.stages.vision.walls import Walls

_WIDER = 1.6  # of the two blurs
_LEAST_SIGMA_PX = 0.8  # a narrower one follows single pixels
_EVERY = 4  # pixel along rows and columns is enough for the median
_MAD = 0.6745  # of a normal distribution, in standard deviations
# What is fainter than this part of a body, and so near to it, is its diffraction ring and no other body.
_RING_SHARE, _RING_RADII, _RING_PX = 0.4, 2.0, 5.0
_LEAST_NOISE = 0.02  # grey levels, of an image without noise


@dataclass(frozen=True, slots=True)
class SpotSearch:
    """The look of a body, and the search for it."""

    radius_px: float
    dark: bool  # relative to the background
    least_snr: float  # of its contrast in the difference, over the noise
    most_elongated: float = 0.0  # largest ratio of the principal curvatures; 0: any

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the narrower blur."""
        return max(self.radius_px / np.sqrt(2.0), _LEAST_SIGMA_PX)

    @property
    def pad_px(self) -> int:
        """Pixels that are read around a place, to each side."""
        return _half_size(_WIDER * self.sigma_px) + 2

    def find(self, image: Image, walls: Walls) -> tuple[Floats, Floats]:
        """Places (n, 2) in px and contrast over noise (n,) of the bodies in the fluid, in raster order."""
        x0, y0, x1, y1 = walls.box
        height, width = image.shape
        left, top = max(x0 - self.pad_px, 0), max(y0 - self.pad_px, 0)
        part = image[top : min(y1 + self.pad_px, height), left : min(x1 + self.pad_px, width)]
        if min(part.shape, default=0) < 3:
            return np.zeros((0, 2)), np.zeros(0)
        light = part.astype(np.float32)
        narrow, wide = _blur(light, self.sigma_px), _blur(light, _WIDER * self.sigma_px)
        contrast = wide - narrow if self.dark else narrow - wide
        distance = walls.distance_px[top : top + part.shape[0], left : left + part.shape[1]]
        fluid = distance[::_EVERY, ::_EVERY] > self.radius_px
        sampled = np.abs(contrast[::_EVERY, ::_EVERY][fluid])
        noise = max(float(np.median(sampled)) / _MAD if len(sampled) else 0.0, _LEAST_NOISE)
        size = 2 * max(round(self.radius_px), 1) + 1
        peaks = contrast == cv2.dilate(contrast, np.ones((size, size), np.uint8))
        peaks &= (contrast > self.least_snr * noise) & (distance > 0.5 * self.radius_px)
        peaks[[0, -1]] = peaks[:, [0, -1]] = False
        rows, columns = np.nonzero(peaks)
        if self.most_elongated > 0.0:
            round_ones = _elongation(contrast, rows, columns) <= self.most_elongated
            rows, columns = rows[round_ones], columns[round_ones]
        here = contrast[rows, columns]
        x = columns + _vertex(contrast[rows, columns - 1], here, contrast[rows, columns + 1]) + left
        y = rows + _vertex(contrast[rows - 1, columns], here, contrast[rows + 1, columns]) + top
        px, snr = np.column_stack((x, y)).astype(np.float64), here.astype(np.float64) / noise
        ring = _on_ring(px, snr, _RING_RADII * self.radius_px + _RING_PX)
        return px[~ring], snr[~ring]


def _elongation(contrast: Image, rows: Ints, columns: Ints) -> Floats:
    """Ratio of the principal curvatures at maxima, at least 1; infinite where it is flat along a line."""
    around = [[contrast[rows + y, columns + x].astype(np.float64) for x in (-1, 0, 1)] for y in (-1, 0, 1)]
    here = 2.0 * around[1][1]
    xx, yy = here - around[1][0] - around[1][2], here - around[0][1] - around[2][1]
    xy = 0.25 * (around[0][2] + around[2][0] - around[0][0] - around[2][2])
    apart = np.hypot(0.5 * (xx - yy), xy)
    middle = 0.5 * (xx + yy)
    least = middle - apart
    return np.where(least > 0.0, (middle + apart) / np.where(least > 0.0, least, 1.0), np.inf)


def _on_ring(px: Floats, snr: Floats, within_px: float) -> Bools:
    """(n,) True for spots that are so much fainter than one nearby that they are its diffraction ring."""
    from scipy.spatial import cKDTree  # not at start-up

    ring = np.zeros(len(px), np.bool_)
    if len(px) < 2:
        return ring
    pairs = cKDTree(px).query_pairs(within_px, output_type="ndarray")
    for one, other in (pairs.T, pairs.T[::-1]):
        ring[one[snr[one] < _RING_SHARE * snr[other]]] = True
    return ring


def _half_size(sigma_px: float) -> int:
    return int(np.ceil(3.0 * sigma_px))


def _blur(light: np.ndarray, sigma_px: float) -> np.ndarray:
    size = 2 * _half_size(sigma_px) + 1
    return cv2.GaussianBlur(light, (size, size), sigma_px, borderType=cv2.BORDER_REPLICATE)


def _vertex(before: Floats, here: Floats, after: Floats) -> Floats:
    """Place of the vertex of the parabola through three values in a row, from the middle one, within half a step."""
    bend = np.minimum(before + after - 2.0 * here, -1e-12)
    return np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
