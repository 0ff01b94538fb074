"""The check of the axes: before anything is controlled, the robot is driven a little along x and y, and back.

No feedback acts meanwhile: with a wrong axis it would drive the robot away from where it is to be held. The assumed
flow is compensated only at a start where the robot had to be held; from the second round on, the flow that was seen.
The robot's own motion of a leg is at most a part of the distance to the walls, and returns, so that only the flow
carries it on. The regression of a part of a round usually decides, and the check ends with it, because a robot that is
not controlled meanwhile drifts; otherwise another, slower round follows, up to 3 s in all.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flowrec.core import Applied, AxesCheck, AxesVerdict, Floats, Track, seconds
from flowrec.physics import Calibration, Robot
from flowrec.stages.control.coils import Coils
from flowrec.stages.control.motion_axes import MotionVerdict, coil_settings, contradiction, orientation_by_motion

LIMIT_S = 3.0  # of driving, after which the check ends in any case
_WAYS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # of the legs of a round
_FIRST_ACROSS = 2  # leg along the other axis, from which on each position may decide
_LEG_S = 0.6  # at most, so that a round of a slow robot ends within the limit
_SPEED_SHARE = 0.6  # of the robot's limit: it does not step out
_LEAST_COUNT = 12  # positions of a round
_LEAST_REACH, _MOST_REACH = 0.2, 0.8  # radii that the robot moves out
_REACH_SHARE = 0.4  # of the distance of its surface to the wall
_FRAMES_LATE = 1.5  # frames until a command takes effect, besides the robot's delay
_GAP_S = 0.25  # without a position, after which a round begins again
_CORRELATED = 2.0  # factor on the standard deviation: the errors of successive positions are alike
_TERMS = 6  # of the regression: 1, t, t^2, t^3 and the robot's own motion along x and y
_WORST_CONDITION = 1e8  # of the normal matrix with ones on its diagonal
_LEAST_GAIN = 0.3  # of a round whose flow the next one compensates
_LEAST_STD = 0.02  # of the gain: the robot does not roll exactly as it is driven


def watch(
    previous: AxesCheck | None,
    track: Track,
    applied: Applied,
    robot: Robot,
    map_um_s: Floats,
    wall_um: float,
    frame_s: float,
    stated: Calibration,
    coils: Coils,
) -> AxesCheck | None:
    """The check after a frame; the previous message itself while the robot is not seen, and after the verdict.

    Parameters
    ----------
    map_um_s : (2,) the flow at the start by the map, to be compensated; 0: none is.
    wall_um : from the place where the robot starts to the nearest wall.
    frame_s : time from one image to the next.
    stated, coils : as configured, for the settings that the verdict names.
    """
    if not track.seen or (previous is not None and previous.verdict):
        return previous
    if previous is None:
        return _round(None, track, robot, wall_um, frame_s)
    dt_s = track.since_s(previous)
    if dt_s > _GAP_S:
        return _round(previous, track, robot, wall_um, frame_s)
    now = _with_position(previous, track, applied, robot, steady_velocity(previous, map_um_s), dt_s)
    if now.driven_s >= LIMIT_S:
        return _judge(now, stated, coils, last=True)
    leg, over = now.leg % len(_WAYS), _leg_is_over(now)
    if over:
        now = replace(now, leg=now.leg + 1, leg_ns=track.stamp_ns)
    if leg < _FIRST_ACROSS:
        return now
    judged = _judge(now, stated, coils, last=False)
    if judged.verdict:
        return judged
    return _round(judged, track, robot, wall_um, frame_s) if over and leg == len(_WAYS) - 1 else now


def steady_velocity(axes: AxesCheck | None, map_um_s: Floats) -> Floats:
    """(2,) velocity demanded against the flow: as the last round tells, or by the map, `map_um_s` (2,)."""
    return -map_um_s if axes is None or not len(axes.against_um_s) else axes.against_um_s


def leg_velocity(axes: AxesCheck | None) -> Floats:
    """(2,) velocity that the present leg demands; 0 before the first one."""
    if axes is None or axes.verdict:
        return np.zeros(2)
    return axes.speed_um_s * np.array(_WAYS[axes.leg % len(_WAYS)])


def _round(before: AxesCheck | None, track: Track, robot: Robot, wall_um: float, frame_s: float) -> AxesCheck:
    """The beginning of a round, each half as fast as the one before."""
    rounds = 0 if before is None else -(-before.leg // len(_WAYS))
    gap_um = max(wall_um - robot.radius_um, 0.0)
    out_um = min(max(_REACH_SHARE * gap_um, _LEAST_REACH * robot.radius_um), _MOST_REACH * robot.radius_um)
    late_s = robot.delay_s + _FRAMES_LATE * frame_s
    speed_um_s = min(_SPEED_SHARE * robot.speed_limit_um_s, 0.5 * out_um / late_s) * 0.5**rounds
    return AxesCheck(
        stamp_ns=track.stamp_ns,
        leg=rounds * len(_WAYS),
        leg_ns=track.stamp_ns,
        driven_s=0.0 if before is None else before.driven_s,
        round_ns=track.stamp_ns,
        from_um=track.position_um,
        own_um=np.zeros(2),
        steady_um=np.zeros(2),
        speed_um_s=speed_um_s,
        reach_um=out_um - speed_um_s * late_s,
        count=1,
        normal=np.diag([1.0] + [0.0] * (_TERMS - 1)),  # of this position
        moment=np.zeros((_TERMS, 2)),
        square_um2=np.zeros(2),
        gain=np.zeros((0, 0)) if before is None else before.gain,
        gain_std=0.0 if before is None else before.gain_std,
        against_um_s=np.zeros(0) if before is None else before.against_um_s,
    )


def _with_position(
    before: AxesCheck, track: Track, applied: Applied, robot: Robot, steady_um_s: Floats, dt_s: float
) -> AxesCheck:
    """The sums with one more position."""
    own_um = before.own_um + robot.um_per_rev * applied.turns
    moved_um = track.position_um - before.from_um
    time_s = seconds(track.stamp_ns - before.round_ns)
    terms = np.array((1.0, time_s, time_s**2, time_s**3, own_um[0], own_um[1]))
    return replace(
        before,
        stamp_ns=track.stamp_ns,
        driven_s=before.driven_s + dt_s,
        own_um=own_um,
        steady_um=before.steady_um + steady_um_s * dt_s,
        count=before.count + 1,
        normal=before.normal + terms[:, None] * terms,
        moment=before.moment + terms[:, None] * moved_um,
        square_um2=before.square_um2 + moved_um * moved_um,
    )


def _leg_is_over(now: AxesCheck) -> bool:
    """True if the robot is out, or back where the legs began, or the leg has lasted long enough."""
    axis, back = divmod(now.leg % len(_WAYS), 2)
    gone_um = float((now.own_um - now.steady_um)[axis])
    arrived = gone_um <= 0.0 if back else gone_um >= now.reach_um
    return arrived or seconds(now.stamp_ns - now.leg_ns) >= _LEG_S


def _judge(now: AxesCheck, stated: Calibration, coils: Coils, *, last: bool) -> AxesCheck:
    """The check with the gain of its round; with a verdict if that is decided, or if it is the last one."""
    found = _fit(now) if now.count >= _LEAST_COUNT else None
    if found is not None:
        gain, std, flow_um_s = found
        # Whatever the axes are, the inverse of the gain takes what is seen to what is to be commanded.
        known = bool(np.linalg.svd(gain)[1][-1] > _LEAST_GAIN)
        against = np.asarray(-np.linalg.solve(gain, flow_um_s), np.float64) if known else now.against_um_s
        now = replace(now, against_um_s=against)
        decides = orientation_by_motion(gain, std).verdict in (AxesVerdict.AGREES, AxesVerdict.CONTRADICTS)
        if decides or not now.gain.size or std < now.gain_std:
            now = replace(now, gain=gain, gain_std=std)
    said = MotionVerdict(AxesVerdict.UNDECIDED) if not now.gain.size else orientation_by_motion(now.gain, now.gain_std)
    if said.verdict in (AxesVerdict.UNDECIDED, AxesVerdict.NO_MOTION) and not last:
        return now
    return replace(now, verdict=said.verdict.value, text=_text(said, now, stated, coils))


def _fit(now: AxesCheck) -> tuple[Floats, float, Floats] | None:
    """Gain (2, 2), standard deviation of its elements and mean flow (2,) as seen, of a round; None: not determined."""
    size = np.sqrt(np.diag(now.normal))
    if not (size > 0.0).all():
        return None
    scaled = now.normal / (size[:, None] * size)
    if np.linalg.cond(scaled) > _WORST_CONDITION:
        return None
    inverse = np.linalg.inv(scaled) / (size[:, None] * size)
    found = inverse @ now.moment
    rest_um2 = np.maximum(now.square_um2 - (found * now.moment).sum(0), 0.0)
    variance_um2 = float(rest_um2.sum()) / (2.0 * (now.count - _TERMS))
    std = _CORRELATED * math.sqrt(variance_um2 * float(np.diag(inverse)[_TERMS - 2 :].max()))
    time_s = seconds(now.stamp_ns - now.round_ns)
    flow_um_s = found[1] + found[2] * time_s + found[3] * time_s**2  # mean over the round
    return found[_TERMS - 2 :].T, math.hypot(std, _LEAST_STD), flow_um_s


def _text(said: MotionVerdict, now: AxesCheck, stated: Calibration, coils: Coils) -> str:
    if said.verdict == AxesVerdict.CONTRADICTS:
        return contradiction(said.orientation, "the coils", coil_settings(said.orientation, coils), stated)
    if said.verdict == AxesVerdict.UNDECIDED:
        return f"the axes of camera and coils are not confirmed: {now.driven_s:.1f} s of small motions tell too little"
    size = math.hypot(*now.gain.ravel().tolist()) / math.sqrt(2.0)
    if said.verdict == AxesVerdict.NO_MOTION:
        return (
            f"the robot does not follow the field: it moves {100.0 * size:.0f} % of what is expected; is it the robot "
            "that is tracked, is it magnetic and free, and do the coils make their field?"
        )
    turned_deg = math.degrees(math.atan2(now.gain[1, 0] - now.gain[0, 1], now.gain[0, 0] + now.gain[1, 1]))
    own = f"{100.0 * size:.0f} +- {100.0 * now.gain_std:.0f} % of the stated motion, {turned_deg:+.0f} degrees off"
    return f"the axes are right: the robot moves as camera and coils say ({own} its heading)"
