"""Another way while the robot is on one: to the same goal only if it is better by more than the map is uncertain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import FlowField, Route
from flowrec.physics import Chip, FlowUncertainty, Robot, fluid_image
from flowrec.stages.planning.cost_rasters import Points
from flowrec.stages.planning.planner import Planner
from flowrec.stages.planning.route import planning_speed_um_s, travel_time, with_remarks

# Of the time that is left: two plans of the same way in the same map may differ by about as much.
_NUMERICAL_SHARE = 0.01
_STEP = 0.2  # standard deviations of the flow, for a derivative


def better_route(
    planner: Planner,
    field: FlowField,
    uncertainty: FlowUncertainty | None,
    present: Route,
    from_s: float,
    goal_um: ArrayLike,
    chip: Chip,
    robot: Robot,
) -> Route:
    """The present route, or one that leaves it after `from_s` along it and is better in the new map `field`.

    Better: the present one can not be followed in the new map, or the other gains more time than
    `planner.replan_deviations` standard deviations of that gain, both in the new map. The gain is uncertain as the map
    is, in the same way for what both routes share. Times before `from_s` stay, so that the reference goes on.
    """
    from_s, at = _branch(present, from_s)
    ahead = present.arrival_s > from_s
    rest = np.concatenate([at[None], present.waypoints_um[ahead]])
    new = planner.plan(field, at, goal_um, chip, robot)
    if not new.reachable:
        return replace(present, reason=f"route kept: {new.reason}")
    speed_um_s = planning_speed_um_s(planner.speed_share, robot)

    def gain_s(flow: FlowField) -> float:
        """By how much the new way is faster in a flow; not finite where one of them is impossible."""
        (slow, _), (fast, _) = (travel_time(flow, points, speed_um_s) for points in (rest, new.waypoints_um))
        return float(slow[-1] - fast[-1])

    gain = gain_s(field)
    if math.isinf(gain):
        said = "the way so far is impossible in the refined flow: another is taken"
    else:
        noise = _noise_s(gain_s, gain, field, uncertainty, chip)
        noise = math.hypot(noise, _NUMERICAL_SHARE * new.lasts_s)
        if not gain > planner.replan_deviations * noise:
            return replace(present, reason=f"route kept: another would gain {gain:.1f} +- {noise:.1f} s")
        said = f"another route gains {gain:.1f} +- {noise:.1f} s"
    return _join_routes(present, from_s, new, said)


def route_elsewhere(
    planner: Planner, field: FlowField, present: Route, from_s: float, goal_um: Points, chip: Chip, robot: Robot
) -> Route:
    """A route that leaves the present one after `from_s` along it for another goal (2,), stated as its `goal_um`.

    The present one, with the reason, where there is none. Times before `from_s` stay, as in `better_route`.
    """
    from_s, at = _branch(present, from_s)
    new = planner.plan(field, at, goal_um, chip, robot)
    if not new.reachable:
        return replace(present, reason=new.reason)
    said = f"to {goal_um[0]:.0f}, {goal_um[1]:.0f} um in {new.lasts_s:.1f} s"
    return replace(_join_routes(present, from_s, new, said), goal_um=goal_um)


def _branch(present: Route, from_s: float) -> tuple[float, Points]:
    """A time along a route and the place (2,) where it is then."""
    from_s = min(max(from_s, 0.0), present.lasts_s)
    return from_s, np.array([np.interp(from_s, present.arrival_s, present.waypoints_um[:, c]) for c in (0, 1)])


def _join_routes(present: Route, from_s: float, new: Route, said: str) -> Route:
    """The present route up to a time along it, then a new one."""
    before = present.arrival_s <= from_s
    if before.any() and present.arrival_s[before][-1] >= from_s:  # the place itself is a waypoint
        before = present.arrival_s < from_s
    return replace(
        with_remarks(new, said),
        waypoints_um=np.concatenate([present.waypoints_um[before], new.waypoints_um]),
        arrival_s=np.concatenate([present.arrival_s[before], from_s + new.arrival_s]),
    )


def _noise_s(
    gain_s: Callable[[FlowField], float], gain: float, field: FlowField, uncertainty: FlowUncertainty | None, chip: Chip
) -> float:
    """Standard deviation of a gain that follows from that of the flow, to first order; 0 where none is known.

    inf where a small change of the flow already makes one of the ways impossible.
    """
    if uncertainty is None:
        return 0.0
    count = len(uncertainty.columns_um_s)
    variance, axes = np.linalg.eigh(uncertainty.covariance[:count, :count])
    squares = 0.0
    for deviation, axis in zip(_STEP * np.sqrt(np.maximum(variance, 0.0)), axes.T, strict=True):
        change = np.tensordot(deviation * axis, uncertainty.columns_um_s, axes=1).astype(np.float32)
        changed = gain_s(replace(field, velocity_um_s=field.velocity_um_s + fluid_image(chip.mask, change)))
        squares += ((changed - gain) / _STEP) ** 2
    return math.sqrt(squares) if math.isfinite(squares) else math.inf
