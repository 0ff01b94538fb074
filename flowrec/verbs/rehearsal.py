"""A rehearsal: a short simulated mission, in memory, that compiles and imports what a run will need.

The first run of an installation compiles for half a minute. A live run that did so while its camera delivers would lose
the images of that time, so it rehearses before; what is compiled stays in the cache of kernels.
"""

from __future__ import annotations

from collections.abc import Callable

from flowrec.core import Progress, Tick, UsageError, kernels_cached, say
from flowrec.physics import load_chip
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, RunControl, run
from flowrec.stages import Config, assemble, load_config, resolve
from flowrec.verbs.interactive import Unattended

# Seconds of session: survey, refinement, plan and the way to the goal take seven. One that gets lost ends here.
LENGTH_S = 15.0
_ADOPT_AFTER_S = 0.1
_SETTINGS = {
    "chip.name": "straight",
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

    Parameters
    ----------
    stopped : asked after every tick; the rehearsal ends when it says so.
    progress : takes the seconds of session so far, of `LENGTH_S`.

    Raises
    ------
    FlowrecError : a method of the configuration can not be used here.
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
    run(pipeline, SimulatedRig.of(pipeline, resolved, LENGTH_S), worker, [], control=control, on_tick=on_tick)


def rehearse_aloud(config: Config, control: Unattended) -> None:
    """Rehearse with progress; a stop of the run does not wait for it."""
    if not kernels_cached():
        say("compiling the numerics, once after an installation: about half a minute")
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
