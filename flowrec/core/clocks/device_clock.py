"""Maps the clock inside a camera to the session clock, from pairs of (device time, arrival).

    arrival = offset + rate * device + delay,    delay >= 0

A frame is never early and sometimes very late, so the clock is the lower envelope of the arrivals, not their mean: of
all lines below every arrival, the one nearest to them (Moon, Skelly & Towsley, "Estimation and removal of clock skew
from network delay measurements", INFOCOM 1999). It is the edge of the lower convex hull over their mean, computed from
the earliest arrival of each half second of the last minute: memory is bounded, and a skew that drifts with temperature
is followed. The smallest delay can not be distinguished from the offset and remains in the stamps.

The stamps follow the envelope at a limited rate, so that an improved fit never causes a step.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

from flowrec.core.units import NS_PER_S, nanoseconds, seconds

_WINDOW_S = 60.0  # long compared with stalls, short compared with changes of temperature
_INTERVAL_S = 0.5  # the earliest arrival of each interval is used
_LEAST_SPAN_S = 5.0  # for a shorter time the skew is zero: it can not be distinguished from jitter
_FOLLOW_S = 1.0  # time constant with which the stamps follow an improved fit
SLEW = 0.01  # largest relative change of their rate
_UNIT_S = 1.0  # over which the unit is measured
_UNIT_TOLERANCE = 0.2  # relative difference beyond which the measured unit replaces the stated one
_EARLY_S = 0.05  # a frame that is earlier than this means that the device's clock was set forwards
_LATE_S = 0.25  # if all frames are later than this, it was set back or stood still
_BACK_S = 1.0  # a frame that is older than this is a reset, not disorder

Point = tuple[int, int]  # device time, unwrapped, in its own unit; arrival, ns on the session clock


@dataclass(frozen=True, slots=True)
class Fit:
    """All that is known of a camera's clock after one frame.

    Attributes
    ----------
    stamp_ns : of the last good frame on the session clock; strictly increasing.
    device, arrival_ns : of the last frame, unchanged.
    flag : irregularity of this frame: '', duplicate, out of order (both are to be skipped), wrapped, reset, unit, jump.
    rate : ns of the session clock per count of the device.
    fitted_ns : predicted earliest arrival of the last good frame.
    late_ns : arrival minus prediction; negative only by rounding.
    unit : ns per count as measured, where it differs from the stated unit; 0.0 otherwise.
    known : whether the rate has been measured rather than stated.
    duplicates, disordered, wraps, resets, jumps : numbers of events since the first frame.
    """

    stamp_ns: int
    device: int
    arrival_ns: int
    flag: str = ""
    rate: float = 1.0
    fitted_ns: int = 0
    late_ns: int = 0
    unit: float = 0.0
    known: bool = False
    duplicates: int = 0
    disordered: int = 0
    wraps: int = 0
    resets: int = 0
    jumps: int = 0
    # The memory of the fit.
    last: Point = (0, 0)  # last good frame
    wrap_offset: int = 0  # counts added for wrap-arounds
    support: Point = (0, 0)  # a point of the envelope
    first: Point = (0, 0)  # first frame of this fit
    first_points: tuple[Point, ...] = ()  # of one second, until the unit is known
    suspected_unit: float = 0.0  # measured in the previous second, if it differed from the stated one
    unit_known: bool = False
    earliest: Point = (0, 0)  # arrival relative to the fit, in the present interval
    interval_start: int = 0  # device time
    minima: tuple[Point, ...] = ()  # earliest arrivals of the intervals before
    old_frames: int = 0  # consecutive frames older than the last good one
    late_intervals: int = 0  # consecutive intervals without a frame that arrived in time

    @property
    def good(self) -> bool:
        """True if the last frame is new; otherwise it is to be skipped and `stamp_ns` is that of an earlier frame."""
        return self.flag not in ("duplicate", "out of order")


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """Settings of the fit. `take` is called with every frame that arrives; its memory is the previous Fit.

    A camera whose unit is not known should be observed for some seconds before a run begins: until then the stated unit
    is used, and if the measured one differs, a step is flagged.
    """

    unit: float = 1.0  # ns per count, as the manufacturer states
    wrap: int = 1 << 32  # counters of fewer than 64 bits start again at this count

    def take(self, fit: Fit | None, device: int, arrival_ns: int) -> Fit:
        """The fit after one more frame, with its stamp or the reason why it is to be skipped."""
        if fit is None:
            return _restart(Fit(arrival_ns - 1, device, arrival_ns, rate=self.unit), device, arrival_ns, "")
        x, wrap_offset = _unwrap(fit, device, arrival_ns, self.wrap)
        if x <= fit.last[0]:
            return _old(replace(fit, device=device, arrival_ns=arrival_ns), x)
        wraps = fit.wraps + (wrap_offset != fit.wrap_offset)
        if fit.old_frames or fit.flag or wraps != fit.wraps:
            flag = "wrapped" if wraps != fit.wraps else ""
            fit = replace(fit, flag=flag, wrap_offset=wrap_offset, wraps=wraps, old_frames=0)
        return _advance(fit, device, (x, arrival_ns))


def _old(fit: Fit, x: int) -> Fit:
    """The fit after a frame that is not newer than the last good one."""
    if x == fit.last[0]:
        return replace(fit, flag="duplicate", duplicates=fit.duplicates + 1)
    if seconds(round((fit.last[0] - x) * fit.rate)) > _BACK_S or fit.old_frames == 2:
        fit = replace(fit, resets=fit.resets + 1, wrap_offset=0)
        return _restart(fit, fit.device, fit.arrival_ns, "reset")
    return replace(fit, flag="out of order", disordered=fit.disordered + 1, old_frames=fit.old_frames + 1)


def _restart(fit: Fit, x: int, arrival_ns: int, flag: str) -> Fit:
    """A fit to one frame; the rate is retained and the stamps continue."""
    first = (x, arrival_ns)
    return replace(
        fit,
        stamp_ns=max(fit.stamp_ns + 1, arrival_ns),
        flag=flag,
        fitted_ns=arrival_ns,
        late_ns=0,
        last=first,
        support=first,
        first=first,
        first_points=() if fit.unit_known else (first,),
        earliest=first,
        interval_start=x,
        minima=(),
        old_frames=0,
        late_intervals=0,
    )


def _advance(fit: Fit, device: int, point: Point) -> Fit:
    """The fit after one more good frame."""
    x, arrival_ns = point
    fitted_ns = _fitted_ns(fit, x)
    early_ns = fitted_ns - arrival_ns
    if not fit.unit_known:
        early = (
            (*fit.first_points, point)
            if _is_over(fit, x, fit.first_points[-1][0], _UNIT_S / 64.0)
            else fit.first_points
        )
        fit = replace(fit, first_points=early, device=device, arrival_ns=arrival_ns)
        if len(early) > 7 and arrival_ns - early[0][1] >= nanoseconds(_UNIT_S):
            judged = _with_unit(fit, point)
            if judged is not None:
                return judged
            fit = replace(
                fit, first_points=(point,), suspected_unit=(early[-1][1] - early[0][1]) / (early[-1][0] - early[0][0])
            )
        if early_ns > nanoseconds(_EARLY_S):
            # The clock seems to count faster than stated; wait for the measurement.
            return replace(fit, last=point, stamp_ns=max(fit.stamp_ns + 1, arrival_ns))
    elif early_ns > nanoseconds(_EARLY_S):
        fit = replace(fit, device=device, arrival_ns=arrival_ns, jumps=fit.jumps + 1)
        return _restart(fit, x, arrival_ns, "jump")
    fitted_ns = min(fitted_ns, arrival_ns)
    fit = replace(
        fit,
        stamp_ns=_next_stamp(fit, x, fitted_ns),
        device=device,
        arrival_ns=arrival_ns,
        fitted_ns=fitted_ns,
        late_ns=arrival_ns - fitted_ns,
        last=point,
        support=point if early_ns > 0 else fit.support,
        earliest=point if _delay_ns(fit.rate, fit.earliest, point) < 0 else fit.earliest,
    )
    return _next_interval(fit, point) if _is_over(fit, x, fit.interval_start, _INTERVAL_S) else fit


def _next_stamp(fit: Fit, x: int, fitted_ns: int) -> int:
    """The next stamp: at the fitted rate, slightly faster or slower towards the envelope."""
    step_ns = (x - fit.last[0]) * fit.rate
    error_ns = fitted_ns - (fit.stamp_ns + step_ns)
    limit_ns = SLEW * step_ns
    correction_ns = error_ns * min(step_ns / (_FOLLOW_S * NS_PER_S), 1.0)
    return fit.stamp_ns + max(round(step_ns + min(max(correction_ns, -limit_ns), limit_ns)), 1)


def _next_interval(fit: Fit, point: Point) -> Fit:
    """Add the earliest arrival of an interval, drop those that are too old, and fit again."""
    late_intervals = (
        fit.late_intervals + 1 if fit.earliest[1] - _fitted_ns(fit, fit.earliest[0]) > nanoseconds(_LATE_S) else 0
    )
    if late_intervals == 4:
        return _restart(replace(fit, jumps=fit.jumps + 1), *point, "jump")
    oldest = point[0] - _WINDOW_S * NS_PER_S / fit.rate
    minima = tuple(one for one in (*fit.minima, fit.earliest) if one[0] >= oldest)
    rate, support, known = fit.rate, fit.support, fit.known
    least_s = min(_LEAST_SPAN_S, 2.0 * _INTERVAL_S) if fit.unit else _LEAST_SPAN_S
    if minima and _is_over(fit, minima[-1][0], minima[0][0], least_s):
        support, rate = envelope(minima)
        known = True
    elif minima:
        support = min(minima, key=lambda one: _delay_ns(fit.rate, minima[0], one))
    fit = replace(fit, rate=rate, support=support, known=known, minima=minima, late_intervals=late_intervals)
    return replace(fit, earliest=point, interval_start=point[0])


def _with_unit(fit: Fit, point: Point) -> Fit | None:
    """The fit with the unit measured over a second; None: not certain yet.

    A unit that differs from the stated one must be measured in two consecutive seconds: a host that is busy at
    first and then catches up receives frames at any rate.
    """
    half = len(fit.first_points) // 2
    # The median of rates over half a second each is insensitive to a stall and to frames that arrive in pairs.
    late, soon = fit.first_points[half:], fit.first_points[: len(fit.first_points) - half]
    rates = sorted((b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(soon, late, strict=True))
    rate = max(rates[len(rates) // 2], 1e-12)
    judged = replace(fit, unit_known=True, first_points=())
    if abs(math.log(rate / fit.rate)) < math.log(1.0 + _UNIT_TOLERANCE):
        support = min((fit.support, *fit.first_points), key=lambda one: _delay_ns(fit.rate, fit.first, one))
        return _advance(replace(judged, support=support), judged.device, point)
    if fit.suspected_unit and abs(math.log(rate / fit.suspected_unit)) < math.log(1.1):
        return _restart(replace(judged, rate=rate, unit=rate), *point, "unit")
    return None


def _unwrap(fit: Fit, device: int, arrival_ns: int, wrap: int) -> tuple[int, int]:
    """Device time with the counts of wrap-arounds added, and those counts."""
    x = device + fit.wrap_offset
    if not 0 <= device < wrap or fit.last[0] - x < wrap // 2:
        return x, fit.wrap_offset
    expected = fit.last[0] + (arrival_ns - fit.last[1]) / fit.rate
    again = x + wrap * round((expected - x) / wrap)
    near = abs(again - expected) * fit.rate < _LATE_S * NS_PER_S and again > fit.last[0]
    return (again, again - device) if near else (x, fit.wrap_offset)


def envelope(points: tuple[Point, ...]) -> tuple[Point, float]:
    """The line below all points and nearest to them: one of its points, and its rate.

    The sum of the distances is smallest for the edge of the lower convex hull that contains the points' mean. `points`:
    in order of device time. Raises ValueError: fewer than two different points.
    """
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (x - hull[-2][0]) >= (y - hull[-2][1]) * (
            hull[-1][0] - hull[-2][0]
        ):
            hull.pop()
        hull.append((x, y))
    total = sum(x for x, _ in points)
    for a, b in itertools.pairwise(hull):
        if b[0] * len(points) >= total:
            return a, (b[1] - a[1]) / (b[0] - a[0])
    raise ValueError("an envelope of less than two points")


def _fitted_ns(fit: Fit, x: int) -> int:
    return fit.support[1] + round((x - fit.support[0]) * fit.rate)


def _delay_ns(rate: float, than: Point, point: Point) -> float:
    """Delay of a point relative to another one at a rate, ns."""
    return point[1] - than[1] - (point[0] - than[0]) * rate


def _is_over(fit: Fit, x: int, interval_start: int, time_s: float) -> bool:
    return (x - interval_start) * fit.rate >= time_s * NS_PER_S
