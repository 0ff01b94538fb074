"""The Kalman filter's noise from a recording: position noise from a parked robot, the flow's changes from the NIS.

The mean normalised innovation squared (NIS) falls as either is stated larger, and is 2 when both are right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowrec.errors import UsageError
from flowrec.estimation.kalman import Kalman
from flowrec.messages import Applied, Estimate, FlowField, Track
from flowrec.robot import Robot
from flowrec.units import seconds

RIGHT_NIS = 2.0
_PIECE_S = 0.5  # over which the drift of a parked robot is taken for straight
_LEAST_PIECES = 3
_SETTLING = 45  # frames that the filter needs before its innovations count
_AGILITY = (1e-3, 1e3)
_STEPS = 8  # of a bisection of those six decades: to a sixth of a factor of ten


@dataclass(frozen=True, slots=True)
class Tuned:
    """What a recording recommends."""

    position_noise_um: float
    source: str  # of it: parked, or moving where the robot never rested
    agility: float
    nis: float  # mean, with these
    nis_before: float  # mean, with the settings as they were
    rest_s: float  # for how long the robot rested

    @property
    def sets(self) -> list[str]:
        """As settings for the command line."""
        return [
            f"observer.kalman.position_noise_um={self.position_noise_um:.3g}",
            f"observer.kalman.agility={self.agility:.3g}",
        ]


def parked_noise(tracks: Sequence[Track], applied: Sequence[Applied]) -> tuple[float, float]:
    """One sigma in um of the position of a robot that is not driven, and for how long in s it was not.

    The rest is cut into half seconds; in each a quadratic drift is taken out, and what scatters around it is measured
    by its median, so that a jump of the tracker does not count. NaN where there are fewer than three.

    A camera's error that stands still with the robot drifts out with it, so this is what a filter calls noise.
    """
    sigmas: list[float] = []
    rest_s = 0.0
    piece: list[Track] = []
    for track, done in zip(tracks, applied, strict=True):
        if not track.seen or np.any(done.turns != 0.0):
            piece = []
            continue
        piece.append(track)
        if seconds(track.stamp_ns - piece[0].stamp_ns) >= _PIECE_S and len(piece) >= 8:
            rest_s += seconds(track.stamp_ns - piece[0].stamp_ns)
            time = np.array([seconds(one.stamp_ns - piece[0].stamp_ns) for one in piece])
            powers = np.vander(time, 3)
            place = np.array([one.position_um for one in piece])
            away = place - powers @ np.linalg.lstsq(powers, place, rcond=None)[0]
            free = len(piece) / (len(piece) - 3.0)
            sigmas.append(1.4826 * float(np.median(np.abs(away))) * math.sqrt(free))
            piece = []
    if len(sigmas) < _LEAST_PIECES:
        return math.nan, rest_s
    return float(np.median(sigmas)), rest_s


def moving_noise(tracks: Sequence[Track], applied: Sequence[Applied], robot: Robot) -> float:
    """One sigma in um from third differences of the positions less the robot's own way: a second choice.

    A flow that changes smoothly drops out of them, and so does all noise that lasts for more than a few frames.
    NaN where there are fewer than eight in a row.
    """
    place = np.array([track.position_um for track in tracks]).reshape(-1, 2)
    moved = robot.um_per_rev * np.array([done.turns for done in applied]).reshape(-1, 2)
    third = np.diff(place - np.cumsum(moved, axis=0), n=3, axis=0)
    seen = np.array([track.seen for track in tracks], bool)
    whole = seen[:-3] & seen[1:-2] & seen[2:-1] & seen[3:] if len(tracks) > 3 else np.zeros(0, bool)
    if np.count_nonzero(whole) < 8:
        return math.nan
    return 1.4826 * float(np.median(np.abs(third[whole]))) / math.sqrt(20.0)  # 1 + 9 + 9 + 1


def mean_nis(
    kalman: Kalman,
    tracks: Sequence[Track],
    applied: Sequence[Applied],
    robot: Robot,
    fields: Sequence[FlowField | None] | None = None,
) -> float:
    """Of a filter that runs over a recording; outliers beyond the gate count as the gate."""
    found: list[float] = []
    last: Estimate | None = None
    for index, (track, done) in enumerate(zip(tracks, applied, strict=True)):
        last = kalman.estimate(last, track, done, robot, None if fields is None else fields[index])
        if index >= _SETTLING and math.isfinite(last.nis):
            found.append(min(last.nis, kalman.gate_nis))
    return float(np.mean(found)) if found else math.nan


def tune(
    tracks: Sequence[Track],
    applied: Sequence[Applied],
    robot: Robot,
    kalman: Kalman,
    fields: Sequence[FlowField | None] | None = None,
) -> Tuned:
    """Position noise where the robot was parked, then the agility that brings the mean NIS to 2.

    A position noise that is stated too large makes the NIS too small whatever the agility, so it comes first. With
    `fields` it is kalman_map that is tuned.

    Raises
    ------
    UsageError
        If the recording is too short to say anything.
    """
    before = mean_nis(kalman, tracks, applied, robot, fields)
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
        if mean_nis(replace(kalman, agility=math.exp(middle)), tracks, applied, robot, fields) > RIGHT_NIS:
            low = middle
        else:
            high = middle
    agility = math.exp(high)
    nis = mean_nis(replace(kalman, agility=agility), tracks, applied, robot, fields)
    return Tuned(noise, source, agility, nis, before, rest_s)
