"""The pipeline, run again over a recorded session: the engine of `flowrec replay`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import (
    ANSWERED_BY,
    DOUBTS,
    MCAP,
    NUMERICS_VERSION,
    WORKER_FIELDS,
    Applied,
    Coverage,
    Mission,
    Observations,
    Outcome,
    Output,
    Phase,
    Progress,
    SessionError,
    Tick,
    Track,
    UsageError,
    WorkOrder,
    as_text,
    doubts_text,
    seconds,
    warn,
)
from flowrec.run import CommandDifference, RecordedRig, ReplayWorker, RunControl, Sink, run, work
from flowrec.stages import (
    OBSERVERS,
    SAMPLERS,
    MotionOfRun,
    Pipeline,
    ResolvedConfig,
    TrackQuality,
    assemble,
    facts_of,
    observe,
    other_packages,
    scale_doubt,
    smooth,
)
from flowrec.store import (
    Session,
    SessionReader,
    SessionWriter,
    files_behind,
    input_blamed,
    session_path,
    session_writer,
)
from flowrec.verbs.comparison import Comparison, Side
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.replay_change import Change
from flowrec.verbs.replay_result import Replayed, WorkerCheck, WorkerResults, digest_lines
from flowrec.verbs.run_summary import figures_of


def replay_session(
    session: Session | Path | str,
    change: Change | None = None,
    from_s: float | None = None,
    verify: bool = False,
    out: Path | None = None,
    overwrite: bool = False,
    frames: bool = False,
    control: Unattended | None = None,
    *,
    segment_ns: tuple[int | None, int] | None = None,
) -> Replayed:
    """Replay a session, in any thread; write the result to a new session if `out` is given.

    Parameters
    ----------
    change : other methods and settings; None: as recorded.
    from_s : session time in s to start at.
    verify : compute the results of the worker again, too, and compare the files with their digests.
    out : session file of the replay.
    overwrite : `out` may replace an existing file.
    frames : copy the camera's images to `out`.
    control : who attends the replay; None: nobody, it takes no signals and shows no progress. A replay that it stops
        returns what was done by then, and `covered` of the result says so.
    segment_ns : replay a segment of a verification: stamps of its first and its last tick, None for the beginning. Its
        start is compared in the segment before, and digests are not.

    Raises
    ------
    UsageError : a change that is not possible, or a time outside of the session.
    SessionError : the session can not be read or replayed, or `out` not be written.
    """
    if out is not None:
        source = session.path if isinstance(session, Session) else session_path(session)
        output = Output(Path(out), MCAP, tuple(files_behind(source)), overwrite)
        output.check()
    session, change = Session.of(session), change or Change()
    control = control or Unattended()
    config = change.apply(session.config)
    stale = change.stale_results(session.config, config)
    if verify and (stale or config != session.config):
        raise UsageError("--verify compares with what was recorded: it goes without --refine, --plan, --set ...")
    packages = other_packages(config, session.provenance)
    config = _with_recorded_region(session, config)
    pipeline = assemble(config, session.chip)
    if "recording" in SAMPLERS[config.sampler.method].needs:
        pipeline = replace(pipeline, hindsight=hindsight(session, pipeline))
    path, reader = session.path, session.reader
    pipeline = replace(pipeline, topics=reader.topics.with_types_of(pipeline.topics))
    start_ns = session.stamp_ns(from_s, "--from") if from_s is not None else None
    end_ns = reader.last_ns
    if segment_ns is not None:
        start_ns, end_ns = segment_ns
    if reader.keyframe_ns is not None:
        # A part of a run begins with a keyframe, whose inputs the part before holds.
        start_ns = max(start_ns or 0, reader.keyframe_ns + 1)
    recorded_start = reader.tick_before(start_ns - 1) if start_ns is not None else Tick()
    start = pipeline.topics.typed_tick(recorded_start)
    rig = RecordedRig(reader, start_ns, stale, end_ns, pipeline.topics)
    progress = Progress()  # until the bar is shown
    # Recorded results stand where today's code computes the same of the same. Hindsight is no message of a tick.
    stands = session.numerics == str(NUMERICS_VERSION) and pipeline.hindsight is None
    worker = ReplayWorker(
        pipeline,
        config.worker.adopt_after_s,
        adoption_stamps(reader),
        stale,
        lambda what: progress.stage(what),
        lambda: rig.recorded,
        change.same_orders(session.config, config) if stands else (),
    )
    order = _order_under_way(reader, start)
    if order is not None:
        worker.submit(order)
    sides = Side.of("recorded", session), Side.of_replay(pipeline.topics)
    results = WorkerResults(Comparison(sides=sides))
    check = WorkerCheck(pipeline, start, order, results) if verify else None
    comparison, commands = Comparison(sides=sides), CommandDifference()
    comparison.begin_after(recorded_start, start)
    first_ns = start_ns if start_ns is not None else reader.first_ns

    def on_tick(tick: Tick) -> None:
        if check is not None:  # it takes as long as the mission's slow stages did
            control.run_control.unless_stopped(partial(check.add, tick), None)
            if control.run_control.reason:
                return  # perhaps not all of this tick was looked at, so it does not count
        comparison.add(rig.recorded, tick)
        commands.add(rig.recorded.demand, tick.demand)
        progress(seconds(tick.stamp_ns - first_ns))

    with ExitStack() as stack:
        stack.enter_context(input_blamed(session, config, "replayed"))
        sinks: list[Sink] = []
        writer, doubts = None, list[str]()
        if out is not None:
            writer = stack.enter_context(
                session_writer(
                    output,
                    config,
                    session.chip,
                    parent=path,
                    facts=facts_of(config, session.provenance),
                    topics=pipeline.topics,
                )
            )
            quality = TrackQuality(pipeline.calibration, pipeline.image_shape, pipeline.robot)
            motion = MotionOfRun(pipeline.robot)
            sinks += [writer if frames else WithoutFrames(writer), quality, motion]
        length_s = max(seconds(end_ns - first_ns), 1e-3)
        progress = stack.enter_context(control.progress(f"replaying {path.name}", length_s))
        with control.end_on_signals():
            report = run(
                pipeline, rig, worker, sinks, start=start, control=control.run_control, on_tick=on_tick, live=False
            )
        if report.ticks == 0 and not control.run_control.reason:
            raise SessionError(f"{path}: holds no tick to replay after {from_s or 0:g} s; see flowrec info {path}")
        last = report.last
        if stale:
            progress.stage("work that was under way")
            with control.end_on_signals():
                closing = partial(_closing_work, pipeline, config, last, rig.recorded, stale)
                last = control.run_control.unless_stopped(closing, last)
            if last is not report.last and sinks:
                sinks[0].write(last)
        covered = coverage_of(session, comparison.ticks, (start_ns, end_ns), from_s, control.run_control)
        if writer is not None:
            ended = Outcome.STOPPED if covered.stopped else Outcome.REPLAYED
            note = f"replay of {path.name}" + (f", {covered.text}" if covered.stopped else "")
            figures = figures_of(session.chip, replace(report, last=last), rig.recorded.true_field)
            refined = report.last.refined
            scale = scale_doubt(refined, config.camera.um_per_px) if refined is not None else ""
            doubts = [*quality.doubts(), *motion.doubts(), *([scale] if scale else [])]
            stated = {DOUBTS: doubts_text(doubts)} if doubts else {}
            writer.close(as_text(figures | {"outcome": ended, "note": note, "covered": covered.amount} | stated))
    result = Replayed(session, config, report, rig.recorded, last, comparison, commands, rig.frames_missing, covered)
    result.doubts, result.packages = doubts, packages
    if verify:
        result.worker = results
        if segment_ns is None:
            with control.end_on_signals():
                result.digest = control.run_control.unless_stopped(partial(digest_lines, path), None)
            if control.run_control.reason:
                result.covered = _with_stop(covered, control.run_control)
    return result


def coverage_of(
    session: Session, ticks: int, between_ns: tuple[int | None, int], from_s: float | None, control: RunControl
) -> Coverage:
    """Coverage of a replay: the ticks that it has looked at, of those with inputs that it was asked for."""
    reader, (start_ns, end_ns) = session.reader, between_ns
    total = reader.counts.get("applied", 0)
    asked, left_out = total, {}
    if start_ns is not None or end_ns < reader.last_ns:
        asked = sum((start_ns or 0) <= stamp_ns <= end_ns for stamp_ns in reader.stamps("applied"))
    part = ""
    if from_s is not None:
        part, left_out = f"from {from_s:g} s on", {f"{total - asked} ticks before {from_s:g} s": "not asked for"}
    elif ticks < asked and not control.reason:
        left_out = {f"{asked - ticks} ticks": "hold neither image nor track, so there is nothing to replay"}
    covered = Coverage(ticks, asked, "ticks", part, left_out=left_out)
    return _with_stop(covered, control) if control.reason else covered


def _with_stop(covered: Coverage, control: RunControl) -> Coverage:
    return replace(covered, stopped=control.reason.removeprefix("stopped by "), status=control.stop_status)


def _with_recorded_region(session: Session, config: ResolvedConfig) -> ResolvedConfig:
    """The configuration of a replay whose images are cropped, if the recorded ones are.

    Warns if tracker or robot differ from the recorded ones: they may need pixels that were not stored.
    """
    if session.reader.region is None:
        return config
    if (config.tracker, config.robot) != (session.config.tracker, session.config.robot):
        warn(
            f"{session.path.name}: most images are black outside of what the recorded tracker read; with another "
            "tracker or robot the replay is not what it would be on whole images"
        )
    return replace(config, recording=replace(config.recording, region="robot"))


def hindsight(session: Session, pipeline: Pipeline) -> Callable[[int], Observations]:
    """The flow observations up to a stamp by the RTS smoother, for `sampler.method = "smoothed"`.

    Raises
    ------
    UsageError : the observer is not the Kalman filter, whose model the smoother shares.
    """
    if "kalman" not in OBSERVERS[pipeline.observer.method].options:
        able = " or ".join(f"'{row.name}'" for row in OBSERVERS.values() if "kalman" in row.options)
        raise UsageError(
            f"sampler.method = {pipeline.sampler.method!r} needs observer.method = {able}, whose model it shares"
        )
    tracks: list[Track] = []
    applied: list[Applied] = []
    for tick in session.ticks(with_frames=False):
        if tick.track is not None and tick.applied is not None and (not tracks or tick.track is not tracks[-1]):
            tracks.append(tick.track)
            applied.append(tick.applied)
    robot, sampler = pipeline.robot, pipeline.sampler

    def observations(stamp_ns: int) -> Observations:
        count = sum(track.stamp_ns <= stamp_ns for track in tracks)
        smoothed = smooth(tracks[:count], applied[:count], pipeline.observer.kalman, robot)
        return observe(smoothed, robot, sampler.spacing_radii, sampler.settled_share)

    return observations


def adoption_stamps(reader: SessionReader) -> dict[int, int]:
    """For each work order of a recording, by number, the stamp of the tick that adopted its result."""
    return {message.request: message.stamp_ns for name in WORKER_FIELDS for message in reader.messages(name)}


class WithoutFrames:
    """A sink that omits the camera images: they stay in the parent session, which the replay names by hash."""

    def __init__(self, writer: SessionWriter) -> None:
        self._writer = writer

    def write(self, tick: Tick) -> None:
        self._writer.write(replace(tick, frame=None))


def _order_under_way(reader: SessionReader, start: Tick) -> Tick | None:
    """The tick of a work order whose result is not yet adopted at the start; None if there is no such order.

    If a part of a run begins after that tick, it is the keyframe, which holds later messages of the stages.
    """
    mission = start.mission
    if mission is None or not mission.wanted:
        return None
    answer = getattr(start, ANSWERED_BY[WorkOrder(mission.wanted)])
    if answer is not None and answer.request == mission.request:
        return None
    return reader.tick_before(max(mission.requested_ns, reader.first_ns))


def _closing_work(
    pipeline: Pipeline, config: ResolvedConfig, last: Tick, recorded: Tick, stale: frozenset[str]
) -> Tick:
    """Compute, after the last frame, results that the recording ended too early to adopt or never ordered."""
    mission = last.mission
    if mission is None or last.assumed is None:
        return last
    stamp_ns, number = last.stamp_ns + 1, mission.request
    tick = replace(last, stamp_ns=stamp_ns, event=None)

    def result_of(order: WorkOrder, **more: Any) -> Any:
        nonlocal number
        number += 1
        ordered: Mission = replace(
            mission, stamp_ns=stamp_ns, wanted=order, request=number, requested_ns=stamp_ns, **more
        )
        return work(pipeline, replace(tick, mission=ordered))

    phases = config.mission.phases
    if "refined" in stale and {Phase.REFINE, Phase.OBSERVE} & set(phases) and last.refined is None:
        tick = replace(tick, refined=result_of(WorkOrder.REFINE))
    navigated = mission.phase in (Phase.NAVIGATE, Phase.DONE)
    planned = last.route is not None and last.route is not recorded.route and navigated
    wants_route = "route" in stale and {Phase.PLAN, Phase.NAVIGATE} & set(phases)
    if wants_route and (tick.refined is not last.refined or not planned):
        tick = replace(tick, route=result_of(WorkOrder.ROUTE, start_um=planned_from(recorded, last)))
    return tick if tick.refined is not last.refined or tick.route is not last.route else last


def planned_from(recorded: Tick, last: Tick) -> NDArray[np.float64]:
    """The start of the recorded route, else the position of the robot: a point (2,) in um."""
    if recorded.route is not None and recorded.route.reachable and recorded.mission is not None:
        return np.array(recorded.route.waypoints_um[0], np.float64)
    assert last.estimate is not None
    return last.estimate.position_um
