"""`kalman` and `kalman_map`: position and flow from filterpy's Kalman filter.

The state is that of process_model.py. `kalman` ignores the channel: it estimates the flow and its gradient.
`kalman_map` uses a known map of the flow and estimates its error. `kalman_auto` is one or the other, see observer.py.
The normalised innovation squared (NIS) has mean 2 when all noise is stated correctly.

The process noise is stated per displacement, not per time, because the flow is steady: over a displacement of one
radius its variance is `flow_change` times the squared speed. The flow changes less in a wide vortex than in a vessel
tree, so the filter adapts: consecutive innovations of one sign show that it lags, and the noise is scaled by their
mean square.
"""

from __future__ import annotations

import copy
import importlib
import math
import sys
from dataclasses import dataclass
from functools import cache, lru_cache
from types import ModuleType
from typing import Annotated, Any

import numpy as np

from flowrec.core import Applied, Estimate, Floats, FlowField, Range, Share, Track
from flowrec.physics import OBSERVER, Robot, sample_as_seen
from flowrec.stages.estimation.process_model import ISOTROPIC, StateLayout, advance_covariance, gradient_at, propagate

_NONE = np.zeros(0)
# One sigma before anything was measured, in um, and as fractions of v_max per radius and of um_per_rev.
_UNKNOWN_UM = 1e4
_UNKNOWN_GRADIENT = 0.2  # standard deviation of the flow's gradient before a measurement, in top speeds per radius
_UNKNOWN_GAIN = 0.15  # the same of um_per_rev, relative
_GAIN_DRIFT = 0.005  # of um_per_rev, one sigma within a second
_REST_FRACTION = 0.05  # of v_max: displacement of a robot at rest that counts, as no flow is perfectly steady
_SLOWEST_FRACTION = 1.0 / 6.0  # of v_max: changes of a slower flow are those of this speed
# Of v_max: a faster estimate is wrong, and as its noise is proportional to it, it would diverge. A robot that is
# pressed against a wall causes this.
_FASTEST_FRACTION = 4.0
_LEAST_SCALE, _LARGEST_SCALE = 0.2, 100.0  # of the adaptive noise
_LARGEST_INNOVATION = 4.0  # sigma: a single outlier is no trend


