"""`flowrec bench loop`: what one tick costs, with recording and viewing on and off, and how fast a replay runs.

The frames are rendered beforehand, then offered at 60 Hz to the real loop: track, observe, control, hand-over to
the sinks. The four kinds of run take turns, so that a drift of the machine's speed meets all of them alike.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.harness import Results
from flowrec.chip.chip import Chip
from flowrec.commands.export import scene_of
from flowrec.commands.record import prepare
from flowrec.commands.replay import Change, replay
from flowrec.config import ResolvedConfig, load_config
from flowrec.messages import Currents, Tick
from flowrec.pipeline import Inputs, Pipeline
from flowrec.rigs.simulated.rig import SimulatedRig
from flowrec.run.loop import LockstepWorker, Sink, run
from flowrec.session_writer import session_header
from flowrec.store import SessionWriter
from flowrec.terminal import progress, table
from flowrec.view import LiveView

RATE_HZ = 60.0
KINDS = ("plain", "recording", "viewing", "recording and viewing")


@dataclass(slots=True)
class PacedRig:
    """Hands out prepared inputs at a fixed rate."""

    prepared: list[Inputs]
    rate_hz: float | None

    def __enter__(self) -> PacedRig:
        return self

    def __exit__(self, *error: object) -> None:
        """Nothing to switch off."""

    def inputs(self) -> Iterator[Inputs]:
        began = time.perf_counter()
        for number, inputs in enumerate(self.prepared):
            if self.rate_hz is not None:
                wait_s = began + number / self.rate_hz - time.perf_counter()
                if wait_s > 0:
                    time.sleep(wait_s)
            yield inputs

    def apply(self, currents: Currents) -> None:
        """Nothing is driven."""

    def zero(self) -> None:
        """Nothing is driven."""


class Keep:
    """A sink that keeps what it is given."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []

    def write(self, tick: Tick) -> None:
        self.ticks.append(tick)


def prepare_inputs(config: ResolvedConfig, pipeline: Pipeline, ticks: int) -> list[Inputs]:
    """Fly a mission in the simulator and keep what its rig yielded, worker results included."""
    rig = SimulatedRig.of(pipeline, config, ticks / config.camera.rate_hz)
    kept = Keep()
    with progress("preparing frames", ticks) as done:
        run(
            pipeline,
            rig,
            LockstepWorker(pipeline, config.worker.adopt_after_s),
            [kept],
            on_tick=lambda _tick: done(len(kept.ticks)),
        )
    prepared, before = [], Tick()
    for tick in kept.ticks:
        assert tick.applied is not None
        fresh = {
            name: value if (value := getattr(tick, name)) is not getattr(before, name) else None
            for name in ("assumed", "refined", "route", "truth", "true_field")
        }
        prepared.append(Inputs(tick.stamp_ns, tick.frame, tick.applied, None, **fresh))
        before = tick
    return prepared


def measure(ticks: Annotated[int, typer.Option(help="Frames per measurement.")] = 900, rounds: int = 2) -> Results:
    """Milliseconds of a tick per kind of run, their ratios, and the speed of a replay without refinement."""
    config, chip, pipeline = prepare(load_config(None, [f"camera.rate_hz={RATE_HZ}"]))
    prepared = prepare_inputs(config, pipeline, ticks)
    total_ms: dict[str, list[float]] = {kind: [] for kind in KINDS}
    sinks_ms: dict[str, list[float]] = {kind: [] for kind in KINDS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        for number in range(rounds * len(KINDS)):
            kind = KINDS[number % len(KINDS)]
            one = _run_once(kind, prepared, config, chip, pipeline, path)
            skip = len(one) // 10  # the robot is found and caches are filled in the first frames
            total_ms[kind] += [tick.timing.total_ms for tick in one[skip:] if tick.timing is not None]
            sinks_ms[kind] += [tick.timing.sinks_ms for tick in one[skip:] if tick.timing is not None]
        began = time.perf_counter()
        done = replay(path, Change())
        wall_s = time.perf_counter() - began
    rows = {
        kind: {
            "median_ms": float(np.median(total_ms[kind])),
            "p99_ms": float(np.percentile(total_ms[kind], 99)),
            "hand_over_median_ms": float(np.median(sinks_ms[kind])),
        }
        for kind in KINDS
    }
    return {
        "frames": {"width_px": config.camera.width_px, "height_px": config.camera.height_px, "rate_hz": RATE_HZ},
        "ticks_per_run": len(prepared),
        "rows": rows,
        "recording_over_plain": {key: rows["recording"][key] / rows["plain"][key] for key in ("median_ms", "p99_ms")},
        "replay": {
            "ticks": done.report.ticks,
            "seconds": wall_s,
            "frames_per_s": done.report.ticks / wall_s,
            "times_real_time_at_60_hz": done.report.ticks / RATE_HZ / wall_s,
            "identical": done.comparison.identical,
        },
    }


def _run_once(
    kind: str, prepared: list[Inputs], config: ResolvedConfig, chip: Chip, pipeline: Pipeline, path: Path
) -> list[Tick]:
    """One paced run with the sinks of its kind; the timings are in the ticks."""
    timings = TimingsOnly()
    with ExitStack() as stack:
        sinks: list[Sink] = [timings]
        if "recording" in kind:
            writer = SessionWriter(path, session_header(config, chip), block=False, overwrite=True)
            sinks.append(stack.enter_context(writer))
        if "viewing" in kind:
            sinks.append(stack.enter_context(LiveView(scene_of(config, chip, pipeline, path), "serve")))
        worker = LockstepWorker(pipeline, config.worker.adopt_after_s, fills=())
        run(pipeline, PacedRig(prepared, RATE_HZ), worker, sinks, end_when_finished=False)
        if "recording" in kind:
            writer.close({"outcome": "bench"})
    return timings.ticks


class TimingsOnly:
    """A sink that keeps the timings alone."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []

    def write(self, tick: Tick) -> None:
        self.ticks.append(replace(Tick(), stamp_ns=tick.stamp_ns, timing=tick.timing))


def show(figures: dict[str, Any]) -> None:
    """Print the figures as a table."""
    rows = [
        (kind, f"{row['median_ms']:.2f}", f"{row['p99_ms']:.2f}", f"{row['hand_over_median_ms']:.3f}")
        for kind, row in figures["rows"].items()
    ]
    table("One tick at 640x512, 60 Hz", ("run", "median ms", "p99 ms", "hand-over ms"), rows)
    ratio, speed = figures["recording_over_plain"], figures["replay"]
    table(
        "Ratios",
        ("", "value"),
        [
            ("recording on / off, median", f"{ratio['median_ms']:.2f}"),
            ("recording on / off, p99", f"{ratio['p99_ms']:.2f}"),
            ("replay, times real time at 60 Hz", f"{speed['times_real_time_at_60_hz']:.1f}"),
        ],
    )
