"""Check of the axes by the robot's motion: the gain from its commanded own motion to its displacement as seen.

The gain M (2, 2) is the identity times the share of the um per revolution that it truly moves, if camera and coils are
as stated; a wrong axis makes it one of the other seven orientations. Its size tells no scale of the image, because it
is that scale times the true um per revolution.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np

from flowrec.core import NS_PER_S, Applied, AxesCheck, AxesVerdict, Floats, Tick
from flowrec.physics import AS_STATED, ORIENTATIONS, Calibration, Orientation, Robot, camera_settings, likeness
from flowrec.stages.control.coils import Coils

# A robot that steps out at 0.7 of the field's frequency still moves a third of what is expected.
_LEAST_MOTION = 0.2  # of the motion that is expected
_STANDARD_ERRORS = 5.0  # by which the best orientation is ahead of others, or of the stated one where that is refuted
_AMONG_OTHERS = 1.0  # by which one that refutes the stated one is ahead of the rest: it is named as the likeliest
_LEAST_FRAMES = 30
_JUMP = 10.0  # times the median of the second differences
_PARTS = 8  # of a recording
_WORST_CONDITION = 1e3  # of the commands
_LAG_S, _LAG_FRAMES = 0.25, 4.0  # of the differences that are compared, at least: more than the delay


@dataclass(frozen=True, slots=True)
class MotionVerdict:
    """`orientation` is that of the chip's axes as seen relative to those of the command, if it is decided."""

    verdict: AxesVerdict
    orientation: Orientation = AS_STATED


def orientation_by_motion(gain: Floats, std: Floats | float) -> MotionVerdict:
    """The verdict of a gain (2, 2) whose elements have these standard deviations (2, 2), or all of them this one."""
    errors = np.broadcast_to(np.asarray(std, np.float64), (2, 2))
    if not np.isfinite(errors).all() or not np.isfinite(gain).all():
        return MotionVerdict(AxesVerdict.UNDECIDED)
    if math.hypot(*gain.ravel().tolist()) / math.sqrt(2.0) + 2.0 * float(errors.max()) < _LEAST_MOTION:
        return MotionVerdict(AxesVerdict.NO_MOTION)
    like = likeness(gain)
    found = ORIENTATIONS[int(like.argmax())]
    agrees = found == AS_STATED
    for each, its in zip(ORIENTATIONS, like.tolist(), strict=True):
        apart = 0.5 * float(np.sqrt((((found.matrix - each.matrix) * errors) ** 2).sum()))
        least = _STANDARD_ERRORS if agrees or each == AS_STATED else _AMONG_OTHERS
        if each != found and like.max() - its < least * apart:
            return MotionVerdict(AxesVerdict.UNDECIDED)
    if like.max() < _LEAST_MOTION:
        return MotionVerdict(AxesVerdict.UNDECIDED)
    return MotionVerdict(AxesVerdict.AGREES if agrees else AxesVerdict.CONTRADICTS, found)


class MotionOfRun:
    """A sink of the ticks of one session: whether its whole motion tells what the check of the axes did not decide."""

    def __init__(self, robot: Robot) -> None:
        self._um_per_rev = robot.um_per_rev
        self._own_um, self._rows = np.zeros(2), array("d")  # time, position and own motion of each
        self._applied: Applied | None = None
        self._axes: AxesCheck | None = None

    def write(self, tick: Tick) -> None:
        """Take one tick."""
        self._axes = tick.axes
        if tick.applied is None or tick.applied is self._applied:
            return
        self._applied = tick.applied
        self._own_um = self._own_um + self._um_per_rev * tick.applied.turns
        if tick.track is not None and tick.track.seen:
            self._rows.extend((tick.stamp_ns / NS_PER_S, *tick.track.position_um, *self._own_um))

    def doubts(self) -> list[str]:
        """Reasons to doubt the axes: the check did not decide, nor does the motion since; empty if there are none."""
        if self._axes is None or self._axes.verdict != AxesVerdict.UNDECIDED:
            return []
        rows = np.array(self._rows).reshape(-1, 5)
        found = orientation_by_motion(*own_gain(rows[:, 0], rows[:, 1:3], rows[:, 3:]))
        if found.verdict == AxesVerdict.CONTRADICTS:
            return [f"the robot moved {found.orientation.name}, relative to the coils"]
        return [] if found.verdict == AxesVerdict.AGREES else [self._axes.text]


def own_gain(stamps_s: Floats, positions_um: Floats, own_um: Floats) -> tuple[Floats, Floats]:
    """The gain (2, 2) of a whole recording, and the standard deviations (2, 2) of its elements, by a jackknife.

    Second differences over a quarter of a second or more are compared: the flow changes slowly against the commands.

    Parameters
    ----------
    stamps_s, positions_um, own_um : (n,), (n, 2) and (n, 2): when and where the robot was seen, and its own motion as
        commanded up to then.
    """
    bad = np.full((2, 2), math.nan), np.full((2, 2), math.inf)
    lag_s = max(_LAG_S, _LAG_FRAMES * float(np.median(np.diff(stamps_s)))) if len(stamps_s) > 1 else _LAG_S
    if len(stamps_s) < _LEAST_FRAMES or stamps_s[-1] - stamps_s[0] < 4.0 * lag_s:
        return bad
    at = np.arange(stamps_s[0] + lag_s, stamps_s[-1] - lag_s, 0.5 * lag_s)

    def bend(values: Floats) -> Floats:
        before, now, after = (
            np.column_stack([np.interp(at + shift, stamps_s, values[:, axis]) for axis in (0, 1)])
            for shift in (-lag_s, 0.0, lag_s)
        )
        return np.asarray(before - 2.0 * now + after, np.float64)

    seen, own = bend(positions_um), bend(own_um)
    size = np.hypot(*seen.T)
    kept = size <= _JUMP * max(float(np.median(size)), 1e-9)  # jumps of the track
    parts = [part for part in np.array_split(np.flatnonzero(kept), _PARTS) if len(part)]
    normal = np.array([own[part].T @ own[part] for part in parts])
    moment = np.array([own[part].T @ seen[part] for part in parts])
    if len(parts) < _PARTS or np.linalg.cond(normal.sum(0)) > _WORST_CONDITION:
        return bad
    gain = np.linalg.solve(normal.sum(0), moment.sum(0)).T
    without = np.linalg.solve(normal.sum(0) - normal, moment.sum(0) - moment)  # of each part: the jackknife
    return gain, np.sqrt((len(parts) - 1) * without.var(0)).T


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
