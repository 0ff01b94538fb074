"""The pipeline, run again over a recorded session: the engine of `flowrec replay`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.core import (
    ANSWERED_BY,
    DOUBTS,
    MCAP,
    NUMERICS_VERSION,
    WORKER_FIELDS,
    Applied,
    Floats,
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
from flowrec.run import CommandDifference, RecordedRig, ReplayWorker, Sink, run, work
from flowrec.stages import (
    OBSERVERS,
    SAMPLERS,
    Pipeline,
    ResolvedConfig,
    assemble,
    facts_of,
    map_doubts,
    observe,
    other_packages,
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
from flowrec.verbs.replay_result import Replay, WorkerCheck, WorkerResults, coverage_of, digest_lines
from flowrec.verbs.run_summary import figures_of, judges_of


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
) -> Replay:
    """Replay a session, in any thread; write the result to a new session if `out` is given.

    Raises UsageError: a change that is not possible, or a time outside of the session; SessionError: the session can
    not be read or replayed, or `out` not be written.

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
    """
    if out is not None:
        source = session.path if isinstance(session, Session) else session_path(session)
        output = Output(Path(out), MCAP, tuple(files_behind(source)), overwrite)
        output.check()
    replay = _Replay(Session.of(session), change or Change(), from_s, segment_ns, verify, control or Unattended())
    with ExitStack() as stack:
        stack.enter_context(input_blamed(replay.session, replay.config, "replayed"))
        writer, judges, sinks = None, judges_of(replay.pipeline), list[Sink]()
        if out is not None:
            session, config, topics = replay.session, replay.config, replay.pipeline.topics
            facts = facts_of(config, session.provenance)
            writer = stack.enter_context(
                session_writer(output, config, session.chip, parent=session.path, facts=facts, topics=topics)
            )
            sinks += [writer if frames else WithoutFrames(writer), *judges]
        replay.show_progress(stack)
        result = replay.run(sinks)
        if writer is not None:
            refined = result.report.last.refined
            result.doubts = [doubt for judge in judges for doubt in judge.doubts()]
            result.doubts += map_doubts(refined, result.config.camera.um_per_px) if refined is not None else []
            _close(writer, result)
            result.file = out
    if verify and segment_ns is None:
        replay.read_digest(result)
    return result


class _Replay:
    """A replay of a session: today's stages on the recorded inputs, compared with what was recorded."""

    def __init__(
        self,
        session: Session,
        change: Change,
        from_s: float | None,
        segment_ns: tuple[int | None, int] | None,
        verify: bool,
        control: Unattended,
    ) -> None:
        """Refuse a change that is not possible, then prepare; nothing runs yet."""
        self.session, self.control, self._from_s = session, control, from_s
        config = change.apply(session.config)
        self._stale = change.stale_results(session.config, config)
        if verify and (self._stale or config != session.config):
            raise UsageError("--verify compares with what was recorded: it goes without --refine, --plan, --set ...")
        self._packages = other_packages(config, session.provenance)
        self.config = _with_recorded_region(session, config)
        self.pipeline = _pipeline_of(session, self.config)
        self._between_ns = start_ns, end_ns = _between_ns(session, from_s, segment_ns)
        reader, topics = session.reader, self.pipeline.topics
        self._first_ns = start_ns if start_ns is not None else reader.first_ns
        recorded_start = reader.tick_before(start_ns - 1) if start_ns is not None else Tick()
        self._start = topics.typed_tick(recorded_start)
        self._rig = RecordedRig(reader, start_ns, self._stale, end_ns, topics)
        self._progress = Progress()  # until the bar is shown
        self._worker = self._worker_with(change)
        order = _order_under_way(reader, self._start)
        if order is not None:
            self._worker.submit(order)
        sides = Side.of("recorded", session), Side.of_replay(topics)
        results = WorkerResults(Comparison(sides=sides))
        self._check = WorkerCheck(self.pipeline, self._start, order, results) if verify else None
        self._comparison, self._commands = Comparison(sides=sides), CommandDifference()
        self._comparison.begin_after(recorded_start, self._start)

    def _worker_with(self, change: Change) -> ReplayWorker:
        """A worker that takes over recorded results where today's code computes the same of the same."""
        # The worker does not refer to `self`: a circle would keep the whole replay in memory after its end.
        rig, recorded = self._rig, self.session.config
        # Hindsight is no message of a tick.
        stands = self.session.numerics == str(NUMERICS_VERSION) and self.pipeline.hindsight is None
        return ReplayWorker(
            self.pipeline,
            self.config.worker.adopt_after_s,
            adoption_stamps(self.session.reader),
            self._stale,
            lambda: rig.recorded,
            change.same_orders(recorded, self.config) if stands else (),
        )

    def show_progress(self, stack: ExitStack) -> None:
        """Show the bar until the stack is left."""
        length_s = max(seconds(self._between_ns[1] - self._first_ns), 1e-3)
        self._progress = stack.enter_context(self.control.progress(f"replaying {self.session.path.name}", length_s))
        self._worker.announce = self._progress.stage

    def run(self, sinks: list[Sink]) -> Replay:
        """Replay all ticks; the first of the sinks also takes results that the recording ended too early for."""
        control = self.control.run_control
        with self.control.end_on_signals():
            report = run(
                self.pipeline,
                self._rig,
                self._worker,
                sinks,
                start=self._start,
                control=control,
                on_tick=self._compare,
                live=False,
            )
        path, last, recorded = self.session.path, report.last, self._rig.recorded
        if report.ticks == 0 and not control.reason:
            raise SessionError(
                f"{path}: holds no tick to replay after {self._from_s or 0:g} s; see flowrec info {path}"
            )
        if self._stale:
            self._progress.stage("work that was under way")
            with self.control.end_on_signals():
                closing = partial(_closing_work, self.pipeline, self.config, last, recorded, self._stale)
                last = control.unless_stopped(closing, last)
            if last is not report.last and sinks:
                sinks[0].write(last)
        return Replay(
            self.session,
            self.config,
            report,
            recorded,
            last,
            self._comparison,
            self._commands,
            self._rig.frames_missing,
            coverage_of(self.session, self._comparison.ticks, self._between_ns, self._from_s, control),
            self._check.results if self._check is not None else None,
            packages=self._packages,
        )

    def _compare(self, tick: Tick) -> None:
        control, recorded = self.control.run_control, self._rig.recorded
        if self._check is not None:  # it takes as long as the mission's slow stages did
            control.unless_stopped(partial(self._check.add, tick), None)
            if control.reason:
                return  # perhaps not all of this tick was looked at, so it does not count
        self._comparison.add(recorded, tick)
        self._commands.add(recorded.demand, tick.demand)
        self._progress(seconds(tick.stamp_ns - self._first_ns))

    def read_digest(self, result: Replay) -> None:
        """Compare the files of the session with their digests."""
        control = self.control.run_control
        with self.control.end_on_signals():
            result.digest = control.unless_stopped(partial(digest_lines, self.session.path), None)
        result.covered = control.with_stop(result.covered)


