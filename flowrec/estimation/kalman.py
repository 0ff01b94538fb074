"""`kalman`: position and flow from filterpy's Kalman filter, the flow as a random walk.

State [x, y, vx, vy]; x' = x + v dt + d with d the displacement by the field as really applied; v' = v + noise of
spectral density q (continuous white acceleration of the flow along the path). The normalised innovation squared (NIS)
has mean 2 when R and q are right.

`kalman_map`: the same filter on what a known map m of the flow misses, v - m(x). The state stays the whole flow at
the robot; the map's change along the way is added to it, v' = v + m(x') - m(x) + noise of a smaller q, so nothing
jumps when another map is adopted. The map is not linear in x: an extended filter, with the midpoint rule for the way.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import Applied, Estimate, FlowField, Matrix, Track
from flowrec.robot import Robot
from flowrec.units import seconds

Floats = NDArray[np.float64]

_H = np.eye(2, 4)
_B = np.eye(4, 2)
_RESIDUAL_SHARE = 0.03  # a map wrong by a sixth leaves a sixth of the flow's changes
_UNKNOWN_UM = 1e4  # one sigma of a position that has never been measured


@dataclass(frozen=True, slots=True)
class Kalman:
    """Settings; None is scaled to the robot.

    A robot of 50 um that swims at up to 600 um/s is the measure. Where it turns from one branch into another the flow
    along its path changes by 200 um/s within 0.3 s: q = 1e4 um2/s3 follows that (13 to 16 um/s RMSE on three simulated
    missions, 42 to 62 um/s at the 99th percentile), q = 1e3 is left behind there (76 to 90 um/s) and wins nothing
    elsewhere. In a channel of another size and speed the flow along the path changes by v within L / v, so q goes as
    v^3 / L.
    """

    position_noise_um: float | None = None  # one sigma of a measured position; None: 2 % of the radius
    flow_noise_um2_s3: float | None = None  # q
    residual_noise_um2_s3: float | None = None  # q of what a map misses; None: 3 % of flow_noise
    drift_um2_s: float = 4.0  # of the position: Brownian motion and uneven rolling
    gate_nis: float = 25.0  # a measurement less likely than this is not used at once ...
    gate_growth: float = 4.0  # ... but the position's variance is multiplied, so that a real jump is soon believed

    def flow_noise(self, robot: Robot) -> float:
        """Spectral density q of the flow's random walk, um2/s3."""
        assert robot.max_speed_um_s is not None
        scale = (robot.max_speed_um_s / 600.0) ** 3 / (robot.radius / 50.0)
        return self.flow_noise_um2_s3 if self.flow_noise_um2_s3 is not None else 1e4 * scale

    def residual_noise(self, robot: Robot) -> float:
        """Spectral density q of the random walk of what a map misses, um2/s3."""
        q = self.residual_noise_um2_s3
        return q if q is not None else _RESIDUAL_SHARE * self.flow_noise(robot)

    def estimate(
        self,
        previous: Estimate | None,
        track: Track,
        applied: Applied,
        robot: Robot,
        field: FlowField | None = None,
    ) -> Estimate:
        """One predict and, where the robot was seen, one update. With a `field` it filters what that misses."""
        q = self.flow_noise(robot) if field is None else self.residual_noise(robot)
        sigma_um = self.position_noise_um if self.position_noise_um is not None else 0.02 * robot.radius
        # State and covariance are set anew for every step: all that the filter knows is in the messages.
        kalman = _filter(sigma_um)
        if previous is None:
            assert robot.max_speed_um_s is not None
            flow_um_s = 0.5 * robot.max_speed_um_s
            guess = np.zeros(2) if field is None else sample(field, track.position_um)
            kalman.x = np.concatenate((track.position_um, guess))
            kalman.P = np.diag([_UNKNOWN_UM**2, _UNKNOWN_UM**2, flow_um_s**2, flow_um_s**2])
        else:
            kalman.x = np.concatenate((previous.position_um, previous.flow_um_s))
            kalman.P = previous.covariance.copy()
            dt = seconds(track.stamp_ns - previous.stamp_ns)
            moved = robot.um_per_rev * applied.turns
            noise = process_noise(dt, q, self.drift_um2_s)
            if field is None:
                kalman.predict(u=moved, B=_B, F=transition(dt), Q=noise)
            else:
                onward, step = along(field, kalman.x, moved, dt)
                kalman.predict(F=step, Q=noise)  # the covariance; the state goes the curved way
                kalman.x = onward
        nis = float("nan")
        if track.seen:
            innovation = track.position_um - kalman.x[:2]
            nis = float(innovation @ np.linalg.solve(kalman.P[:2, :2] + kalman.R, innovation))
            if nis <= self.gate_nis:
                kalman.update(track.position_um)
            else:
                kalman.P[:2, :2] *= self.gate_growth
        covariance = 0.5 * (kalman.P + kalman.P.T)
        return Estimate(
            stamp_ns=track.stamp_ns,
            position_um=kalman.x[:2],
            flow_um_s=kalman.x[2:],
            covariance=covariance,
            nis=nis,
            measured_um=track.position_um,
            seen=track.seen,
        )


@lru_cache(maxsize=8)
def _filter(sigma_um: float) -> KalmanFilter:
    """A filter for positions with this noise; making one costs as much as using it."""
    kalman = KalmanFilter(dim_x=4, dim_z=2, dim_u=2)
    kalman.H = _H
    kalman.R = np.eye(2) * sigma_um**2
    return kalman


@lru_cache(maxsize=16)
def transition(dt: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(4, 4) of the state over dt, without input."""
    matrix = np.eye(4)
    matrix[0, 2] = matrix[1, 3] = dt
    return matrix


@lru_cache(maxsize=16)
def process_noise(dt: float, q: float, drift: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Process noise of a random-walk velocity over dt, with a random walk of the position on top."""
    noise = np.zeros((4, 4))
    for axis in (0, 1):
        noise[axis, axis] = q * dt**3 / 3 + drift * dt
        noise[axis, axis + 2] = noise[axis + 2, axis] = q * dt**2 / 2
        noise[axis + 2, axis + 2] = q * dt
    return noise


def along(field: FlowField, state: Floats, moved: Floats, dt: float) -> tuple[Floats, Floats]:
    """The state (4,) after dt along a map, by the midpoint rule, and the derivative (4, 4) of it by the state before.

    Of the derivative what the map's own curvature adds over one step is left out.
    """
    here = sample(field, state[:2])
    middle = state[2:] + sample(field, state[:2] + 0.5 * (dt * state[2:] + moved)) - here
    position = state[:2] + dt * middle + moved
    flow = state[2:] + sample(field, position) - here
    step = np.eye(4)
    step[0, 2] = step[1, 3] = dt
    for axis in (0, 1):  # dv'/dv = 1 + dt dm/dx
        aside = np.zeros(2)
        aside[axis] = 0.5 * field.um_per_px
        slope = (sample(field, position + aside) - sample(field, position - aside)) / field.um_per_px
        step[2:, 2 + axis] += dt * slope
    return np.concatenate((position, flow)), step


def memory_s(covariance: Matrix) -> float:
    """How long a filter remembers, at most 1 s: K_x / K_v = P_xx / P_xv; 0 for one that states no coupling."""
    coupling = 0.5 * (covariance[0, 2] + covariance[1, 3])
    if coupling <= 0:
        return 0.0
    return float(min(0.5 * (covariance[0, 0] + covariance[1, 1]) / coupling, 1.0))
