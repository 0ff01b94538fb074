"""Estimates along the way to Observations: the local flow that a refinement may use."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np

from flowrec.core import Bools, Estimate, Floats, Method, Methods, Observations, Range, Share, nanoseconds, seconds
from flowrec.physics import Robot
from flowrec.stages.estimation.kalman import lag_s, memory_s

_OUTLIER_NIS = 25.0  # no observation is taken from an estimate whose measurement was less likely than this
_EXTRA_POINTS = 2  # a polynomial needs more points than coefficients to state its scatter

# The option of a row is the section of its settings, an object with `treat`; without one nothing is changed.
SAMPLERS = Methods(
    "sampler.method",
    Method("filter", "flowrec.stages.estimation.sampler:Sampler", "the observer's estimates as they are"),
    Method(
        "trimmed", "flowrec.stages.estimation.sampler:Trimmed", "trimmed and smoothed as in the paper", ("trimmed",)
    ),
    Method(
        "smoothed",
        "flowrec.stages.estimation.smoother:smooth",
        "by the RTS smoother, in a replay only",
        needs=("recording",),
    ),
)


@dataclass(frozen=True, slots=True)
class Trimmed:
    """The paper's treatment of a survey.

    "To reduce noise, the top and bottom 20% of the velocity values are discarded, followed by polynomial smoothing."
    The paper does not say of which values. In a whole survey the top 20 % are the narrow branches, where the flow is
    fast and correct, so values are discarded within a window that slides along the way, each component separately;
    `over` = "survey" is the other interpretation.
    """

    # fraction of the observations discarded at the top, and the same at the bottom
    discarded_share: Annotated[float, Range(0.0, 0.49)] = 0.2
    # values that are compared: of a window that slides along the way, or of the whole survey
    over: Literal["window", "survey"] = "window"
    window: Annotated[int, Range(1, 1001)] = 9  # observations along the way
    degree: Annotated[int, Range(0, 9)] = 2  # degree of the polynomial in the distance travelled

    def treat(self, observations: Observations) -> Observations:
        """Smoothed observations at the same positions, without those that are not finite.

        The standard deviation is that of one retained value: the larger of the stated one and the scatter around the
        polynomial. The mean is more accurate, but neighbours share the values that they are computed from, so as
        independent observations they are worth no more (the Sampler uses the same argument).
        """
        finite = (
            np.isfinite(observations.position_um).all(axis=1)
            & np.isfinite(observations.flow_um_s).all(axis=1)
            & np.isfinite(observations.std_um_s)
        )
        kept = observations.only(finite)
        position, flow, std = kept.position_um, kept.flow_um_s, kept.std_um_s
        count = len(std)
        if count <= self.degree + _EXTRA_POINTS:
            return kept
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(position, axis=0).T))])
        retained = np.stack([_central(flow[:, axis], self.discarded_share) for axis in (0, 1)], axis=1)
        smooth, scatter = flow.copy(), np.tile(std[:, None], 2)
        for index in range(count):
            first = min(max(index - self.window // 2, 0), max(count - self.window, 0))
            near = slice(first, first + self.window)
            for axis in (0, 1):
                values = flow[near, axis]
                use = retained[near, axis] if self.over == "survey" else _central(values, self.discarded_share)
                if np.count_nonzero(use) > self.degree + 1:
                    smooth[index, axis], rms = _polynomial(
                        distance[near][use] - distance[index], values[use], std[near][use], self.degree
                    )
                    scatter[index, axis] = max(std[index], rms)
        return replace(kept, flow_um_s=smooth, std_um_s=np.sqrt((scatter**2).mean(axis=1)))


@dataclass(frozen=True, slots=True)
class Sampler:
    """Takes observations from the estimates, so far apart that their errors are nearly independent.

    A filter with gains K_x and K_v that assumes a constant flow responds to a changing one with the lag K_x / K_v; one
    that knows the gradient or a map hardly lags. An observation is therefore placed where the robot was that long ago,
    and its standard deviation is increased, so that observations closer in time than the filter's memory do not count
    the same noise twice.
    """

    spacing_radii: Annotated[float, Range(0.0, 1e3)] = 0.8  # least distance between observations, in robot radii
    memories: Annotated[float, Range(0.0, 1e3)] = 2.0  # least time between observations, in memories of the filter
    # no observation while the flow's sigma exceeds this fraction of the robot's top speed
    settled_share: Annotated[float, Range(0.0, 10.0)] = 0.1
    floor_um_s: Annotated[float, Range(1e-3, 1e4)] = 2.0  # least sigma of an observation
    # one sigma of the robot rolling off its course, which appears as flow; fraction of its own speed
    rolling_share: Share = 0.02
    # take them from a filter that knows no map (`Observer.without_map`): a map is no measurement
    without_map: bool = True
    capacity: Annotated[int, Range(1, 100_000)] = 2000  # the oldest are dropped first
    # observations that a refinement is given: as the filter made them, trimmed as in the paper, or smoothed afterwards
    method: Annotated[str, SAMPLERS] = "filter"
    trimmed: Trimmed = field(default_factory=Trimmed)

    def treat(self, observations: Observations) -> Observations:
        """The observations that a refinement is given.

        Raises
        ------
        UsageError : `method` is not in the table.
        """
        options = SAMPLERS[self.method].options
        return getattr(self, options[0]).treat(observations) if options else observations

    def collect(
        self, previous: Observations | None, before: Estimate | None, estimate: Estimate, robot: Robot
    ) -> Observations | None:
        """The observations after this frame; the previous object itself when none is due.

        Parameters
        ----------
        before : the estimate of the frame before.
        """
        variance = estimate.flow_variance
        if before is None or not estimate.seen or not before.seen:
            return previous
        if not estimate.nis < _OUTLIER_NIS and not math.isnan(estimate.nis):
            return previous
        if variance > (self.settled_share * robot.max_speed_um_s) ** 2:
            return previous
        filter_memory_s = memory_s(estimate.covariance)
        dt = estimate.since_s(before)
        if dt <= 0.0:
            return previous
        velocity = (estimate.position_um - before.position_um) / dt
        position = estimate.position_um - lag_s(estimate) * velocity
        elapsed_s = math.inf
        if previous is not None and len(previous.position_um):
            soon = estimate.stamp_ns < previous.stamp_ns + nanoseconds(self.memories * filter_memory_s)
            distance = math.dist(position, previous.position_um[-1])
            if soon or distance < self.spacing_radii * robot.radius_um:
                return previous
            elapsed_s = estimate.since_s(previous)
        own_um_s = math.hypot(*(velocity - estimate.flow_um_s))
        total = variance * (1.0 + 2.0 * filter_memory_s / elapsed_s) + (self.rolling_share * own_um_s) ** 2
        sigma = max(self.floor_um_s, math.sqrt(total))
        one = Observations(
            estimate.stamp_ns,
            position[None],
            estimate.flow_um_s[None],
            np.array([sigma]),
            estimate.rolled_um_s[None] if estimate.rolled_um_s.size else None,
            np.array([seconds(estimate.stamp_ns) - filter_memory_s]),
            robot.radius_um,
        )
        return one if previous is None else previous.followed_by(one).only(slice(-self.capacity, None))


def _central(values: Floats, discarded: float) -> Bools:
    """True where a value is neither among the largest nor the smallest; `discarded` is the fraction of either."""
    rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
    count = int(discarded * len(values))
    return (rank >= count) & (rank < len(values) - count)


def _polynomial(distance: Floats, values: Floats, std: Floats, degree: int) -> tuple[float, float]:
    """Value of the least squares polynomial at distance 0, and the standard deviation of the values around it."""
    scale = max(float(np.abs(distance).max()), 1e-12)
    powers = np.vander(distance / scale, degree + 1, increasing=True)
    weight = 1.0 / np.maximum(std, 1e-6 * max(float(std.max()), 1e-12))
    coefficients = np.linalg.lstsq(powers * weight[:, None], values * weight, rcond=None)[0]
    freedom = len(values) - degree - 1
    return float(coefficients[0]), float(np.sqrt(((values - powers @ coefficients) ** 2).sum() / freedom))
