"""The controller stage: follow the route, or hold the place, whatever the flow does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.control.delay_compensation import FlowBelief, blend, remembered, roll_forward
from flowrec.control.policy import astray_um, downhill
from flowrec.control.tracking_laws import ff_fb_law, ff_fb_literal_law, saturated, shortened, vector_law
from flowrec.control.trajectory import bearable_pace, governed_pace, nearest_on, place_on, velocity_on
from flowrec.control.wall_barrier import guarded, least_room
from flowrec.flow import sample
from flowrec.messages import Demand, Estimate, FlowField, Mission, Route
from flowrec.ranges import PositiveShare, Range
from flowrec.robot import Robot
from flowrec.units import seconds

Vector = NDArray[np.float64]
Method = Literal["vector", "policy", "ff_fb", "ff_fb_literal", "ff_fb_no_flow", "ff_fb_observer"]
_FOLLOWING = ("survey", "navigate")
_USUAL_RADII_PER_S = 12.0
_LARGEST_SHARE = 0.3
_NEAR_RADII = 4.0


def _mapped_flow(field: FlowField | None, estimate: Estimate) -> Vector:
    return sample(field, estimate.position_um) if field is not None else estimate.flow_um_s


def _no_flow(_field: FlowField | None, _estimate: Estimate) -> Vector:
    return np.zeros(2)


def _observed_flow(_field: FlowField | None, estimate: Estimate) -> Vector:
    return estimate.flow_um_s


# The paper's law and those that it is compared with: the law itself, and the flow that it makes up for.
_PaperLaw = Callable[[Vector, Vector, Vector, float, float], Vector]
_PAPER: dict[str, tuple[_PaperLaw, Callable[[FlowField | None, Estimate], Vector]]] = {
    "ff_fb": (ff_fb_law, _mapped_flow),
    "ff_fb_literal": (ff_fb_literal_law, _mapped_flow),
    "ff_fb_no_flow": (ff_fb_law, _no_flow),
    "ff_fb_observer": (ff_fb_law, _observed_flow),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Aim:
    """What the robot is to do: be at the reference now, and at the other one, moving, when a demand takes effect.

    Under the policy there is a heading instead, and the reference is for people.
    """

    reference_um: Vector
    reference_then_um: Vector
    moving_um_s: Vector
    progress_s: float
    error_um: float
    heading: Vector | None = None

    @staticmethod
    def at_rest(place_um: Vector, position_um: Vector, progress_s: float) -> _Aim:
        return _Aim(place_um, place_um, np.zeros(2), progress_s, _distance(place_um, position_um))


@dataclass(frozen=True, slots=True)
class Controller:
    """Tracking with the flow compensated, or the planner's own policy (science.md, section 5).

    vector: u = sat(xd_dot - v(x+) + Kp (xd - x+)); x+ is the estimate rolled forward over the demands still on
    their way to the coils.
    policy: u = -V grad T / |grad T| at x+, with V the robot's limit and T the route's time to go; the slope is felt
    over a radius, or over a frame's way. No reference, and no new plan wherever the robot is blown. Beside the goal,
    and on a route without T (a survey), vector.
    ff_fb: the paper's feedforward-feedback law, made sound, with the map's flow; ff_fb_literal as it is printed,
    ff_fb_no_flow without flow compensation, ff_fb_observer with the observer's flow.

    Rates and times are meant for a robot that swims up to 12 of its radii in a second. For one that is faster, in
    smaller or swifter vessels, they are that much quicker, as far as the frame rate allows.
    """

    method: Method = "vector"
    kp_per_s: Annotated[float, Range(0.0, 1e3)] = 3.0  # of vector
    ff_fb_kp_per_s: Annotated[float, Range(0.0, 1e3)] = 1.0  # of ff_fb, as in the paper
    # the robot may be this far off before the reference slows down,
    lag_free_radii: Annotated[float, Range(0.0, 1e3)] = 0.5
    lag_full_radii: Annotated[float, Range(0.01, 1e3)] = 3.0  # and waits for it from here on
    # of the robot's limit that the reference may ask for; the rest is left to feedback
    pace_share: PositiveShare = 0.95
    # share of the flow's speed that the map is thought to be wrong by
    map_error: Annotated[float, Range(0.0, 10.0)] = 0.3
    # how far behind a changing flow an observer without a map is thought to be
    observer_lag_s: Annotated[float, Range(0.0, 60.0)] = 0.3
    # clearance kept from walls, in robot radii; 0: no wall guard
    guard_radii: Annotated[float, Range(0.0, 100.0)] = 1.1
    guard_per_s: Annotated[float, Range(0.01, 1e4)] = 12.0  # how fast the room left above that may be used up
    # so near to the goal, or a frame's way, the policy hands over to vector
    hold_radii: Annotated[float, Range(0.0, 1e3)] = 0.5
    # while the robot is not seen the demand dies away with this time constant
    blind_s: Annotated[float, Range(1e-3, 60.0)] = 0.5

    def control(
        self,
        previous: Demand | None,
        mission: Mission,
        route: Route | None,
        estimate: Estimate,
        field: FlowField | None,
        robot: Robot,
        clearance_um: NDArray[np.float32] | None,
        um_per_px: float,
        strength: float = 1.0,
        observer_knows_map: bool = False,
    ) -> Demand:
        """The demand after this frame, never above what the robot can do.

        In the phases survey and navigate the reference runs along the route, from its start when the phase begins;
        else it is the place where the phase found the robot. A finished mission asks for nothing. While the robot is
        held on its way, by the operator or because it is out of sight, the reference is the place where that found it;
        then it goes on along the route.

        Parameters
        ----------
        clearance_um : (h, w) distance to the walls at the pixels of the chip, None without walls.
        um_per_px : size of those pixels.
        strength : 0 to 1, the share of its full amplitude that the field has just now: the step-out goes with it.
        observer_knows_map : the estimate's flow is already that of the map, corrected (kalman_map).
        """
        if previous is not None and previous.stamp_ns == estimate.stamp_ns:
            return previous
        dt_s = seconds(estimate.stamp_ns - previous.stamp_ns) if previous is not None else 0.0
        limit_um_s = robot.speed_limit_at(strength)
        sent = previous.sent_um_s if previous is not None else np.zeros((0, 2))
        lag_s = 0.0 if observer_knows_map else self.observer_lag_s / _hurry(robot)
        belief = blend(field, estimate, sent, self.map_error, lag_s)
        point = roll_forward(estimate.position_um, sent, dt_s, robot.delay, belief)
        on_way = not mission.finished and mission.phase in _FOLLOWING
        if not on_way or route is None or not len(route.waypoints_um) or _held_since_ns(mission) is not None:
            place = self._place(previous, mission, estimate, point)
            # Held on its way, the robot goes on from there afterwards.
            left_s = previous.progress_s if on_way and previous is not None else 0.0
            aim = _Aim.at_rest(place, estimate.position_um, left_s)
        elif self.method == "policy" and route.time_to_go_s is not None:
            spacing_um = route.time_to_go_um_per_px or um_per_px
            aim = self._homing(route, route.time_to_go_s, estimate, belief.at(point), point, robot, spacing_um, dt_s)
        else:
            aim = self._following(previous, mission, route, estimate, belief, robot, limit_um_s, dt_s)
        demand, cut = np.zeros(2), False
        if not mission.finished and math.isfinite(aim.error_um):
            demand, cut = self._law(aim, estimate, field, belief, point, robot, limit_um_s, dt_s)
            if clearance_um is not None and self.guard_radii > 0.0:
                keep_um, per_s = self.guard_radii * robot.radius, _quicker(self.guard_per_s, robot, dt_s)
                if route is not None:
                    # Where the way leads through a gap with less room than that, the guard must not close it.
                    near_um = route.waypoints_um[_apart(route.waypoints_um, point) < _NEAR_RADII * robot.radius]
                    some_um = near_um[:: len(near_um) // 16 + 1]
                    keep_um = min(keep_um, max(least_room(some_um, clearance_um, um_per_px), robot.radius))
                demand = guarded(demand, belief.at(point), point, clearance_um, um_per_px, keep_um, per_s)
                demand, cut_again = shortened(demand, limit_um_s)
                cut = cut or cut_again
            if not estimate.seen:
                demand = self._blind(previous, demand, robot, dt_s)
        return Demand(
            stamp_ns=estimate.stamp_ns,
            velocity_um_s=demand,
            reference_um=aim.reference_um,
            progress_s=aim.progress_s,
            error_um=aim.error_um,
            saturated=cut,
            sent_um_s=remembered(sent, demand, dt_s, robot.delay),
        )

    def _following(
        self,
        previous: Demand | None,
        mission: Mission,
        route: Route,
        estimate: Estimate,
        belief: FlowBelief,
        robot: Robot,
        limit_um_s: float,
        dt_s: float,
    ) -> _Aim:
        """The reference on its way along the route, at a pace that the robot can keep up with."""
        if previous is None or mission.since_ns > previous.stamp_ns or route.stamp_ns > previous.stamp_ns:
            progress_s, pace = 0.0, 1.0
        else:
            place = place_on(route, previous.progress_s)
            planned = velocity_on(route, previous.progress_s, max(dt_s, 1e-3))
            pace = governed_pace(
                place - estimate.position_um,
                planned,
                self.lag_free_radii * robot.radius,
                self.lag_full_radii * robot.radius,
            )
            pace = bearable_pace(planned, belief.at(place), self.pace_share * limit_um_s, pace)
            progress_s = min(previous.progress_s + pace * dt_s, float(route.arrival_s[-1]))
        then_s = progress_s + pace * robot.delay
        reference = place_on(route, progress_s)
        return _Aim(
            reference_um=reference,
            reference_then_um=place_on(route, then_s),
            moving_um_s=pace * velocity_on(route, then_s, max(pace * dt_s, 1e-3)),
            progress_s=progress_s,
            error_um=_distance(reference, estimate.position_um),
        )

    def _homing(
        self,
        route: Route,
        time_to_go_s: NDArray[np.float32],
        estimate: Estimate,
        flow_um_s: Vector,
        point: Vector,
        robot: Robot,
        um_per_px: float,
        dt_s: float,
    ) -> _Aim:
        """Down the time to go, and to rest at its end."""
        goal = route.waypoints_um[-1]
        left_um = _distance(goal, point)
        drift = flow_um_s / robot.speed_limit_um_s
        fastest = 1.0 + _length(drift)  # over ground, as a share of the robot's own speed
        frame_um = robot.speed_limit_um_s * dt_s
        hold = left_um <= max(self.hold_radii * robot.radius, um_per_px, fastest * frame_um)
        progress_s = float(route.arrival_s[-1]) if hold else nearest_on(route, estimate.position_um)
        # The slope of pixels is felt over two of them; beyond the goal there is nothing to be felt.
        reach_um = min(max(robot.radius, 2.0 * um_per_px, frame_um), left_um / fastest)
        return _Aim(
            reference_um=goal if hold else place_on(route, progress_s),
            reference_then_um=goal,
            moving_um_s=np.zeros(2),
            progress_s=progress_s,
            # Off the route is no error where a way is known.
            error_um=astray_um(time_to_go_s, um_per_px, estimate.position_um),
            heading=None if hold else downhill(time_to_go_s, um_per_px, point, reach_um, drift),
        )

    @staticmethod
    def _place(previous: Demand | None, mission: Mission, estimate: Estimate, point: Vector) -> Vector:
        """Where to stay: as near as the robot can stop to where phase or hold found it, or it was found after a loss.

        NaN while it has not been seen, or not for so long that nothing is asked of it any more.
        """
        if previous is None or not np.isfinite(previous.reference_um).all():
            return point if estimate.seen else np.full(2, np.nan)
        if mission.finished:
            return previous.reference_um
        if not estimate.seen and not previous.velocity_um_s.any():
            return np.full(2, np.nan)
        since_ns, held_ns = mission.since_ns, _held_since_ns(mission)
        if held_ns is not None and mission.phase in _FOLLOWING:
            since_ns = max(since_ns, held_ns)
        return point if since_ns > previous.stamp_ns else previous.reference_um

    def _law(
        self,
        aim: _Aim,
        estimate: Estimate,
        field: FlowField | None,
        belief: FlowBelief,
        point: Vector,
        robot: Robot,
        limit_um_s: float,
        dt_s: float,
    ) -> tuple[Vector, bool]:
        """The demand (2,) um/s, walls aside, and whether the robot's limit cut it."""
        if aim.heading is not None:
            return limit_um_s * aim.heading, False
        if self.method in _PAPER:
            law, flow_of = _PAPER[self.method]
            error, flow = aim.reference_then_um - estimate.position_um, flow_of(field, estimate)
            return shortened(law(error, aim.moving_um_s, flow, self.ff_fb_kp_per_s, dt_s), limit_um_s)
        wanted = vector_law(aim.reference_then_um - point, aim.moving_um_s, _quicker(self.kp_per_s, robot, dt_s))
        return saturated(wanted, belief.at(point), limit_um_s)

    def _blind(self, previous: Demand | None, demand_um_s: Vector, robot: Robot, dt_s: float) -> Vector:
        """The demand while the robot is not seen: never more than what is left of the last one, in the end nothing."""
        last = previous.velocity_um_s if previous is not None else np.zeros(2)
        left_um_s = math.hypot(last[0], last[1]) * math.exp(-dt_s / self.blind_s)
        if left_um_s < 0.02 * robot.speed_limit_um_s:
            return np.zeros(2)
        return shortened(demand_um_s, left_um_s)[0]


def _held_since_ns(mission: Mission) -> int | None:
    """When the robot was told to stay, by the operator or for want of sight, whichever came first; None: it is not."""
    return min((ns for ns in (mission.held_since_ns, mission.blind_since_ns) if ns is not None), default=None)


def _hurry(robot: Robot) -> float:
    """How many times quicker than the robot that the settings are meant for."""
    assert robot.max_speed_um_s is not None
    return max(1.0, robot.max_speed_um_s / robot.radius / _USUAL_RADII_PER_S)


def _quicker(per_s: float, robot: Robot, dt_s: float) -> float:
    """A rate for this robot; what is held for a whole frame must not undo more than a third of an error in one."""
    return max(per_s, min(per_s * _hurry(robot), _LARGEST_SHARE / dt_s)) if dt_s > 0.0 else per_s


def _apart(points_um: NDArray[np.float64], point_um: Vector) -> NDArray[np.float64]:
    return np.asarray(np.hypot(points_um[:, 0] - point_um[0], points_um[:, 1] - point_um[1]))


def _length(vector: Vector) -> float:
    return math.hypot(vector[0], vector[1])


def _distance(a: Vector, b: Vector) -> float:
    return math.hypot(a[0] - b[0], a[1] - b[1])
