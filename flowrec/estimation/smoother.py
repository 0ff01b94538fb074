"""`smoothed`: position and flow at every frame from the frames before and after it (Rauch, Tung and Striebel, 1965).

The model is the Kalman filter's own prediction at every frame, with the robot's displacement in it (filterpy's
rts_smoother leaves that input out): x_s = x + C (x_s' - x'), C = P F^T P'^-1, where primes are of the next frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowrec.declarations import Matrix
from flowrec.estimation.kalman import Kalman, carried, memory_s
from flowrec.messages import Applied, Estimate, Observations, Track
from flowrec.robot import Robot
from flowrec.units import seconds


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """One row per frame."""

    stamps_ns: tuple[int, ...]
    position_um: Matrix  # (n, 2)
    flow_um_s: Matrix  # (n, 2)
    covariance: Matrix  # (n, 4, 4) of [x, y, vx, vy]: um2, um2/s, um2/s2
    memory_s: Matrix  # (n,) K_x / K_v of the filter: how far apart two flows share their noise


def smooth(tracks: Sequence[Track], applied: Sequence[Applied], kalman: Kalman, robot: Robot) -> Smoothed:
    """Run the filter forward over a recorded sequence and the smoother back."""
    estimates: list[Estimate] = []
    for track, done in zip(tracks, applied, strict=True):
        estimates.append(kalman.estimate(estimates[-1] if estimates else None, track, done, robot))
    count = len(estimates)
    states = np.zeros((count, 4))
    covariances = np.zeros((count, 4, 4))
    memory = np.array([memory_s(estimate.covariance) for estimate in estimates])
    state, covariance = np.zeros(0), np.zeros((0, 0))
    for index in range(count - 1, -1, -1):
        if index == count - 1:
            layout = kalman.layout()
            state, covariance = carried(estimates[index], layout, robot)
        else:
            ahead, expected, layout, step = kalman.predict(
                estimates[index], tracks[index + 1], applied[index + 1], robot
            )
            known, spread = carried(estimates[index], layout, robot)
            gain = np.linalg.solve(expected, step @ spread).T
            state = known + gain @ (state - ahead)
            covariance = spread + gain @ (covariance - expected) @ gain.T
            covariance = 0.5 * (covariance + covariance.T)
        states[index], covariances[index] = state[:4], covariance[:4, :4]
    stamps = tuple(track.stamp_ns for track in tracks)
    return Smoothed(stamps, states[:, :2], states[:, 2:], covariances, memory)


def observe(smoothed: Smoothed, robot: Robot, spacing_radii: float = 0.8, settled_share: float = 0.1) -> Observations:
    """Observations so far apart, in way and in time, that each has noise of its own; std as the smoother has it."""
    chosen: list[int] = []
    std = np.sqrt(0.5 * (smoothed.covariance[:, 2, 2] + smoothed.covariance[:, 3, 3]))
    for index, position in enumerate(smoothed.position_um):
        if std[index] > settled_share * robot.max_speed_um_s:
            continue
        if chosen:
            way = math.dist(position, smoothed.position_um[chosen[-1]])
            passed_s = seconds(smoothed.stamps_ns[index] - smoothed.stamps_ns[chosen[-1]])
            # Both sides of a smoothed flow remember.
            if way < spacing_radii * robot.radius_um or passed_s < 2.0 * smoothed.memory_s[index]:
                continue
        chosen.append(index)
    stamp_ns = smoothed.stamps_ns[-1] if smoothed.stamps_ns else 0
    return Observations(stamp_ns, smoothed.position_um[chosen], smoothed.flow_um_s[chosen], std[chosen])
