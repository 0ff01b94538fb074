"""`flowrec record`: drive a mission on a rig and write every stage to one session file."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flowrec.chip import load_chip, median_width_um
from flowrec.chip.chip import Chip
from flowrec.chip.picture_orientation import ImageVerdict
from flowrec.clocks import ClockMonitor
from flowrec.commands.admission import admitted
from flowrec.commands.auto_recovery import recover_leftovers
from flowrec.commands.axes import checked_image
from flowrec.commands.interactive import Unattended
from flowrec.commands.rehearsal import rehearse_aloud
from flowrec.commands.run_summary import GOOD_ENDS, Recorded, figures_of, files_text
from flowrec.commands.watching import View, Watching
from flowrec.config import Config, ResolvedConfig, registration_of
from flowrec.console.console import refuse_without_packages
from flowrec.console.messages import Ended
from flowrec.coverage import Coverage
from flowrec.enums import Outcome, Phase
from flowrec.errors import MovieError, SessionError, UnreachableError, UsageError
from flowrec.estimation.sampler import SAMPLERS
from flowrec.messages import FlowField
from flowrec.pipeline import Pipeline, assemble
from flowrec.planning.feasibility import no_room, swept_out, too_swift
from flowrec.resolve import derived, resolve
from flowrec.rig_settings import LAB, MOVIE, RIGS
from flowrec.rigs.movie.rig import MovieRig, fitted_to_movie
from flowrec.rigs.movie.source import opened
from flowrec.rigs.rig import Connecting, Picturing, Rig
from flowrec.run.disk_monitor import DiskMonitor, refuse_below
from flowrec.run.loop import Sink, run
from flowrec.run.watchdog import Watchdog
from flowrec.run.worker_process import ProcessWorker
from flowrec.run.workers import LockstepWorker, Preloaded, Worker
from flowrec.run_figures import RunStatistics
from flowrec.session import Session, files_behind
from flowrec.session_writer import session_writer
from flowrec.store.run_files import run_files, run_path, runs_in
from flowrec.store.writer import SessionWriter
from flowrec.summary import DOUBTS, as_text, doubts_text
from flowrec.system.outputs import MCAP, RRD, Output
from flowrec.system.processes import realtime_priority
from flowrec.terminal import say, warn
from flowrec.topics import Tick
from flowrec.vision.track_quality import TrackQuality

# Parts of the 2 s that a run may take to end; the rest is for the coils (run/control.py) and for Python itself.
CLOSE_TIMEOUT_S = 0.5  # for images that are still queued
VIEW_TIMEOUT_S = 0.2  # for a viewer to show the last messages
_GIVE_UP_TIMEOUT_S = 1.0  # to close the file while the main thread hangs
_LEAST_FRAMES = 3.0  # of the camera within the watchdog's timeout


class Prepared(NamedTuple):
    """What a run needs excluded its rig.

    Attributes
    ----------
    derived : settings that were derived because they were not given, by key.
    facts : about the source of a movie, for the head of the session.
    image : what the images of a movie say about the axes; None: not looked at.
    """

    config: ResolvedConfig
    chip: Chip
    pipeline: Pipeline
    derived: dict[str, float]
    facts: Mapping[str, str]
    image: ImageVerdict | None = None


def prepare(asked: Config, aloud: bool = True) -> Prepared:
    """Resolve a configuration and check that the mission is feasible; warn, if `aloud`, where it is likely to fail.

    Raises
    ------
    UsageError : the method of the sampler needs a recording.
    UnreachableError : see `refuse_adrift`.
    ChipError : the images of a movie show the chip in another orientation than stated, or at another scale.
    """
    if "recording" in SAMPLERS[asked.sampler.method].needs:
        able = " or ".join(f"'{row.name}'" for row in SAMPLERS.values() if "recording" not in row.needs)
        raise UsageError(
            f"sampler.method = {asked.sampler.method!r} needs the whole recording: use it in flowrec replay --refine; "
            f"a run takes {able}"
        )
    tell, caution = (say, warn) if aloud else (_unsaid, _unsaid)
    given, facts = asked, dict[str, str]()
    if asked.rig == MOVIE:
        asked, found, remarks = fitted_to_movie(given)
        facts |= found
        tell(f"{given.movie.path}: {facts['source_images']}, {facts['source_codec']}, times: {facts['source_times']}")
        for remark in remarks:
            caution(remark)
    chip = load_chip(asked.chip)
    config = resolve(asked, chip)
    image = None
    if asked.rig == MOVIE:
        image, moved = _looked_at(config, chip)
        if image is not None:
            facts["source_axes"] = image.text
        if moved:
            caution(moved)
            facts["source_walls"] = moved
    made = derived(given, config)
    if made:
        what = "derived to fit the movie and the chip" if asked.rig == MOVIE else "derived to fit the chip"
        unused = ("survey.", "plan.") if config.mission.observes else ()
        tell(f"{what}: {', '.join(f'{key} = {value:g}' for key, value in made.items() if not key.startswith(unused))}")
    refuse_adrift(config, chip)
    full_mt = config.coils.full_mt(config.robot)
    if full_mt < config.coils.amplitude_mt:
        caution(
            f"coils and amplifiers make {full_mt:.2g} of {config.coils.amplitude_mt:g} mT: the robot follows it up to "
            f"{config.robot.max_speed_um_s:.0f} um/s; see coils.max_current_a and coils.amplifier"
        )
    for opening in chip.openings:
        if opening.kind == "inlet" and opening.value > config.robot.max_speed_um_s:
            caution(
                f"inlet {opening.side} {opening.first}-{opening.last}: mean speed {opening.value:.0f} um/s is faster "
                f"than the robot's {config.robot.max_speed_um_s:.0f} um/s; it can be carried there but not come back"
            )
    blind_um = config.robot.delay_s * config.robot.max_speed_um_s
    if blind_um > 0.5 * median_width_um(chip):
        caution(
            f"in the {1e3 * config.robot.delay_s:.0f} ms from command to motion a robot at "
            f"{config.robot.max_speed_um_s:.0f} um/s goes {blind_um:.0f} um, more than half a channel: expect it to be "
            "swept into walls; set a smaller robot.delay_s or a slower flow (chip.inlet_speed_um_s)"
        )
    return Prepared(config, chip, assemble(config, chip), made, facts, image)


def _looked_at(config: ResolvedConfig, chip: Chip) -> tuple[ImageVerdict | None, str]:
    """What a movie says about the axes; and what to say if the walls are not where its registration puts them."""
    from flowrec.commands.calibrate_image import walls_state

    try:
        with opened(config.movie) as movie:
            image = movie.median_image()
    except MovieError:  # an image can not be read: the run tells that
        return None, ""
    verdict = checked_image(image, config, chip, config.movie.path)
    good, text = walls_state(image, chip, registration_of(config.camera, chip)) or (True, "")
    return verdict, "" if good else text


def _unsaid(_text: str) -> None:
    """In place of `say`."""


def refuse_adrift(config: ResolvedConfig, chip: Chip) -> None:
    """Check before the run that the assumed flow lets the robot reach the goal; a robot that is observed has none.

    Raises
    ------
    UnreachableError : the flow at the start is too fast to hold the robot there; the flow carries it out of an outlet
        before the ramp of the coils is complete; every route to the goal is too narrow, or too fast to be steered on.
    """
    if config.mission.observes:
        return
    robot, field = config.robot, config.flow.solve(chip)
    start = np.asarray(config.mission.start, np.float64)
    course_error = config.plan.swift.course_error(robot, robot.speed_limit_um_s)
    reason = too_swift(chip, field, start, start, course_error)
    if reason:
        raise UnreachableError(f"unreachable: the robot can not be held at the start: {reason}")
    if {Phase.PLAN, Phase.NAVIGATE} & set(config.mission.phases):
        goal = np.asarray(config.mission.goal, np.float64)
        reason = no_room(chip, field, start, goal, robot)
        reason = reason or too_swift(chip, field, start, goal, course_error)
        if reason:
            raise UnreachableError(f"unreachable: {reason}")
    reason = swept_out(chip, field, start, course_error, 0.0 if config.mission.hold_start_s else config.coils.ramp_s)
    if reason:
        raise UnreachableError(f"unreachable: {reason}")


def default_path(config: Config, folder: Path | None = None) -> Path:
    """The path date_operator_sample_number.mcap with the first free number."""
    sample = config.recording.sample or Path(config.chip.path).stem or config.chip.name
    words = [datetime.now().astimezone().strftime("%Y-%m-%d"), config.recording.operator, sample]
    stem = "_".join(word.replace(" ", "-") for word in words if word)
    folder = folder or Path()
    names = runs_in(folder)
    for number in range(1, 10_000):
        path = folder / f"{stem}_{number:03d}.mcap"
        if path not in names:
            return path
    raise SessionError(f"{folder}: 9999 sessions named {stem} are here; name one with --out")


def field_of_session(path: Path, chip: Chip) -> dict[str, FlowField]:
    """Assumed and refined flow at the end of an earlier session, on the same chip."""
    fields = {name: field for name, field in Session(path).fields.items() if name != "true"}
    if "assumed" not in fields:
        raise UsageError(f"start.field = {path}: that session holds no flow field; survey and refine first")
    shape = fields["assumed"].velocity_um_s.shape[:2]
    if shape != chip.mask.shape or not math.isclose(fields["assumed"].um_per_px, chip.um_per_px):
        raise UsageError(f"start.field = {path}: its field is for another chip ({shape[1]} x {shape[0]} pixels)")
    return fields


def record(
    config: Config,
    out: Path | None = None,
    view: View = "none",
    realtime: bool = False,
    overwrite: bool = False,
    control: Unattended | None = None,
    inputs: Sequence[Path] = (),
    keep_failed: bool = True,
    given_facts: Mapping[str, str] | None = None,
    console: bool = False,
    given_doubts: Sequence[str] = (),
) -> Recorded:
    """Run the mission of `config` and write it to `out`, in any thread.

    The field is off before this function returns or raises, whatever the exception; also for KeyboardInterrupt.

    Parameters
    ----------
    view : spawn, serve, rrd or none.
    realtime : keep the rig to the wall clock, with a watchdog of its ticks (run/watchdog.py); devices of a lab know no
        other time.
    control : who attends the run; None: nobody, it takes no signals and no keys and shows no progress.
    inputs : files that were read besides those that `config` names; no output may be one of them.
    keep_failed : False: a run that ends by an exception leaves no file, and one that it was to replace stays.
    given_facts : more for the provenance in the head of the file.
    console : serve a page on this machine that shows the run and steers it.
    given_doubts : why the result is doubtful, besides what the track shows.

    Raises
    ------
    FlowrecError : any of its kinds; a stage, a rig or a worker may raise others.
    """
    if console:
        refuse_without_packages()
    inputs = (*inputs, *_files_of(config))
    if out is not None:  # before anything else: to solve the flow takes a while
        Output(out, MCAP, inputs, overwrite).check()
    resolved, chip, pipeline, made, found, *_ = prepare(config)
    source = {**found, **(given_facts or {})}
    realtime = realtime or resolved.rig == LAB
    timeout_s = _guard_timeout_s(resolved) if realtime and resolved.rig != MOVIE else None
    path = _place(resolved, out, overwrite)
    output = Output(path, MCAP, inputs, overwrite)
    if view == "rrd":
        Output(path.with_suffix(RRD[0]), RRD, inputs, overwrite).check()
    fields = field_of_session(Path(resolved.start.field), chip) if resolved.start.field else {}
    rig: Rig = RIGS[resolved.rig].load().of(pipeline, resolved, resolved.duration_s, realtime)
    if isinstance(rig, Connecting):
        rig.tell = warn
    folder, floor_gb = path.resolve().parent, resolved.recording.disk_floor_gb
    control = control if control is not None else Unattended()
    run_control = control.run_control
    watchdog = Watchdog(rig, timeout_s, partial(run_control.stop, zero=True), warn)
    statistics = RunStatistics()
    clocks = ClockMonitor()
    low: list[str] = []
    opened: list[SessionWriter] = []

    def disk_low(reason: str) -> None:
        low.append(reason)
        run_control.stop(reason)

    with ExitStack() as stack:
        # From the first byte of the file to the last, every way to end the run leaves a complete file.
        stack.enter_context(control.armed(watchdog, lambda: _close_in_thread(opened, run_control.reason)))
        if isinstance(rig, Connecting):
            stack.enter_context(rig.connected())  # before there is a file
        if isinstance(rig, Picturing) and resolved.mission.check_axes:
            verdict = checked_image(rig.picture(), resolved, chip, "camera")
            source |= {"source_axes": verdict.text} if verdict is not None else {}
        tried = realtime and resolved.recording.admission_s > 0.0
        if tried:
            rehearse_aloud(resolved, control)
        worker: Worker
        worker = ProcessWorker(pipeline) if realtime else LockstepWorker(pipeline, resolved.worker.adopt_after_s)
        stack.callback(worker.close)
        if tried:
            source |= admitted(rig, worker, (resolved, chip, pipeline), fields, folder, run_control)
        writer = stack.enter_context(
            session_writer(
                output,
                resolved,
                chip,
                live=realtime,
                in_pieces=True,
                derived=made,
                facts=source,
                keep_failed=keep_failed,
            )
        )
        opened.append(writer)
        quality = TrackQuality(pipeline.calibration, pipeline.image_shape, pipeline.robot)
        sinks: list[Sink] = [writer, statistics, quality]
        if fields:
            worker = Preloaded(worker, fields)
        disk = stack.enter_context(DiskMonitor(folder, lambda: writer.bytes_written, floor_gb, disk_low).running())
        watching = stack.enter_context(
            Watching(
                view,
                (resolved, chip, pipeline, path),
                run_control if console else None,
                lambda: {"disk": disk.text, "file_mb": writer.bytes_written / 1e6, "duration_s": resolved.duration_s},
            )
        )
        sinks += watching.sinks
        # A run that is not in real time never waits: with real-time priority it would occupy a core.
        priority = realtime_priority() if realtime else nullcontext(enter_result=False)
        with control.shown(writer, disk) as show, priority as first:
            writes_first = first and writer.prioritise()

            def on_tick(tick: Tick) -> None:
                show(tick)
                _report_remarks(writer)

            report = run(
                pipeline,
                rig,
                worker,
                sinks,
                control=run_control,
                on_tick=on_tick,
                queue_state=lambda: (writer.queue_bytes / 1e6, writer.dropped_frames),
                clocks=clocks,
                watchdog=watchdog,
                paced=realtime,
            )
        facts = figures_of(chip, report, statistics.true_field)
        # Without navigation, and for a control law that descends the time to go, there is no reference.
        if not (resolved.mission.observes or resolved.control.needs):
            facts["tracking_error_um"] = statistics.tracking_error_um
        if control.note:
            facts["note_not_finished"] = control.note
        refined, not_refined = report.last.refined, list[str]()
        if refined is not None and refined.refused and resolved.refine.observes_flow and refined.log_score is None:
            not_refined = [f"the flow was not refined: {refined.refused}"]
        if isinstance(rig, MovieRig) and rig.noticed:
            facts["note_movie"] = "; ".join(rig.noticed)
        covered = None
        if isinstance(rig, MovieRig):
            stopped = run_control.reason.removeprefix("stopped by ")
            covered = Coverage(rig.taken, rig.images, "images", stopped=stopped, status=run_control.stop_status)
            facts["covered"] = covered.amount
        if doubts := doubts_text([*given_doubts, *not_refined, *quality.doubts()]):
            facts[DOUBTS] = doubts
        outcome = as_text(facts) | clocks.outcome()
        if realtime:
            outcome["loop_priority"] = "real time" if first else "ordinary"
            outcome["writer_priority"] = "real time" if writes_first else "ordinary"
        bad = "" if report.outcome in GOOD_ENDS else f"the run ended {report.outcome}: {report.note}".rstrip(": ")
        writer.close(outcome, CLOSE_TIMEOUT_S if run_control.reason else None, why=bad)
        _report_remarks(writer)
        told = report.outcome + (f" ({report.note})" if report.note else "")
        ended = Ended(told, files_text(path, tuple(writer.files)), good=not bad)
        watching.close(ended, VIEW_TIMEOUT_S if run_control.reason else None)
    facts["frames_dropped"] = writer.dropped_frames  # the writer has added it to the outcome of the file
    files = tuple(writer.files)
    ended_early, stopped_by = (low[0] if low else ""), bool(run_control.reason)
    recorded = Recorded(path, report, facts, files, made, ended_early, stopped_by, source, covered)
    if view == "rrd" and run_control.reason:
        say(f"the run was stopped: no .rrd was made; flowrec export {path} makes it")
    elif view == "rrd":
        from flowrec.commands.export import export

        for name in recorded.sessions:
            facts["rrd"] = str(export(name, overwrite=overwrite))
    return recorded


def _guard_timeout_s(config: ResolvedConfig) -> float:
    """The timeout of the watchdog in s; UsageError if it is shorter than a few frames of the camera."""
    timeout_s, rate_hz = config.safety.guard_timeout_s, config.camera.rate_hz
    if timeout_s * rate_hz < _LEAST_FRAMES:
        raise UsageError(
            f"safety.guard_timeout_s = {timeout_s:g}: shorter than {_LEAST_FRAMES:g} frames at camera.rate_hz = "
            f"{rate_hz:g}; the nearest that works is {_LEAST_FRAMES / rate_hz:.3g}"
        )
    return timeout_s


def _close_in_thread(opened: list[SessionWriter], reason: str) -> str:
    """Close the file while the main thread hangs; return a message about the file.

    Runs in the thread of the signals, and does not wait if the main thread hangs in the writer.
    """
    if not opened:
        return ""
    writer = opened[0]

    def close() -> None:
        with suppress(SessionError):  # what was written stays in the partial file
            writer.close(
                {"outcome": Outcome.FAILED, "note": f"{reason}; the main thread did not answer"}, CLOSE_TIMEOUT_S
            )

    thread = threading.Thread(target=close, name="give up", daemon=True)
    thread.start()
    thread.join(_GIVE_UP_TIMEOUT_S)
    if writer.partial_path.exists():
        return f"flowrec recover {writer.partial_path} makes a session of what was recorded"
    return f"the file is whole: {files_text(writer.path, tuple(writer.files))}"


def _files_of(config: Config) -> list[Path]:
    """The files that a configuration names, and those that are read with them."""
    files: list[Path] = []
    chip = Path(config.chip.path)
    if chip.name:
        files += [chip, chip.with_suffix(".png"), chip.with_suffix(".toml")]
    if config.start.field:
        files += files_behind(Path(config.start.field))
    movie = config.movie
    return [*files, *(Path(name) for name in (movie.path, movie.times, movie.coils) if name)]


def _report_remarks(writer: SessionWriter) -> None:
    while writer.remarks:
        say(writer.remarks.popleft())


def _place(config: Config, out: Path | None, overwrite: bool) -> Path:
    """The path of the session, after unfinished sessions in its folder are recovered and the free space is checked."""
    folder = out.parent if out is not None else Path()
    made: dict[Path, str] = {}
    if config.recording.recover_leftovers:
        excluded = frozenset(run_files(out.resolve())) if out is not None and overwrite else frozenset()
        made = recover_leftovers(folder, excluded)
    path = out if out is not None else default_path(config)
    same = next((file for file in made if run_path(file) == path), None)
    if same is not None and not overwrite:
        raise SessionError(
            f"{same}: was left by a run that did not finish and has just been recovered ({made[same]}); "
            "choose another name for this run with --out"
        )
    refuse_below(config.recording.disk_floor_gb, path.resolve().parent)
    return path
