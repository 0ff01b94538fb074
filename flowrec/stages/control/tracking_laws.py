"""The tracking laws: from the reference and the estimate to the velocity demanded of the robot.

All vectors are (2,) in um and um/s. A law is a row of CONTROLLERS (controller.py): a frozen dataclass whose fields are
the settings of `Controller` that the row names, with the methods of `TrackingLaw`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from flowrec.core import Demand, Estimate, Floats, FlowField, Mission, Route
from flowrec.physics import Robot, sample
from flowrec.stages.control.delay_compensation import CorrectedFlow

_LARGEST_CORRECTION = 0.3  # of an error, within one frame


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """Inputs of a tracking law for one frame."""

    previous: Demand | None
    mission: Mission
    route: Route | None
    estimate: Estimate
    field: FlowField | None
    flow: CorrectedFlow
    robot: Robot
    predicted_um: Floats  # position of the robot when a demand of now takes effect
    limit_um_s: float  # largest speed that may be demanded
    dt_s: float  # since the previous frame, 0 on the first
    um_per_px: float  # of the chip's mask

    @property
    def flow_um_s(self) -> Floats:
        """Flow at the predicted position."""
        return self.flow.at(self.predicted_um)

    def scaled_rate(self, per_s: float) -> float:
        """A rate in proportion to the robot's speed; a third of an error at most is corrected within one frame."""
        if self.dt_s <= 0.0:
            return per_s
        return max(per_s, min(per_s * self.robot.speed_ratio, _LARGEST_CORRECTION / self.dt_s))


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Reference position now, and position and velocity at the time when the present demand takes effect."""

    position_um: Floats
    future_um: Floats
    velocity_um_s: Floats
    progress_s: float  # time along the route
    error_um: float
    heading: Floats | None = None  # direction to swim in; a policy sets it, and the positions only inform people

    @staticmethod
    def at_rest(position_um: Floats, estimate: Estimate, progress_s: float) -> Reference:
        """The reference that holds a position."""
        error_um = math.dist(position_um, estimate.position_um)
        return Reference(position_um, position_um, np.zeros(2), progress_s, error_um)


class TrackingLaw(ABC):
    """A method of the control stage."""

    def reference(self, now: Situation) -> Reference | None:
        """The law's own reference on a route; None: the trajectory's."""
        return None

    @abstractmethod
    def velocity(self, now: Situation, reference: Reference) -> tuple[Floats, bool]:
        """The demand without regard to walls, and whether the speed limit reduced it."""


@dataclass(frozen=True, slots=True)
class VectorLaw(TrackingLaw):
    """u = sat(xd_dot - v(x+) + Kp (xd - x+)), where x+ is the predicted position."""

    kp_per_s: float

    def velocity(self, now: Situation, reference: Reference) -> tuple[Floats, bool]:
        """As in TrackingLaw."""
        error = reference.future_um - now.predicted_um
        over_ground = reference.velocity_um_s + now.scaled_rate(self.kp_per_s) * error
        return compensate_flow(over_ground, now.flow_um_s, now.limit_um_s)


@dataclass(frozen=True, slots=True)
class FeedforwardFeedback(TrackingLaw):
    """The feedforward-feedback law of the paper with its two defects corrected.

    |u| = |xd_dot - v| + Kp (e_x cos phi + e_y sin phi), where the heading phi is the mean of those of xd_dot - v and of
    e = xd - x - v dt, weighted by the errors along and across the heading of xd_dot. Unlike the printed law, the mean
    is one of directions on the circle, and it is the feedforward's where there is no error.
    """

    ff_fb_kp_per_s: float

    def velocity(self, now: Situation, reference: Reference) -> tuple[Floats, bool]:
        """As in TrackingLaw."""
        error = reference.future_um - now.estimate.position_um
        return limit_length(self.law(error, reference.velocity_um_s, self.flow(now), now.dt_s), now.limit_um_s)

    def flow(self, now: Situation) -> Floats:
        """The flow that is compensated: that of the map, or of the observer without a map."""
        return sample(now.field, now.estimate.position_um) if now.field is not None else now.estimate.flow_um_s

    def law(self, error_um: Floats, velocity_um_s: Floats, flow_um_s: Floats, dt_s: float) -> Floats:
        """The demand (2,) before the speed limit; `error_um` is xd - x, `velocity_um_s` is xd_dot."""
        e = error_um - flow_um_s * dt_s
        feedforward = velocity_um_s - flow_um_s
        course = math.atan2(velocity_um_s[1], velocity_um_s[0])
        along = abs(math.cos(course) * e[0] + math.sin(course) * e[1])
        across = abs(-math.sin(course) * e[0] + math.cos(course) * e[1])
        weight = across / (along + across) if along + across > 1e-9 else 0.0
        heading = self.mean_heading(math.atan2(feedforward[1], feedforward[0]), math.atan2(e[1], e[0]), weight)
        unit = np.array([math.cos(heading), math.sin(heading)])
        return (math.hypot(*feedforward) + self.ff_fb_kp_per_s * float(e @ unit)) * unit

    def mean_heading(self, feedforward: float, feedback: float, weight: float) -> float:
        """The heading at a fraction `weight` of the shorter arc from one to the other."""
        turn = feedback - feedforward
        return feedforward + weight * math.atan2(math.sin(turn), math.cos(turn))


class LiteralFeedforwardFeedback(FeedforwardFeedback):
    """The law as the paper prints it: the arithmetic mean of two angles, which wraps around. Only 0/0 is avoided."""

    def mean_heading(self, feedforward: float, feedback: float, weight: float) -> float:
        """The arithmetic mean, which for 179 and -179 degrees is 0."""
        return (1.0 - weight) * feedforward + weight * feedback


class UncompensatedFeedforwardFeedback(FeedforwardFeedback):
    """The law without flow compensation."""

    def flow(self, now: Situation) -> Floats:
        """Zero."""
        return np.zeros(2)


class ObserverFeedforwardFeedback(FeedforwardFeedback):
    """The law with the observer's flow."""

    def flow(self, now: Situation) -> Floats:
        """The observer's, whether there is a map or not."""
        return now.estimate.flow_um_s


