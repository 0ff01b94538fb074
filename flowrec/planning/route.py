"""Routes as messages: a path with its times, or none with its reason."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flowrec.errors import UsageError
from flowrec.flow import sample
from flowrec.messages import FlowField, Route
from flowrec.planning.timing import ground_speed, travel_time
from flowrec.robot import Robot

Points = NDArray[np.float64]


def planning_speed_um_s(share: float, robot: Robot) -> float:
    """The speed through the fluid that a plan counts on, um/s.

    Raises
    ------
    UsageError
        If that is no speed at all.
    """
    # A float and nothing else: every other type would be compiled for anew.
    speed_um_s = float(share * robot.speed_limit_um_s)
    if not speed_um_s > 0.0:
        raise UsageError(
            f"plan: speed_share {share:g} of the robot's {robot.speed_limit_um_s:g} um/s leaves no speed to plan with; "
            "both must be more than zero"
        )
    return speed_um_s


def no_route(method: str, reason: str) -> Route:
    """The honest answer."""
    return Route(0, 0, method, False, reason, np.zeros((0, 2)), np.zeros(0))


def timed_route(
    method: str, field: FlowField, path_um: Points, speed_um_s: float, remark: str, idle_um_s: float | None = None
) -> Route:
    """The route along a path (n, 2), waypoints at most a pixel apart, or none where the flow forbids it.

    With `idle_um_s` the robot swims as slowly as saves the most energy.
    """
    waypoints = _dense(path_um, field.um_per_px)
    arrival, feasible = travel_time(field, waypoints, speed_um_s, idle_um_s)
    if not feasible:
        return no_route(method, too_fast(field, waypoints, speed_um_s))
    return Route(0, 0, method, True, remark, waypoints, arrival)


def too_fast(field: FlowField, path_um: Points, speed_um_s: float) -> str:
    """One line that names the place on a path (n, 2) where the robot falls back most."""
    points = _dense(path_um, 0.25 * field.um_per_px)
    middles, legs = 0.5 * (points[1:] + points[:-1]), np.diff(points, axis=0)
    worst = int(np.argmin(ground_speed(field, middles, legs, speed_um_s)))
    flow_um_s = float(np.hypot(*sample(field, middles[worst])))
    return (
        f"the flow is too fast: {flow_um_s:.0f} um/s at {middles[worst, 0]:.0f},{middles[worst, 1]:.0f} um, where the "
        f"plan counts on {speed_um_s:.0f} um/s through the fluid"
    )


def _dense(path: Points, spacing: float) -> Points:
    """The same polyline (n, 2), its vertices kept, further points between them at most `spacing` apart."""
    lengths = np.hypot(*np.diff(path, axis=0).T)
    keep = np.concatenate([[True], lengths > 1e-6 * spacing])
    points, lengths = path[keep], lengths[keep[1:]]
    counts = np.maximum(1, np.ceil(lengths / spacing - 1e-9)).astype(np.int64)
    leg = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(counts.sum()) - (np.cumsum(counts) - counts)[leg]) / counts[leg]
    dense = points[leg] + share[:, None] * np.diff(points, axis=0)[leg]
    return np.concatenate([dense, points[-1:]])