@dataclass(frozen=True, slots=True)
class Kalman:
    """Settings; None is scaled to the robot."""

    # one sigma of a measured position; None: 2 % of the radius
    position_noise_um: Annotated[float, Range(1e-4, 1e4)] | None = None
    # spectral density q of a plain random walk of the flow in time, um2/s3; replaces the settings below up to
    # `watch_radii`
    flow_noise_um2_s3: Annotated[float, Range(0.0, 1e12)] | None = None
    flow_change: Share = 2e-3  # variance of the flow's change over one radius, relative to its squared speed
    # variance of the change of the flow's gradient times the radius over one radius, relative to its squared speed
    slope_change: Share = 2e-5
    # error of a map, as a fraction of the flow and of its changes; None: from the map
    map_share: Annotated[float, Range(0.0, 10.0)] | None = None
    # factor on the variances of all changes: what `flowrec bench observer --session` tunes
    agility: Annotated[float, Range(1e-6, 1e6)] = 1.0
    # innovations are averaged over the time in which the robot covers this distance at v_max
    watch_radii: Annotated[float, Range(0.01, 1e3)] = 2.2
    # growth of the position's variance by Brownian motion and uneven rolling
    drift_um2_s: Annotated[float, Range(0.0, 1e6)] = 4.0
    gate_nis: Annotated[float, Range(1.0, 1e9)] = 25.0  # a measurement with a larger NIS is not used at once
    # factor on the position's variance in that case, so that a real jump is soon accepted
    gate_growth: Annotated[float, Range(1.0, 1e6)] = 4.0
    # also estimate the robot's um per revolution; it is observable only while the heading varies, see `estimate`
    estimate_gain: bool = False

    def estimate(
        self, previous: Estimate | None, track: Track, applied: Applied, robot: Robot, field: FlowField | None = None
    ) -> Estimate:
        """One prediction and, where the robot was seen, one update; with a `field`, the map model.

        A wrong um per revolution is equivalent to a flow along the heading. Only turns distinguish them, so with
        `estimate_gain` the filter needs headings that vary within its memory of the flow; on a straight path the
        variance of the gain, and so the estimate, does not change.
        """
        if previous is not None and math.hypot(*previous.flow_um_s) > _FASTEST_FRACTION * robot.max_speed_um_s:
            previous = None  # start again
        state, covariance, layout, _ = self.predict(previous, track, applied, robot, field)
        sigma_um = self.position_noise_um if self.position_noise_um is not None else 0.02 * robot.radius_um
        # All memory is in the messages: the filter is copied, because several threads may replay at a time.
        kalman = copy.copy(_filter(layout.size, sigma_um))
        kalman.x, kalman.P = state, covariance
        nis = math.nan
        surprise = np.zeros(2) if previous is None or previous.surprise.size == 0 else previous.surprise
        seen = track.seen and math.isfinite(float(track.position_um.sum()))
        if seen:
            innovation = track.position_um - state[:2]
            expected = covariance[:2, :2] + kalman.R
            xx, xy, yy = float(expected[0, 0]), float(expected[0, 1]), float(expected[1, 1])
            x, y = float(innovation[0]), float(innovation[1])
            nis = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
            if previous is not None:
                weight = self._innovation_weight(robot, track.since_s(previous))
                normal = innovation / math.sqrt(0.5 * (xx + yy))
                size = math.hypot(*normal)
                surprise = surprise + weight * (min(1.0, _LARGEST_INNOVATION / max(size, 1e-9)) * normal - surprise)
            if nis <= self.gate_nis:
                kalman.update(track.position_um)
            else:
                kalman.P[:2, :2] *= self.gate_growth
        slopes = kalman.x[4:7] if layout.gradient else _NONE
        if field is not None:
            xx, xy, yx, yy = gradient_at(field, float(kalman.x[0]), float(kalman.x[1]))
            slopes = np.array([0.5 * (xx - yy), xy, yx])
        return Estimate(
            stamp_ns=track.stamp_ns,
            position_um=kalman.x[:2],
            flow_um_s=kalman.x[2:4],
            covariance=0.5 * (kalman.P + kalman.P.T),
            nis=nis,
            measured_um=track.position_um,
            seen=seen,
            slopes_per_s=slopes,
            surprise=surprise,
            um_per_rev=float(kalman.x[-1]) if layout.gain else None,
        )

    def predict(
        self, previous: Estimate | None, track: Track, applied: Applied, robot: Robot, field: FlowField | None = None
    ) -> tuple[Floats, Floats, StateLayout, Floats]:
        """State (n,) and covariance (n, n) before the measurement, their layout, and the Jacobian (n, n)."""
        layout = self.layout(field)
        if previous is None:
            state, covariance = _prior(layout, robot)
            if np.isfinite(track.position_um).all():
                state[:2] = track.position_um
            if field is not None:
                state[2:4] = sample_as_seen(field, state[:2])
            return state, covariance, layout, np.eye(layout.size)
        state, covariance = state_of(previous, layout, robot)
        dt = max(track.since_s(previous), 0.0)
        ahead, jacobian = propagate(
            state, layout, applied.turns, robot.um_per_rev, dt, field, constant_flow=not previous.seen
        )
        change = math.dist(ahead[:2].tolist(), state[:2].tolist())
        noise = self._noise(previous, change, dt, robot, field)
        return ahead, advance_covariance(covariance, jacobian, *layout, dt, *noise), layout, jacobian

    def layout(self, field: FlowField | None = None) -> StateLayout:
        """Components of the state."""
        return StateLayout(gradient=field is None and self.flow_noise_um2_s3 is None, gain=self.estimate_gain)

    def _noise(
        self, previous: Estimate, moved_um: float, dt: float, robot: Robot, field: FlowField | None
    ) -> tuple[float, float, float, float]:
        """Variances of the process noise of a step, as of `advance_covariance`: flow, gradient, gain and drift."""
        gain = (_GAIN_DRIFT * robot.um_per_rev) ** 2 * dt
        share = 1.0 if field is None else OBSERVER.of(field, self.map_share) ** 2
        if self.flow_noise_um2_s3 is not None:
            return self.flow_noise_um2_s3 * share * dt, 0.0, gain, self.drift_um2_s
        displacement = moved_um + _REST_FRACTION * robot.max_speed_um_s * dt
        speed = math.hypot(*previous.flow_um_s, _SLOWEST_FRACTION * robot.max_speed_um_s)
        unit = self.agility * self._noise_scale(previous, robot, dt) * displacement / robot.radius_um * speed**2
        unit *= share
        return self.flow_change * unit, self.slope_change * unit / robot.radius_um**2, gain, self.drift_um2_s

    def _innovation_weight(self, robot: Robot, dt: float) -> float:
        """Weight of the newest innovation in their exponential mean."""
        return min(max(dt, 0.0) * robot.max_speed_um_s / (self.watch_radii * robot.radius_um), 0.5)

    def _noise_scale(self, previous: Estimate, robot: Robot, dt: float) -> float:
        """Factor on the noise: 1 where the mean innovation is as large as that of white innovations."""
        weight = self._innovation_weight(robot, dt)
        if previous.surprise.size == 0 or weight == 0.0:
            return 1.0
        excess = 0.5 * float(previous.surprise @ previous.surprise) * (2.0 - weight) / weight
        return min(max(excess * math.sqrt(excess), _LEAST_SCALE), _LARGEST_SCALE)


