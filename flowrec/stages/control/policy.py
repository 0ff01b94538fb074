"""The policy: the heading that decreases the time to go fastest, wherever the robot is.

To first order the best heading is -grad T / |grad T|; the flow is already contained in T. Differences of neighbouring
pixels are a poor gradient, though: beside walls they are one-sided, and on the kinks of T (two ways of equal duration,
a corner, the edge of the band along the walls) the gradient is undefined and the command chatters. The heading is
therefore the one after which, a short distance on, the least time is left. In the limit of a short distance that is the
gradient; on a kink it is one of the two ways.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, Floats32, cells_at, nearest_pixel
from flowrec.stages.control.tracking_laws import Reference, Situation, VectorLaw
from flowrec.stages.control.trajectory import nearest_time, position_at

_HEADINGS = 64  # compared first, 5.6 degrees apart; a parabola through the best one refines it
_STEP_PX = 1.5  # between points that are evaluated on the way, so that no wall is missed
_ANGLES = np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], -1)
_NEAR_PX = 16  # where the nearest pixel with a time is searched first


@dataclass(frozen=True, slots=True)
class Policy(VectorLaw):
    """u = -V grad T / |grad T| at the predicted position, with V the robot's speed limit and T the time to go.

    The gradient is taken over a radius, or over the distance of a frame. There is no reference, and no new plan
    wherever the robot is carried. Within `hold_radii` of the goal, and on a route without T (a survey), it is the
    VectorLaw.
    """

    hold_radii: float

    def reference(self, now: Situation) -> Reference | None:
        """Down the gradient of the time to go, and to rest at its end."""
        route, robot = now.route, now.robot
        if route is None or route.time_to_go_s is None:
            return None
        um_per_px = route.time_to_go_um_per_px or now.um_per_px
        goal = route.waypoints_um[-1]
        left_um = math.dist(goal, now.predicted_um)
        drift = now.flow_um_s / robot.speed_limit_um_s
        fastest = 1.0 + math.hypot(*drift)  # over ground, in units of the robot's own speed
        frame_um = robot.speed_limit_um_s * now.dt_s
        hold = left_um <= max(self.hold_radii * robot.radius_um, um_per_px, fastest * frame_um)
        progress_s = route.lasts_s if hold else nearest_time(route, now.estimate.position_um)
        # A gradient on pixels needs two of them; beyond the goal there is none.
        distance_um = min(max(robot.radius_um, 2.0 * um_per_px, frame_um), left_um / fastest)
        return Reference(
            position_um=goal if hold else position_at(route, progress_s),
            future_um=goal,
            velocity_um_s=np.zeros(2),
            progress_s=progress_s,
            # To be off the route is no error where T is known.
            error_um=distance_to_known(route.time_to_go_s, um_per_px, now.estimate.position_um),
            heading=None
            if hold
            else steepest_descent(route.time_to_go_s, um_per_px, now.predicted_um, distance_um, drift),
        )

    def velocity(self, now: Situation, reference: Reference) -> tuple[Floats, bool]:
        """As in TrackingLaw."""
        if reference.heading is None:
            return VectorLaw.velocity(self, now, reference)
        return now.limit_um_s * reference.heading, False


def steepest_descent(
    time_to_go_s: Floats32, um_per_px: float, point_um: Floats, distance_um: float, drift: Floats | None = None
) -> Floats:
    """Unit vector (2,): the heading for which T is least after the robot has swum a distance from a point.

    Where T is unknown in all directions, the heading is that to the nearest pixel where it is known.

    Parameters
    ----------
    time_to_go_s : (h, w) T; not finite where it is unknown.
    drift : (2,) flow in units of the robot's speed, which carries the robot meanwhile. With it the heading is exact in
        uniform flow for any distance, without it only for a short one.
    """
    point = point_um / um_per_px
    distance = distance_um / um_per_px
    displacements = _DIRECTIONS if drift is None else _DIRECTIONS + drift
    steps = math.ceil(distance * float(np.hypot(*displacements.T).max()) / _STEP_PX)
    points = point + (distance / steps * np.arange(1, steps + 1))[:, None, None] * displacements  # (steps, headings, 2)
    times = cells_at(points, time_to_go_s.shape).interpolate_known(time_to_go_s)
    ends = np.where(np.isfinite(times).all(axis=0), times[-1], np.inf)
    best = int(np.argmin(ends))
    if not math.isfinite(ends[best]):
        return _towards_known(time_to_go_s, point)
    angle = float(_ANGLES[best])
    before, after = float(ends[best - 1]), float(ends[(best + 1) % _HEADINGS])
    curvature = before - 2.0 * float(ends[best]) + after
    if math.isfinite(curvature) and curvature > 0.0:  # the minimum of a parabola through three headings
        angle += 0.5 * (before - after) / curvature * (2.0 * math.pi / _HEADINGS)
    return np.array([math.cos(angle), math.sin(angle)])


def distance_to_known(time_to_go_s: Floats32, um_per_px: float, point_um: Floats) -> float:
    """Distance from a point (2,) to the nearest pixel with a time, 0 up to half a diagonal; inf if no pixel has one."""
    point = point_um / um_per_px
    row, column = nearest_pixel(float(point[0]), float(point[1]), time_to_go_s.shape)
    known = math.isfinite(time_to_go_s[row, column])
    nearest = np.array([column, row], np.float64) if known else _nearest_known(time_to_go_s, point)
    if nearest is None:
        return math.inf
    return max(math.hypot(*(nearest - point)) - math.sqrt(0.5), 0.0) * um_per_px


def _towards_known(time_to_go_s: Floats32, point: Floats) -> Floats:
    """Unit vector from a point (px) to the nearest pixel with a time; zero if there is none, or the robot is on it."""
    nearest = _nearest_known(time_to_go_s, point)
    difference = np.zeros(2) if nearest is None else nearest - point
    length = math.hypot(*difference)
    return np.asarray(difference / length) if length > 0.0 else np.zeros(2)


def _nearest_known(time_to_go_s: Floats32, point: Floats) -> Floats | None:
    """(2,) px, the nearest pixel with a time: searched nearby first, then everywhere."""
    h, w = time_to_go_s.shape
    x, y = min(max(float(point[0]), 0.0), w - 1.0), min(max(float(point[1]), 0.0), h - 1.0)
    for size in (_NEAR_PX, h + w):
        left, top = max(int(x) - size, 0), max(int(y) - size, 0)
        rows, columns = np.nonzero(np.isfinite(time_to_go_s[top : int(y) + size + 2, left : int(x) + size + 2]))
        if len(rows):
            k = int(np.argmin((columns + left - point[0]) ** 2 + (rows + top - point[1]) ** 2))
            return np.array([columns[k] + left, rows[k] + top], np.float64)
    return None
