"""Admission to a live run: whether this machine holds the images of the camera, measured before there is a file.

The images of the camera pass through the whole pipeline, the writer and the disk of the session, at the camera's rate,
for some seconds. Nothing is energised, and what was written is removed. Besides, the process of the slow stages has
then done the first order of the mission: it has imported, compiled and factorised what that needs.

Before that, and before the first run of an installation, comes a rehearsal: a short simulated mission, in memory, that
compiles and imports what a run will need. That takes half a minute. A live run that did so while its camera delivers
would lose the images of that time; what is compiled stays in the cache of kernels.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowrec.core import (
    MCAP,
    BoundedProcess,
    FlowField,
    FlowrecError,
    Output,
    Progress,
    RigError,
    Route,
    Tick,
    UsageError,
    keep_kernels,
    kernels_cached,
    nanoseconds,
    realtime_priority,
    say,
    temporary_name,
    warn,
)
from flowrec.physics import Chip, load_chip
from flowrec.rigs import Rig, SimulatedRig, Tried
from flowrec.run import LockstepWorker, RunControl, Worker, run
from flowrec.stages import Config, Pipeline, ResolvedConfig, assemble, load_config, resolve, step
from flowrec.store import SessionWriter, session_writer
from flowrec.verbs.interactive import Unattended

_ENOUGH = 0.95  # of the camera's rate, which a trial of two seconds does not measure more exactly
_TRIES = 3  # one moment without a processor does not show that the machine is too slow
_PATIENCE_S = 2.0  # for what waits for the disk after the last image
_SETTLE_S = 0.1  # after the last image until it is written, on a machine with time to spare
_POLL_S = 0.005


class Held(NamedTuple):
    """Rates that a trial has measured, in images a second."""

    asked_hz: float  # rate of the camera
    ticks_hz: float  # of the pipeline's ticks
    written_hz: float  # of what reached the disk
    realtime: bool = True  # whether the loop had real-time priority

    @property
    def hz(self) -> float:
        """Rate that the machine holds, in images a second: the least of the three."""
        return min(self.asked_hz, self.ticks_hz, self.written_hz)

    @property
    def enough(self) -> bool:
        """True if no image would be lost."""
        return self.hz >= _ENOUGH * self.asked_hz

    def __str__(self) -> str:
        held = self.asked_hz if self.enough else self.hz
        return f"{held:.0f} of {self.asked_hz:.0f} images a second"


def admit(
    rig: Rig,
    worker: Worker,
    of: tuple[ResolvedConfig, Chip, Pipeline],
    known: Mapping[str, FlowField],
    folder: Path,
    control: RunControl,
) -> dict[str, str]:
    """Let the worker do the first order, then measure; return the result for the head of the session.

    Nothing is done for a rig whose images can not be had before the run, and after a stop. Raises FlowrecError: images
    would be lost, and `recording.accept_losses` is not set; the first order can not be done, the camera gives no image,
    the folder can not be written.

    Parameters
    ----------
    rig : connected, not entered.
    known : flow fields of an earlier session, which the run begins with.
    folder : of the session; a file in it is written, and removed.
    """
    config, chip, pipeline = of
    if not isinstance(rig, Tried) or control.reason:
        return {}
    known = _after_first_order(rig, pipeline, worker, known, control)
    trials: list[Held] = []
    while len(trials) < _TRIES and not any(held.enough for held in trials):
        with _scratch(folder, config, chip) as writer:
            held = _trial(rig, pipeline, writer, known, config, control)
        if held is None:
            return {}
        trials.append(held)
    best = max(trials, key=lambda held: held.hz)
    if not best.enough:
        if not config.recording.accept_losses:
            raise RigError(refusal(best, config, folder))
        warn(f"this machine holds {best}: images will be lost (--accept-losses)")
    return {"admission": f"holds {best}"}


def refusal(held: Held, config: ResolvedConfig, folder: Path) -> str:
    """Error text for a machine on which images would be lost: in one line what, where, what next."""
    camera = config.camera
    slow = "the pipeline" if held.ticks_hz <= held.written_hz else f"writing to {folder}"
    priority = "" if held.realtime else "allow real-time priority (rtprio 4 in /etc/security/limits.conf), "
    return (
        f"this machine holds {held}, and {slow} is the limit ({camera.width_px} x {camera.height_px} pixels): close "
        f"other programs, {priority}set a lower camera.rate_hz, a smaller image or recording.region = 'robot'; or go "
        "on with --accept-losses"
    )


def _after_first_order(
    rig: Tried, pipeline: Pipeline, worker: Worker, known: Mapping[str, FlowField], control: RunControl
) -> dict[str, FlowField]:
    """The fields that the run begins with and, if the first order is for one, the one that it gives."""
    fields = dict(known)
    with contextlib.closing(rig.tried()) as arriving:
        arrived = next(arriving)
        tick = step(pipeline, Tick(), replace(arrived, **_as_adopted(fields, arrived.stamp_ns)))
    if tick.mission is None or not tick.mission.wanted:
        return fields
    worker.submit(tick)
    while not control.reason:
        done = worker.due(tick.stamp_ns)
        if done:
            return fields | {name: found for name, found in done.items() if isinstance(found, FlowField)}
        time.sleep(_POLL_S)
    return fields


def _as_adopted(fields: Mapping[str, FlowField], stamp_ns: int) -> dict[str, Any]:
    return {name: replace(field, stamp_ns=stamp_ns, request=0) for name, field in fields.items()}


@contextlib.contextmanager
def _scratch(folder: Path, config: ResolvedConfig, chip: Chip) -> Iterator[SessionWriter]:
    """A writer of the run's settings, whose file is gone afterwards."""
    output = Output(folder / temporary_name(".mcap"), MCAP, ())
    writer = session_writer(output, config, chip, live=True, keep_failed=False)
    try:
        yield writer
    finally:
        writer.discard()


