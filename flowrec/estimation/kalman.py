"""`kalman` and `kalman_map`: position and flow from filterpy's Kalman filter.

The state is motion.py's. `kalman` knows nothing of the channel: it estimates the flow with its slopes. `kalman_map`
follows a known map of the flow and estimates what that misses. The normalised innovation squared (NIS) has mean 2
when all noise is stated right.

How much the flow may change is stated per way, not per time, as the flow is steady: over a way of one radius by the
share `flow_change` (a variance) of its square. In a wide vortex it changes less than in a vessel tree, so the filter
watches itself: innovations that keep their sign, as white ones do not, say that it is left behind; the noise is scaled
by how much they do.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np

from flowrec.declarations import Matrix
from flowrec.estimation.process_model import ISOTROPIC, Floats, Layout, noise, onward, slope_of
from flowrec.flow import sample
from flowrec.messages import Applied, Estimate, FlowField, Track
from flowrec.ranges import Range, Share
from flowrec.robot import Robot
from flowrec.units import seconds

_NONE = np.zeros(0)
_UNKNOWN_UM = 1e4  # one sigma of a position that has never been measured
_SLOPE_SHARE = 0.2  # one sigma of a slope that nothing is known of: v_max times this per radius
_GAIN_SHARE = 0.15  # one sigma of the robot's um per revolution before it is estimated
_GAIN_WANDERS = 0.005  # of it, within a second
_STILL_SHARE = 0.05  # of v_max: even a robot at rest has this way behind it, as no flow is quite steady
_SLOWEST_SHARE = 1.0 / 6.0  # of v_max: changes of a slow flow are a share of this
# Of v_max: an estimate of a faster flow is wrong, and as its noise grows with it, gets worse without limit. A robot
# that is pressed against a wall brings the filter there.
_FASTEST_SHARE = 4.0
_CALM, _HURRY = 0.2, 100.0  # the noise is scaled within these
_SURPRISE_LIMIT = 4.0  # sigma: one wild measurement is no trend


@dataclass(frozen=True, slots=True)
class Kalman:
    """Settings; None is scaled to the robot."""

    # one sigma of a measured position; None: 2 % of the radius
    position_noise_um: Annotated[float, Range(1e-4, 1e4)] | None = None
    # q of a plain random walk of the flow in time, um2/s3, in place of all that follows up to `watch_radii`.
    flow_noise_um2_s3: Annotated[float, Range(0.0, 1e12)] | None = None
    flow_change: Share = 2e-3  # variance of the flow's change over a way of one radius, as a share of its square
    slope_change: Share = 2e-5  # the same of its slopes times the radius
    map_share: Annotated[float, Range(0.0, 10.0)] = 0.25  # of the flow, and so of its changes, that a map misses
    # all changes' variances times this: the knob of `flowrec bench observer --session`
    agility: Annotated[float, Range(1e-6, 1e6)] = 1.0
    # innovations are averaged over the time that the robot needs for this way at v_max
    watch_radii: Annotated[float, Range(0.01, 1e3)] = 2.2
    drift_um2_s: Annotated[float, Range(0.0, 1e6)] = 4.0  # of the position: Brownian motion and uneven rolling
    gate_nis: Annotated[float, Range(1.0, 1e9)] = 25.0  # a measurement less likely than this is not used at once ...
    # ... but the position's variance is multiplied, so that a real jump is soon believed
    gate_growth: Annotated[float, Range(1.0, 1e6)] = 4.0
    # Also estimate the robot's um per revolution. It shows only against its heading: see `estimate`.
    estimate_gain: bool = False

    def estimate(
        self,
        previous: Estimate | None,
        track: Track,
        applied: Applied,
        robot: Robot,
        field: FlowField | None = None,
    ) -> Estimate:
        """One predict and, where the robot was seen, one update. With a `field` it filters what that misses.

        A wrong um per revolution looks like a flow along the heading. Only turns set it apart from a flow, so with
        `estimate_gain` the filter needs headings that vary within the memory of the flow; on a straight way its
        variance stays what it was and the belief with it.
        """
        if previous is not None and math.hypot(*previous.flow_um_s) > _FASTEST_SHARE * robot.max_speed_um_s:
            previous = None  # begin anew
        state, covariance, layout, _ = self.predict(previous, track, applied, robot, field)
        sigma_um = self.position_noise_um if self.position_noise_um is not None else 0.02 * robot.radius_um
        # State and covariance are set anew for every step: all that the filter knows is in the messages.
        kalman = copy.copy(_filter(layout.size, sigma_um))  # several threads may replay at a time
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
                share = self._watch_share(robot, seconds(track.stamp_ns - previous.stamp_ns))
                normal = innovation / math.sqrt(0.5 * (xx + yy))
                size = math.hypot(normal[0], normal[1])
                surprise = surprise + share * (min(1.0, _SURPRISE_LIMIT / max(size, 1e-9)) * normal - surprise)
            if nis <= self.gate_nis:
                kalman.update(track.position_um)
            else:
                kalman.P[:2, :2] *= self.gate_growth
        slopes = kalman.x[4:7] if layout.slopes else np.zeros(0)
        if field is not None:
            slope = slope_of(field, kalman.x[:2])
            slopes = np.array([0.5 * (slope[0, 0] - slope[1, 1]), slope[0, 1], slope[1, 0]])
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
    ) -> tuple[Floats, Floats, Layout, Floats]:
        """State (n,) and covariance (n, n) before the track is looked at, their layout, and the derivative (n, n)."""
        layout = self.layout(field)
        if previous is None:
            state, covariance = _first(layout, track, robot, field)
            return state, covariance, layout, np.eye(layout.size)
        state, covariance = carried(previous, layout, robot)
        dt = max(seconds(track.stamp_ns - previous.stamp_ns), 0.0)
        ahead, step = onward(state, layout, applied.turns, robot.um_per_rev, dt, field, held=not previous.seen)
        covariance = step @ covariance @ step.T + self._noise(previous, layout, ahead - state, dt, robot, field)
        return ahead, covariance, layout, step

    def layout(self, field: FlowField | None = None) -> Layout:
        """What the state holds."""
        return Layout(slopes=field is None and self.flow_noise_um2_s3 is None, gain=self.estimate_gain)

    def _noise(
        self, previous: Estimate, layout: Layout, change: Floats, dt: float, robot: Robot, field: FlowField | None
    ) -> Floats:
        gain = (_GAIN_WANDERS * robot.um_per_rev) ** 2 * dt
        if self.flow_noise_um2_s3 is not None:
            q = self.flow_noise_um2_s3 * (1.0 if field is None else self.map_share**2)
            return noise(layout, dt, q * dt, 0.0, gain, self.drift_um2_s)
        way = math.hypot(change[0], change[1]) + _STILL_SHARE * robot.max_speed_um_s * dt
        flow = previous.flow_um_s
        speed = math.hypot(flow[0], flow[1], _SLOWEST_SHARE * robot.max_speed_um_s)
        unit = self.agility * self._scale(previous, robot, dt) * way / robot.radius_um * speed**2
        if field is not None:
            unit *= self.map_share**2
        slope = self.slope_change * unit / robot.radius_um**2
        return noise(layout, dt, self.flow_change * unit, slope, gain, self.drift_um2_s)

    def _watch_share(self, robot: Robot, dt: float) -> float:
        """Weight of the newest innovation in their sliding mean."""
        return min(max(dt, 0.0) * robot.max_speed_um_s / (self.watch_radii * robot.radius_um), 0.5)

    def _scale(self, previous: Estimate, robot: Robot, dt: float) -> float:
        """By how much the noise is scaled: 1 where the mean innovation is as large as that of white ones."""
        share = self._watch_share(robot, dt)
        if previous.surprise.size == 0 or share == 0.0:
            return 1.0
        excess = 0.5 * float(previous.surprise @ previous.surprise) * (2.0 - share) / share
        return min(max(excess * math.sqrt(excess), _CALM), _HURRY)


def carried(previous: Estimate, layout: Layout, robot: Robot) -> tuple[Floats, Floats]:
    """State and covariance of a message in a layout; what the message does not hold begins with what is usual.

    So an observer goes on from another one's estimate, and one with a map from its own without.
    """
    gain = previous.um_per_rev is not None
    had = Layout(slopes=len(previous.covariance) - gain == 7, gain=gain)  # a map's slopes are not of the state
    if had == layout:
        slopes = previous.slopes_per_s if had.slopes else _NONE
        felt = _NONE if previous.um_per_rev is None else np.array([previous.um_per_rev])
        return np.concatenate((previous.position_um, previous.flow_um_s, slopes, felt)), previous.covariance.copy()
    state, covariance = _usual(layout, robot)
    kept = [0, 1, 2, 3]
    state[:4] = *previous.position_um, *previous.flow_um_s
    if layout.slopes and had.slopes:
        kept += [4, 5, 6]
        state[4:7] = previous.slopes_per_s
    origin = list(kept)
    if layout.gain and previous.um_per_rev is not None:
        kept.append(layout.size - 1)
        origin.append(had.size - 1)
        state[-1] = previous.um_per_rev
    covariance[np.ix_(kept, kept)] = previous.covariance[np.ix_(origin, origin)]
    return state, covariance


def _first(layout: Layout, track: Track, robot: Robot, field: FlowField | None) -> tuple[Floats, Floats]:
    state, covariance = _usual(layout, robot)
    if np.isfinite(track.position_um).all():
        state[:2] = track.position_um
    if field is not None:
        state[2:4] = sample(field, state[:2])
    return state, covariance


def _usual(layout: Layout, robot: Robot) -> tuple[Floats, Floats]:
    """State and covariance before anything was measured."""
    state = np.zeros(layout.size)
    variance = np.full(layout.size, _UNKNOWN_UM**2)
    variance[2:4] = (0.5 * robot.max_speed_um_s) ** 2
    if layout.slopes:
        variance[4:7] = (_SLOPE_SHARE * robot.max_speed_um_s / robot.radius_um) ** 2 * ISOTROPIC
    if layout.gain:
        state[-1] = robot.um_per_rev
        variance[-1] = (_GAIN_SHARE * robot.um_per_rev) ** 2
    return state, np.diag(variance)


@lru_cache(maxsize=16)
def _filter(size: int, sigma_um: float) -> Any:
    """A filter for positions with this noise, to be copied before use; making one costs as much as using it."""
    from filterpy.kalman import KalmanFilter  # late: it imports scipy.stats and matplotlib, 0.3 s of CPU time

    kalman = KalmanFilter(dim_x=size, dim_z=2)
    kalman.H = np.eye(2, size)
    kalman.R = np.eye(2) * sigma_um**2
    return kalman


def memory_s(covariance: Matrix) -> float:
    """How long a filter remembers, at most 1 s: K_x / K_v = P_xx / P_xv; 0 for one that states no coupling."""
    coupling = 0.5 * (covariance[0, 2] + covariance[1, 3])
    if coupling <= 0:
        return 0.0
    return float(min(0.5 * (covariance[0, 0] + covariance[1, 1]) / coupling, 1.0))


def behind_s(estimate: Estimate) -> float:
    """By how much the estimated flow is that of earlier: its memory where it takes the flow for constant.

    With slopes in the state half of that (on missions in channels the observations then fit the flow best where they
    are placed), with those of a map nothing.
    """
    if estimate.slopes_per_s.size == 0:
        return memory_s(estimate.covariance)
    return 0.5 * memory_s(estimate.covariance) if len(estimate.covariance) >= 7 else 0.0
