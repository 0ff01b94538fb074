"""Masked normalised cross-correlation of an image with the robot's template; walls are left out.

With weights M (1 where a pixel counts) the correlation of image I with template T at each position is that of the
weighted samples, after subtraction of their weighted means:
    cov = T*(MI) - (T*M)(1*MI) / (1*M),  var_I = 1*(MI^2) - (1*MI)^2 / (1*M),  var_T likewise.
The kernel is compiled: the region is small on most frames, and the overhead of NumPy would exceed the work.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from flowrec.core import Bools, Floats32, Image, compiled
from flowrec.stages.vision.disc_fit import RIM_RATIO, initial_edge_px, profile

_LEAST_OVERLAP = 0.5  # fraction of the template that must lie on pixels that count


@lru_cache(maxsize=16)
def template(radius_px: float, step: int) -> Floats32:
    """The robot (n, n), n odd, in an image reduced by `step`: disc -1, rim positive, background 0; mean subtracted."""
    radius, edge = radius_px / step, initial_edge_px(radius_px) / step + 0.3 * (step > 1)
    half = math.ceil(1.15 * radius + 2.5 * edge)
    fine = 4
    axis = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    shape = np.empty((len(axis), len(axis)))
    for row, y in enumerate(axis.tolist()):
        for column, x in enumerate(axis.tolist()):
            disc, rim, _, _ = profile((math.hypot(x, y) - radius) / edge)
            shape[row, column] = RIM_RATIO * rim - disc
    binned = shape.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean(axis=(1, 3))
    pattern = np.ascontiguousarray(binned - binned.mean(), np.float32)
    pattern.flags.writeable = False
    return pattern


def masked_ncc(
    image: Image | Floats32,
    distance_px: Floats32,
    box: tuple[int, int, int, int],
    step: int,
    margin_px: float,
    clearance_px: float,
    pattern: Floats32,
) -> Floats32:
    """Correlation -1 to 1 (rows, columns) with the robot centred on each block of step x step pixels of a box.

    Pixels nearer to a wall than the margin do not count, nor do those outside the image. Blocks nearer to a wall than
    the clearance can not hold the centre and are -1. `pattern`: (n, n) of mean 0, at the scale of the reduced image;
    see `template`.
    """
    x0, y0 = box[0], box[1]
    columns, rows = (box[2] - x0 + step - 1) // step, (box[3] - y0 + step - 1) // step
    half = pattern.shape[0] // 2
    tall, wide = rows + 2 * half, columns + 2 * half
    blocks = _weighted_blocks(image, distance_px, x0 - half * step, y0 - half * step, wide, tall, step, margin_px)
    # A kernel of its own: it takes seconds to compile for a kind of image.
    return _correlation(*blocks, distance_px, x0, y0, step, clearance_px, pattern)


@compiled
def _correlation(
    grey: Floats32,
    square: Floats32,
    weight: Floats32,
    whole: Bools,
    distance_px: Floats32,
    x0: int,
    y0: int,
    step: int,
    clearance_px: float,
    pattern: Floats32,
) -> Floats32:
    """`masked_ncc` for the blocks of `_weighted_blocks`, half a pattern more than the box on each side."""
    height, width = distance_px.shape
    size = pattern.shape[0]
    rows, columns = grey.shape[0] - size + 1, grey.shape[1] - size + 1
    correlation = np.full((rows, columns), -1.0, np.float32)
    middle = (step - 1) // 2
    area = np.float32(size * size)
    one = np.float32(1.0)
    squared = pattern * pattern
    spread = squared.sum()
    for row in range(rows):
        y = min(y0 + row * step + middle, height - 1)
        first, last = columns, -1
        for column in range(columns):
            if distance_px[y, min(x0 + column * step + middle, width - 1)] >= clearance_px:
                first, last = min(first, column), column
        if last < 0:
            continue
        span = last + 1 - first
        sum_i, sum_i2 = _window_sums(grey, row, first, span, size), _window_sums(square, row, first, span, size)
        open_fluid = whole[row : row + size].all()
        cov, sum_m = np.zeros(span, np.float32), np.full(span, area if open_fluid else np.float32(0.0))
        sum_t, sum_t2 = np.zeros(span, np.float32), np.zeros(span, np.float32)
        for j in range(size):
            for k in range(size):
                _add(cov, pattern[j, k], grey[row + j, first + k :])
        if not open_fluid:
            for j in range(size):
                for k in range(size):
                    part = weight[row + j, first + k :]
                    _add(sum_m, one, part)
                    _add(sum_t, pattern[j, k], part)
                    _add(sum_t2, squared[j, k], part)
        for i in range(span):
            if sum_m[i] < _LEAST_OVERLAP * area:
                continue
            if distance_px[y, min(x0 + (first + i) * step + middle, width - 1)] < clearance_px:
                continue
            var_t, joint = spread, cov[i]
            if not open_fluid:
                var_t = sum_t2[i] - sum_t[i] * sum_t[i] / sum_m[i]
                joint = cov[i] - sum_t[i] * sum_i[i] / sum_m[i]
            var_i = sum_i2[i] - sum_i[i] * sum_i[i] / sum_m[i]
            correlation[row, first + i] = joint / np.sqrt(max(var_i * var_t, np.float32(1e-3)))
    return correlation


@compiled
def _weighted_blocks(
    image: Image | Floats32,
    distance_px: Floats32,
    x0: int,
    y0: int,
    columns: int,
    rows: int,
    step: int,
    margin_px: float,
) -> tuple[Floats32, Floats32, Floats32, Bools]:
    """M I, M I^2 and M (rows, columns) of blocks of step x step pixels from (x0, y0) on; rows in which all M are 1.

    I is in grey levels minus 128. M is the fraction of a block that counts: 0 outside the image.
    """
    height, width = image.shape
    grey = np.zeros((rows, columns), np.float32)
    square = np.zeros(grey.shape, np.float32)
    weight = np.zeros(grey.shape, np.float32)
    whole = np.ones(rows, np.bool_)
    for j in range(rows):
        for i in range(columns):
            left, top = x0 + i * step, y0 + j * step
            total, count = 0.0, 0.0
            if left >= 0 and top >= 0 and left + step <= width and top + step <= height:
                for y in range(top, top + step):
                    for x in range(left, left + step):
                        total += image[y, x]
                        count += distance_px[y, x] > margin_px
            covered = count / (step * step)
            weight[j, i] = covered
            level = total / (step * step) - 128.0
            grey[j, i], square[j, i] = covered * level, covered * level * level
            if covered < 1.0:
                whole[j] = False
    return grey, square, weight, whole


@compiled
def _window_sums(values: Floats32, row: int, first: int, span: int, size: int) -> Floats32:
    """Sums (span,) over windows of size x size from (row, first) on: along the columns first, then along the row."""
    one = np.float32(1.0)
    line = np.zeros(span + size - 1, np.float32)
    for j in range(row, row + size):
        _add(line, one, values[j, first:])
    sums = np.zeros(span, np.float32)
    for k in range(size):
        _add(sums, one, line[k:])
    return sums


@compiled
def _add(to: Floats32, factor: np.float32, what: Floats32) -> None:
    """Add a multiple of the first part of an array to another, in a loop that is vectorised."""
    for i in range(len(to)):
        to[i] += factor * what[i]
