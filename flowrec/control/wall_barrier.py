"""The wall guard: no demand may bring the robot to a wall faster than the room that is left allows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
# Where the clearance hardly rises in any direction the robot is in the middle between two walls.
_LEAST_SLOPE = 0.3


def guarded(
    demand_um_s: Vector,
    flow_um_s: Vector,
    position_um: Vector,
    clearance_um: NDArray[np.float32],
    um_per_px: float,
    keep_um: float,
    per_s: float,
) -> Vector:
    """The demand (2,), changed as little as needed for (u + v) . n >= -per_s (clearance - keep_um).

    n points away from the nearest wall. So the approach to a wall slows exponentially towards `keep_um`, and a
    robot that is nearer than that moves away; motion along the wall is left alone (a control barrier function).
    """
    clearance, slope = _clearance_and_slope(clearance_um, position_um / um_per_px)
    steepness = math.hypot(slope[0], slope[1]) / um_per_px
    if not (math.isfinite(clearance) and steepness > _LEAST_SLOPE):
        return demand_um_s
    away = slope / (steepness * um_per_px)
    missing = -per_s * (clearance - keep_um) - float((demand_um_s + flow_um_s) @ away)
    return demand_um_s + max(missing, 0.0) * away


def least_room(points_um: NDArray[np.float64], clearance_um: NDArray[np.float32], um_per_px: float) -> float:
    """The smallest clearance (um) at some points (n, 2); inf of none."""
    return min((_clearance_and_slope(clearance_um, point / um_per_px)[0] for point in points_um), default=math.inf)


def _clearance_and_slope(raster: NDArray[np.float32], point: Vector) -> tuple[float, Vector]:
    """Bilinear value of a raster (h, w) and its gradient per pixel at a point (x, y) in pixels."""
    h, w = raster.shape
    x, y = min(max(float(point[0]), 0.0), w - 1.0), min(max(float(point[1]), 0.0), h - 1.0)
    i, j = min(int(x), w - 2), min(int(y), h - 2)
    a, b = x - i, y - j
    (upper_left, upper_right), (lower_left, lower_right) = raster[j : j + 2, i : i + 2].tolist()
    value = (1 - b) * ((1 - a) * upper_left + a * upper_right) + b * ((1 - a) * lower_left + a * lower_right)
    right = (1 - b) * (upper_right - upper_left) + b * (lower_right - lower_left)
    down = (1 - a) * (lower_left - upper_left) + a * (lower_right - upper_right)
    return value, np.array([right, down])
