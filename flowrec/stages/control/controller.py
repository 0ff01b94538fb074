"""The control stage: follow the route, or hold a position, in any flow.

A control barrier function limits the speed towards a wall in proportion to the remaining distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np

from flowrec.core import (
    Demand,
    Estimate,
    Floats,
    Floats32,
    FlowField,
    Method,
    Methods,
    Mission,
    Phase,
    PositiveShare,
    Range,
    Route,
    bilinear,
    cell_at,
    compiled,
)
from flowrec.physics import CONTROL, Robot
from flowrec.stages.control.delay_compensation import append_demand, corrected_flow, predict_position
from flowrec.stages.control.tracking_laws import Reference, Situation, TrackingLaw, limit_length
from flowrec.stages.control.trajectory import follow

_LEAST_SLOPE = 0.3  # below this gradient of the clearance the point is in the middle between two walls
_NEAR_RADII = 4.0  # waypoints within this distance count
_MOST_WAYPOINTS = 16  # of those near the robot that are compared in a tick


def wall_barrier(
    demand_um_s: Floats, now: Situation, clearance_um: Floats32, keep_um: float, per_s: float
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
    waypoints_um: Floats, x_um: float, y_um: float, near_um: float, clearance_um: Floats32, um_per_px: float
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


def clearance_and_slope(clearance_um: Floats32, point_px: Floats) -> tuple[float, Floats]:
    """Clearance at a point (x, y) in px, bilinear, and its gradient (2,) per pixel."""
    row, column, *_, a, b = cell_at(float(point_px[0]), float(point_px[1]), clearance_um.shape)
    (upper_left, upper_right), (lower_left, lower_right) = clearance_um[row : row + 2, column : column + 2].tolist()
    value = (1 - b) * ((1 - a) * upper_left + a * upper_right) + b * ((1 - a) * lower_left + a * lower_right)
    right = (1 - b) * (upper_right - upper_left) + b * (lower_right - lower_left)
    down = (1 - a) * (lower_left - upper_left) + a * (lower_right - upper_right)
    return value, np.array([right, down])


_FOLLOWING = (Phase.SURVEY, Phase.NAVIGATE)
_NOTHING_SENT = np.zeros((0, 2))
_NOTHING_SENT.flags.writeable = False  # as the array of a message is: kernels are compiled for either kind
_LEAST_SPEED = 0.02  # of the robot's limit: a demand below it is zero while the robot is not seen

_LAWS = "flowrec.stages.control.tracking_laws:"
_FF_FB = ("ff_fb_kp_per_s",)
CONTROLLERS = Methods(
    "control.method",
    Method("vector", f"{_LAWS}VectorLaw", "proportional tracking with the flow compensated", ("kp_per_s",)),
    Method(
        "policy",
        "flowrec.stages.control.policy:Policy",
        "descends the gradient of the planner's time to go, without a reference",
        ("kp_per_s", "hold_radii"),
        needs=("time_to_go",),
    ),
    Method("ff_fb", f"{_LAWS}FeedforwardFeedback", "the paper's feedforward-feedback law, corrected", _FF_FB),
    Method("ff_fb_literal", f"{_LAWS}LiteralFeedforwardFeedback", "the paper's law as printed", _FF_FB),
    Method("ff_fb_no_flow", f"{_LAWS}UncompensatedFeedforwardFeedback", "ff_fb without flow compensation", _FF_FB),
    Method("ff_fb_observer", f"{_LAWS}ObserverFeedforwardFeedback", "ff_fb with the observer's flow", _FF_FB),
    group="flowrec.controllers",
    verb="velocity",
)


@dataclass(frozen=True, slots=True)
class Controller:
    """Steers the robot along its route; `method` selects a row of CONTROLLERS.

    Rates and times are meant for a robot that swims up to 12 of its radii per second. They are scaled for one that is
    faster, as far as the frame rate permits.
    """

    method: Annotated[str, CONTROLLERS] = "vector"
    kp_per_s: Annotated[float, Range(0.0, 1e3)] = 3.0  # proportional gain Kp of vector
    ff_fb_kp_per_s: Annotated[float, Range(0.0, 1e3)] = 1.0  # proportional gain Kp of the paper's laws, as in the paper
    # error of the robot up to which the reference keeps its planned pace
    lag_free_radii: Annotated[float, Range(0.0, 1e3)] = 0.5
    lag_full_radii: Annotated[float, Range(0.01, 1e3)] = 3.0  # error at which the reference stops and waits
    # fraction of the robot's limit that the reference may use; feedback uses the rest
    pace_share: PositiveShare = 0.95
    # standard deviation of the map, as a fraction of the flow's speed; None: from the map
    map_error: Annotated[float, Range(0.0, 10.0)] | None = None
    # assumed lag of an observer without a map behind a changing flow
    observer_lag_s: Annotated[float, Range(0.0, 60.0)] = 0.3
    # clearance that the wall barrier keeps, in robot radii; 0: no wall barrier
    guard_radii: Annotated[float, Range(0.0, 100.0)] = 1.1
    guard_per_s: Annotated[float, Range(0.01, 1e4)] = 12.0  # largest ratio of the speed towards a wall and the distance
    # within this distance of the goal, or that of a frame, policy changes to vector
    hold_radii: Annotated[float, Range(0.0, 1e3)] = 0.5
    # time constant with which the demand decays while the robot is not seen
    blind_s: Annotated[float, Range(1e-3, 60.0)] = 0.5

    @property
    def needs(self) -> tuple[str, ...]:
        """Requirements of the method on other stages, see `Method`; empty for a package that is not installed."""
        return CONTROLLERS[self.method].needs if self.method in CONTROLLERS else ()

    def control(
        self,
        previous: Demand | None,
        mission: Mission,
        route: Route | None,
        estimate: Estimate,
        field: FlowField | None,
        robot: Robot,
        clearance_um: Floats32 | None,
        um_per_px: float,
        strength: float = 1.0,
        estimate_uses_map: bool = False,
        driven_um_s: Floats | None = None,
        hand_share: Floats | None = None,
    ) -> Demand:
        """The demand after this frame, never above the robot's speed limit.

        In the phases survey and navigate the reference runs along the route, from its start when the phase begins; in
        the others it is the position at which the phase found the robot. A finished mission demands nothing. While the
        robot is held on its way, by the operator or because it is out of sight, the reference is the position where the
        hold began; afterwards it continues along the route. Raises UsageError: `method` is not in the table.

        Parameters
        ----------
        clearance_um : (h, w) distance to the walls at the pixels of the chip, None without walls.
        um_per_px : size of those pixels.
        strength : 0 to 1, present fraction of the field's full amplitude; the step-out frequency is proportional to it.
        estimate_uses_map : the observer corrects the map (kalman_map), so it does not lag behind it.
        hand_share : (2,) velocity over the speed limit by which a hand steers, in the place of the method; None: none
            does.
        driven_um_s : (2,) velocity to demand without any feedback, as the check of the axes does; None: control it.
        """
        if previous is not None and previous.stamp_ns == estimate.stamp_ns:
            return previous
        law = _law(self)
        dt_s = estimate.since_s(previous)
        sent = previous.sent_um_s if previous is not None else _NOTHING_SENT
        lag_s = 0.0 if estimate_uses_map else self.observer_lag_s / robot.speed_ratio
        flow = corrected_flow(field, estimate, sent, CONTROL.of(field, self.map_error), lag_s)
        now = Situation(
            previous=previous,
            mission=mission,
            route=route,
            estimate=estimate,
            field=field,
            flow=flow,
            robot=robot,
            predicted_um=predict_position(estimate.position_um, sent, dt_s, robot.delay_s, flow),
            limit_um_s=robot.speed_limit_at(strength),
            dt_s=dt_s,
            um_per_px=um_per_px,
        )
        reference = self._reference(now, law, driven=driven_um_s is not None)
        demand, saturated = np.zeros(2), False
        if driven_um_s is not None:
            if estimate.seen and not mission.finished:
                demand, saturated = limit_length(driven_um_s, now.limit_um_s)
        elif not mission.finished and math.isfinite(reference.error_um):
            demand, saturated = law.velocity(now, reference) if hand_share is None else _by_hand(now, hand_share)
            if clearance_um is not None and self.guard_radii > 0.0:
                keep_um, per_s = self.guard_radii * robot.radius_um, now.scaled_rate(self.guard_per_s)
                demand, limited = wall_barrier(demand, now, clearance_um, keep_um, per_s)
                saturated = saturated or limited
            if not estimate.seen:
                demand = self._decay_demand(now, demand)
        return Demand(
            stamp_ns=estimate.stamp_ns,
            velocity_um_s=demand,
            reference_um=reference.position_um,
            progress_s=reference.progress_s,
            error_um=reference.error_um,
            saturated=saturated,
            sent_um_s=append_demand(sent, demand, dt_s, robot.delay_s),
        )

    def _reference(self, now: Situation, law: TrackingLaw, *, driven: bool) -> Reference:
        """On the way along the route, or at rest; of a robot that is driven or taken by hand where it is."""
        if now.mission.by_hand:  # and afterwards goes on along the route from where it was taken
            return Reference.at_rest(now.predicted_um, now.estimate, now.previous.progress_s if now.previous else 0.0)
        if driven:
            return Reference.at_rest(_where_it_is(now), now.estimate, 0.0)
        route = now.route
        following = not now.mission.finished and now.mission.phase in _FOLLOWING
        if not following or route is None or not len(route.waypoints_um) or _hold_ns(now.mission) is not None:
            # A robot that is held on its way continues from there afterwards.
            progress_s = now.previous.progress_s if following and now.previous is not None else 0.0
            return Reference.at_rest(_hold_position(now), now.estimate, progress_s)
        own = law.reference(now)
        if own is not None:
            return own
        radius_um = now.robot.radius_um
        lag_free_um, lag_full_um = self.lag_free_radii * radius_um, self.lag_full_radii * radius_um
        return follow(now, route, lag_free_um, lag_full_um, self.pace_share)

    def _decay_demand(self, now: Situation, demand_um_s: Floats) -> Floats:
        """The demand while the robot is not seen: limited by the decay of the previous one, finally zero."""
        last = now.previous.velocity_um_s if now.previous is not None else np.zeros(2)
        limit_um_s = math.hypot(*last) * math.exp(-now.dt_s / self.blind_s)
        if limit_um_s < _LEAST_SPEED * now.robot.speed_limit_um_s:
            return np.zeros(2)
        return limit_length(demand_um_s, limit_um_s)[0]


@lru_cache(maxsize=16)
def _law(settings: Controller) -> TrackingLaw:
    """The method of a controller with the settings that its row names."""
    return CONTROLLERS[settings.method].build(settings)


def _by_hand(now: Situation, share: Floats) -> tuple[Floats, bool]:
    """The velocity that a hand asks for, and whether the limit reduced it."""
    return limit_length(share * now.limit_um_s, now.limit_um_s)


def _where_it_is(now: Situation) -> Floats:
    """The predicted position, from which the robot is held afterwards; NaN where it is not seen."""
    return now.predicted_um if now.estimate.seen else np.full(2, np.nan)


def _hold_position(now: Situation) -> Floats:
    """Position to hold: the predicted one when the phase or the hold began, or when the robot was found again.

    NaN before the robot is seen for the first time, when it has not been seen for so long that the demand is zero, and
    where it is only observed.
    """
    previous, mission = now.previous, now.mission
    if mission.phase == Phase.OBSERVE:
        return np.full(2, np.nan)
    if previous is None or not np.isfinite(previous.reference_um).all():
        return _where_it_is(now)
    if mission.finished:
        return previous.reference_um
    if not now.estimate.seen and not previous.velocity_um_s.any():
        return np.full(2, np.nan)
    hold_ns = _hold_ns(mission)  # a mission that is held stays in its phase
    since_ns = hold_ns if hold_ns is not None and mission.phase in _FOLLOWING else mission.since_ns
    return now.predicted_um if since_ns > previous.stamp_ns else previous.reference_um


def _hold_ns(mission: Mission) -> int | None:
    """Time at which the hold began, by the operator or because the robot was not seen; None: no hold."""
    return min((ns for ns in (mission.held_since_ns, mission.blind_since_ns) if ns is not None), default=None)
