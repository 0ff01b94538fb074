"""Streams from real outlets in other processes: samples lost, error of their stamps, cost of a tick.

python -m tests.perf.streams [--seconds S]

Outlets of 1, 100 and 1,000 Hz, and one of 1,000 Hz with 32 channels, each in a process of its own, stamp their samples
evenly by the monotonic clock, which all processes of a machine share. A loop of 30 ticks a second takes them as a run
does. The true time of a sample follows from its number.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from contextlib import ExitStack

import numpy as np

from flowrec.core import SAMPLES, STREAMS, Applied
from flowrec.run import RunControl, StreamInputs
from flowrec.run.loop import SWITCH_S
from flowrec.stages import Inputs, StreamSettings

STREAMS_OF = {"slow": (1.0, 1), "usual": (100.0, 1), "fast": (1000.0, 1), "wide": (1000.0, 32)}
PERIOD_S = 1.0 / 30.0


class Clock:
    """A rig whose stamp 0 is when it is made."""

    def __init__(self) -> None:
        self.epoch_ns: int | None = time.monotonic_ns()


def main() -> None:
    """Measure, and print a line for each stream."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=120.0)
    seconds = parser.parse_args().seconds
    sys.setswitchinterval(SWITCH_S)  # as a run does
    for chosen in ({"": (0.0, 0)}, {"wide": STREAMS_OF["wide"]}, STREAMS_OF):
        measure({name: each for name, each in chosen.items() if name}, seconds if len(chosen) > 1 else seconds / 8.0)


def measure(chosen: dict[str, tuple[float, int]], duration_s: float) -> None:
    """One run with some streams."""
    clock, told, costs_us = Clock(), list[str](), list[float]()
    with ExitStack() as stack:
        mark = f"perf{time.monotonic_ns()}"
        began: dict[str, float] = {}
        for name, (rate_hz, channels) in chosen.items():
            command = [sys.executable, "-m", "tests.twins.lsl_outlet", f"{mark}{name}", "--rate", str(rate_hz)]
            child = subprocess.Popen(
                [*command, "--channels", str(channels), "--format", "double64"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            stack.callback(child.wait)
            stack.callback(child.kill)
            assert child.stdout is not None
            began[name] = float(child.stdout.readline().split()[1])
        settings = {name: StreamSettings(outlet=f"{mark}{name}") for name in chosen}
        streams = StreamInputs(settings, clock, RunControl(), told.append, realtime=True)  # type: ignore[arg-type]
        streams.connect(stack)
        stack.enter_context(streams)
        found = list[tuple[np.ndarray, np.ndarray, np.ndarray, int]]()
        states = None
        end_s, due_s = time.monotonic() + duration_s, time.monotonic()
        waiting: list[Inputs] = []

        def ticks():  # type: ignore[no-untyped-def]
            while True:
                yield waiting.pop()

        joining = streams.join(ticks())
        while time.monotonic() < end_s:
            due_s += PERIOD_S
            time.sleep(max(0.0, due_s - time.monotonic()))
            assert clock.epoch_ns is not None
            stamp = time.monotonic_ns() - clock.epoch_ns
            waiting.append(Inputs(stamp, None, Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))))
            before = time.perf_counter()
            joined = next(joining)
            costs_us.append(1e6 * (time.perf_counter() - before))
            if (samples := joined.extra.get(SAMPLES)) is not None:
                found.append((samples.channel, samples.sample_ns, samples.value, stamp))  # type: ignore[attr-defined]
            states = joined.extra.get(STREAMS, states)
        costs = np.percentile(costs_us, [50, 95, 99, 100])
        print(
            f"{len(chosen)} streams, {duration_s:g} s, {len(costs_us)} ticks: us a tick, median, 95, 99 %, most:",
            *np.round(costs),
        )
        print(*told, sep="\n", end="\n" if told else "")
        if states is not None and found:
            report(chosen, began, found, states, clock.epoch_ns)


def report(chosen, began, found, states, epoch_ns) -> None:  # type: ignore[no-untyped-def]
    """Print what came of each stream."""
    channel, sample_ns, value = (np.concatenate([each[n] for each in found]) for n in range(3))
    taken_ns = np.repeat([each[3] for each in found], [len(each[0]) for each in found])
    first = 0
    for number, (name, (rate_hz, channels)) in enumerate(chosen.items()):
        mine = channel == first
        counts = [int((channel == place).sum()) for place in range(first, first + channels)]
        numbers, stamps = value[mine], sample_ns[mine]
        true_ns = 1e9 * (began[name] + (numbers + 1) / rate_hz) - epoch_ns
        error_us = (stamps - true_ns) / 1e3
        late_ms = (taken_ns[mine] - true_ns) / 1e6
        lost = int(np.diff(numbers).sum()) - (len(numbers) - 1) + (max(counts) - min(counts))
        print(
            f"  {name}: {rate_hz:g} Hz x {channels}: {len(numbers)} samples, lost {lost}, queue {states.lost[number]}, "
            f"missing {states.missing[number]}, steps {states.steps[number]}; stamp error, us: median "
            f"{np.median(error_us):.0f}, most {np.abs(error_us).max():.0f}; sample to tick, ms: median "
            f"{np.median(late_ms):.0f}, 99 % {np.percentile(late_ms, 99):.0f}, most {late_ms.max():.0f}; jitter "
            f"{1e3 * states.jitter_s[number]:.2f} ms"
        )
        first += channels


if __name__ == "__main__":
    main()
