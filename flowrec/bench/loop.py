"""`flowrec bench loop`: the time of one tick with recording and viewing on and off, and the speed of a replay.

The frames are rendered first, then given to the control loop at 60 Hz: tracking, estimation, control, hand-over to the
sinks. The four kinds of run take turns, so that a change of the machine's speed affects all of them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from flowrec.bench.harness import Results, print_rows
from flowrec.core import Currents, Tick, Timing, progress, table
from flowrec.exports import scene_of
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, Sink, run
from flowrec.stages import Inputs, Pipeline, ResolvedConfig, load_config
from flowrec.store import SessionWriter, WriterOptions, session_header
from flowrec.verbs import Change, prepare, replay_session
from flowrec.view import LiveView

RATE_HZ = 60.0
ROUNDS = 2  # of all kinds of runs, one after the other: what drifts in the machine meets each kind
KINDS = ("plain", "recording", "viewing", "recording and viewing")


@dataclass(slots=True)
class PacedRig:
    """A rig that yields prepared inputs at a fixed rate and drives nothing."""

    prepared: list[Inputs]

    def __enter__(self) -> PacedRig:
        return self

    def __exit__(self, *error: object) -> None: ...

    def inputs(self) -> Iterator[Inputs]:
        began = time.perf_counter()
        for number, inputs in enumerate(self.prepared):
            time.sleep(max(began + number / RATE_HZ - time.perf_counter(), 0.0))
            yield inputs

    def apply(self, currents: Currents) -> None: ...

    def zero(self) -> None: ...


def prepare_inputs(config: ResolvedConfig, pipeline: Pipeline, ticks: int) -> list[Inputs]:
    """Run a mission in the simulator; the inputs of its rig, with the results of its workers."""
    rig = SimulatedRig.of(pipeline, config, ticks / (config.camera.rate_hz or RATE_HZ))
    prepared: list[Inputs] = []
    before = Tick()

    def collect(tick: Tick) -> None:
        nonlocal before
        assert tick.applied is not None
        names = ("assumed", "refined", "route", "truth", "true_field")
        new = {name: getattr(tick, name) for name in names if getattr(tick, name) is not getattr(before, name)}
        prepared.append(Inputs(tick.stamp_ns, tick.frame, tick.applied, None, **new))
        before = tick

    run(pipeline, rig, LockstepWorker(pipeline, config.worker.adopt_after_s), [], on_tick=collect)
    return prepared


def paced_run(
    prepared: list[Inputs],
    config: ResolvedConfig,
    pipeline: Pipeline,
    sinks: Sequence[Sink],
    queue_state: Callable[[], tuple[float, int]] = lambda: (0.0, 0),
) -> list[Timing]:
    """Run prepared inputs at 60 Hz; the timing of each tick but the first tenth, in which caches are filled."""
    timings: list[Timing | None] = []
    worker = LockstepWorker(pipeline, config.worker.adopt_after_s, fills=())
    run(
        *(pipeline, PacedRig(prepared), worker, sinks),
        on_tick=lambda tick: timings.append(tick.timing),
        queue_state=queue_state,
        live=False,
    )
    return [timing for timing in timings[len(timings) // 10 :] if timing is not None]


def measure(ticks: Annotated[int, typer.Option(help="Frames per measurement.")] = 900) -> Results:
    """Time of a tick in ms by kind of run, their ratios, and the speed of a replay without refinement."""
    config, chip, pipeline, *_ = prepare(load_config(None, [f"camera.rate_hz={RATE_HZ}"]))
    timings: dict[str, list[Timing]] = {kind: [] for kind in KINDS}
    runs = ("preparation", *KINDS * ROUNDS, "replay")
    with progress("timing", len(runs), "runs") as finished, tempfile.TemporaryDirectory() as folder:
        prepared = prepare_inputs(config, pipeline, ticks)
        finished(1)
        path = Path(folder) / "bench.mcap"
        for number, kind in enumerate(runs[1:-1], 2):
            with ExitStack() as stack:
                sinks: list[Sink] = []
                if "recording" in kind:
                    writer = SessionWriter(
                        path, session_header(config, chip), WriterOptions(block=False, overwrite=True)
                    )
                    sinks.append(stack.enter_context(writer))
                if "viewing" in kind:
                    sinks.append(stack.enter_context(LiveView(scene_of(config, chip, path), "serve")))
                timings[kind] += paced_run(prepared, config, pipeline, sinks)
                if "recording" in kind:
                    writer.close({"outcome": "bench"})
            finished(number)
        began = time.perf_counter()
        done = replay_session(path, Change())
        wall_s = time.perf_counter() - began
        finished(len(runs))
    rows = {
        kind: {
            "median_ms": float(np.median([timing.total_ms for timing in found])),
            "p99_ms": float(np.percentile([timing.total_ms for timing in found], 99)),
            "hand_over_median_ms": float(np.median([timing.sinks_ms for timing in found])),
        }
        for kind, found in timings.items()
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


def show(results: Results) -> None:
    """Print the results as tables."""
    columns = {"run": "{run}", "median ms": "{median_ms:.2f}", "p99 ms": "{p99_ms:.2f}"}
    rows = [{"run": kind, **row} for kind, row in results["rows"].items()]
    print_rows("One tick at 640x512, 60 Hz", rows, columns | {"hand-over ms": "{hand_over_median_ms:.3f}"})
    ratio, speed = results["recording_over_plain"], results["replay"]["times_real_time_at_60_hz"]
    ratios = [(f"recording on / off, {name}", f"{ratio[f'{name}_ms']:.2f}") for name in ("median", "p99")]
    table("Ratios", ("", "value"), [*ratios, ("replay, times real time at 60 Hz", f"{speed:.1f}")])