def state_of(estimate: Estimate, layout: StateLayout, robot: Robot) -> tuple[Floats, Floats]:
    """State and covariance of a message in a layout; what the message does not hold is that of the prior.

    So an observer can continue from the estimate of another one, with or without a map.
    """
    has_gain = estimate.um_per_rev is not None
    # With a map, the gradient of the message is not part of the state.
    own = StateLayout(gradient=len(estimate.covariance) - has_gain == 7, gain=has_gain)
    if own == layout:
        slopes = estimate.slopes_per_s if own.gradient else _NONE
        gain = _NONE if estimate.um_per_rev is None else np.array([estimate.um_per_rev])
        return np.concatenate((estimate.position_um, estimate.flow_um_s, slopes, gain)), estimate.covariance.copy()
    state, covariance = _prior(layout, robot)
    indices = [0, 1, 2, 3]
    state[:4] = *estimate.position_um, *estimate.flow_um_s
    if layout.gradient and own.gradient:
        indices += [4, 5, 6]
        state[4:7] = estimate.slopes_per_s
    own_indices = list(indices)
    if layout.gain and estimate.um_per_rev is not None:
        indices.append(layout.size - 1)
        own_indices.append(own.size - 1)
        state[-1] = estimate.um_per_rev
    covariance[np.ix_(indices, indices)] = estimate.covariance[np.ix_(own_indices, own_indices)]
    return state, covariance


def _prior(layout: StateLayout, robot: Robot) -> tuple[Floats, Floats]:
    """State and covariance before anything was measured."""
    state = np.zeros(layout.size)
    variance = np.full(layout.size, _UNKNOWN_UM**2)
    variance[2:4] = (0.5 * robot.max_speed_um_s) ** 2
    if layout.gradient:
        variance[4:7] = (_UNKNOWN_GRADIENT * robot.max_speed_um_s / robot.radius_um) ** 2 * ISOTROPIC
    if layout.gain:
        state[-1] = robot.um_per_rev
        variance[-1] = (_UNKNOWN_GAIN * robot.um_per_rev) ** 2
    return state, np.diag(variance)


@lru_cache(maxsize=16)
def _filter(size: int, sigma_um: float) -> Any:
    """A filter for positions with this noise, to be copied before use: to make one takes as long as to use it."""
    kalman = _filter_class()(dim_x=size, dim_z=2)
    kalman.H = np.eye(2, size)
    kalman.R = np.eye(2) * sigma_um**2
    return kalman


@cache
def _filter_class() -> Any:
    """The KalmanFilter of filterpy, imported at first use and without scipy.stats, which takes 0.3 s of CPU time.

    filterpy.stats imports scipy.stats for a log-likelihood that is not used here. While filterpy.kalman is imported, a
    module that imports the real function when it is called stands in for filterpy.stats.
    """
    name = "filterpy.stats"
    if name in sys.modules:
        return importlib.import_module("filterpy.kalman").KalmanFilter
    deferred = ModuleType(name)
    deferred.logpdf = lambda *args, **options: importlib.import_module(name).logpdf(*args, **options)  # type: ignore[attr-defined]
    sys.modules[name] = deferred
    try:
        return importlib.import_module("filterpy.kalman").KalmanFilter
    finally:
        del sys.modules[name]


def corrects_map(estimate: Estimate) -> bool:
    """True if an estimate was made with a map: it states the map's gradient and has none in its state."""
    return estimate.slopes_per_s.size > 0 and len(estimate.covariance) < 7


def memory_s(covariance: Floats) -> float:
    """Time constant of a filter, at most 1 s: K_x / K_v = P_xx / P_xv; 0 for one that states no coupling."""
    coupling = 0.5 * (covariance[0, 2] + covariance[1, 3])
    if coupling <= 0:
        return 0.0
    return float(min(0.5 * (covariance[0, 0] + covariance[1, 1]) / coupling, 1.0))


def newest_share(dt_s: float, memory: float) -> float:
    """Share of the newest value in a mean with a memory in s, after a time dt_s."""
    return 1.0 - math.exp(-max(dt_s, 0.0) / memory) if memory > 0.0 else 1.0


def lag_s(estimate: Estimate) -> float:
    """Lag of the estimated flow behind the true one: the filter's memory where it assumes a constant flow.

    Half of that with the gradient in the state (on missions in channels the observations fit the flow best if they are
    placed accordingly), zero with that of a map.
    """
    if estimate.slopes_per_s.size == 0:
        return memory_s(estimate.covariance)
    return 0.5 * memory_s(estimate.covariance) if len(estimate.covariance) >= 7 else 0.0
