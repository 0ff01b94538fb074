"""Tuning of the Kalman filter from a recording: position noise from a parked robot, flow changes from the NIS.

The mean normalised innovation squared (NIS) decreases when either noise is stated larger, and is 2 when both are right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flowrec.core import STD_PER_MAD, Applied, Estimate, FlowField, Track, UsageError, seconds
from flowrec.physics import Robot
from flowrec.stages import EXPECTED_NIS, Kalman

_INTERVAL_S = 0.5  # over which the drift of a parked robot is taken as quadratic
_LEAST_INTERVALS = 3  # whose median is the noise
_LEAST_SAMPLES = 8  # in an interval, of which a quadratic takes three, or third differences
_SETTLING = 45  # frames before the filter's innovations count
_AGILITY = (1e-3, 1e3)  # both ends of the search
_STEPS = 8  # of the bisection of these six decades: to 6 %


class Tuned(NamedTuple):
    """Recommended settings."""

    position_noise_um: float
    source: str  # of it: parked, or moving if the robot never rested
    agility: float
    nis: float  # mean, with these settings
    nis_before: float  # mean, with the previous settings
    rest_s: float  # for how long the robot rested

    @property
    def sets(self) -> list[str]:
        """As settings for the command line."""
        return [
            f"observer.kalman.position_noise_um={self.position_noise_um:.3g}",
            f"observer.kalman.agility={self.agility:.3g}",
        ]


def parked_noise(tracks: Sequence[Track], applied: Sequence[Applied]) -> tuple[float, float]:
    """One sigma in um of the measured position while the robot is not driven, and the duration in s.

    In intervals of half a second, a quadratic drift is subtracted and the scatter is measured by its median, so that a
    jump of the tracker does not count. NaN for fewer than three intervals. An error of the camera that is constant
    while the robot rests is subtracted with the drift, so this is what a filter calls noise.
    """
    sigmas: list[float] = []
    rest_s = 0.0
    interval: list[Track] = []
    for track, one_applied in zip(tracks, applied, strict=True):
        if not track.seen or np.any(one_applied.turns != 0.0):
            interval = []
            continue
        interval.append(track)
        if seconds(track.stamp_ns - interval[0].stamp_ns) >= _INTERVAL_S and len(interval) >= _LEAST_SAMPLES:
            time = np.array([seconds(each.stamp_ns - interval[0].stamp_ns) for each in interval])
            rest_s += float(time[-1])
            powers = np.vander(time, 3)
            position = np.array([each.position_um for each in interval])
            residual = position - powers @ np.linalg.lstsq(powers, position, rcond=None)[0]
            freedom = len(interval) / (len(interval) - 3.0)
            sigmas.append(STD_PER_MAD * float(np.median(np.abs(residual))) * math.sqrt(freedom))
            interval = []
    return (float(np.median(sigmas)) if len(sigmas) >= _LEAST_INTERVALS else math.nan), rest_s


def moving_noise(tracks: Sequence[Track], applied: Sequence[Applied], robot: Robot) -> float:
    """One sigma in um from third differences of the positions less the robot's own motion: the second choice.

    Third differences cancel a flow that changes smoothly, and also noise that lasts for more than a few frames. NaN for
    fewer than eight of them.
    """
    position = np.array([track.position_um for track in tracks]).reshape(-1, 2)
    moved = robot.um_per_rev * np.array([each.turns for each in applied]).reshape(-1, 2)
    third = np.diff(position - np.cumsum(moved, axis=0), n=3, axis=0)
    seen = np.array([track.seen for track in tracks], bool)
    complete = seen[:-3] & seen[1:-2] & seen[2:-1] & seen[3:] if len(tracks) > 3 else np.zeros(0, bool)
    if np.count_nonzero(complete) < _LEAST_SAMPLES:
        return math.nan
    return STD_PER_MAD * float(np.median(np.abs(third[complete]))) / math.sqrt(20.0)  # 1 + 9 + 9 + 1


def tune(
    tracks: Sequence[Track],
    applied: Sequence[Applied],
    robot: Robot,
    kalman: Kalman,
    fields: Sequence[FlowField | None] | None = None,
) -> Tuned:
    """Position noise while the robot was parked, then the agility for which the mean NIS is 2.

    Position noise that is stated too large makes the NIS too small for any agility, so it is determined first. With
    `fields`, kalman_map is tuned. Raises UsageError: the recording is too short.
    """

    def mean_nis(kalman: Kalman) -> float:
        """Mean NIS of a filter over the recording; values beyond the gate count as the gate. NaN without any."""
        found: list[float] = []
        last: Estimate | None = None
        for index, (track, one_applied) in enumerate(zip(tracks, applied, strict=True)):
            last = kalman.estimate(last, track, one_applied, robot, None if fields is None else fields[index])
            if index >= _SETTLING and math.isfinite(last.nis):
                found.append(min(last.nis, kalman.gate_nis))
        return float(np.mean(found)) if found else math.nan

    before = mean_nis(kalman)
    noise, rest_s = parked_noise(tracks, applied)
    source = "parked" if noise > 0.0 else "moving"
    if source == "moving":
        noise = moving_noise(tracks, applied, robot)
    if not (math.isfinite(before) and noise > 0.0):
        raise UsageError(
            f"{len(tracks)} frames with the robot are too few to tune an observer; record some seconds more"
        )
    kalman = replace(kalman, position_noise_um=noise)
    low, high = (math.log(end) for end in _AGILITY)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        if mean_nis(replace(kalman, agility=math.exp(middle))) > EXPECTED_NIS:
            low = middle
        else:
            high = middle
    agility = math.exp(high)
    return Tuned(noise, source, agility, mean_nis(replace(kalman, agility=agility)), before, rest_s)
