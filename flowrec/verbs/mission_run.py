"""A mission on a rig, written to one session file: the engine of `flowrec record` and `flowrec import`."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flowrec.console import RunEnded, refuse_without_packages
from flowrec.core import (
    DOUBTS,
    MCAP,
    RRD,
    ClockMonitor,
    Coverage,
    FlowField,
    Outcome,
    Output,
    SessionError,
    Tick,
    UsageError,
    View,
    as_text,
    doubts_text,
    realtime_priority,
    say,
    warn,
)
from flowrec.physics import Chip
from flowrec.rigs import Connecting, MovieRig, Picturing, Rig
from flowrec.run import (
    DiskMonitor,
    LockstepWorker,
    Preloaded,
    ProcessWorker,
    RunControl,
    Sink,
    Streams,
    Watchdog,
    Worker,
    refuse_below,
    run,
)
from flowrec.stages import (
    MOVIE,
    RIGS,
    Config,
    MotionOfRun,
    ResolvedConfig,
    RunStatistics,
    TrackQuality,
    extra_rows,
    scale_doubt,
)
from flowrec.store import Session, SessionWriter, files_behind, run_files, run_path, runs_in, session_writer
from flowrec.verbs.admission import admit
from flowrec.verbs.auto_recovery import recover_leftovers
from flowrec.verbs.axes import checked_image
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.preparation import Prepared, prepare
from flowrec.verbs.rehearsal import rehearse_aloud
from flowrec.verbs.run_summary import GOOD_ENDS, Recorded, figures_of, files_text
from flowrec.verbs.watching import Watching

if TYPE_CHECKING:
    pass

# Parts of the 2 s that a run may take to end; the rest is for the coils (run/control.py) and for Python itself.
CLOSE_TIMEOUT_S = 0.5  # for images that are still queued
VIEW_TIMEOUT_S = 0.2  # for a viewer to show the last messages
_GIVE_UP_TIMEOUT_S = 1.0  # to close the file while the main thread hangs
_LEAST_FRAMES = 3.0  # of the camera within the watchdog's timeout


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


def run_mission(
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
    known: Prepared | None = None,
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
    known : see `prepare`.
    given_doubts : why the result is doubtful, besides what the run shows.

    Raises
    ------
    FlowrecError : any of its kinds; a stage, a rig or a worker may raise others.
    """
    if console:
        refuse_without_packages()
    inputs = (*inputs, *_files_of(config))
    if out is not None:  # before anything else: to solve the flow takes a while
        Output(out, MCAP, inputs, overwrite).check()
    resolved, chip, pipeline, made, found, _, walls = prepare(config, known=known)
    source = {**found, **(given_facts or {})}
    realtime = realtime or "realtime" in RIGS[resolved.rig].needs
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
    streams = Streams(extra_rows(resolved), warn) if resolved.topics else None
    low: list[str] = []
    opened: list[SessionWriter] = []

    def disk_low(reason: str) -> None:
        low.append(reason)
        run_control.stop(reason)

    with ExitStack() as stack:
        # From the first byte of the file to the last, every way to end the run leaves a complete file.
        stack.enter_context(control.end_on_signals(watchdog, lambda: _close_in_thread(opened, run_control.reason)))
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
            source |= admit(rig, worker, (resolved, chip, pipeline), fields, folder, run_control)
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
        motion = MotionOfRun(pipeline.robot)
        sinks: list[Sink] = [writer, statistics, quality, motion]
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
        with control.show_run(writer, disk) as show, priority as first:
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
                streams=streams,
            )
        facts = figures_of(chip, report, statistics.true_field)
        # Without navigation, and for a control law that descends the time to go, there is no reference.
        if not (resolved.mission.observes or resolved.control.needs):
            facts["tracking_error_um"] = statistics.tracking_error_um
        if control.note:
            facts["note_not_finished"] = control.note
        doubted = [walls.text] if walls is not None and walls.other_scale else []
        refinement_facts, refinement_doubts = _judge_refinement(
            report.last.refined, resolved, known_doubts=bool(doubted)
        )
        facts |= refinement_facts
        doubted += refinement_doubts
        if isinstance(rig, MovieRig) and rig.noticed:
            facts["note_movie"] = "; ".join(rig.noticed)
        covered = _coverage_of_movie(rig, run_control) if isinstance(rig, MovieRig) else None
        if covered is not None:
            facts["covered"] = covered.amount
        if doubts := doubts_text([*given_doubts, *doubted, *quality.doubts(), *motion.doubts()]):
            facts[DOUBTS] = doubts
        outcome = as_text(facts) | clocks.outcome()
        if realtime:
            outcome["loop_priority"] = "real time" if first else "ordinary"
            outcome["writer_priority"] = "real time" if writes_first else "ordinary"
        bad = "" if report.outcome in GOOD_ENDS else f"the run ended {report.outcome}: {report.note}".rstrip(": ")
        writer.close(outcome, CLOSE_TIMEOUT_S if run_control.reason else None, why=bad)
        _report_remarks(writer)
        told = report.outcome + (f" ({report.note})" if report.note else "")
        ended = RunEnded(told, files_text(path, tuple(writer.files)), good=not bad)
        watching.close(ended, VIEW_TIMEOUT_S if run_control.reason else None)
    facts["frames_dropped"] = writer.dropped_frames  # the writer has added it to the outcome of the file
    files = tuple(writer.files)
    ended_early, stopped_by = (low[0] if low else ""), bool(run_control.reason)
    recorded = Recorded(path, report, facts, files, made, ended_early, stopped_by, source, covered)
    if view == "rrd":
        _export_rrd(recorded, run_control, overwrite)
    return recorded


def _judge_refinement(
    refined: FlowField | None, config: ResolvedConfig, *, known_doubts: bool
) -> tuple[dict[str, str], list[str]]:
    """Facts and doubts about the refined flow of a run; its scale is not doubted again if the walls' is."""
    facts: dict[str, str] = {}
    doubts: list[str] = []
    if refined is None:
        return facts, doubts
    if not known_doubts and (scale := scale_doubt(refined, config.camera.um_per_px)):
        doubts.append(scale)
    if refined.refused and refined.log_score is None:
        if config.refine.observes_flow:
            doubts.append(f"the flow was not refined: {refined.refused}")
        else:  # a movie without a log: nothing was asked that was not done
            facts["not_refined"] = f"because {refined.refused}"
    return facts, doubts


def _coverage_of_movie(rig: MovieRig, control: RunControl) -> Coverage:
    """Coverage of a movie: the images that were taken of all."""
    stopped = control.reason.removeprefix("stopped by ")
    return Coverage(rig.taken, rig.images, "images", stopped=stopped, status=control.stop_status)


def _export_rrd(recorded: Recorded, control: RunControl, overwrite: bool) -> None:
    """Write an .rrd of each session of a run and add it to the facts; after a stop, say how to make it."""
    if control.reason:
        say(f"the run was stopped: no .rrd was made; flowrec export {recorded.path} makes it")
        return
    from flowrec.exports import export

    for name in recorded.sessions:
        recorded.facts["rrd"] = str(export(name, overwrite=overwrite))


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
