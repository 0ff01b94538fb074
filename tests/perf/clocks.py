"""`python -m tests.perf.clocks`: errors of frame stamps by the fit of a camera's clock to the host's, and by arrival.

The series are simulated, so the truth is known: a camera at 100 Hz for some minutes, its clock 50 ppm fast, frames that
arrive at least 0.2 ms late, and one fault per series.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from flowrec.bench.harness import Results, Seed, print_rows, run
from flowrec.core import NS_PER_S, DeviceClock, Fit

_RATE_HZ = 100.0
_SKEW = 50e-6
_LEAST_S, _JITTER_S = 200e-6, 300e-6  # of the way to the host: at the least, and the mean of what comes on top
_SETTLED_S = 15.0  # from then on a series is judged, and from so long after something went wrong
_EPOCH = 1_234_567_890_123


@dataclass(frozen=True, slots=True)
class Series:
    """Frames as they arrive."""

    name: str
    # (n,) when each was taken and could have been here at the earliest, ns on the host's clock
    true_ns: NDArray[np.int64]
    device: list[int]  # counts of the camera's clock, n of them
    arrival_ns: list[int]  # n, in the order of arrival
    events_s: tuple[float, ...] = ()  # when something went wrong that a new fit has to be begun for


def series(name: str, seconds: float = 300.0, seed: int = 0) -> Series:
    """One of `CASES`."""
    rng = np.random.default_rng([seed, 31])
    count = int(seconds * _RATE_HZ)
    taken = np.arange(count) / _RATE_HZ  # s
    delay = rng.exponential(_JITTER_S, count)
    if name in ("stalls", "all at once"):
        for at in rng.uniform(0.0, seconds, max(1, round(seconds / 5.0))):
            delay += np.where((taken >= at) & (taken < at + 0.1), at + 0.1 - taken, 0.0)  # nothing gets through
    if name == "busy host":  # most frames wait for a turn of some ms
        delay += rng.gamma(2.0, 2e-3, count)
    ran = taken * (1.0 + _SKEW)
    if name in ("drift", "all at once"):  # warms up by 20 ppm with a time of two minutes
        ran = ran + 20e-6 * (taken - 120.0 * (1.0 - np.exp(-taken / 120.0)))
    events: tuple[float, ...] = ()
    device = np.rint(ran * NS_PER_S).astype(np.int64) + _EPOCH
    half = seconds / 2.0
    if name == "unit x10":
        device = np.rint(ran * 10.0 * NS_PER_S).astype(np.int64)
    elif name == "unit x0.694":
        device = np.rint(ran * 0.694 * NS_PER_S).astype(np.int64)
    elif name == "reset":
        device, events = device - np.where(taken >= half, device[taken >= half][0] - 1000, 0), (half,)
    elif name == "set forwards":
        device, events = device + np.where(taken >= half, 3600 * NS_PER_S, 0), (half,)
    elif name == "32 bit":
        device = device % (1 << 32)
    true_ns = np.rint((taken + _LEAST_S) * NS_PER_S).astype(np.int64)
    arrival_ns = np.maximum.accumulate(true_ns + np.rint(delay * NS_PER_S).astype(np.int64))  # none overtakes another
    order = np.arange(count)
    if name == "out of order":
        for at in range(150, count - 1, 150):
            order[at : at + 2] = order[at : at + 2][::-1]
            arrival_ns[at : at + 2] = arrival_ns[at + 1] + np.array([0, 50_000])
        for at in range(100, count - 1, 150):
            order[at + 1] = order[at]  # and some twice
    return Series(name, true_ns[order], device[order].tolist(), arrival_ns.tolist(), events)


CASES = (
    "plain", "stalls", "busy host", "drift", "all at once", "unit x10", "unit x0.694", "32 bit", "reset",
    "set forwards", "out of order",
)  # fmt: skip


def measure(
    seconds: Annotated[float, typer.Option(min=60.0, help="Length of each series.")] = 300.0,
    seed: Seed = 0,
    cases: Sequence[str] = CASES,
    methods: Sequence[str] | None = None,
) -> Results:
    """Errors of the stamps by case and method, s."""
    rows = []
    for case in cases:
        one = series(case, seconds, seed)
        for method in METHODS if methods is None else methods:
            dated = METHODS[method]
            began = time.process_time()
            stamps, said = dated(one)
            cost_us = 1e6 * (time.process_time() - began) / len(one.device)
            rows.append({"case": case, "method": method, "us_per_frame": cost_us, **_judged(one, stamps), "said": said})
    return {"rate_hz": _RATE_HZ, "seconds": seconds, "skew_ppm": 1e6 * _SKEW, "rows": rows}


def _judged(one: Series, stamps: NDArray[np.float64]) -> dict[str, float]:
    """Errors of the stamped frames after the fit has settled; the largest step is that of all frames."""
    good = np.isfinite(stamps)
    off_s = (stamps[good] - one.true_ns[good]) / NS_PER_S
    at_s = one.true_ns[good] / NS_PER_S
    settled = at_s > _SETTLED_S
    for event_s in one.events_s:
        settled &= (at_s < event_s) | (at_s > event_s + _SETTLED_S)
    judged = off_s[settled] if settled.any() else np.array([np.nan])
    return {
        "mean_s": float(judged.mean()),
        "rms_s": float(np.sqrt((judged**2).mean())),
        "p99_s": float(np.percentile(abs(judged), 99)),
        "max_s": float(abs(judged).max()),
        "step_s": float(abs(np.diff(off_s)[settled[1:]]).max(initial=0.0)),
        "backwards": int((np.diff(stamps[good]) <= 0).sum()),
    }


def _arrival(one: Series) -> tuple[NDArray[np.float64], str]:
    return np.array(one.arrival_ns, np.float64), ""


def _ours(one: Series) -> tuple[NDArray[np.float64], str]:
    clock, fit = DeviceClock(), None
    stamps = np.full(len(one.device), np.nan)
    for n, (device, arrival_ns) in enumerate(zip(one.device, one.arrival_ns, strict=True)):
        fit = clock.take(fit, device, arrival_ns)
        if fit.good:
            stamps[n] = fit.stamp_ns
    return stamps, said_of(fit) if fit is not None else ""


def said_of(fit: Fit) -> str:
    """Faults of the clock that a fit has detected."""
    counts = {
        "twice": fit.duplicates, "out of order": fit.disordered, "wraps": fit.wraps, "resets": fit.resets,
        "jumps": fit.jumps,
    }  # fmt: skip
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    return ", ".join([f"unit {fit.unit:.3g}" for _ in range(fit.unit > 0.0)] + parts)


METHODS: dict[str, Callable[[Series], tuple[NDArray[np.float64], str]]] = {"arrival": _arrival, "flowrec": _ours}


def show(figures: dict[str, Any]) -> None:
    """Print the table."""
    print_rows(
        f"Errors of stamps in us, {figures['rate_hz']:g} Hz for {figures['seconds']:g} s, {figures['skew_ppm']:g} ppm",
        [row | {key[:-2]: 1e6 * value for key, value in row.items() if key.endswith("_s")} for row in figures["rows"]],
        {
            "case": "{case}",
            "fit": "{method}",
            **{name: f"{{{name}:.4g}}" for name in ("mean", "rms", "p99", "max", "step")},
            "backwards": "{backwards}",
            "us/frame": "{us_per_frame:.1f}",
            "detected": "{said}",
        },
    )


if __name__ == "__main__":
    run(measure, show)
