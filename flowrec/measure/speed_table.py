"""The speed of a robot over the frequency of its field, by its motion: the table `robot.speed_at_hz`.

In each short window the mean velocity is that of s(f) h + c v: h the heading of the log, turned as the fit of the
motion found, v the known flow with a scale c of its own. s is linear between the pairs of the table and from
0 to the first one, so the speeds of the pairs follow by least squares, with weights of Student's t distribution.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flowrec.core import Z95, Floats, FlowField
from flowrec.measure.motion_fit import MotionFit
from flowrec.measure.motion_regression import Turns
from flowrec.physics import Robot, sample
from flowrec.stages import FREEDOM, FieldLog

_WINDOW_S = 0.25  # longer than the noise of a track, shorter than most commands hold
_PARTS = 8  # of a window, in which frequency and heading hold
_RARE = 0.05  # share of the slowest and of the fastest steps that make no pair
_EACH = 8  # windows of each pair, at least
_MOST = 6  # pairs
_APART = 1.15  # ratio of the bounds of the frequencies of a pair, at least
_REWEIGHTINGS = 5  # after which the weights hold
_BENT = 1.3  # ratio of the largest to the smallest um per revolution over the frequency, from which on it is told
_GAIN = 0.03  # systematic error, relative: the flow along the way changes with the robot's own motion


class SpeedTable(NamedTuple):
    """Pairs of frequency (Hz) and speed (um/s), both rising, and the standard errors of the speeds.

    `why_not` : why there are none, as words after a colon; '' if there are.
    """

    pairs: tuple[tuple[float, float], ...]
    std_um_s: tuple[float, ...]
    why_not: str = ""


def fit_speed_table(
    time_s: Floats, positions_um: Floats, turns: Turns, fit: MotionFit, flow: FlowField | None = None
) -> SpeedTable:
    """The table of a track (n,) and (n, 2), whose turns of the field are those of the log, not of a table.

    Parameters
    ----------
    fit : of the same track: offset, rate and heading of the log.
    flow : known one, which carries the robot; its scale is fitted.
    """
    first = np.unique(np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], _WINDOW_S)))
    span_s = np.diff(time_s[first])
    used = (span_s > 0.5 * _WINDOW_S) & (span_s < 2.0 * _WINDOW_S)
    begin, end, span_s = first[:-1][used], first[1:][used], span_s[used]
    parts = time_s[begin, None] + span_s[:, None] * np.arange(_PARTS + 1) / _PARTS
    turned = turns(fit.offset_s + fit.rate * parts.ravel()).reshape(*parts.shape, 2)
    steps = _in_chip(np.diff(turned, axis=1), fit)
    frequency_hz = np.hypot(steps[..., 0], steps[..., 1]) * (_PARTS / span_s[:, None])
    knots_hz = _knots(frequency_hz[frequency_hz > 0.0])
    if len(knots_hz) < 2:
        apart = f", about {knots_hz[0]:.3g} Hz" if len(knots_hz) else ""
        why = f"the field has one frequency only{apart}; record with a wider range of speeds, as a survey has it"
        return SpeedTable((), (), why)
    velocity = (positions_um[end] - positions_um[begin]) / span_s[:, None]
    places = 0.5 * (positions_um[end] + positions_um[begin])
    carried = np.zeros_like(velocity) if flow is None else np.array([sample(flow, place) for place in places])
    return _rising(knots_hz, *_speeds(frequency_hz, knots_hz, steps, velocity, carried))


def _knots(frequency_hz: Floats) -> Floats:
    """(k,) frequencies of pairs: medians of bins of equal ratios, where there are enough windows."""
    if not len(frequency_hz):
        return np.zeros(0)
    low_hz, high_hz = np.quantile(frequency_hz, (_RARE, 1.0 - _RARE))  # a step across a change has any
    frequency_hz = frequency_hz[(frequency_hz >= low_hz * (1.0 - 1e-9)) & (frequency_hz <= high_hz * (1.0 + 1e-9))]
    ratio = np.log(frequency_hz / frequency_hz.min())
    width = max(float(np.log(_APART)), float(ratio.max()) / _MOST * (1.0 + 1e-9))
    bins = (ratio / width).astype(int)
    parts = [frequency_hz[bins == number] for number in np.unique(bins)]
    kept: list[float] = []
    for part in parts:
        if len(part) >= _EACH * _PARTS and (not kept or np.median(part) > _APART * kept[-1]):
            kept.append(float(np.median(part)))
    return np.array(kept)


def _in_chip(steps: Floats, fit: MotionFit) -> Floats:
    """Turns (..., 2) of the log as turns in the chip."""
    x, y = steps[..., 0], -steps[..., 1] if fit.mirrored else steps[..., 1]
    c, s = np.cos(fit.heading_offset_rad), np.sin(fit.heading_offset_rad)
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _speeds(
    frequency_hz: Floats, knots_hz: Floats, steps: Floats, velocity: Floats, carried: Floats
) -> tuple[Floats, Floats]:
    """Speeds (k,) at the knots and their standard errors, by weighted least squares."""
    at_hz = np.append(0.0, knots_hz)
    size = np.hypot(steps[..., 0], steps[..., 1])
    headings = steps / np.maximum(size, 1e-12)[..., None]
    ones = np.eye(len(at_hz))[1:]  # a speed of 1 at one of the knots
    columns = [(np.interp(frequency_hz, at_hz, one)[..., None] * headings).mean(axis=1).ravel() for one in ones]
    columns += [carried.ravel()] if carried.any() else []
    X, y = np.column_stack(columns), velocity.ravel()
    weight = np.ones(len(velocity))
    for _ in range(_REWEIGHTINGS):
        W = np.repeat(weight, 2)
        unscaled = np.linalg.pinv(X.T @ (W[:, None] * X))
        found = unscaled @ X.T @ (W * y)
        square = ((y - X @ found).reshape(-1, 2) ** 2).sum(axis=1)
        variance = float((weight * square).sum()) / max(len(y) - len(found), 1)
        weight = (FREEDOM + 2.0) / (FREEDOM + square / max(variance, 1e-12))
    std = np.sqrt(variance * np.diag(unscaled))
    count = len(knots_hz)
    return found[:count], np.hypot(std[:count], _GAIN * found[:count])


def _rising(knots_hz: Floats, speeds: Floats, std: Floats) -> SpeedTable:
    """The pairs that are faster than all before them, so none beyond the fastest speed."""
    kept = [n for n, speed in enumerate(speeds) if speed > max(speeds[:n], default=0.0)]
    if len(kept) < 2:
        return SpeedTable((), (), "the speed does not rise with the frequency; does the robot step out at all of them")
    pairs = tuple((float(f"{knots_hz[n]:.4g}"), float(f"{speeds[n]:.4g}")) for n in kept)
    return SpeedTable(pairs, tuple(float(std[n]) for n in kept))


def proportional_log(log: FieldLog, robot: Robot) -> FieldLog:
    """The log of a field in which the robot without a table moves as this one does in that of `log`."""
    if not robot.speed_at_hz:
        return log
    as_moved_hz = [robot.proportional_hz(each) for each in log.frequency_hz.tolist()]
    return FieldLog(log.times_ns, as_moved_hz, log.heading_rad, log.amplitude_mt, log.currents_a)


def propose_table(found: SpeedTable, robot: Robot, sets: dict[str, Any]) -> list[str]:
    """Put a table into the settings of a robot that has one; sentences on it. Of another robot it is only named."""
    if robot.speed_at_hz and found.why_not:
        return [f"robot.speed_at_hz is not fitted: {found.why_not}"]
    if not found.pairs:
        return []
    stated = [robot.um_per_rev * robot.proportional_hz(hz) for hz, _ in found.pairs]
    errors = zip(found.pairs, found.std_um_s, stated, strict=True)
    off = [100.0 * (um_s / known - 1.0) for (_, um_s), std, known in errors if abs(um_s - known) > Z95 * std]
    text = ", ".join(f"{um_s:.4g} ± {std:.2g} um/s at {hz:.3g} Hz" for (hz, um_s), std in zip(*found[:2], strict=True))
    if robot.speed_at_hz:
        del sets["robot.um_per_rev"]  # that of the first pair
        sets["robot.speed_at_hz"] = found.pairs
        differ = f"; the stated table is up to {max(off, key=abs):+.0f} % off" if off else "; the stated table agrees"
        return [f"speeds: {text}{differ}"]
    slopes = [um_s / hz for hz, um_s in found.pairs]
    if max(slopes) < _BENT * min(slopes):
        return []
    return [f"the speed is not in proportion to the frequency ({text}): set robot.speed_at_hz = {list(found.pairs)}"]
