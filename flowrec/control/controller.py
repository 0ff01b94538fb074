"""The controller stage: follow the route, or hold the place, whatever the flow does."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.control.laws import ff_fb_law, saturated, shortened, vector_law
from flowrec.control.prediction import FlowBelief, blend, remembered, roll_forward
from flowrec.control.reference import governed_pace, place_on, velocity_on
from flowrec.control.walls import guarded
from flowrec.flow import sample
from flowrec.messages import Demand, Estimate, FlowField, Mission, Route
from flowrec.robot import Robot
from flowrec.units import seconds

Vector = NDArray[np.float64]
_FOLLOWING = ("survey", "navigate")
_USUAL_RADII_PER_S = 12.0
_LARGEST_SHARE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Aim:
    """What the robot is to do: be at the reference now, and at the other one, moving, when a demand takes effect."""

    reference_um: Vector
    reference_then_um: Vector
    moving_um_s: Vector
    progress_s: float

    @staticmethod
    def at_rest(place_um: Vector) -> _Aim:
        return _Aim(place_um, place_um, np.zeros(2), 0.0)


@dataclass(frozen=True, slots=True)
class Controller:
    """Tracking with the flow compensated (science.md, section 5).

    vector: u = sat(xd_dot - v(x+) + Kp (xd - x+)); x+ is the estimate rolled forward over the demands still on
    their way to the coils. ff_fb: the paper's feedforward-feedback law, made sound.

    Rates and times are meant for a robot that swims up to 12 of its radii in a second. For one that is faster, in
    smaller or swifter vessels, they are that much quicker, as far as the frame rate allows.
    """

    method: Literal["vector", "ff_fb"] = "vector"
    kp_per_s: float = 3.0  # of vector
    ff_fb_kp_per_s: float = 1.0  # of ff_fb, as in the paper
    lag_free_radii: float = 0.5  # the robot may be this far off before the reference slows down,
    lag_full_radii: float = 3.0  # and waits for it from here on
    map_error: float = 0.3  # share of the flow's speed that the map is thought to be wrong by
    observer_lag_s: float = 0.3  # how far behind a changing flow the observer is thought to be
    guard_radii: float = 1.1  # clearance kept from walls, in robot radii; 0: no wall guard
    guard_per_s: float = 5.0  # how fast the room left above that may be used up
    blind_s: float = 0.5  # while the robot is not seen the demand dies away with this time constant

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
    ) -> Demand:
        """The demand after this frame.

        In the phases survey and navigate the reference runs along the route, from its start when the phase begins;
        else it is the place where the phase found the robot. A finished mission asks for nothing.

        Parameters
        ----------
        clearance_um : (h, w) distance to the walls at the pixels of the chip, None without walls.
        um_per_px : size of those pixels.
        """
        if previous is not None and previous.stamp_ns == estimate.stamp_ns:
            return previous
        dt_s = seconds(estimate.stamp_ns - previous.stamp_ns) if previous is not None else 0.0
        sent = previous.sent_um_s if previous is not None else np.zeros((0, 2))
        belief = blend(field, estimate, sent, self.map_error, self.observer_lag_s / _hurry(robot))
        point = roll_forward(estimate.position_um, sent, dt_s, robot.delay, belief)
        aim = self._aim(previous, mission, route, estimate, point, robot, dt_s)
        error = aim.reference_um - estimate.position_um
        demand, saturated = np.zeros(2), False
        if not mission.finished and np.isfinite(error).all():
            demand, saturated = self._law(aim, estimate, field, belief, point, robot, clearance_um, um_per_px, dt_s)
            if not estimate.seen:
                demand = self._blind(previous, demand, robot, dt_s)
        return Demand(
            stamp_ns=estimate.stamp_ns,
            velocity_um_s=demand,
            reference_um=aim.reference_um,
            progress_s=aim.progress_s,
            error_um=math.hypot(error[0], error[1]),
            saturated=saturated,
            sent_um_s=remembered(sent, demand, dt_s, robot.delay),
        )

    def _aim(
        self,
        previous: Demand | None,
        mission: Mission,
        route: Route | None,
        estimate: Estimate,
        point: Vector,
        robot: Robot,
        dt_s: float,
    ) -> _Aim:
        """The reference of this frame; `point` is where the robot will be when the demand takes effect."""
        began = previous is None or mission.since_ns > previous.stamp_ns
        if mission.finished or mission.phase not in _FOLLOWING or route is None or not route.reachable:
            return _Aim.at_rest(self._place(previous, began, mission, estimate, point))
        if previous is None or began or route.stamp_ns > previous.stamp_ns:
            progress_s, pace = 0.0, 1.0
        else:
            span_s = max(dt_s, 1e-3)
            pace = governed_pace(
                place_on(route, previous.progress_s) - estimate.position_um,
                velocity_on(route, previous.progress_s, span_s),
                self.lag_free_radii * robot.radius,
                self.lag_full_radii * robot.radius,
            )
            progress_s = min(previous.progress_s + pace * dt_s, float(route.arrival_s[-1]))
        then_s = progress_s + pace * robot.delay
        return _Aim(
            reference_um=place_on(route, progress_s),
            reference_then_um=place_on(route, then_s),
            moving_um_s=pace * velocity_on(route, then_s, max(pace * dt_s, 1e-3)),
            progress_s=progress_s,
        )

    @staticmethod
    def _place(previous: Demand | None, began: bool, mission: Mission, estimate: Estimate, point: Vector) -> Vector:
        """Where to stay: as near as the robot can stop to where the phase found it, or it was found after a loss.

        NaN while it has not been seen, or not for so long that nothing is asked of it any more.
        """
        if previous is None or not np.isfinite(previous.reference_um).all():
            return point if estimate.seen else np.full(2, np.nan)
        if mission.finished:
            return previous.reference_um
        if not estimate.seen and not previous.velocity_um_s.any():
            return np.full(2, np.nan)
        return point if began else previous.reference_um

    def _law(
        self,
        aim: _Aim,
        estimate: Estimate,
        field: FlowField | None,
        belief: FlowBelief,
        point: Vector,
        robot: Robot,
        clearance_um: NDArray[np.float32] | None,
        um_per_px: float,
        dt_s: float,
    ) -> tuple[Vector, bool]:
        """The demand (2,) um/s and whether the robot's limit cut it."""
        limit_um_s = robot.speed_limit_um_s
        if self.method == "vector":
            flow = belief.at(point)
            wanted = vector_law(aim.reference_then_um - point, aim.moving_um_s, _quicker(self.kp_per_s, robot, dt_s))
            demand, cut = saturated(wanted, flow, limit_um_s)
        else:
            point = estimate.position_um
            flow = sample(field, point) if field is not None else estimate.flow_um_s
            wanted = ff_fb_law(aim.reference_um - point, aim.moving_um_s, flow, self.ff_fb_kp_per_s, dt_s)
            demand, cut = shortened(wanted, limit_um_s)
        if clearance_um is None or self.guard_radii <= 0.0:
            return demand, cut
        keep_um = self.guard_radii * robot.radius
        demand = guarded(demand, flow, point, clearance_um, um_per_px, keep_um, _quicker(self.guard_per_s, robot, dt_s))
        demand, cut_again = shortened(demand, limit_um_s)
        return demand, cut or cut_again

    def _blind(self, previous: Demand | None, demand_um_s: Vector, robot: Robot, dt_s: float) -> Vector:
        """The demand while the robot is not seen: never more than what is left of the last one, in the end nothing."""
        last = previous.velocity_um_s if previous is not None else np.zeros(2)
        left_um_s = math.hypot(last[0], last[1]) * math.exp(-dt_s / self.blind_s)
        if left_um_s < 0.02 * robot.speed_limit_um_s:
            return np.zeros(2)
        return shortened(demand_um_s, left_um_s)[0]


def _hurry(robot: Robot) -> float:
    """How many times quicker than the robot that the settings are meant for."""
    assert robot.max_speed_um_s is not None
    return max(1.0, robot.max_speed_um_s / robot.radius / _USUAL_RADII_PER_S)


def _quicker(per_s: float, robot: Robot, dt_s: float) -> float:
    """A rate for this robot; what is held for a whole frame must not undo more than a third of an error in one."""
    return max(per_s, min(per_s * _hurry(robot), _LARGEST_SHARE / dt_s)) if dt_s > 0.0 else per_s
