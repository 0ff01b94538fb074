"""`smoothed`: position and flow at every frame from the frames before and after it (Rauch, Tung and Striebel, 1965).

The model is the Kalman filter's own prediction at every frame, which includes the robot's displacement (filterpy's
rts_smoother omits that input): x_s = x + C (x_s' - x'), C = P F^T P'^-1, where primes are of the next frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowrec.core import NS_PER_S, Applied, Estimate, Floats, Observations, Track, seconds
from flowrec.physics import Robot
from flowrec.stages.estimation.kalman import Kalman, memory_s, state_of


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """One row per frame."""

    stamps_ns: tuple[int, ...]
    position_um: Floats  # (n, 2)
    flow_um_s: Floats  # (n, 2)
    covariance: Floats  # (n, 4, 4) of [x, y, vx, vy]: um2, um2/s, um2/s2
    memory_s: Floats  # (n,) K_x / K_v of the filter: time over which the errors of the flow are correlated
    rolled_um_s: Floats  # (n, 2) the robot's own motion, averaged over that time on either side


def smooth(tracks: Sequence[Track], applied: Sequence[Applied], kalman: Kalman, robot: Robot) -> Smoothed:
    """Run the filter forward over a recorded sequence and the smoother backward."""
    estimates: list[Estimate] = []
    for track, one_applied in zip(tracks, applied, strict=True):
        estimates.append(kalman.estimate(estimates[-1] if estimates else None, track, one_applied, robot))
    count = len(estimates)
    states = np.zeros((count, 4))
    covariances = np.zeros((count, 4, 4))
    memory = np.array([memory_s(estimate.covariance) for estimate in estimates])
    state, covariance = np.zeros(0), np.zeros((0, 0))
    for index in range(count - 1, -1, -1):
        if index == count - 1:
            state, covariance = state_of(estimates[index], kalman.layout(), robot)
        else:
            ahead, expected, layout, jacobian = kalman.predict(
                estimates[index], tracks[index + 1], applied[index + 1], robot
            )
            filtered, spread = state_of(estimates[index], layout, robot)
            gain = np.linalg.solve(expected, jacobian @ spread).T
            state = filtered + gain @ (state - ahead)
            covariance = spread + gain @ (covariance - expected) @ gain.T
            covariance = 0.5 * (covariance + covariance.T)
        states[index], covariances[index] = state[:4], covariance[:4, :4]
    stamps = tuple(track.stamp_ns for track in tracks)
    rolled = _rolled_um_s(stamps, applied, memory, robot)
    return Smoothed(stamps, states[:, :2], states[:, 2:], covariances, memory, rolled)


def _rolled_um_s(stamps: Sequence[int], applied: Sequence[Applied], memory: Floats, robot: Robot) -> Floats:
    """(n, 2) mean of the robot's own motion with the weight exp(-|t| / memory), which is that of the smoother."""
    dt = np.diff(np.array(stamps, np.float64), prepend=np.nan) / NS_PER_S
    turns = np.array([one.turns for one in applied]).reshape(-1, 2)
    now = robot.um_per_rev * turns / np.where(dt > 0.0, dt, np.inf)[:, None]
    ways = []
    for order in (slice(None), slice(None, None, -1)):
        mean, gaps = now[order].copy(), np.abs(np.diff(np.array(stamps, np.float64)[order])) / NS_PER_S
        for index in range(1, len(mean)):
            keep = math.exp(-gaps[index - 1] / max(memory[order][index], 1e-9))
            mean[index] = keep * mean[index - 1] + (1.0 - keep) * mean[index]
        ways.append(mean[order])
    return 0.5 * (ways[0] + ways[1])


def observe(smoothed: Smoothed, robot: Robot, spacing_radii: float = 0.8, settled_share: float = 0.1) -> Observations:
    """Observations so far apart, in distance and time, that their errors are independent; std is the smoother's.

    Parameters
    ----------
    spacing_radii, settled_share : as of Sampler.
    """
    chosen: list[int] = []
    std = np.sqrt(0.5 * (smoothed.covariance[:, 2, 2] + smoothed.covariance[:, 3, 3]))
    for index, position in enumerate(smoothed.position_um):
        if std[index] > settled_share * robot.max_speed_um_s:
            continue
        if chosen:
            distance = math.dist(position, smoothed.position_um[chosen[-1]])
            elapsed_s = seconds(smoothed.stamps_ns[index] - smoothed.stamps_ns[chosen[-1]])
            # Smoothing correlates in both directions, hence the factor 2.
            if distance < spacing_radii * robot.radius_um or elapsed_s < 2.0 * smoothed.memory_s[index]:
                continue
        chosen.append(index)
    stamp_ns = smoothed.stamps_ns[-1] if smoothed.stamps_ns else 0
    time_s = np.array([seconds(smoothed.stamps_ns[index]) for index in chosen])
    return Observations(
        stamp_ns,
        smoothed.position_um[chosen],
        smoothed.flow_um_s[chosen],
        std[chosen],
        smoothed.rolled_um_s[chosen],
        time_s,
        robot.radius_um,
    )
