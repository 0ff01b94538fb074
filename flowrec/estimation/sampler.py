"""Estimates along the way to Observations: the local flow that a refinement may use."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from flowrec.estimation.kalman import behind_s, memory_s
from flowrec.estimation.trimmed import Trimmed
from flowrec.messages import Estimate, Observations
from flowrec.ranges import Range, Share
from flowrec.robot import Robot
from flowrec.units import nanoseconds, seconds


@dataclass(frozen=True, slots=True)
class Sampler:
    """Keeps one observation every so often. The filter's memory makes neighbours alike and late; both are allowed for.

    A filter that weighs position and velocity by gains K_x and K_v and takes the flow for constant answers to a
    changing one K_x / K_v later; one that knows the slopes or a map hardly lags. An observation is therefore placed
    where the robot was that long ago, and its standard deviation is raised so that observations closer in time than
    the filter remembers do not count the same noise twice.
    """

    spacing_radii: Annotated[float, Range(0.0, 1e3)] = 0.8  # least way between two observations, in radii of the robot
    memories: Annotated[float, Range(0.0, 1e3)] = 2.0  # and least time, in memories of the filter
    # no observation while the flow's sigma is above this share of the robot's top speed
    settled_share: Annotated[float, Range(0.0, 10.0)] = 0.1
    floor_um_s: Annotated[float, Range(1e-3, 1e4)] = 2.0  # no observation claims a smaller sigma
    rolling_share: Share = 0.02  # of the robot's own speed, one sigma: rolled off course, which passes for flow
    capacity: Annotated[int, Range(1, 100_000)] = 2000  # the oldest go first
    # trimmed: as in the paper, before a refinement uses them; smoothed: by the RTS smoother, in a replay only.
    method: Literal["filter", "trimmed", "smoothed"] = "filter"
    trimmed: Trimmed = field(default_factory=Trimmed)

    def treat(self, observations: Observations) -> Observations:
        """What a refinement is given of them."""
        return self.trimmed.treat(observations) if self.method == "trimmed" else observations

    def collect(
        self, previous: Observations | None, before: Estimate | None, estimate: Estimate, robot: Robot
    ) -> Observations | None:
        """The observations after this frame; the previous object itself when none is due."""
        variance = 0.5 * (estimate.covariance[2, 2] + estimate.covariance[3, 3])
        if before is None or not estimate.seen or not before.seen:
            return previous
        if not estimate.nis < 25.0 and not math.isnan(estimate.nis):
            return previous
        if variance > (self.settled_share * robot.max_speed_um_s) ** 2:
            return previous
        lag_s = memory_s(estimate.covariance)
        dt = seconds(estimate.stamp_ns - before.stamp_ns)
        if dt <= 0.0:
            return previous
        velocity = (estimate.position_um - before.position_um) / dt
        position = estimate.position_um - behind_s(estimate) * velocity
        if previous is not None and len(previous.position_um):
            way = math.dist(position, previous.position_um[-1])
            soon = estimate.stamp_ns < previous.stamp_ns + nanoseconds(self.memories * lag_s)
            if soon or way < self.spacing_radii * robot.radius_um:
                return previous
            wait_s = seconds(estimate.stamp_ns - previous.stamp_ns)
        else:
            wait_s = math.inf
        own_um_s = math.hypot(*(velocity - estimate.flow_um_s))
        spread = variance * (1.0 + 2.0 * lag_s / wait_s) + (self.rolling_share * own_um_s) ** 2
        sigma = max(self.floor_um_s, math.sqrt(spread))
        if previous is None:
            return Observations(estimate.stamp_ns, position[None], estimate.flow_um_s[None], np.array([sigma]))
        keep = slice(-self.capacity + 1, None)
        return Observations(
            estimate.stamp_ns,
            np.concatenate((previous.position_um[keep], position[None])),
            np.concatenate((previous.flow_um_s[keep], estimate.flow_um_s[None])),
            np.concatenate((previous.std_um_s[keep], [sigma])),
        )
