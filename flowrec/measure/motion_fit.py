"""A movie against the log of its coils: offset and rate of the clocks, um per revolution, and the axes of the heading.

The robot's own motion is k n: k um per revolution, n the revolutions that the log tells (exact integrals, so a frame
may lie anywhere between two commands), turned by the heading offset, and mirrored if the log's y axis is opposed to the
chip's. What carries it besides is the flow, which changes slowly against the commands (whitening.py). The movie is
searched in the whole log (motion_search.py) and the best places are refined (motion_regression.py).

The offset is that of the motion. If movie and log share a clock it is the negative latency from the command to the
motion in the image. Otherwise latency and difference of the clocks are one number: nothing in a movie and a log tells
them apart.

A fit is refused if the log of another run could have given it: see `refusal`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import exp1

from flowrec.core import Floats, FlowField, Ints, UsageError
from flowrec.measure.motion_regression import MotionRegression, Place, TrackRegression, Turns, heading_and_size
from flowrec.measure.motion_search import SearchRange, search
from flowrec.physics import sample
from flowrec.stages import FREEDOM, RESTART, SKIPPED, USED, Flags, fit_noise, whiten, without_jumps

# Of 72 simulated missions all pass with their own log, which explains 0.73 to 0.97. Of 288 comparisons with logs of
# other runs, which explain 0 to 0.5 in most cases, 2 pass: on the same chip, where the commands are nearly the same and
# the offset is right to 4 ms. Measured by python -m tests.perf.alignment.
LEAST_EXPLAINED = 0.65
UNEXPLAINED = "is it the log of another run, or does the track follow another particle"  # where no more is known
# Of a session and its own log on one clock nothing has to tell the log from that of another run. Images that are
# stamped up to 25 ms late, each by another time, leave 0.5 of the 0.84 that the same motion explains with right stamps,
# and the offset within its error; a track of another particle leaves 0.0.
LEAST_EXPLAINED_OWN = 0.2
LEAST_EXPLAINED_WITH_RATE = 0.75  # a rate that differs from 1 gives the log of another run one more way to fit
LARGEST_P_VALUE = 0.01  # of the best offset in time against the null: above it none was found
LEAST_FRAMES = 30
_SEARCHED_FRAMES = 1800  # of the part that moves most: where it lies in the log is searched for with these alone
_REFINED = 6  # places that are refined
_ROUNDS = 2  # of noise and parameters in turns
_GATE = 8.0  # standard deviations beyond which a position is no motion of this robot
_RATE_BY_CHANCE = 10.0  # logarithm of the likelihood by which a free rate must be better than rate 1
_AMBIGUOUS = 12.0  # the same of the best place against the second best
_SIGNIFICANT = 3.0  # standard errors
_SPIKE = 8.0  # times the median deviation from the line between the neighbours; a wrong position deviates more
_KINK = 3.0  # times the deviation of the neighbours from theirs; a change of velocity deviates as they do
# Another thing is followed from a frame on if the way to it exceeds that of 95 % of the frames so many times,
_JUMP = 6.0
_LONE_JUMP = 2.0  # or so many times, where the ways before and after it do not.
_LARGEST_EXCURSIONS = 0.25  # fraction of the frames that may be passed over as spent on other things
_LOG_VARIANCE = 0.03109  # of log(1 + x / FREEDOM) of normal noise, see `_explained`
# Systematic errors, in quadrature with the statistical ones; measured on simulated missions.
_OFFSET_S = 3e-4
_COMMAND_REVOLUTIONS = 0.03  # by which a change of the command takes effect late
_GAIN, _GAIN_WITHOUT_FLOW = 0.02, 0.05  # relative: the flow along the way changes with the robot's own motion
_HEADING_RAD = 0.009  # added to the standard error of the heading in quadrature: half a degree


class MotionFit(NamedTuple):
    """Time of the log = offset_s + rate * time of the movie. Each `_std` is one standard error, inf if not known."""

    offset_s: float
    offset_std_s: float
    rate: float  # exactly 1 if the estimate does not differ from it significantly
    rate_estimate: float
    rate_std: float  # of the estimate; 0: it was not searched
    um_per_rev: float
    um_per_rev_std: float
    heading_offset_rad: float  # heading in the chip = this + heading of the log; mirrored: this - heading of the log
    heading_offset_std_rad: float
    mirrored: bool
    explained: float  # fraction that the log explains of the changes of motion beyond the noise, see `_explained`
    second_explained: float  # the same at the best other place of the log
    p_value: float  # probability that an unrelated log fits as well somewhere
    refusal: str  # why the fit must not be used, for people; '' if it may be
    frames: int  # that were used
    left_out: int  # frames with a position that the robot can not have reached


def fit_motion(
    stamps_s: ArrayLike,
    positions_um: ArrayLike,
    turns: Turns,
    log_span_s: tuple[float, float],
    within: SearchRange,
    flow: FlowField | None = None,
    *,
    exact_log: bool = False,
    log_error_s: float = 0.0,
    own_log: bool = False,
) -> MotionFit:
    """Place a movie in a log. Raises UsageError: too few frames, a robot that does not move, or a log without turns.

    Parameters
    ----------
    stamps_s, positions_um : (n,) and (n, 2) of the frames in which the robot was seen, on the movie's clock.
    turns, log_span_s : the log, and its first and last time on its own clock.
    within : where to search.
    flow : known one, which carries the robot; its scale is fitted.
    exact_log : it tells what the field did; else what was commanded, which takes effect within a turn of the field.
    log_error_s : standard error of the times at which the log says that the field changed.
    own_log : it is that of this run for certain.
    """
    time_s, positions = _check_track(stamps_s, positions_um)
    carried = _flow_displacement(time_s, positions, flow)
    positions = positions - positions.mean(0)
    everything = _stretches(time_s, positions)
    noise = fit_noise(time_s, positions, everything)
    part = _liveliest(whiten(time_s, positions, everything, noise))
    free = (within.last_offset_s > within.first_offset_s, within.largest_rate > within.least_rate)
    seen = TrackRegression(time_s[part], positions[part], everything[part], noise, turns, free)
    candidates, p_value = search(seen, log_span_s, within)
    if not candidates:
        raise UsageError(
            "no turns of the field with the amplitude on at the times of the movie, so nothing can be compared"
        )
    track = TrackRegression(time_s, positions, everything, noise, turns, free, carried)
    places = [
        Place(each.offset_s + (each.rate - 1.0) * seen.middle_s, each.rate, each.mirrored)
        for each in candidates[:_REFINED]
    ]
    if len(seen.time_s) < len(time_s):  # where a part lies tells the rate well enough for the whole
        found_there = [seen.fit(each).place for each in places]
        lever_s = track.middle_s - seen.middle_s
        places = [each._replace(offset_s=each.offset_s + (each.rate - 1.0) * lever_s) for each in found_there]
    best = min((track.fit(each) for each in places), key=lambda fit: fit.cost)
    for _ in range(_ROUNDS):
        rest = track.remainder(best)
        noise = fit_noise(time_s, rest, track.flags, track.noise)
        track = replace(track, noise=noise, flags=without_jumps(time_s, rest, everything, noise, _GATE))
        best = track.fit(best.place)
    others = [track.fit(each) for each in places]
    nearer = (fit for fit in others if not _apart(fit.place, best.place, track))
    best = min((best, *nearer), key=lambda fit: fit.cost)
    apart = (fit for fit in others if _apart(fit.place, best.place, track))
    second = min(apart, key=lambda fit: fit.cost, default=None)
    late_s = math.hypot(_OFFSET_S, log_error_s)
    if not exact_log:  # a log of commands is late by a part of a revolution that differs from change to change
        late_s = math.hypot(late_s, _COMMAND_REVOLUTIONS / max(_mean_hz(track, best), 1e-3))
    least = LEAST_EXPLAINED_OWN if own_log else LEAST_EXPLAINED
    return _result(track, best, second, p_value, everything, late_s, least)


def _check_track(stamps_s: ArrayLike, positions_um: ArrayLike) -> tuple[Floats, Floats]:
    time_s, positions = np.array(stamps_s, np.float64), np.array(positions_um, np.float64)
    if positions.shape != (len(time_s), 2) or not np.isfinite(positions).all() or not (np.diff(time_s) > 0.0).all():
        raise UsageError("stamps must increase, and every one needs a position (x, y) that is a number")
    if len(time_s) < LEAST_FRAMES:
        raise UsageError(f"{len(time_s)} frames with the robot; at least {LEAST_FRAMES} are needed")
    if not np.ptp(positions, axis=0).any():
        raise UsageError("the robot does not move")
    return time_s, positions


def _flow_displacement(time_s: Floats, positions_um: Floats, flow: FlowField | None) -> Floats | None:
    """(n, 2) um that a flow carries the robot until each frame."""
    if flow is None:
        return None
    speed = np.array([sample(flow, point) for point in positions_um])
    steps = 0.5 * np.diff(time_s)[:, None] * (speed[1:] + speed[:-1])
    carried = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return carried if carried.any() else None


def _apart(one: Place, other: Place, track: TrackRegression) -> bool:
    """True if two places lie at different times of the log."""
    return abs(one.offset_s - other.offset_s) > 0.1 or abs(one.rate - other.rate) * track.duration_s > 0.2


def _result(
    track: TrackRegression,
    best: MotionRegression,
    second: MotionRegression | None,
    p_value: float,
    everything: Flags,
    late_s: float,
    least: float,
) -> MotionFit:
    # A position from which the track comes back at once is an error of the tracker: a command acts on the velocity.
    whole = replace(track, flags=np.where(track.flags == SKIPPED, track.flags, everything))
    ambiguous = second is not None and second.cost - best.cost < _AMBIGUOUS
    errors = track.covariance(best)
    rate, rate_std = best.place.rate, 0.0
    if track.free[1]:
        rate_std = math.hypot(math.sqrt(errors[1, 1]), 2.0 * late_s / track.duration_s)
        at_rate_1 = replace(track, free=(track.free[0], False))
        fixed = at_rate_1.fit(best.place._replace(rate=1.0))
        if not abs(rate - 1.0) > _SIGNIFICANT * rate_std or fixed.cost - best.cost < _RATE_BY_CHANCE:
            track, best, errors = at_rate_1, fixed, at_rate_1.covariance(fixed)
    place, middle_s = best.place, track.middle_s
    lever = np.array([1.0, -middle_s if track.free[1] else 0.0])
    variance = float(lever @ errors[:2, :2] @ lever) if np.isfinite(errors).all() else math.inf
    k, heading, k_std, heading_std = heading_and_size(best.gain, errors[2:, 2:])
    unsure = _GAIN if track.carried_um is not None else _GAIN_WITHOUT_FLOW
    left_out = int((track.flags == SKIPPED).sum())
    fit = MotionFit(
        # At the start of the movie's clock: the offset of its middle less (rate - 1) * middle.
        offset_s=place.offset_s - (place.rate - 1.0) * middle_s,
        offset_std_s=math.hypot(math.sqrt(max(variance, 0.0)), late_s),
        rate=place.rate,
        rate_estimate=rate,
        rate_std=rate_std,
        um_per_rev=k,
        um_per_rev_std=math.hypot(k_std, unsure * k),
        heading_offset_rad=heading,
        heading_offset_std_rad=math.hypot(heading_std, _HEADING_RAD),
        mirrored=place.mirrored,
        explained=_explained_fraction(whole, best),
        second_explained=0.0 if second is None else _explained_fraction(whole, second),
        p_value=p_value,
        refusal="",
        frames=len(track.flags) - left_out,
        left_out=left_out,
    )
    return fit._replace(refusal=_refusal(fit, least, ambiguous=ambiguous))


def _explained_fraction(track: TrackRegression, fit: MotionRegression) -> float:
    """Fraction of the logarithm of the likelihood above that of noise alone which the log accounts for; at most 1.

    As innovations have Student's t distribution, log(1 + square / freedom) of each counts: five positions of something
    else do not outweigh a hundred changes of the command. No stretch is left out because it does not fit, and the noise
    is that of the quiet half of the frames: large innovations, which the log of another run leaves, are not noise.
    """
    white, left = track.whiten(track.positions_um), track.whiten(track.remainder(fit))
    used = np.any(white != 0.0, axis=1)
    moved, rest = (white[used] ** 2).sum(1), (left[used] ** 2).sum(1)
    if not used.any():
        return 0.0
    quiet = max(float(np.median(rest)) / math.log(2.0), 1e-300)  # the mean square, if they were normal
    motion = float(np.log1p(moved / (FREEDOM * quiet)).sum())
    unexplained = float(np.log1p(rest / (FREEDOM * quiet)).sum())
    # The mean of log(1 + x / FREEDOM) for x of mean 1 and exponential distribution: normal noise of two axes.
    of_noise = len(rest) * math.exp(FREEDOM) * float(exp1(FREEDOM))
    # Motion hardly above the noise is explained by anything: so much of it may be noise.
    doubtful = 2.0 * math.sqrt(_LOG_VARIANCE * len(rest))
    return (motion - unexplained) / (motion - min(of_noise, unexplained) + doubtful) if motion > of_noise else 0.0


def _liveliest(white: Floats) -> slice:
    """The frames that are searched: all, or of a long movie those in a row with the largest innovations.

    The number of rates that a search must try grows with its length.
    """
    if len(white) <= _SEARCHED_FRAMES:
        return slice(0, len(white))
    # The root keeps one jump of the tracker from deciding.
    moved = np.concatenate([[0.0], np.cumsum(np.sqrt(np.hypot(*white.T)))])
    first = int(np.argmax(moved[_SEARCHED_FRAMES:] - moved[:-_SEARCHED_FRAMES]))
    return slice(first, first + _SEARCHED_FRAMES)


def _stretches(time_s: Floats, positions_um: Floats) -> Flags:
    """Flags (n,) that skip single wrong positions and excursions to other things, and begin a stretch at each jump."""
    flags: Flags = np.full(len(time_s), USED, np.int8)
    flags[_spikes(time_s, positions_um)] = SKIPPED
    kept = np.flatnonzero(flags == USED)
    velocity = np.diff(positions_um[kept], axis=0) / np.diff(time_s[kept])[:, None]
    speed = np.hypot(*velocity.T)
    fast, away = float(np.quantile(speed, 0.95)), _off_neighbours(velocity)
    jumps = (speed > _JUMP * fast) | (away > max(_LONE_JUMP * fast, _SPIKE * float(np.median(away))))
    flags[kept[1:][jumps]] = RESTART
    _skip_excursions(flags, kept, np.flatnonzero(jumps) + 1)
    return flags


def _skip_excursions(flags: Flags, kept: Ints, starts: Ints) -> None:
    """Skip what lies between two jumps if it is short: the track went to something else and came back.

    Parameters
    ----------
    kept : frames in use.
    starts : places in `kept` of those that the track jumped to.
    """
    left = int(_LARGEST_EXCURSIONS * len(kept))
    for first, last in sorted(itertools.pairwise(starts), key=lambda ends: int(ends[1] - ends[0])):
        if last - first > left:
            return
        flags[kept[first:last]] = SKIPPED
        left -= int(last - first)


def _off_neighbours(velocity: Floats) -> Floats:
    """Distance (n,) of each velocity (n, 2) from the line between those before and after it; 0 at the ends.

    A change of the command takes the velocity from one end of this line to the other, a jump takes it off.
    """
    before, here, after = velocity[:-2], velocity[1:-1], velocity[2:]
    along = after - before
    part = ((here - before) * along).sum(1) / np.maximum((along**2).sum(1), 1e-300)
    nearest = before + np.clip(part, 0.0, 1.0)[:, None] * along
    return np.pad(np.hypot(*(here - nearest).T), 1)


def _spikes(time_s: Floats, positions_um: Floats) -> Ints:
    """Positions far from the line between their neighbours, where these lie on that between theirs.

    Before the noise is known: a few wrong positions in a hundred make it look so large that no command is seen.
    """
    before, here, after = positions_um[1:-3], positions_um[2:-2], positions_um[3:-1]
    inner = ((time_s[2:-2] - time_s[1:-3]) / (time_s[3:-1] - time_s[1:-3]))[:, None]
    outer = ((time_s[2:-2] - time_s[:-4]) / (time_s[4:] - time_s[:-4]))[:, None]
    near, far = before + inner * (after - before), positions_um[:-4] + outer * (positions_um[4:] - positions_um[:-4])
    away, bend, moved = (np.hypot(*each.T) for each in (here - near, far - near, after - before))
    # A jump to something else, which lasts, moves the neighbours too.
    return np.flatnonzero((away > _SPIKE * np.median(away)) & (away > _KINK * bend) & (away > moved)) + 2


def _mean_hz(track: TrackRegression, fit: MotionRegression) -> float:
    """Root mean square of the field's frequency while it turns, Hz."""
    turns = track.turns(track.log_times_s(fit.place))
    speed = np.hypot(*np.diff(turns, axis=0).T) / (fit.place.rate * np.diff(track.time_s))
    turning = speed[speed > 0.0]
    return float(np.sqrt((turning**2).mean())) if turning.size else 0.0


def refusal_of(fit: MotionFit, least: float) -> str:
    """The refusal of a fit that explains less than is needed."""
    return (
        f"the log explains {100.0 * fit.explained:.0f} % of the robot's changes of motion, at least "
        f"{100.0 * least:.0f} % are needed: {UNEXPLAINED}"
    )


def _refusal(fit: MotionFit, least: float, *, ambiguous: bool) -> str:
    least = least if fit.rate == 1.0 else LEAST_EXPLAINED_WITH_RATE
    if fit.explained < least:
        return refusal_of(fit, least)
    if fit.p_value > LARGEST_P_VALUE or not math.isfinite(fit.offset_std_s):
        return (
            "the command changes too seldom in this movie to tell where in the log it lies (such a fit has probability "
            f"{fit.p_value:.2g} by chance); take a longer movie"
        )
    if ambiguous:
        return (
            f"two places of the log fit alike ({100.0 * fit.explained:.0f} and {100.0 * fit.second_explained:.0f} % "
            "are explained), as when commands repeat; take a longer movie"
        )
    return ""