def _trial(
    rig: Tried,
    pipeline: Pipeline,
    writer: SessionWriter,
    known: Mapping[str, FlowField],
    config: ResolvedConfig,
    control: RunControl,
) -> Held | None:
    """Record for `recording.admission_s`, with the priorities of a run."""
    last, ticks, first, latest = Tick(), 0, None, None
    with realtime_priority() as granted, contextlib.closing(rig.tried()) as arriving:
        if granted:
            writer.prioritise()
        begin_s = time.monotonic()
        for arrived in arriving:
            if arrived.frame is None:
                continue
            latest, adopted = arrived.frame, {}
            if first is None:
                first, begin_s, adopted = latest, time.monotonic(), _as_adopted(known, arrived.stamp_ns)
            last = step(pipeline, last, replace(arrived, **adopted))
            truth = {name: getattr(arrived, name) for name in ("truth", "true_field", "true_tracers")}
            writer.write(replace(last, **truth))
            ticks += 1
            if control.reason:
                return None
            if latest.stamp_ns - first.stamp_ns >= nanoseconds(config.recording.admission_s):
                break
    if first is None or latest is None or ticks < 2:
        raise RigError("the camera gave no two images; see to its trigger (lab.trigger) and its cable")
    ticked_s = time.monotonic()
    while writer.queue_bytes and time.monotonic() < ticked_s + _PATIENCE_S:
        time.sleep(_POLL_S)
    written_s = max(time.monotonic() - _SETTLE_S, ticked_s) - begin_s
    waiting = min(writer.queue_bytes / max(latest.image.nbytes, 1), ticks)
    asked_hz = (latest.index - first.index) / latest.since_s(first)
    # One image less than the ticks: the time begins with the first.
    written = ticks - 1 - writer.dropped_frames - waiting
    return Held(asked_hz, (ticks - 1) / (ticked_s - begin_s), written / written_s, granted)


# Seconds of session: survey, refinement, plan and the way to the goal take seven. One that gets lost ends here.
LENGTH_S = 15.0
_ADOPT_AFTER_S = 0.1
_HELP_S = 600.0  # of CPU time, at most
_SETTINGS = {
    "chip.name": "straight",
    "mission.goal": "outlet",
    "camera.width_px": 96,
    "camera.height_px": 77,
    "camera.rate_hz": 15.0,
    "robot.radius_um": 70.0,
    "robot.max_speed_um_s": 900.0,
    "simulated.world": "kind",
    "simulated.seed": 5,
    "refine.assimilate.doubt_depth": False,
    "recording.disk_floor_gb": 0.0,
}
_ON_THE_ROBOT_PX = (15, 38)  # column, row of these images, at the start


def rehearse(config: Config, stopped: Callable[[], object] = lambda: False, progress: Progress | None = None) -> None:
    """Fly a short mission with the methods of a configuration, as fast as it goes and without a file.

    Raises FlowrecError: a method of the configuration can not be used here.

    Parameters
    ----------
    stopped : asked after every tick; the rehearsal ends when it says so.
    progress : takes the seconds of session so far, of `LENGTH_S`.
    """
    progress = progress if progress is not None else Progress()
    small = _small(config)
    chip = load_chip(small.chip)
    resolved = resolve(small, chip)
    pipeline = assemble(resolved, chip)
    control = RunControl()

    def on_tick(tick: Tick) -> None:
        progress(tick.stamp_ns / 1e9)
        if tick.mission is not None:
            progress.stage(tick.mission.phase)
        if stopped():
            control.stop("stopped")

    worker = LockstepWorker(pipeline, _ADOPT_AFTER_S)
    with BoundedProcess("kernels", _HELP_S, error=FlowrecError) as helper:
        if not kernels_cached():  # two processors compile in two thirds of the time
            helper.begin(route_on_assumed_flow, resolved, chip)
        run(pipeline, SimulatedRig.of(pipeline, resolved, LENGTH_S), worker, [], control=control, on_tick=on_tick)
    if not control.reason:
        keep_kernels()


def route_on_assumed_flow(config: ResolvedConfig, chip: Chip) -> Route:
    """The way of a mission from its start to its goal on the flow that the chip states."""
    start_um, goal_um = np.array(config.mission.start, np.float64), np.array(config.mission.goal, np.float64)
    return config.plan.plan(config.flow.solve(chip), start_um, goal_um, chip, config.robot)


def rehearse_aloud(config: Config, control: Unattended) -> None:
    """Rehearse with progress; a stop of the run does not wait for it."""
    if not kernels_cached():
        say("compiling the numerics, once after an installation: half a minute")
    run_control = control.run_control
    with control.progress("getting ready", LENGTH_S) as progress:
        run_control.unless_stopped(lambda: rehearse(config, lambda: run_control.reason, progress), None)


def _small(config: Config) -> Config:
    """The settings of the rehearsal: those that choose a kernel are the run's."""
    sets = _SETTINGS | {
        "camera.bits": config.camera.bits,
        "observer.method": config.observer.method,
        "survey.method": config.survey.method,
        "plan.method": config.plan.method,
        "plan.cost": config.plan.cost,
        "control.method": config.control.method,
    }
    if config.tracker.click_px is not None or config.tracker.box_px is not None:
        sets["tracker.click_px"] = _ON_THE_ROBOT_PX
    try:
        return load_config(None, sets)
    except UsageError:  # settings that go together only with others of the run
        return load_config(None, _SETTINGS)
