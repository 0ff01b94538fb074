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
