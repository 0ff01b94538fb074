"""Where the robot should be: a route driven along at a pace that never outruns the robot."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from flowrec.messages import Route

Vector = NDArray[np.float64]


def place_on(route: Route, time_s: float) -> Vector:
    """(2,) um: the route at a time since its start, its ends before and behind."""
    # By bisection rather than np.interp, which gives the interpreter away to other threads on every call.
    after = bisect_right(route.arrival_s, time_s)
    if after in (0, len(route.arrival_s)):
        return np.array(route.waypoints_um[0 if after == 0 else -1])
    begin, end = float(route.arrival_s[after - 1]), float(route.arrival_s[after])
    share = (time_s - begin) / (end - begin)
    return np.asarray((1.0 - share) * route.waypoints_um[after - 1] + share * route.waypoints_um[after])


def velocity_on(route: Route, time_s: float, over_s: float) -> Vector:
    """(2,) um/s: mean velocity along the route in the time `over_s` from a time on; zero at its end."""
    return (place_on(route, time_s + over_s) - place_on(route, time_s)) / over_s


def nearest_on(route: Route, point_um: Vector) -> float:
    """Time (s) at which the route passes nearest to a point (2,) um; the first of several such times."""
    points = route.waypoints_um
    if len(points) < 2:
        return float(route.arrival_s[0])
    begin, leg = points[:-1], np.diff(points, axis=0)
    square = np.maximum((leg**2).sum(axis=1), 1e-12)
    share = np.clip(((point_um - begin) * leg).sum(axis=1) / square, 0.0, 1.0)
    k = int(np.argmin(((begin + share[:, None] * leg - point_um) ** 2).sum(axis=1)))
    return float(route.arrival_s[k] + share[k] * (route.arrival_s[k + 1] - route.arrival_s[k]))


def governed_pace(error_um: Vector, velocity_um_s: Vector, free_um: float, full_um: float) -> float:
    """How fast the reference may go on, as a share of the planned pace: 1 in step, 0 when the robot is left behind.

    An error (reference minus robot, (2,)) sideways or behind brakes the reference, from `free_um` on until it waits
    at `full_um`. A robot that the flow has carried ahead by more than `free_um` pulls it forward, up to twice the
    pace, rather than being driven back against the flow.
    """
    speed = float(np.hypot(velocity_um_s[0], velocity_um_s[1]))
    lag = math.hypot(error_um[0], error_um[1])
    ahead = 0.0
    if speed > 0.0:
        along = float(error_um @ velocity_um_s) / speed
        if along < 0.0:
            ahead = -along
            lag = math.sqrt(max(lag * lag - along * along, 0.0))
    braked = min(max((full_um - lag) / (full_um - free_um), 0.0), 1.0)
    return braked * (1.0 + min(max((ahead - free_um) / full_um, 0.0), 1.0))


def bearable_pace(velocity_um_s: Vector, flow_um_s: Vector, limit_um_s: float, at_most: float) -> float:
    """The largest share p of a reference's velocity (2,) that a robot in this flow can keep up with.

    That is the largest p in 0..at_most with |p xd_dot - v| <= limit. Where there is none, the p that asks least of
    the robot: it is swept away all the same, but not also left behind. One that the flow carries faster than the
    reference wants to go is no reason to slow down.
    """
    gg = float(velocity_um_s @ velocity_um_s)
    if gg <= 0.0:
        return at_most
    gv = float(velocity_um_s @ flow_um_s)
    room = gv * gv - gg * (float(flow_um_s @ flow_um_s) - limit_um_s**2)
    return min(max((gv + math.sqrt(max(room, 0.0))) / gg, 0.0), at_most)