def compensate_flow(over_ground_um_s: Floats, flow_um_s: Floats, limit_um_s: float) -> tuple[Floats, bool]:
    """The demand relative to the fluid for a velocity g over ground, and whether the limit reduced it.

    To keep the robot on its course, the flow across it is compensated first: of all u = s g - v within the limit, this
    is the one with s nearest to 1. Where the flow across the course alone exceeds the limit, u opposes it entirely.
    """
    demand = over_ground_um_s - flow_um_s
    if math.hypot(*demand) <= limit_um_s:
        return demand, False
    within = factors_within(over_ground_um_s, flow_um_s, limit_um_s)
    if within is None:
        return limit_length(demand, limit_um_s)
    s = min(max(1.0, within[0]), within[1])
    return limit_length(s * over_ground_um_s - flow_um_s, limit_um_s)[0], True


def factors_within(over_ground_um_s: Floats, flow_um_s: Floats, limit_um_s: float) -> tuple[float, float] | None:
    """The least and the largest s for which |s g - v| is within the limit, of a velocity g over ground in a flow v.

    Where there is none, both are the s of the least speed. None: g is zero.
    """
    gg = float(over_ground_um_s @ over_ground_um_s)
    if gg <= 0.0:
        return None
    gv = float(over_ground_um_s @ flow_um_s)
    root = math.sqrt(max(gv * gv - gg * (float(flow_um_s @ flow_um_s) - limit_um_s**2), 0.0))
    return (gv - root) / gg, (gv + root) / gg


def limit_length(vector: Floats, limit: float) -> tuple[Floats, bool]:
    """The vector, scaled down to a length if it is longer, and whether it was."""
    length = math.hypot(*vector)
    return (vector, False) if length <= limit else (vector * (limit / length), True)
