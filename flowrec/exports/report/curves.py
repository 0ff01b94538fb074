"""Curves over the time of a session in a fixed number of buckets: memory does not grow with the session."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, seconds

BUCKETS = 600  # of 0.3 mm in the widest figure
_MOST_SPANS = 200  # in one timeline; later ones are not drawn
_GAP = 4.0  # of the usual interval of values: a longer one interrupts the line


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A curve for a figure; a row of NaN interrupts it where there were no values.

    Attributes
    ----------
    time_s : (n,) session time.
    mean, low, high : (n,) mean, least and largest value around that time; equal where there is one value.
    """

    time_s: Floats
    mean: Floats
    low: Floats
    high: Floats

    def __bool__(self) -> bool:
        return len(self.time_s) > 0

    @property
    def known(self) -> Floats:
        """The means without the interruptions."""
        return self.mean[np.isfinite(self.mean)]

    @property
    def largest(self) -> float:
        """The largest value; NaN without any."""
        return float(np.nanmax(self.high)) if len(self.known) else math.nan


class CurveBuilder:
    """Takes values one by one; values that are not finite leave a gap.

    Parameters
    ----------
    first_ns, last_ns : stamps between which the values lie.
    """

    def __init__(self, first_ns: int, last_ns: int) -> None:
        self._first_ns = first_ns
        self._per_ns = BUCKETS / max(last_ns - first_ns, 1)
        self._rows: dict[int, tuple[int, float, float, float, float]] = {}  # number, time, mean, low, high by bucket

    def add(self, stamp_ns: int, value: float) -> None:
        if not math.isfinite(value):
            return
        at = min(max(int((stamp_ns - self._first_ns) * self._per_ns), 0), BUCKETS - 1)
        count, time_s, mean, low, high = self._rows.get(at, (0, 0.0, 0.0, value, value))
        count += 1
        # Running means: a sum of the largest floating-point numbers would overflow.
        time_s, mean = time_s + (seconds(stamp_ns) - time_s) / count, mean + (value / count - mean / count)
        self._rows[at] = count, time_s, mean, min(low, value), max(high, value)

    def curve(self) -> Curve:
        """The curve of all values so far."""
        table = np.array([row[1:] for _, row in sorted(self._rows.items())], np.float64).reshape(-1, 4)
        steps = np.diff(table[:, 0])
        if len(steps):
            gaps = np.flatnonzero(steps > _GAP * np.median(steps)) + 1
            between = 0.5 * (table[gaps, 0] + table[gaps - 1, 0])
            blank = np.column_stack([between, *[np.full(len(gaps), np.nan)] * 3])
            table = np.insert(table, gaps, blank, axis=0)
        return Curve(*np.ascontiguousarray(table.T))


@dataclass(frozen=True, slots=True)
class Span:
    """A state and how long it lasted, in session time."""

    name: str
    from_s: float
    to_s: float


class SpanBuilder:
    """Takes the states of successive ticks; '' means no state. No more than _MOST_SPANS are kept."""

    def __init__(self) -> None:
        self.spans: list[Span] = []
        self._name, self._from_s = "", 0.0

    def add(self, time_s: float, name: str) -> None:
        """The state from now on."""
        if name == self._name:
            return
        if self._name and len(self.spans) < _MOST_SPANS:
            self.spans.append(Span(self._name, self._from_s, time_s))
        self._name, self._from_s = name, time_s

    def end(self, time_s: float) -> None:
        """The session ends."""
        self.add(time_s, "")
