"""The clocks of a run side by side, told about once a second and whenever one of them does what it should not."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from flowrec.clocks.device_clock import Fit
from flowrec.messages import Clocks
from flowrec.units import nanoseconds, seconds

_SET_S = 0.01  # what the wall clock goes by against the monotonic one that it was set, and not read late
_TOGETHER_NS = 100_000
_TRIES = 5
_COUNTS = 1 << 63  # what a message can hold of a counter
CRYSTAL_PPM = 500.0  # no clock of a camera is off by more


def read_clocks() -> tuple[int, int]:
    """Monotonic and wall clock in ns, read at one moment: again where something came between."""
    best = (0, 0, 1 << 62)
    for _ in range(_TRIES):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < best[2]:
            best = ((before + after) // 2, wall, after - before)
        if best[2] < _TOGETHER_NS:
            break
    return best[0], best[1]


class ClockWatch:
    """Makes the Clocks messages of a run.

    Parameters
    ----------
    read : monotonic and wall clock, ns.
    every_s : of the session clock.
    """

    def __init__(self, read: Callable[[], tuple[int, int]] = read_clocks, every_s: float = 1.0) -> None:
        self._read = read
        self._every_ns = nanoseconds(every_s)
        self._apart_ns: int | None = None  # wall - monotonic
        self._first_apart_ns = 0
        self._wall_jumps = 0
        self._passed_over = 0
        self._late_s = self._latest_s = 0.0  # since the last message
        self._frames = 0
        self._all_late_s = self._worst_s = 0.0
        self._all_frames = 0
        self._said: Clocks | None = None

    def pass_over(self) -> None:
        """A frame whose stamp does not grow has been left out."""
        self._passed_over += 1

    def see(self, stamp_ns: int, fit: Fit | None) -> Clocks | None:
        """The latest message, a new one when it is time. `fit` is of the camera's clock, where it has one."""
        monotonic_ns, wall_ns = self._read()
        apart_ns = wall_ns - monotonic_ns
        if self._apart_ns is None:
            self._apart_ns = self._first_apart_ns = apart_ns
        if abs(apart_ns - self._apart_ns) > nanoseconds(_SET_S):
            self._wall_jumps += 1
        self._apart_ns = apart_ns
        if fit is not None:
            late_s = seconds(fit.late_ns)
            self._late_s, self._latest_s = self._late_s + late_s, max(self._latest_s, late_s)
            self._frames += 1
        said = self._said
        known = fit if fit is not None else Fit(0, 0, 0)
        counts = (self._wall_jumps, self._passed_over, *_faults(known))
        told = said is not None and counts == (said.wall_jumps, said.passed_over, *_faults(said))
        if said is not None and told and stamp_ns < said.stamp_ns + self._every_ns:
            return said
        self._said = Clocks(
            stamp_ns=stamp_ns,
            monotonic_ns=monotonic_ns,
            wall_ns=wall_ns,
            wall_set_s=seconds(apart_ns - self._first_apart_ns),
            wall_jumps=self._wall_jumps,
            passed_over=self._passed_over,
            device=known.device % _COUNTS,
            arrival_ns=known.arrival_ns,
            fitted_ns=known.fitted_ns,
            rate=known.rate if fit is not None else 0.0,
            known=known.known,
            late_s=self._late_s / max(self._frames, 1),
            latest_s=self._latest_s,
            duplicates=known.duplicates,
            disordered=known.disordered,
            wraps=known.wraps,
            resets=known.resets,
            jumps=known.jumps,
            unit=known.unit,
        )
        self._all_late_s += self._late_s
        self._all_frames += self._frames
        self._worst_s = max(self._worst_s, self._latest_s)
        self._late_s, self._latest_s, self._frames = 0.0, 0.0, 0
        return self._said

    def outcome(self) -> dict[str, str]:
        """For the end of a session: both clocks read together, and a line for people."""
        monotonic_ns, wall_ns = self._read()
        facts = {"wall_ns": str(wall_ns), "monotonic_ns": str(monotonic_ns)}
        if self._said is not None:
            facts["clocks"] = told_of(self._said, self._all_late_s / max(self._all_frames, 1), self._worst_s)
        return facts


def told_of(last: Clocks, late_s: float, latest_s: float) -> str:
    """The clocks of a run in a line: its last message, and how late its frames were on average and at most."""
    parts = [camera_told(last, late_s, latest_s)] if last.rate else []
    parts += [f"{count} frames {what}" for what, count in faults_of(last)]
    if last.wall_jumps:
        parts.append(f"wall clock set {last.wall_jumps} times, by {last.wall_set_s:+.3f} s in all")
    return "; ".join(parts) or "nothing is known of a camera's clock"


def camera_told(last: Clocks, late_s: float, latest_s: float) -> str:
    """What the camera's clock is like."""
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
    """How much faster the camera's clock runs than the host's, in millionths; NaN where the unit is not as said."""
    return 1e6 * (1.0 / clocks.rate - 1.0) if clocks.rate and not clocks.unit else math.nan


def faults_of(last: Clocks) -> list[tuple[str, int]]:
    """What went wrong with frames, in words, and how often; only what did."""
    every = (
        ("came twice", last.duplicates),
        ("out of order", last.disordered),
        ("with the camera's clock set back", last.resets),
        ("with the camera's clock set forwards, or standing still before", last.jumps),
        ("whose stamp did not grow passed over", last.passed_over),
    )
    return [(what, count) for what, count in every if count]


def _faults(of: Fit | Clocks) -> tuple[float, ...]:
    """What is told at once when it changes."""
    return (of.duplicates, of.disordered, of.resets, of.jumps, of.unit)
