"""Routes as messages: the travel time along a path by the model alone, or the reason why there is no route.

Every planner is timed here, in the same way: nothing that a planner assumed enters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Floats, FlowField, Route, UsageError
from flowrec.physics import Robot, sample
from flowrec.stages.planning.cost_rasters import Points

_STEPS_PER_PX = 4.0


def planning_speed_um_s(share: float, robot: Robot) -> float:
    """The robot's speed through the fluid that a plan counts on: a share of its speed limit, um/s.

    Raises UsageError if that is not positive.
    """
    # A Python float: numba would compile every kernel anew for another type.
    speed_um_s = float(share * robot.speed_limit_um_s)
    if not speed_um_s > 0.0:
        raise UsageError(
            f"plan: speed_share {share:g} of the robot's {robot.speed_limit_um_s:g} um/s leaves no speed to plan with; "
            "both must be more than zero"
        )
    return speed_um_s


def ground_speed(
    field: FlowField, points_um: Points, directions: Points, speed_um_s: float, idle_um_s: float | None = None
) -> Floats:
    """Speed over ground (n,) in um/s of a robot at points (n, 2) that moves along directions (n, 2) of any length.

    d . v + sqrt(V^2 - |v_perp|^2); -inf where the flow across is faster than V, and V for a direction without length.
    With `idle_um_s` the robot saves energy: sqrt(idle^2 + |v|^2), limited to what V allows (kernels.step_energy).
    """
    velocity = sample(field, points_um)
    along, spare = along_and_spare(velocity, directions, speed_um_s)
    root = np.sqrt(np.maximum(spare, 0.0))
    ground = along + root
    if idle_um_s is not None:
        ground = np.clip(np.sqrt(idle_um_s**2 + (velocity**2).sum(axis=1)), along - root, along + root)
    return np.where(spare >= 0.0, ground, -np.inf)


def along_and_spare(velocity: Points, directions: Points, speed: float) -> tuple[Floats, Floats]:
    """Flow (n,) along directions (n, 2) of any length, and V^2 - |v_perp|^2 (n,)."""
    length = np.hypot(directions[:, 0], directions[:, 1])
    unit = directions / np.where(length > 0.0, length, 1.0)[:, None]
    along = unit[:, 0] * velocity[:, 0] + unit[:, 1] * velocity[:, 1]
    across = unit[:, 0] * velocity[:, 1] - unit[:, 1] * velocity[:, 0]
    return along, speed**2 - across**2


def travel_time(
    field: FlowField, waypoints_um: Points, speed_um_s: float, idle_um_s: float | None = None
) -> tuple[Floats, bool]:
    """Times at which a robot that follows a polyline passes its points, and whether it can follow it.

    The ground speed is taken in the middle of steps of at most a quarter of a pixel.

    Parameters
    ----------
    waypoints_um : (n, 2) points of the polyline.
    speed_um_s : V, speed through the fluid.
    idle_um_s : for a robot that saves energy, see `ground_speed`.

    Returns
    -------
    arrival_s (n,) since the first point, inf behind the first place where the flow is too fast; and feasible.
    """
    points = np.asarray(waypoints_um, np.float64)
    arrival = np.zeros(len(points))
    if len(points) < 2:
        return arrival, True
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    steps = np.maximum(1, np.ceil(lengths * _STEPS_PER_PX / field.um_per_px)).astype(np.int64)
    first = np.cumsum(steps) - steps
    leg = np.repeat(np.arange(len(legs)), steps)
    fraction = (np.arange(steps.sum()) - first[leg] + 0.5) / steps[leg]
    ground = ground_speed(field, points[leg] + fraction[:, None] * legs[leg], legs[leg], speed_um_s, idle_um_s)
    distance = (lengths / steps)[leg]
    possible = ground > 1e-9 * speed_um_s
    time = np.where(possible, distance / np.where(possible, ground, 1.0), np.inf)
    arrival[1:] = np.cumsum(np.add.reduceat(time, first))
    return arrival, bool(np.isfinite(arrival[-1]))


def no_route(method: str, reason: str) -> Route:
    """The message that there is no route."""
    return Route(0, 0, method, False, reason, np.zeros((0, 2)), np.zeros(0))


def with_remarks(route: Route, *remarks: str) -> Route:
    """The route with remarks, as far as there are any, before its own."""
    return replace(route, reason="; ".join(filter(None, (*remarks, route.reason))))


def timed_route(
    method: str, field: FlowField, path_um: Points, speed_um_s: float, idle_um_s: float | None = None
) -> Route:
    """The route along a path (n, 2) um, waypoints at most a pixel apart; none where the flow is too fast for it.

    With `idle_um_s` the robot swims at the speed that saves the most energy.
    """
    px = field.um_per_px
    waypoints = subdivide(path_um, px, 1e-6 * px)
    arrival, feasible = travel_time(field, waypoints, speed_um_s, idle_um_s)
    if not feasible:
        return no_route(method, too_fast(field, waypoints, speed_um_s))
    return Route(0, 0, method, True, "", waypoints, arrival)


def too_fast(field: FlowField, path_um: Points, speed_um_s: float) -> str:
    """Error text that names the place on a path (n, 2) um where the ground speed is lowest."""
    px = field.um_per_px
    points = subdivide(path_um, 0.25 * px, 0.25e-6 * px)
    middles, legs = 0.5 * (points[1:] + points[:-1]), np.diff(points, axis=0)
    worst = int(np.argmin(ground_speed(field, middles, legs, speed_um_s)))
    flow_um_s = float(np.hypot(*sample(field, middles[worst])))
    return (
        f"the flow is too fast: {flow_um_s:.0f} um/s at {middles[worst, 0]:.0f},{middles[worst, 1]:.0f} um, where the "
        f"plan counts on {speed_um_s:.0f} um/s through the fluid"
    )


def subdivide(path: Points, spacing: float, shortest: float, single_leg: int = 1) -> Points:
    """Polyline (n, 2) with further points, at most `spacing` apart, and without legs up to `shortest`.

    A path of one leg is divided into at least `single_leg` parts.
    """
    lengths = np.hypot(*np.diff(path, axis=0).T)
    kept = np.concatenate([[True], lengths > shortest])
    points, lengths = path[kept], lengths[kept[1:]]
    least = single_leg if len(lengths) == 1 else 1
    counts = np.maximum(least, np.ceil(lengths / spacing - 1e-9)).astype(np.int64)
    leg = np.repeat(np.arange(len(counts)), counts)
    fraction = (np.arange(counts.sum()) - (np.cumsum(counts) - counts)[leg]) / counts[leg]
    return np.concatenate([points[leg] + fraction[:, None] * np.diff(points, axis=0)[leg], points[-1:]])
