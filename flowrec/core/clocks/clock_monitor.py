"""The clocks of a run: a message about once a second, and at once when a clock is set or a frame is irregular."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from flowrec.core.clocks.device_clock import Fit
from flowrec.core.diagnostics import Clocks
from flowrec.core.units import nanoseconds, seconds

_SET_S = 0.01  # a larger change of the wall clock relative to the monotonic one means that it was set
_SIMULTANEOUS_NS = 100_000  # between two readings of one clock, with the other clock's between them
_ATTEMPTS = 5  # to read both clocks within that time
_EVERY_NS = nanoseconds(1.0)  # between the messages on the session clock
_COUNTS = 1 << 63  # largest counter that a message can hold
CRYSTAL_PPM = 500.0  # largest plausible error of a camera's clock


def read_clocks() -> tuple[int, int]:
    """Monotonic and wall clock in ns, read simultaneously: again if the reading was interrupted."""
    best = (0, 0, 1 << 62)
    for _ in range(_ATTEMPTS):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < best[2]:
            best = ((before + after) // 2, wall, after - before)
        if best[2] < _SIMULTANEOUS_NS:
            break
    return best[0], best[1]


@dataclass(slots=True)
class _Lateness:
    """Delay of frames relative to the fit."""

    total_s: float = 0.0
    latest_s: float = 0.0
    frames: int = 0

    def add(self, late_s: float) -> None:
        self.total_s += late_s
        self.latest_s = max(self.latest_s, late_s)
        self.frames += 1

    @property
    def mean_s(self) -> float:
        return self.total_s / max(self.frames, 1)


class ClockMonitor:
    """Makes the Clocks messages of a run.

    `read`: returns monotonic and wall clock, ns.
    """

    def __init__(self, read: Callable[[], tuple[int, int]] = read_clocks) -> None:
        self._read = read
        self._offset_ns: int | None = None  # wall - monotonic
        self._first_offset_ns = 0
        self._wall_jumps = 0
        self._skipped = 0
        self._recent, self._all = _Lateness(), _Lateness()  # since the last message, and since the start
        self._last: Clocks | None = None

    def count_skipped(self) -> None:
        """A frame was left out because its stamp did not increase."""
        self._skipped += 1

    def update(self, stamp_ns: int, fit: Fit | None) -> Clocks | None:
        """The latest message, a new one when it is due. `fit` is that of the camera's clock, if it has one."""
        monotonic_ns, wall_ns = self._read()
        offset_ns = wall_ns - monotonic_ns
        if self._offset_ns is None:
            self._offset_ns = self._first_offset_ns = offset_ns
        if abs(offset_ns - self._offset_ns) > nanoseconds(_SET_S):
            self._wall_jumps += 1
        self._offset_ns = offset_ns
        if fit is not None:
            for lateness in (self._recent, self._all):
                lateness.add(seconds(fit.late_ns))
        last, known = self._last, fit if fit is not None else Fit(0, 0, 0)
        counts = (self._wall_jumps, self._skipped, *_irregularities(known))
        unchanged = last is not None and counts == (last.wall_jumps, last.passed_over, *_irregularities(last))
        if last is not None and unchanged and stamp_ns < last.stamp_ns + _EVERY_NS:
            return last
        self._last = Clocks(
            stamp_ns=stamp_ns,
            monotonic_ns=monotonic_ns,
            wall_ns=wall_ns,
            wall_set_s=seconds(offset_ns - self._first_offset_ns),
            wall_jumps=self._wall_jumps,
            passed_over=self._skipped,
            device=known.device % _COUNTS,
            arrival_ns=known.arrival_ns,
            fitted_ns=known.fitted_ns,
            rate=known.rate if fit is not None else 0.0,
            known=known.known,
            late_s=self._recent.mean_s,
            latest_s=self._recent.latest_s,
            duplicates=known.duplicates,
            disordered=known.disordered,
            wraps=known.wraps,
            resets=known.resets,
            jumps=known.jumps,
            unit=known.unit,
        )
        self._recent = _Lateness()
        return self._last

    def outcome(self) -> dict[str, str]:
        """For the end of a session: both clocks, read simultaneously, and a line of text."""
        monotonic_ns, wall_ns = self._read()
        facts = {"wall_ns": str(wall_ns), "monotonic_ns": str(monotonic_ns)}
        if self._last is not None:
            facts["clocks"] = _summary(self._last, self._all.mean_s, self._all.latest_s)
        return facts


def _summary(last: Clocks, late_s: float, latest_s: float) -> str:
    """The clocks of a run in one line."""
    parts = [camera_summary(last, late_s, latest_s)] if last.rate else []
    parts += [f"{count} frames {what}" for what, count in irregular_frames(last)]
    if last.wall_jumps:
        parts.append(f"wall clock set {last.wall_jumps} times, by {last.wall_set_s:+.3f} s in all")
    return "; ".join(parts) or "nothing is known of a camera's clock"


def camera_summary(last: Clocks, late_s: float, latest_s: float) -> str:
    """The camera's clock in one line: its last message, and mean and maximum delay of the frames."""
    if last.unit:
        skew = f"counts {last.rate:.6g} ns at a time and not what it was said to"
    elif not last.known:
        skew = "was not measured, the run was too short"
    else:
        skew = f"{skew_ppm(last):+.1f} ppm"
    return (
        f"camera's clock {skew}; frames arrived {1e3 * late_s:.2f} ms late on average, {1e3 * latest_s:.1f} ms at most"
    )


def skew_ppm(clocks: Clocks) -> float:
    """Relative rate of the camera's clock to the host's minus 1, in ppm; NaN where the unit is not as stated."""
    return 1e6 * (1.0 / clocks.rate - 1.0) if clocks.rate and not clocks.unit else math.nan


def irregular_frames(last: Clocks) -> list[tuple[str, int]]:
    """Kinds of irregular frames that occurred, as text, and how often."""
    counts = {
        "came twice": last.duplicates,
        "out of order": last.disordered,
        "with the camera's clock set back": last.resets,
        "with the camera's clock set forwards, or standing still before": last.jumps,
        "whose stamp did not grow passed over": last.passed_over,
    }
    return [(what, count) for what, count in counts.items() if count]


def _irregularities(of: Fit | Clocks) -> tuple[float, ...]:
    """Figures of which a change causes a message at once."""
    return (of.duplicates, of.disordered, of.resets, of.jumps, of.unit)
