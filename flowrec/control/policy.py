"""The policy: down the time to go, wherever the robot is.

To first order the best heading is -grad T / |grad T|; the flow is in T already. Differences of neighbouring pixels
are a poor slope, though: beside walls they are one-sided, on the kinks of T (two ways equally fast, a corner to be
rounded, the edge of the band along the walls) they point along no way at all, and the robot stands there and
trembles. So the heading is the one after which, a little way on, the least time is left. In the limit of a short way
that is the slope; on a kink it is one of the two ways.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Floats = NDArray[np.float64]
Raster = NDArray[np.float32]
_HEADINGS = 64
_STEP_PX = 1.5  # places looked at on the way, so that a wall is not jumped
_ANGLES = np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS)
_WAYS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], -1)


def downhill(
    time_to_go_s: Raster, um_per_px: float, point_um: Vector, reach_um: float, drift: Vector | None = None
) -> Vector:
    """Unit vector (2,): the heading from a point after which T is least when `reach_um` have been swum.

    `drift` (2,) is the flow as a share of the robot's speed: it carries the robot meanwhile. With it the heading is
    exact in uniform flow however far the reach, without it only for a short one.
    Where no way about has a time, the heading is that to the nearest pixel that has.
    """
    point = point_um / um_per_px
    reach = reach_um / um_per_px
    ways = _WAYS if drift is None else _WAYS + drift
    steps = math.ceil(reach * float(np.hypot(*ways.T).max()) / _STEP_PX)
    along = point + (reach / steps * np.arange(1, steps + 1))[:, None, None] * ways  # (steps, ways, 2)
    times = _between(time_to_go_s, along)
    ends = np.where(np.isfinite(times).all(axis=0), times[-1], np.inf)
    best = int(np.argmin(ends))
    if not math.isfinite(ends[best]):
        return _homeward(time_to_go_s, point)
    angle = float(_ANGLES[best])
    before, after = float(ends[best - 1]), float(ends[(best + 1) % _HEADINGS])
    bend = before - 2.0 * float(ends[best]) + after
    if math.isfinite(bend) and bend > 0.0:  # the lowest point of a parabola through three ways
        angle += 0.5 * (before - after) / bend * (2.0 * math.pi / _HEADINGS)
    return np.array([math.cos(angle), math.sin(angle)])


def astray_um(time_to_go_s: Raster, um_per_px: float, point_um: Vector) -> float:
    """Distance from a point (2,) to the nearest pixel with a time, 0 up to half a diagonal; inf if no pixel has one."""
    point = point_um / um_per_px
    h, w = time_to_go_s.shape
    column, row = min(max(round(float(point[0])), 0), w - 1), min(max(round(float(point[1])), 0), h - 1)
    if math.isfinite(time_to_go_s[row, column]):
        nearest = np.array([column, row], np.float64)
    else:
        found = _nearest(time_to_go_s, point)
        if found is None:
            return math.inf
        nearest = found
    return max(math.hypot(*(nearest - point)) - math.sqrt(0.5), 0.0) * um_per_px


def _homeward(time_to_go_s: Raster, point: Vector) -> Vector:
    """Unit vector from a point (px) to the nearest pixel with a time; zero if there is none, or the robot is on it."""
    nearest = _nearest(time_to_go_s, point)
    if nearest is None:
        return np.zeros(2)
    way = nearest - point
    length = math.hypot(*way)
    return np.asarray(way / length) if length > 0.0 else np.zeros(2)


def _nearest(time_to_go_s: Raster, point: Vector) -> Vector | None:
    """(2,) px, the nearest pixel with a time: first looked for nearby, then everywhere."""
    h, w = time_to_go_s.shape
    x, y = min(max(float(point[0]), 0.0), w - 1.0), min(max(float(point[1]), 0.0), h - 1.0)
    for reach in (16, h + w):
        left, top = max(int(x) - reach, 0), max(int(y) - reach, 0)
        rows, columns = np.nonzero(np.isfinite(time_to_go_s[top : int(y) + reach + 2, left : int(x) + reach + 2]))
        if len(rows):
            k = int(np.argmin((columns + left - point[0]) ** 2 + (rows + top - point[1]) ** 2))
            return np.array([columns[k] + left, rows[k] + top], np.float64)
    return None


def _between(raster: Raster, points: Floats) -> Floats:
    """Bilinear time (...) at points (..., 2) px, from those corners that have one; inf where they weigh too little."""
    h, w = raster.shape
    x, y = points[..., 0], points[..., 1]
    inside = (x >= -0.5) & (x <= w - 0.5) & (y >= -0.5) & (y <= h - 0.5)
    x, y = np.clip(x, 0.0, w - 1.0), np.clip(y, 0.0, h - 1.0)
    i, j = np.minimum(x.astype(np.intp), w - 2), np.minimum(y.astype(np.intp), h - 2)
    a, b = x - i, y - j
    total, weight = np.zeros(x.shape), np.zeros(x.shape)
    for down, right, share in ((0, 0, (1 - a) * (1 - b)), (0, 1, a * (1 - b)), (1, 0, (1 - a) * b), (1, 1, a * b)):
        times = raster[j + down, i + right]
        known = np.isfinite(times)
        total += share * np.where(known, times, 0.0)
        weight += share * known
    return np.where(inside & (weight >= 0.25), total / np.maximum(weight, 0.25), np.inf)
