"""Control barrier function for walls: limits the speed towards a wall in proportion to the remaining distance."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, bilinear, cell_at, compiled
from flowrec.stages.control.tracking_laws import Situation, limit_length

_LEAST_SLOPE = 0.3  # below this gradient of the clearance the point is in the middle between two walls
_NEAR_RADII = 4.0  # waypoints within this distance count
_MOST_WAYPOINTS = 16


def wall_barrier(
    demand_um_s: Floats, now: Situation, clearance_um: NDArray[np.float32], keep_um: float, per_s: float
) -> tuple[Floats, bool]:
    """The demand within the speed limit that keeps the robot off the walls, and whether the limit reduced it.

    Where the route leads through a gap that is narrower than `keep_um`, the clearance kept is that of the gap, but not
    less than the robot's radius.

    Parameters
    ----------
    clearance_um : (h, w) distance to the nearest wall at the pixels of the chip's mask.
    keep_um : clearance that the robot keeps.
    per_s : largest ratio of the speed towards a wall to the remaining distance.
    """
    if now.route is not None:
        x_um, y_um = now.predicted_um.tolist()
        near_um = _NEAR_RADII * now.robot.radius_um
        gap_um = _narrowest_um(now.route.waypoints_um, x_um, y_um, near_um, clearance_um, now.um_per_px)
        keep_um = min(keep_um, max(gap_um, now.robot.radius_um))
    clearance, slope = clearance_and_slope(clearance_um, now.predicted_um / now.um_per_px)
    steepness = math.hypot(*slope) / now.um_per_px
    if math.isfinite(clearance) and steepness > _LEAST_SLOPE:
        away = slope / (steepness * now.um_per_px)
        demand_um_s = constrain(demand_um_s, now.flow_um_s, away, clearance - keep_um, per_s)
    return limit_length(demand_um_s, now.limit_um_s)


@compiled
def _narrowest_um(
    waypoints_um: Floats, x_um: float, y_um: float, near_um: float, clearance_um: NDArray[np.float32], um_per_px: float
) -> float:
    """Least clearance at some 16 of the waypoints (n, 2) that are near a point; infinite if none is."""
    count = 0
    for k in range(len(waypoints_um)):
        count += math.hypot(waypoints_um[k, 0] - x_um, waypoints_um[k, 1] - y_um) < near_um
    stride, number, least = count // _MOST_WAYPOINTS + 1, 0, math.inf
    for k in range(len(waypoints_um)):
        if math.hypot(waypoints_um[k, 0] - x_um, waypoints_um[k, 1] - y_um) < near_um:
            if number % stride == 0:
                here_um = bilinear(clearance_um, waypoints_um[k, 0] / um_per_px, waypoints_um[k, 1] / um_per_px)
                least = min(least, here_um)
            number += 1
    return least


def constrain(demand_um_s: Floats, flow_um_s: Floats, away: Floats, left_um: float, per_s: float) -> Floats:
    """The demand u (2,), changed as little as needed for (u + v) . n >= -per_s left.

    n is the unit vector `away` from the nearest wall. The approach to the wall slows down exponentially, and a robot
    that is too near moves away; motion along the wall is not changed.
    """
    missing = -per_s * left_um - float((demand_um_s + flow_um_s) @ away)
    return demand_um_s + max(missing, 0.0) * away


def clearance_and_slope(clearance_um: NDArray[np.float32], point_px: Floats) -> tuple[float, Floats]:
    """Clearance at a point (x, y) in px, bilinear, and its gradient (2,) per pixel."""
    row, column, *_, a, b = cell_at(float(point_px[0]), float(point_px[1]), clearance_um.shape)
    (upper_left, upper_right), (lower_left, lower_right) = clearance_um[row : row + 2, column : column + 2].tolist()
    value = (1 - b) * ((1 - a) * upper_left + a * upper_right) + b * ((1 - a) * lower_left + a * lower_right)
    right = (1 - b) * (upper_right - upper_left) + b * (lower_right - lower_left)
    down = (1 - a) * (lower_left - upper_left) + a * (lower_right - upper_right)
    return value, np.array([right, down])
