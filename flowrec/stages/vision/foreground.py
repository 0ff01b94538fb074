"""Foreground of an image: what differs from the local background, whatever its shape and polarity.

c = smoothed image - mean over a window of several radii (the band-pass of Crocker and Grier, 1996). A slope of the
illumination leaves no trace in c. Solid of the mask, where it is certain, is left out of the means and has c = 0.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import Floats, Floats32, Image, compiled

WINDOW = 2.0  # half width of the background's window in radii
_NOISE_FLOOR = 2.0  # standard deviations of c below which a pixel is background


@compiled
def reduced_foreground(
    image: Image,
    distance_px: Floats32,
    x0: int,
    y0: int,
    columns: int,
    rows: int,
    step: int,
    half: int,
    solid_px: float,
) -> Floats32:
    """Foreground c (rows, columns) in grey levels, of blocks of step x step pixels from (x0, y0) on.

    `half` is the half width of the background's window in blocks. Blocks whose distance to the walls is below
    `solid_px` (a negative number: depth in the solid) are left out. The image continues beyond its border as it ends.
    """
    pad = half + 1
    tall, wide = rows + 2 * pad, columns + 2 * pad
    grey, count = _block_means(image, distance_px, x0 - pad * step, y0 - pad * step, wide, tall, step, solid_px)
    sums = np.zeros((tall + 1, wide + 1))
    counts = np.zeros((tall + 1, wide + 1))
    for j in range(tall):
        line, line_count = 0.0, 0.0
        for i in range(wide):
            line += grey[j, i]
            line_count += count[j, i]
            sums[j + 1, i + 1] = sums[j, i + 1] + line
            counts[j + 1, i + 1] = counts[j, i + 1] + line_count
    found = np.zeros((rows, columns), np.float32)
    size = 2 * half + 1
    for j in range(rows):
        a, b = j + 1, j + 1 + size
        for i in range(columns):
            if count[j + pad, i + pad] == 0.0:
                continue
            left, right = i + 1, i + 1 + size
            total = sums[b, right] - sums[a, right] - sums[b, left] + sums[a, left]
            inside = counts[b, right] - counts[a, right] - counts[b, left] + counts[a, left]
            smooth, weight = 0.0, 0.0
            for dj in range(-1, 2):
                for di in range(-1, 2):
                    part = (2.0 - abs(dj)) * (2.0 - abs(di)) * count[j + pad + dj, i + pad + di]
                    smooth += part * grey[j + pad + dj, i + pad + di]
                    weight += part
            found[j, i] = smooth / weight - total / inside
    return found


@compiled
def _block_means(
    image: Image,
    distance_px: Floats32,
    x0: int,
    y0: int,
    columns: int,
    rows: int,
    step: int,
    solid_px: float,
) -> tuple[Floats32, Floats32]:
    """Mean grey levels (rows, columns) of blocks of step x step pixels from (x0, y0) on, and 1 where a block counts.

    Both are 0 in a block whose distance to the walls is below `solid_px`.
    """
    height, width = image.shape
    grey = np.empty((rows, columns), np.float32)
    count = np.empty((rows, columns), np.float32)
    middle = step // 2
    for j in range(rows):
        top = y0 + j * step
        for i in range(columns):
            left = x0 + i * step
            total = 0.0
            if left >= 0 and top >= 0 and left + step <= width and top + step <= height:
                for y in range(top, top + step):
                    for x in range(left, left + step):
                        total += image[y, x]
            else:
                for y in range(top, top + step):
                    for x in range(left, left + step):
                        total += image[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
            open_fluid = (
                distance_px[min(max(top + middle, 0), height - 1), min(max(left + middle, 0), width - 1)] >= solid_px
            )
            count[j, i] = 1.0 if open_fluid else 0.0
            grey[j, i] = total / (step * step) if open_fluid else 0.0
    return grey, count


@compiled
def _above_noise(value: float, sign: int) -> tuple[float, float]:
    """Foreground over its noise, 0 where it has the other sign, as of `energy_map`; its square above that of noise."""
    value = 0.0 if sign * value < 0.0 else value
    return value, max(value * value - _NOISE_FLOOR * _NOISE_FLOOR, 0.0)


@compiled
def energy_map(c: Floats32, noise: float, sign: int, half: int) -> Floats32:
    """Mean of the squared foreground, in units of its noise, over (2 half + 1)^2 blocks, taken twice.

    sign: 1 bright parts only, -1 dark parts only, 0 both.
    """
    rows, columns = c.shape
    energy = np.empty((rows, columns), np.float32)
    for j in range(rows):
        for i in range(columns):
            energy[j, i] = _above_noise(c[j, i] / noise, sign)[1]
    for _ in range(2):
        energy = _box_mean(energy, half)
    return energy


@compiled
def _box_mean(values: Floats32, half: int) -> Floats32:
    rows, columns = values.shape
    across = np.empty((rows, columns), np.float32)
    scale = 1.0 / (2 * half + 1)
    for j in range(rows):
        total = 0.0
        for i in range(-half, columns):
            if i + half < columns:
                total += values[j, i + half]
            if i - half - 1 >= 0:
                total -= values[j, i - half - 1]
            if i >= 0:
                across[j, i] = total * scale
    out = np.empty((rows, columns), np.float32)
    line = np.zeros(columns)
    for j in range(-half, rows):
        if j + half < rows:
            for i in range(columns):
                line[i] += across[j + half, i]
        if j - half - 1 >= 0:
            for i in range(columns):
                line[i] -= across[j - half - 1, i]
        if j >= 0:
            for i in range(columns):
                out[j, i] = max(line[i], 0.0) * scale
    return out


@compiled
def peaks(values: Floats32, least: float, apart: int, most: int) -> Floats:
    """Local maxima (n, 3) of a map: column, row, value; the greatest first, at most `most`, `apart` blocks apart."""
    rows, columns = values.shape
    found = np.empty((most, 3))
    n = 0
    for j in range(rows):
        for i in range(columns):
            value = values[j, i]
            if value <= least or (n == most and value <= found[n - 1, 2]):
                continue
            highest = True
            for y in range(max(j - apart, 0), min(j + apart + 1, rows)):
                for x in range(max(i - apart, 0), min(i + apart + 1, columns)):
                    # Of equal neighbours the first one counts.
                    other = values[y, x]
                    if other > value or (other == value and (y < j or (y == j and x < i))):
                        highest = False
                        break
                if not highest:
                    break
            if not highest:
                continue
            place = min(n, most - 1)
            while place > 0 and found[place - 1, 2] < value:
                found[place, 0], found[place, 1], found[place, 2] = found[place - 1]
                place -= 1
            found[place, 0], found[place, 1], found[place, 2] = i, j, value
            n = min(n + 1, most)
    return found[:n]


@compiled
def silhouette_centroid(
    c: Floats32, noise: float, sign: int, x: float, y: float, radius: float, moves: int
) -> tuple[float, float, float, float]:
    """Centroid of the foreground within a radius, in blocks: x, y, energy and the level that halves a weight.

    The weight of a pixel is e / (e + level^2) with e its squared foreground: it saturates, so that a half dark, half
    bright object has its centroid in the middle of its outline. The window follows the centroid `moves` times.
    """
    rows, columns = c.shape
    energy, level = 0.0, 0.0
    for move in range(moves + 1):
        i0, i1 = max(math.floor(x - radius), 0), min(math.ceil(x + radius) + 1, columns)
        j0, j1 = max(math.floor(y - radius), 0), min(math.ceil(y + radius) + 1, rows)
        energy, count, fourth = 0.0, 1e-9, 0.0
        for j in range(j0, j1):
            for i in range(i0, i1):
                if (i - x) ** 2 + (j - y) ** 2 <= radius * radius:
                    _, e = _above_noise(c[j, i] / noise, sign)
                    energy += e
                    fourth += e * e
                    count += 1.0
        energy /= count
        if energy <= 0.0 or move == moves:
            break
        # The mean of e weighted by itself is the typical energy of the object's own pixels.
        level = fourth / count / energy
        half = 0.15 * level
        faint = max(0.25 * math.sqrt(level), 1.0)
        total, sum_x, sum_y = 1e-12, 0.0, 0.0
        for j in range(j0, j1):
            for i in range(i0, i1):
                rho2 = (i - x) ** 2 + (j - y) ** 2
                if rho2 <= (radius + 1.0) ** 2:
                    value, e = _above_noise(c[j, i] / noise, sign)
                    edge = min(max(radius + 0.5 - math.sqrt(rho2), 0.0), 1.0)  # no step as pixels enter the window
                    w = edge * (max(abs(value) - faint, 0.0) if sign != 0 else e / (e + half))
                    total += w
                    sum_x += w * i
                    sum_y += w * j
        if total < 1e-9:
            break
        x, y = sum_x / total, sum_y / total
    return x, y, energy, math.sqrt(level)


@compiled
def patch_at(c: Floats32, x: float, y: float, half: int) -> Floats32:
    """Bilinear samples (2 half + 1, 2 half + 1) of a map around a point; 0 outside."""
    rows, columns = c.shape
    size = 2 * half + 1
    out = np.zeros((size, size), np.float32)
    i0, j0 = math.floor(x), math.floor(y)
    fx, fy = x - i0, y - j0
    for v in range(size):
        j = j0 + v - half
        if j < 0 or j + 1 >= rows:
            continue
        for u in range(size):
            i = i0 + u - half
            if i < 0 or i + 1 >= columns:
                continue
            upper = c[j, i] + fx * (c[j, i + 1] - c[j, i])
            lower = c[j + 1, i] + fx * (c[j + 1, i + 1] - c[j + 1, i])
            out[v, u] = upper + fy * (lower - upper)
    return out


@compiled
def most_similar(
    c: Floats32, x: float, y: float, views: Floats32, window: Floats32, reach: int
) -> tuple[int, float, int, int]:
    """The view (n, s, s) most similar to the map near a point: its number, weighted correlation, offset in x and y."""
    rows, columns = c.shape
    half = views.shape[1] // 2
    column, row = round(x), round(y)
    best, best_view, best_i, best_j = -1.0, 0, 0, 0
    for dj in range(-reach, reach + 1):
        for di in range(-reach, reach + 1):
            left, top = column + di - half, row + dj - half
            for k in range(views.shape[0]):
                sw, si, st, sii, stt, sit = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for v in range(2 * half + 1):
                    j = top + v
                    if j < 0 or j >= rows:
                        continue
                    for u in range(2 * half + 1):
                        i = left + u
                        w = window[v, u]
                        if w == 0.0 or i < 0 or i >= columns:
                            continue
                        a, b = c[j, i], views[k, v, u]
                        sw += w
                        si += w * a
                        st += w * b
                        sii += w * a * a
                        stt += w * b * b
                        sit += w * a * b
                if sw <= 0.0:
                    continue
                var_i, var_t = sii - si * si / sw, stt - st * st / sw
                if var_i <= 1e-12 or var_t <= 1e-12:
                    continue
                ncc = (sit - si * st / sw) / math.sqrt(var_i * var_t)
                if ncc > best:
                    best, best_view, best_i, best_j = ncc, k, di, dj
    return best_view, best, best_i, best_j


@compiled
def register_view(
    c: Floats32, x: float, y: float, view: Floats32, window: Floats32, limit: float
) -> tuple[float, float, float]:
    """Position at which a view fits the map best, by Gauss-Newton for shift, gain and offset; and its correlation.

    Returns the start with correlation -1 if it does not converge within `limit` blocks.
    """
    half = view.shape[0] // 2
    size = 2 * half + 1
    at_x, at_y = x, y
    for _ in range(20):
        patch = patch_at(c, at_x, at_y, half)
        gain, offset = _gain(patch, view, window)
        if gain <= 0.0:
            return x, y, -1.0
        # The gradient is that of the view, which is less noisy than the image.
        xx, xy, yy, right_x, right_y = 1e-12, 0.0, 1e-12, 0.0, 0.0
        for v in range(1, size - 1):
            for u in range(1, size - 1):
                w = window[v, u]
                if w > 0.0:
                    gx = 0.5 * (view[v, u + 1] - view[v, u - 1])
                    gy = 0.5 * (view[v + 1, u] - view[v - 1, u])
                    miss = gain * view[v, u] + offset - patch[v, u]
                    xx += w * gx * gx
                    xy += w * gx * gy
                    yy += w * gy * gy
                    right_x += w * gx * miss
                    right_y += w * gy * miss
        determinant = max(xx * yy - xy * xy, 1e-9 * (xx + yy) ** 2) * gain
        step_x = (yy * right_x - xy * right_y) / determinant
        step_y = (xx * right_y - xy * right_x) / determinant
        at_x += min(max(step_x, -0.7), 0.7)
        at_y += min(max(step_y, -0.7), 0.7)
        if not (abs(at_x - x) <= limit and abs(at_y - y) <= limit):
            return x, y, -1.0
        if abs(step_x) < 2e-3 and abs(step_y) < 2e-3:
            break
    return at_x, at_y, correlation(patch_at(c, at_x, at_y, half), view, window)


@compiled
def _moments(patch: Floats32, view: Floats32, window: Floats32) -> tuple[float, float, float, float, float, float]:
    """Weighted sums of 1, patch, view, patch^2, view^2 and patch view."""
    sw, si, st, sii, stt, sit = 1e-12, 0.0, 0.0, 0.0, 0.0, 0.0
    for v in range(patch.shape[0]):
        for u in range(patch.shape[1]):
            w, a, b = window[v, u], patch[v, u], view[v, u]
            sw += w
            si += w * a
            st += w * b
            sii += w * a * a
            stt += w * b * b
            sit += w * a * b
    return sw, si, st, sii, stt, sit


@compiled
def _gain(patch: Floats32, view: Floats32, window: Floats32) -> tuple[float, float]:
    """Weighted least-squares gain and offset: patch = gain view + offset."""
    sw, si, st, _, stt, sit = _moments(patch, view, window)
    gain = (sit - si * st / sw) / max(stt - st * st / sw, 1e-12)
    return gain, (si - gain * st) / sw


@compiled
def correlation(patch: Floats32, view: Floats32, window: Floats32) -> float:
    """Weighted correlation of two views."""
    sw, si, st, sii, stt, sit = _moments(patch, view, window)
    spread = (sii - si * si / sw) * (stt - st * st / sw)
    return (sit - si * st / sw) / math.sqrt(max(spread, 1e-18))
