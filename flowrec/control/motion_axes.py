"""What a robot's motion says about the axes: the gain from its own motion as commanded to its displacement as seen.

The gain M (2, 2) is the identity times the share of the um per revolution that it truly moves, if camera and coils are
as stated; a wrong axis makes it one of the other seven orientations. Its size tells no scale of the image, because it
is that scale times the true um per revolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.orientation import AS_STATED, ORIENTATIONS, Orientation, camera_settings, likeness
from flowrec.chip.registration import Calibration
from flowrec.control.coils import Coils
from flowrec.enums import AxesVerdict

# A robot that steps out at 0.7 of the field's frequency still moves a third of what is expected.
_LEAST_MOTION = 0.2  # of the motion that is expected
_STANDARD_ERRORS = 5.0  # by which the best orientation is ahead of the next one
_LEAST_FRAMES = 30
_JUMP = 10.0  # times the median of the second differences
_PARTS, _LEAST_PARTS = 8, 4  # of a recording, and of those that determine a gain
_WORST_CONDITION = 1e3  # of the commands of a part


@dataclass(frozen=True, slots=True)
class MotionVerdict:
    """`orientation` is that of the chip's axes as seen relative to those of the command, if it is decided."""

    verdict: AxesVerdict
    orientation: Orientation = AS_STATED


def orientation_by_motion(gain: NDArray[np.float64], std: float) -> MotionVerdict:
    """The verdict of a gain (2, 2) whose elements have this standard deviation."""
    like = likeness(gain)
    second, best = np.sort(like)[-2:].tolist()
    if not math.isfinite(std) or not np.isfinite(gain).all():
        return MotionVerdict(AxesVerdict.UNDECIDED)
    if math.hypot(*gain.ravel().tolist()) / math.sqrt(2.0) + 2.0 * std < _LEAST_MOTION:
        return MotionVerdict(AxesVerdict.NO_MOTION)
    if best < _LEAST_MOTION or best - second < _STANDARD_ERRORS * std:
        return MotionVerdict(AxesVerdict.UNDECIDED)
    found = ORIENTATIONS[int(like.argmax())]
    return MotionVerdict(AxesVerdict.AGREES if found == AS_STATED else AxesVerdict.CONTRADICTS, found)


def own_gain(
    stamps_s: NDArray[np.float64], positions_um: NDArray[np.float64], own_um: NDArray[np.float64], lag_s: float
) -> tuple[NDArray[np.float64], float]:
    """The gain of a whole recording, and its standard deviation from that of its parts.

    Second differences over `lag_s` are compared: the flow changes slowly against the commands.

    Parameters
    ----------
    stamps_s, positions_um, own_um : (n,), (n, 2) and (n, 2): when and where the robot was seen, and its own motion as
        commanded up to then.
    lag_s : more than the delay from command to motion.
    """
    bad = np.full((2, 2), math.nan), math.inf
    if len(stamps_s) < _LEAST_FRAMES or stamps_s[-1] - stamps_s[0] < 4.0 * lag_s:
        return bad
    at = np.arange(stamps_s[0] + lag_s, stamps_s[-1] - lag_s, 0.5 * lag_s)

    def bend(values: NDArray[np.float64]) -> NDArray[np.float64]:
        before, now, after = (
            np.column_stack([np.interp(at + shift, stamps_s, values[:, axis]) for axis in (0, 1)])
            for shift in (-lag_s, 0.0, lag_s)
        )
        return np.asarray(before - 2.0 * now + after, np.float64)

    seen, own = bend(positions_um), bend(own_um)
    size = np.hypot(*seen.T)
    kept = size <= _JUMP * max(float(np.median(size)), 1e-9)  # jumps of the track
    gains = []
    for part in np.array_split(np.flatnonzero(kept), _PARTS):
        normal = own[part].T @ own[part]
        if len(part) < 3 or np.linalg.cond(normal) > _WORST_CONDITION:
            continue
        gains.append(np.linalg.solve(normal, own[part].T @ seen[part]).T)
    if len(gains) < _LEAST_PARTS:
        return bad
    each = np.array(gains)
    return np.median(each, axis=0), float(each.std(0, ddof=1).max()) / math.sqrt(len(gains))


def contradiction(orientation: Orientation, driver: str, settings: str, stated: Calibration | None) -> str:
    """The line on a robot that moves in another orientation than it is driven in, with the settings to paste.

    Parameters
    ----------
    driver, settings : what it is driven by, and the settings with which that would be right.
    stated : the registration of the image; None: it is known to be right.
    """
    moves = f"the robot moves {orientation.name}, relative to {driver}"
    if stated is None:
        return f"{moves}: set {settings}"
    image = camera_settings(orientation.in_image(stated).seen_by(stated))
    return f"{moves}: if it is the image that is so, set {image}; if it is {driver}, set {settings}"


def coil_settings(orientation: Orientation, coils: Coils) -> str:
    """coils.mt_per_a with the horizontal field in another orientation: that of a helix is across its way."""
    turn = orientation.matrix
    if coils.mode == "helix" and orientation.mirrored:
        turn = -turn
    field = np.array(coils.mt_per_a)
    field[:2] = turn @ field[:2]
    rows = ", ".join("[" + ", ".join(f"{v + 0.0:g}" for v in row) + "]" for row in field.tolist())
    return f"coils.mt_per_a = [{rows}]"