def _pipeline_of(session: Session, config: ResolvedConfig) -> Pipeline:
    """The stages of a replay, with the message types of the recording."""
    pipeline = assemble(config, session.chip)
    if "recording" in SAMPLERS[config.sampler.method].needs:
        pipeline = replace(pipeline, hindsight=hindsight(session, pipeline))
    return replace(pipeline, topics=session.reader.topics.with_types_of(pipeline.topics))


def _between_ns(
    session: Session, from_s: float | None, segment_ns: tuple[int | None, int] | None
) -> tuple[int | None, int]:
    """Stamps of the first and the last tick to replay; None for the beginning."""
    start_ns = session.stamp_ns(from_s, "--from") if from_s is not None else None
    end_ns = session.reader.last_ns
    if segment_ns is not None:
        start_ns, end_ns = segment_ns
    keyframe_ns = session.reader.keyframe_ns
    if keyframe_ns is not None:
        # A part of a run begins with a keyframe, whose inputs the part before holds.
        start_ns = max(start_ns or 0, keyframe_ns + 1)
    return start_ns, end_ns


def _close(writer: SessionWriter, result: Replay) -> None:
    """Close the file of a replay with its figures, its doubts and how it ended."""
    covered = result.covered
    ended = Outcome.STOPPED if covered.stopped else Outcome.REPLAYED
    note = f"replay of {result.session.path.name}" + (f", {covered.text}" if covered.stopped else "")
    ran = replace(result.report, last=result.replayed)
    figures = figures_of(result.session.chip, ran, result.recorded.true_field)
    stated = {DOUBTS: doubts_text(result.doubts)} if result.doubts else {}
    writer.close(as_text(figures | {"outcome": ended, "note": note, "covered": covered.amount} | stated))


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

    Raises UsageError: the observer is not the Kalman filter, whose model the smoother shares.
    """
    if "kalman" not in OBSERVERS[pipeline.observer.method].options:
        able = " or ".join(f"'{row.name}'" for row in OBSERVERS.values() if "kalman" in row.options)
        raise UsageError(
            f"sampler.method = {pipeline.sampler.method!r} needs observer.method = {able}, whose model it shares"
        )
    tracks: list[Track] = []
    applied: list[Applied] = []
    before: Applied | None = None
    for tick in session.ticks(with_frames=False):
        if tick.track is not None and tick.applied is not None and (not tracks or tick.track is not tracks[-1]):
            tracks.append(tick.track)
            applied.append(pipeline.response.proportional_turns(before, tick.applied))
            before = tick.applied
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


def planned_from(recorded: Tick, last: Tick) -> Floats:
    """The start of the recorded route, else the position of the robot: a point (2,) in um."""
    if recorded.route is not None and recorded.route.reachable and recorded.mission is not None:
        return np.array(recorded.route.waypoints_um[0], np.float64)
    assert last.estimate is not None
    return last.estimate.position_um
