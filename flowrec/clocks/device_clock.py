"""The clock inside a camera -> the session clock, from pairs of (device time, arrival).

    arrival = offset + rate * device + delay,    delay >= 0

A frame is never early and sometimes very late, so the clock is the lower envelope of the arrivals and not their mean:
of all lines below every arrival, the one nearest to them (Moon, Skelly & Towsley, "Estimation and removal of clock
skew from network delay measurements", INFOCOM 1999). It is the edge of the lower convex hull over their mean, found
here on the earliest arrival of each half second of the last minute: memory is bounded, and a skew that drifts with
temperature is followed. The least delay itself can not be told from the offset; it stays in the stamps.

What is handed out follows the envelope at a limited rate, so that a better fit is never seen as a step.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

from flowrec.units import NS_PER_S, nanoseconds, seconds

Point = tuple[int, int]  # device time, unwrapped, in its own unit; arrival, ns on the session clock


@dataclass(frozen=True, slots=True)
class Fit:
    """All that is known of a camera's clock after one frame.

    Attributes
    ----------
    stamp_ns : of the last good frame on the session clock; strictly growing.
    device, arrival_ns : of the last frame, as they came.
    flag : what is wrong with this frame: '', duplicate, out of order (these two are to be passed over), wrapped, reset,
        unit, jump.
    rate : ns of the session clock to one count of the device.
    fitted_ns : when, by the fit, the last good frame would have arrived at the earliest.
    late_ns : how much later it did; below zero only by rounding.
    unit : what one count seems to be, ns, when it is not what it was said to be; 0.0 otherwise.
    known : whether the rate has been measured, and is not just what it was said to be.
    duplicates, disordered, wraps, resets, jumps : how often, since the first frame.
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
    last: Point = (0, 0)  # good frame
    turned: int = 0  # counts lost to wrap-arounds
    support: Point = (0, 0)  # a point of the envelope
    began: Point = (0, 0)  # first frame of this fit
    early: tuple[Point, ...] = ()  # of a second, until the unit is sure ...
    doubt: float = 0.0  # ... and what it was in the second before, where that was not what it should be
    sure: bool = False
    earliest: Point = (0, 0)  # of the half second that is going on ...
    since: int = 0  # ... which began at this device time
    kept: tuple[Point, ...] = ()  # of those before
    behind: int = 0  # frames in a row from before the last good one
    stood: int = 0  # half seconds in a row without one timely frame

    @property
    def good(self) -> bool:
        """Whether the last frame is new; else it is to be passed over and `stamp_ns` is not its own."""
        return self.flag not in ("duplicate", "out of order")


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """How to fit. `take` is called with every frame that arrives; its memory is the previous Fit.

    A camera whose unit is not known is best looked at for some seconds before a run begins: until then the unit is what
    it is said to be, and where it turns out to be another, a step is flagged.
    """

    unit: float = 1.0  # ns to one count, as the camera's maker says
    wrap: int = 1 << 32  # counters that are shorter than 64 bit begin again here
    window_s: float = 60.0  # long against stalls, short against changes of temperature
    piece_s: float = 0.5  # of each the earliest arrival is kept
    least_span_s: float = 5.0  # before, the skew is taken as zero: it can not be told from jitter
    follow_s: float = 1.0  # in about this time the stamps come round to a better fit ...
    slew: float = 0.01  # ... but never run faster or slower by more than this share
    sure_s: float = 1.0  # then the unit is judged ...
    unit_tolerance: float = 0.2  # ... to be another than said when it is off by more than this share
    early_s: float = 0.05  # no frame can be: the device's clock was set forwards
    late_s: float = 0.25  # frames that all are: it was set back, or stood still
    back_s: float = 1.0  # farther back is no disorder

    def take(self, fit: Fit | None, device: int, arrival_ns: int) -> Fit:
        """The fit after one more frame, with its stamp or with why it is to be passed over."""
        if fit is None:
            return self._begun(Fit(arrival_ns - 1, device, arrival_ns, rate=self.unit), device, arrival_ns, "")
        x, turned = self._unwrapped(fit, device, arrival_ns)
        if x <= fit.last[0]:
            return self._not_new(replace(fit, device=device, arrival_ns=arrival_ns), x)
        wraps = fit.wraps + (turned != fit.turned)
        if fit.behind or fit.flag or wraps != fit.wraps:
            flag = "wrapped" if wraps != fit.wraps else ""
            fit = replace(fit, flag=flag, turned=turned, wraps=wraps, behind=0)
        return self._on(fit, device, (x, arrival_ns))

    def _not_new(self, fit: Fit, x: int) -> Fit:
        """A frame that does not come after the last good one."""
        if x == fit.last[0]:
            return replace(fit, flag="duplicate", duplicates=fit.duplicates + 1)
        if seconds(round((fit.last[0] - x) * fit.rate)) > self.back_s or fit.behind == 2:
            fit = replace(fit, resets=fit.resets + 1, turned=0)
            return self._begun(fit, fit.device, fit.arrival_ns, "reset")
        return replace(fit, flag="out of order", disordered=fit.disordered + 1, behind=fit.behind + 1)

    def _begun(self, fit: Fit, x: int, arrival_ns: int, flag: str) -> Fit:
        """A fit that knows one frame; the rate is kept, and the stamps go on."""
        first = (x, arrival_ns)
        return replace(
            fit,
            stamp_ns=max(fit.stamp_ns + 1, arrival_ns),
            flag=flag,
            fitted_ns=arrival_ns,
            late_ns=0,
            last=first,
            support=first,
            began=first,
            early=() if fit.sure else (first,),
            earliest=first,
            since=x,
            kept=(),
            behind=0,
            stood=0,
        )

    def _on(self, fit: Fit, device: int, point: Point) -> Fit:
        """One more good frame."""
        x, arrival_ns = point
        fitted_ns = _at(fit, x)
        early_ns = fitted_ns - arrival_ns
        if not fit.sure:
            early = (*fit.early, point) if _apart(fit, x, fit.early[-1][0], self.sure_s / 64.0) else fit.early
            fit = replace(fit, early=early, device=device, arrival_ns=arrival_ns)
            if len(early) > 7 and arrival_ns - early[0][1] >= nanoseconds(self.sure_s):
                judged = self._judged(fit, point)
                if judged is not None:
                    return judged
                fit = replace(fit, early=(point,), doubt=(early[-1][1] - early[0][1]) / (early[-1][0] - early[0][0]))
            if early_ns > nanoseconds(self.early_s):
                # It seems to count faster than said; wait until that is sure.
                return replace(fit, last=point, stamp_ns=max(fit.stamp_ns + 1, arrival_ns))
        elif early_ns > nanoseconds(self.early_s):
            fit = replace(fit, device=device, arrival_ns=arrival_ns, jumps=fit.jumps + 1)
            return self._begun(fit, x, arrival_ns, "jump")
        fitted_ns = min(fitted_ns, arrival_ns)
        fit = replace(
            fit,
            stamp_ns=self._followed(fit, x, fitted_ns),
            device=device,
            arrival_ns=arrival_ns,
            fitted_ns=fitted_ns,
            late_ns=arrival_ns - fitted_ns,
            last=point,
            support=point if early_ns > 0 else fit.support,
            earliest=point if _late(fit.rate, fit.earliest, point) < 0 else fit.earliest,
        )
        return self._next_piece(fit, point) if _apart(fit, x, fit.since, self.piece_s) else fit

    def _followed(self, fit: Fit, x: int, fitted_ns: int) -> int:
        """The next stamp: on at the fitted rate, and a little faster or slower towards the envelope."""
        step_ns = (x - fit.last[0]) * fit.rate
        off_ns = fitted_ns - (fit.stamp_ns + step_ns)
        most_ns = self.slew * step_ns
        mend_ns = off_ns * min(step_ns / (self.follow_s * NS_PER_S), 1.0)
        return fit.stamp_ns + max(round(step_ns + min(max(mend_ns, -most_ns), most_ns)), 1)

    def _next_piece(self, fit: Fit, point: Point) -> Fit:
        """Keep the earliest of a piece, forget what is too old, and fit anew."""
        stood = fit.stood + 1 if fit.earliest[1] - _at(fit, fit.earliest[0]) > nanoseconds(self.late_s) else 0
        if stood == 4:
            return self._begun(replace(fit, jumps=fit.jumps + 1), *point, "jump")
        oldest = point[0] - self.window_s * NS_PER_S / fit.rate
        kept = tuple(one for one in (*fit.kept, fit.earliest) if one[0] >= oldest)
        rate, support, known = fit.rate, fit.support, fit.known
        least_s = min(self.least_span_s, 2.0 * self.piece_s) if fit.unit else self.least_span_s
        if kept and _apart(fit, kept[-1][0], kept[0][0], least_s):
            support, rate = envelope(kept)
            known = True
        elif kept:
            support = min(kept, key=lambda one: _late(fit.rate, kept[0], one))
        return replace(fit, rate=rate, support=support, known=known, kept=kept, earliest=point, since=point[0],
                       stood=stood)  # fmt: skip

    def _judged(self, fit: Fit, point: Point) -> Fit | None:
        """After a second: is a count what it is said to be? None: not sure yet.

        That it is not has to be seen in two seconds running: a host that is busy at first and then catches up sees
        frames at any rate.
        """
        half = len(fit.early) // 2
        # Over half a second each, and the median of them: neither a stall nor frames that come in pairs mislead it.
        late, soon = fit.early[half:], fit.early[: len(fit.early) - half]
        rates = sorted((b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(soon, late, strict=True))
        rate = max(rates[len(rates) // 2], 1e-12)
        judged = replace(fit, sure=True, early=())
        if abs(math.log(rate / fit.rate)) < math.log(1.0 + self.unit_tolerance):
            support = min((fit.support, *fit.early), key=lambda one: _late(fit.rate, fit.began, one))
            return self._on(replace(judged, support=support), judged.device, point)
        if fit.doubt and abs(math.log(rate / fit.doubt)) < math.log(1.1):
            return self._begun(replace(judged, rate=rate, unit=rate), *point, "unit")
        return None

    def _unwrapped(self, fit: Fit, device: int, arrival_ns: int) -> tuple[int, int]:
        """Device time with what wrap-arounds took added, and how much that is."""
        x = device + fit.turned
        if not 0 <= device < self.wrap or fit.last[0] - x < self.wrap // 2:
            return x, fit.turned
        expected = fit.last[0] + (arrival_ns - fit.last[1]) / fit.rate
        again = x + self.wrap * round((expected - x) / self.wrap)
        near = abs(again - expected) * fit.rate < self.late_s * NS_PER_S and again > fit.last[0]
        return (again, again - device) if near else (x, fit.turned)


def envelope(points: tuple[Point, ...]) -> tuple[Point, float]:
    """The line below all points and nearest to them: one of its points, and its rate.

    Points in order of device time, at least two different ones. The sum of the distances is least for the edge of the
    lower convex hull that lies over the points' mean.
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


def _at(fit: Fit, x: int) -> int:
    return fit.support[1] + round((x - fit.support[0]) * fit.rate)


def _late(rate: float, than: Point, point: Point) -> float:
    """By how much a point arrived later than another one at this rate, ns."""
    return point[1] - than[1] - (point[0] - than[0]) * rate


def _apart(fit: Fit, x: int, since: int, time_s: float) -> bool:
    return (x - since) * fit.rate >= time_s * NS_PER_S
