"""Log of the rotating field: a piecewise constant record, and the robot's turns that follow from it.

A rig keeps one and makes its `Applied` messages of it. The field of a row lasts from its stamp to the stamp of the next
row; that of the last row lasts on. Before the first row there is no field. Where the plane of rotation turns, the rows
are the segments of field_rotation.py, so that the turns are exact there as well (`extend`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import NS_PER_S, Applied, Floats, Ints, nanoseconds, seconds
from flowrec.stages.control.field_rotation import MotionSegment

_COILS = 3  # where no row says otherwise
_FREQUENCY, _HEADING, _AMPLITUDE, _CURRENTS = 0, 1, 2, slice(3, None)
_LEAST_ROWS = 64  # by which the log grows at least; it doubles
_PARTS = 8  # steps from row to row in which an interpolated field changes


class FieldRow(NamedTuple):
    """The field from one stamp on."""

    frequency_hz: float
    heading_rad: float  # direction in which the robot travels
    amplitude_mt: float
    currents_a: Floats  # (k,) of each coil, of three x, y, z; zeros if they are not known


class FieldLog:
    """Frequency, heading, amplitude and currents by time; see above.

    It has no lock: an owner whose threads append and read brings one. Raises ValueError: stamps that decrease, or
    arrays of other shapes.

    Parameters
    ----------
    times_ns : (n,) stamps, not decreasing; of rows with the same stamp the last one counts.
    frequency_hz, heading_rad, amplitude_mt : (n,)
    currents_a : (n, k) of k coils; None: not known.
    coils : their number k where no currents are given.
    """

    def __init__(
        self,
        times_ns: ArrayLike = (),
        frequency_hz: ArrayLike = (),
        heading_rad: ArrayLike = (),
        amplitude_mt: ArrayLike = (),
        currents_a: ArrayLike | None = None,
        coils: int = _COILS,
    ) -> None:
        currents = np.zeros((0, coils)) if currents_a is None else np.asarray(currents_a, np.float64)
        times = np.array(times_ns, np.int64)
        self._rows = len(times)
        if (np.diff(times) < 0).any():
            raise ValueError(f"stamps of a field log decrease after row {int(np.argmax(np.diff(times) < 0))}")
        self._times_ns = times
        self._values = np.zeros((self._rows, _CURRENTS.start + currents.shape[-1]))
        for column, given in ((_FREQUENCY, frequency_hz), (_HEADING, heading_rad), (_AMPLITUDE, amplitude_mt)):
            self._values[:, column] = np.asarray(given, np.float64)
        if currents_a is not None:
            self._values[:, _CURRENTS] = currents
        self._turns = np.zeros((self._rows, 2))  # from the first row to each row
        if self._rows:
            lasts_s = np.diff(times)[:, None] / NS_PER_S
            self._turns[1:] = np.cumsum(self._rates(slice(0, -1)) * lasts_s, axis=0)

    def __len__(self) -> int:
        return self._rows

    @property
    def times_ns(self) -> Ints:
        """(n,) stamps of the rows."""
        return self._times_ns[: self._rows]

    @property
    def frequency_hz(self) -> Floats:
        """(n,)"""
        return self._values[: self._rows, _FREQUENCY]

    @property
    def heading_rad(self) -> Floats:
        """(n,)"""
        return self._values[: self._rows, _HEADING]

    @property
    def amplitude_mt(self) -> Floats:
        """(n,)"""
        return self._values[: self._rows, _AMPLITUDE]

    @property
    def currents_a(self) -> Floats:
        """(n, k)"""
        return self._values[: self._rows, _CURRENTS]

    def append(
        self,
        stamp_ns: int,
        frequency_hz: float,
        heading_rad: float,
        amplitude_mt: float,
        currents_a: ArrayLike | None = None,
    ) -> None:
        """The field from a stamp on; a row of the same stamp is replaced.

        Raises ValueError: a stamp before that of the last row.
        """
        n = self._rows
        if n and stamp_ns < self._times_ns[n - 1]:
            raise ValueError(f"stamp {stamp_ns} ns is before the last row of the field log, {self._times_ns[n - 1]} ns")
        if n and stamp_ns == self._times_ns[n - 1]:
            n -= 1
        elif n == len(self._times_ns):
            self._grow()
        if n:
            lasts_s = seconds(stamp_ns - int(self._times_ns[n - 1]))
            self._turns[n] = self._turns[n - 1] + self._rates(slice(n - 1, n))[0] * lasts_s
        self._times_ns[n] = stamp_ns
        self._values[n, : _CURRENTS.start] = frequency_hz, heading_rad, amplitude_mt
        self._values[n, _CURRENTS] = 0.0 if currents_a is None else currents_a
        self._rows = n + 1

    def extend(
        self, stamp_ns: int, segments: Iterable[MotionSegment], amplitude_mt: float, currents_a: ArrayLike | None = None
    ) -> int:
        """Append the segments of a motion of the field, from a stamp on. Returns the stamp of their end."""
        for each in segments:
            self.append(stamp_ns, each.frequency_hz, each.heading_rad, amplitude_mt, currents_a)
            stamp_ns += nanoseconds(each.duration_s)
        return stamp_ns

    def forget(self, before_ns: int) -> None:
        """Drop the rows that ended before a stamp, so that the log of a long run stays small."""
        first = max(int(np.searchsorted(self.times_ns, before_ns, "right")) - 1, 0)
        kept = slice(first, self._rows)
        self._times_ns, self._values = self._times_ns[kept].copy(), self._values[kept].copy()
        self._turns = self._turns[kept] - self._turns[first] if self._rows else self._turns
        self._rows -= first

    def at(self, stamp_ns: int) -> FieldRow:
        """The field at a stamp."""
        row = int(np.searchsorted(self.times_ns, stamp_ns, "right")) - 1
        if row < 0:
            return FieldRow(0.0, 0.0, 0.0, np.zeros(self._values.shape[1] - _CURRENTS.start))
        values = self._values[row]
        frequency_hz, heading_rad, amplitude_mt = values[: _CURRENTS.start].tolist()
        return FieldRow(frequency_hz, heading_rad, amplitude_mt, values[_CURRENTS].copy())

    def turns_until(self, stamps_ns: ArrayLike) -> Floats:
        """(..., 2) revolutions along x and y from the first row to stamps (...): the integral of f (cos, sin) dt.

        Time without amplitude does not count. Stamps may be fractions of a ns.
        """
        stamps = np.asarray(stamps_ns)
        if not self._rows:
            return np.zeros((*stamps.shape, 2))
        row = np.maximum(np.searchsorted(self.times_ns, stamps, "right") - 1, 0)
        since_s = np.maximum(stamps - self._times_ns[row], 0) / NS_PER_S
        return self._turns[row] + self._rates(row) * since_s[..., None]

    def turns(self, from_ns: int, to_ns: int) -> Floats:
        """(2,) revolutions along x and y between two stamps; see `turns_until`."""
        begin, end = self.turns_until(np.array([from_ns, to_ns], np.int64))
        return end - begin

    def applied_at(self, stamp_ns: int, before_ns: int | None) -> Applied:
        """The message of a frame: the field at its stamp, and the turns since the previous frame (None: the first)."""
        now = self.at(stamp_ns)
        turns = self.turns(before_ns, stamp_ns) if before_ns is not None else np.zeros(2)
        return Applied(stamp_ns, now.frequency_hz, now.heading_rad, now.amplitude_mt, now.currents_a, turns)

    def shift_clock(self, offset_ns: int, rate: float = 1.0) -> Self:
        """The log on another clock, which shows rate * t + offset_ns when this one shows t."""
        times = self.times_ns if rate == 1.0 else np.rint(self.times_ns * rate).astype(np.int64)
        return type(self)(times + offset_ns, self.frequency_hz, self.heading_rad, self.amplitude_mt, self.currents_a)

    def interpolate(self) -> Self:
        """The field of rows that are samples: from one row to the next it changes evenly, in steps."""
        if self._rows < 2:
            return self
        parts = np.arange(_PARTS) / _PARTS
        begins, lasts = self.times_ns[:-1, None], np.diff(self.times_ns)[:, None]
        times = np.append(np.rint(begins + lasts * parts).astype(np.int64), self.times_ns[-1])
        middle = np.append((np.arange(self._rows - 1)[:, None] + parts + 0.5 / _PARTS).ravel(), self._rows - 1.0)
        rows = np.arange(self._rows)
        along, across = (np.interp(middle, rows, each) for each in self._rates(slice(0, self._rows)).T)
        held = np.minimum(middle.astype(np.intp), self._rows - 1)
        turns = np.hypot(along, across)
        amplitude = np.where(turns > 0.0, np.interp(middle, rows, self.amplitude_mt), self.amplitude_mt[held])
        return type(self)(times, turns, np.arctan2(across, along), amplitude, self.currents_a[held])

    def _rates(self, rows: slice | Ints) -> Floats:
        """(..., 2) revolutions per second along x and y; zero without amplitude."""
        values = self._values[rows]
        frequency = np.where(values[..., _AMPLITUDE] > 0.0, values[..., _FREQUENCY], 0.0)
        heading = values[..., _HEADING]
        return np.stack([frequency * np.cos(heading), frequency * np.sin(heading)], axis=-1)

    def _grow(self) -> None:
        more = max(len(self._times_ns), _LEAST_ROWS)
        self._times_ns = np.concatenate([self._times_ns, np.zeros(more, np.int64)])
        self._values = np.concatenate([self._values, np.zeros((more, self._values.shape[1]))])
        self._turns = np.concatenate([self._turns, np.zeros((more, 2))])
