"""How much each place of an image looks like the robot: normalised correlation that leaves out the walls.

With weights M (1 where a pixel counts) the correlation of image I with template T at each place is that of the
weighted samples, after taking off their weighted means:
    cov = T*(MI) - (T*M)(1*MI) / (1*M),  var_I = 1*(MI^2) - (1*MI)^2 / (1*M),  var_T likewise.
"""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.vision.disc import disc, rim

Floats = NDArray[np.float32]
RIM_SHARE = 0.35  # brightness of the rim as a share of the disc's darkness, to begin with


@functools.lru_cache(maxsize=32)
def template(radius_px: float, edge_px: float) -> Floats:
    """The robot (n, n), dark disc -1, bright rim, background 0, averaged over pixels."""
    half = math.ceil(1.15 * radius_px + 2.5 * edge_px)
    fine = 4
    axis = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    s = (np.hypot(axis[None], axis[:, None]) - radius_px) / edge_px
    shape = -disc(s) + RIM_SHARE * rim(s)
    binned = shape.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean(axis=(1, 3))
    return np.ascontiguousarray(binned, np.float32)


def likeness(image: Floats, weight: Floats | None, pattern: Floats) -> tuple[Floats, Floats]:
    """Correlation -1 to 1 and amplitude (grey levels per unit of the pattern) at each place (h, w).

    `weight` None means that every pixel counts. Where less than half of the pattern's window counts both are 0.
    """
    centred = image - np.float32(image.mean())  # float32: sums of squares must not cancel
    size = pattern.shape[0]
    area = np.float32(size * size)

    def correlate(data: Floats, kernel: Floats) -> Floats:
        return np.asarray(cv2.filter2D(data, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT_101), np.float32)

    def total(data: Floats) -> Floats:
        box = cv2.boxFilter(data, cv2.CV_32F, (size, size), normalize=False, borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(box, np.float32)

    if weight is None:
        sum_t = np.float32(pattern.sum())
        var_t: Floats | np.float32 = np.float32((pattern * pattern).sum()) - sum_t * sum_t / area
        sum_i = total(centred)
        cov = correlate(centred, pattern) - sum_t / area * sum_i
        var_i = total(centred * centred) - sum_i * sum_i / area
        amplitude = cov / var_t
        found = cov / np.sqrt(np.maximum(var_i * var_t, 1e-3))
        return np.asarray(found, np.float32), np.asarray(amplitude, np.float32)
    masked = centred * weight
    count = total(weight)
    share = 1.0 / np.maximum(count, 1.0)
    sum_t_map, sum_i = correlate(weight, pattern), total(masked)
    var_t = np.maximum(correlate(weight, pattern * pattern) - sum_t_map * sum_t_map * share, 1e-6)
    cov = correlate(masked, pattern) - sum_t_map * sum_i * share
    var_i = total(masked * centred) - sum_i * sum_i * share
    enough = count >= 0.5 * area
    found = np.where(enough, cov / np.sqrt(np.maximum(var_i * var_t, 1e-3)), 0.0)
    return np.asarray(found, np.float32), np.asarray(np.where(enough, cov / var_t, 0.0), np.float32)
