"""The reference trajectory: positions along a route, advanced at a pace that the robot can follow."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np

from flowrec.core import Floats, Route
from flowrec.stages.control.tracking_laws import Reference, Situation, factors_within


def follow(now: Situation, route: Route, lag_free_um: float, lag_full_um: float, pace_fraction: float) -> Reference:
    """The reference on its way along the route; at the start when the phase has just begun.

    A route that is adopted within a phase begins as the one before, with the same times, so the reference goes on.

    Parameters
    ----------
    lag_free_um, lag_full_um : see `governed_pace`.
    pace_fraction : fraction of the robot's speed limit that the reference may use; feedback uses the rest.
    """
    robot, estimate, previous = now.robot, now.estimate, now.previous
    if previous is None or now.mission.since_ns > previous.stamp_ns:
        progress_s, pace = 0.0, 1.0
    else:
        position = position_at(route, previous.progress_s)
        planned = velocity_at(route, previous.progress_s, max(now.dt_s, 1e-3))
        pace = governed_pace(position - estimate.position_um, planned, lag_free_um, lag_full_um)
        pace = feasible_pace(planned, now.flow.at(position), pace_fraction * now.limit_um_s, pace)
        progress_s = min(previous.progress_s + pace * now.dt_s, route.lasts_s)
    future_s = progress_s + pace * robot.delay_s
    position = position_at(route, progress_s)
    return Reference(
        position_um=position,
        future_um=position_at(route, future_s),
        velocity_um_s=pace * velocity_at(route, future_s, max(pace * now.dt_s, 1e-3)),
        progress_s=progress_s,
        error_um=math.dist(position, estimate.position_um),
    )


def position_at(route: Route, time_s: float) -> Floats:
    """(2,) um: the route at a time since its start; its ends before and after."""
    # By bisection, because np.interp releases the interpreter lock on every call.
    after = bisect_right(route.arrival_s, time_s)
    if after in (0, len(route.arrival_s)):
        return np.array(route.waypoints_um[0 if after == 0 else -1])
    begin, end = float(route.arrival_s[after - 1]), float(route.arrival_s[after])
    weight = (time_s - begin) / (end - begin)
    return (1.0 - weight) * route.waypoints_um[after - 1] + weight * route.waypoints_um[after]


def velocity_at(route: Route, time_s: float, over_s: float) -> Floats:
    """(2,) um/s: mean velocity along the route in the interval `over_s` after a time; zero at its end."""
    return (position_at(route, time_s + over_s) - position_at(route, time_s)) / over_s


def nearest_time(route: Route, point_um: Floats) -> float:
    """Time (s) at which the route passes nearest to a point (2,) um; the first of several such times."""
    points = route.waypoints_um
    if len(points) < 2:
        return float(route.arrival_s[0])
    begin, segment = points[:-1], np.diff(points, axis=0)
    square = np.maximum((segment**2).sum(axis=1), 1e-12)
    fraction = np.clip(((point_um - begin) * segment).sum(axis=1) / square, 0.0, 1.0)
    k = int(np.argmin(((begin + fraction[:, None] * segment - point_um) ** 2).sum(axis=1)))
    return float(route.arrival_s[k] + fraction[k] * (route.arrival_s[k + 1] - route.arrival_s[k]))


def governed_pace(error_um: Floats, velocity_um_s: Floats, free_um: float, full_um: float) -> float:
    """Factor on the planned pace of the reference: 1 without error, 0 when the robot is left behind.

    An error (reference minus robot, (2,)) sideways or behind slows the reference down, from `free_um` on until it
    stops at `full_um`. A robot that the flow has carried ahead by more than `free_um` speeds it up, to twice the pace
    at most, so that the robot is not driven back against the flow.
    """
    speed = float(np.hypot(*velocity_um_s))
    lag = math.hypot(*error_um)
    ahead = 0.0
    if speed > 0.0:
        along = float(error_um @ velocity_um_s) / speed
        if along < 0.0:
            ahead = -along
            lag = math.sqrt(max(lag * lag - along * along, 0.0))
    slowdown = min(max((full_um - lag) / (full_um - free_um), 0.0), 1.0)
    return slowdown * (1.0 + min(max((ahead - free_um) / full_um, 0.0), 1.0))


def feasible_pace(velocity_um_s: Floats, flow_um_s: Floats, limit_um_s: float, most: float) -> float:
    """The largest factor p on a reference's velocity (2,) with which a robot in this flow can keep up.

    That is the largest p in 0..most with |p xd_dot - v| <= limit. Where there is none, it is the p that needs least
    speed: the robot is swept away, but the reference does not leave it behind as well. A flow that is faster than the
    reference in its direction does not slow it down.
    """
    within = factors_within(velocity_um_s, flow_um_s, limit_um_s)
    return most if within is None else min(max(within[1], 0.0), most)
