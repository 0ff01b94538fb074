"""`flowrec replay`: run the pipeline again over a recorded session, the same or with other stages."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec import topics
from flowrec.chip.chip import Chip
from flowrec.commands.compare import Comparison, Side
from flowrec.commands.interactive import Unattended
from flowrec.config import ResolvedConfig, with_sets
from flowrec.enums import WorkOrder
from flowrec.errors import FlowrecError, SessionError, UsageError, printable
from flowrec.estimation.smoother import observe, smooth
from flowrec.messages import Applied, Demand, FlowField, Observations, Route, Tick, Track
from flowrec.pipeline import Pipeline, assemble
from flowrec.ranges import faults as range_faults
from flowrec.rigs.recorded import RecordedRig
from flowrec.run.jobs import work
from flowrec.run.loop import LockstepWorker, RunReport, Sink, run
from flowrec.session import Session, content_blamed, files_behind
from flowrec.session_writer import session_writer
from flowrec.store import SessionReader, SessionWriter, digest_faults
from flowrec.summary import as_text
from flowrec.system.outputs import MCAP, RRD, check_output
from flowrec.terminal import warn
from flowrec.topics import ANSWERED_BY, BY_FIELD, WORKER_FIELDS
from flowrec.units import seconds

# What a recording has settled once and for all.
FIXED = ("chip", "camera", "rig", "simulated")


@dataclass(frozen=True, slots=True)
class Change:
    """What a replay does differently: the verbs of the command line."""

    refine: str | None = None
    plan: str | None = None
    observer: str | None = None
    controller: str | None = None
    sets: tuple[str, ...] = ()

    def apply(self, config: ResolvedConfig) -> ResolvedConfig:
        """The recorded configuration with the changes; a what-if never replans on a robot that can not follow."""
        plan, controller = _that_go_together(self.plan, self.controller, config)
        typed = {
            "refine.method": ("--refine", self.refine),
            "plan.method": ("--plan", plan),
            "observer.method": ("--observer", self.observer),
            "control.method": ("--controller", controller),
        }
        given = {key: (flag, value) for key, (flag, value) in typed.items() if value is not None}
        sets = [*(f"{key}={value}" for key, (_, value) in given.items()), *self.sets]
        if not sets:
            return config
        changed = with_sets(config, sets, {key: flag for key, (flag, _) in given.items()})
        phases = changed.mission.phases
        if self.refine is not None and "refine" not in phases:
            phases = tuple(dict.fromkeys((*phases, "refine", "plan")))
        mission = replace(changed.mission, phases=phases, replan_error_um=math.inf)
        return replace(changed, mission=mission)


def _that_go_together(
    plan: str | None, controller: str | None, config: ResolvedConfig
) -> tuple[str | None, str | None]:
    """Planner and controller asked for; where only one is and the recorded other does not suit it, one that does."""
    if controller == "policy" and plan is None and config.plan.method != "time_field":
        return "time_field", controller
    if plan not in (None, "time_field") and controller is None and config.control.method == "policy":
        return plan, "vector"
    return plan, controller


@dataclass(slots=True)
class CommandDifference:
    """A sink's tally of how far the replayed demand is from the recorded one."""

    compared: int = 0
    changed: int = 0
    first_ns: int | None = None
    _square: float = 0.0

    def add(self, was: Demand | None, now: Demand | None) -> None:
        """Compare one pair of demands."""
        if was is None or now is None:
            return
        self.compared += 1
        difference = math.dist(was.velocity_um_s, now.velocity_um_s)
        self._square += difference**2
        if difference > 1.0:  # um/s: below that nobody would see it
            self.changed += 1
            self.first_ns = now.stamp_ns if self.first_ns is None else self.first_ns

    @property
    def rms_um_s(self) -> float:
        """Root mean square difference of the demanded velocity."""
        return math.sqrt(self._square / self.compared) if self.compared else 0.0


@dataclass(slots=True)
class Replayed:
    """What a replay found."""

    source: Path
    recorded_config: ResolvedConfig
    config: ResolvedConfig
    chip: Chip
    report: RunReport
    recorded: Tick
    replayed: Tick
    true_field: FlowField | None
    comparison: Comparison
    frames_missing: int
    commands: CommandDifference
    worker_check: WorkerCheck | None  # of --verify
    digest: tuple[bool, list[str]] | None  # likewise: whether the file is as it was recorded, and lines that say so


def stale_results(recorded: ResolvedConfig, changed: ResolvedConfig) -> frozenset[str]:
    """The worker results that must be made anew; changing what a recording has settled is a UsageError."""
    sections = [
        each.name for each in fields(ResolvedConfig) if getattr(recorded, each.name) != getattr(changed, each.name)
    ]
    for section in sections:
        if section in FIXED:
            raise UsageError(
                f"--set {section}...: a replay can not change the {section} of a recording; "
                "record again, or use --refly"
            )
    return topics.stale_results(sections)


def check_outputs(path: Path, out: Path, *, refly: bool, rrd: bool, overwrite: bool) -> None:
    """Refuse what a replay of `path` may not write, before it begins: `out` and what is made beside it."""
    inputs = files_behind(path)
    check_output(out, MCAP, inputs=inputs, overwrite=overwrite)
    if refly:
        check_output(refly_path(out), MCAP, inputs=inputs, overwrite=overwrite)
    if rrd:
        check_output(out.with_suffix(RRD[0]), RRD, inputs=inputs, overwrite=overwrite)


def refly_path(out: Path) -> Path:
    """Where the flight of the replayed plan goes, beside the replay."""
    return out.with_name(f"{out.stem}_refly{MCAP[0]}")


def replay(
    session: Session | Path | str,
    change: Change | None = None,
    from_s: float | None = None,
    verify: bool = False,
    out: Path | None = None,
    overwrite: bool = False,
    frames: bool = False,
    control: Unattended | None = None,
) -> Replayed:
    """Replay a session with `change`, in any thread; write the result to `out` when given.

    Parameters
    ----------
    from_s : resume at this second.
    verify : do the worker's orders again as well, and compare.
    frames : copy the camera's images to `out`.
    control : who attends it; None: nobody, it takes no signals and shows no progress.
    """
    session, change = Session.of(session), change if change is not None else Change()
    path, reader, recorded_config, chip = session.path, session.reader, session.config, session.chip
    config = change.apply(recorded_config)
    stale = stale_results(recorded_config, config)
    if change.refine is not None:
        stale |= topics.stale_results(["refine"])
    if verify and (stale or config != recorded_config):
        raise UsageError("--verify compares with what was recorded: it goes without --refine, --plan, --set ...")
    config = _warned_of_windows(reader, recorded_config, config)
    pipeline = assemble(config, chip)
    if config.sampler.method == "smoothed":
        pipeline = replace(pipeline, hindsight=hindsight(reader, pipeline))
    start_ns = session.stamp_ns(from_s, "--from") if from_s is not None else None
    if reader.carried_ns is not None:
        # A piece of a run begins with what was known, not with a frame to work on.
        start_ns = max(start_ns or 0, reader.carried_ns + 1)
    start = reader.tick_before(start_ns - 1) if start_ns is not None else Tick()
    rig = RecordedRig(reader, start_ns, stale)
    worker = LockstepWorker(pipeline, config.worker.adopt_after_s, adoption_stamps(reader), stale)
    order = _order_under_way(reader, start)
    if order is not None:
        worker.submit(order)
    sides = Side.of("recorded", session), Side("replayed", "the replay")
    checker = WorkerCheck(pipeline, start, order, Comparison(sides=sides)) if verify else None
    comparison, commands = Comparison(sides=sides), CommandDifference()
    truth: list[FlowField] = [] if start.true_field is None else [start.true_field]

    def on_tick(tick: Tick) -> None:
        comparison.add(rig.recorded, tick)
        commands.add(rig.recorded.demand, tick.demand)
        if tick.true_field is not None:
            truth.append(tick.true_field)
        if checker is not None:
            checker.see(tick)
        done(seconds(tick.stamp_ns - first_ns))

    control = control if control is not None else Unattended()
    desk = control.desk
    first_ns = start_ns if start_ns is not None else reader.first_ns
    with ExitStack() as stack:
        stack.enter_context(_settings_blamed(path, config))
        stack.enter_context(content_blamed(session, "replayed"))
        sinks: list[Sink] = []
        writer = None
        if out is not None:
            writer = stack.enter_context(session_writer(out, config, chip, parent=path, overwrite=overwrite))
            sinks.append(writer if frames else WithoutFrames(writer))
        length_s = max(seconds(reader.last_ns - first_ns), 1e-3)
        done = stack.enter_context(control.progress(f"replaying {path.name}", length_s))
        with control.armed():
            report = run(pipeline, rig, worker, sinks, start=start, desk=desk, on_tick=on_tick, end_when_finished=False)
        if report.ticks == 0:
            raise SessionError(f"{path}: holds no tick to replay after {from_s or 0:g} s; see flowrec info {path}")
        last = report.last
        if stale and not desk.reason:
            last = _closing_work(pipeline, config, report.last, rig.recorded, stale)
            if last is not report.last and sinks:
                sinks[0].write(last)
        if writer is not None:
            ended = "stopped" if desk.reason else "replayed"
            note = f"replay of {path.name}" + (f", {desk.reason}" if desk.reason else "")
            figures = {"duration_s": report.duration_s, "wall_s": report.wall_s, "ticks": report.ticks}
            writer.close(as_text({"outcome": ended, "note": note, **figures}))
    return Replayed(
        source=path,
        recorded_config=recorded_config,
        config=config,
        chip=chip,
        report=report,
        recorded=rig.recorded,
        replayed=last,
        true_field=truth[-1] if truth else None,
        comparison=comparison,
        frames_missing=rig.frames_missing,
        commands=commands,
        worker_check=checker,
        digest=intact(reader) if verify else None,
    )


@contextmanager
def _settings_blamed(path: Path, config: ResolvedConfig) -> Iterator[None]:
    """A replay runs with recorded settings that are outside of their ranges; where it fails, the first one is named."""
    fault = next(range_faults(config), None)
    try:
        yield
    except FlowrecError:
        raise
    except Exception as error:
        if fault is None:
            raise
        raise SessionError(
            f"{path}: the replay failed ({type(error).__name__}) with what was recorded: {fault}; replay it with "
            f"--set {fault.key}=..."
        ) from error


def _warned_of_windows(reader: SessionReader, recorded: ResolvedConfig, config: ResolvedConfig) -> ResolvedConfig:
    """Where images are windows another tracker may look outside of them, and what is written are windows again."""
    if reader.region is None:
        return config
    if (config.tracker, config.robot) != (recorded.tracker, recorded.robot):
        warn(
            f"{reader.path.name}: most images are black but for what the recorded tracker read; with another tracker or"
            " robot the replay is not what it would be on whole images"
        )
    return replace(config, recording=replace(config.recording, region="robot"))


def hindsight(reader: SessionReader, pipeline: Pipeline) -> Callable[[int], Observations]:
    """The recorded way up to a stamp as the RTS smoother sees it, for `sampler.method = "smoothed"`.

    Raises
    ------
    UsageError
        If the observer is not the Kalman filter, whose model the smoother shares.
    """
    if pipeline.observer.method == "luenberger":
        raise UsageError("sampler.method = 'smoothed' needs observer.method = 'kalman', whose model it shares")
    tracks: list[Track] = []
    applied: list[Applied] = []
    for tick in reader.ticks(with_frames=False):
        if tick.track is not None and tick.applied is not None and (not tracks or tick.track is not tracks[-1]):
            tracks.append(tick.track)
            applied.append(tick.applied)
    robot, sampler = pipeline.robot, pipeline.sampler

    def upto(stamp_ns: int) -> Observations:
        known = sum(track.stamp_ns <= stamp_ns for track in tracks)
        smoothed = smooth(tracks[:known], applied[:known], pipeline.observer.kalman, robot)
        return observe(smoothed, robot, sampler.spacing_radii, sampler.settled_share)

    return upto


def adoption_stamps(reader: SessionReader) -> dict[int, int]:
    """For each work order of a recording, by number, the tick that adopted its result."""
    stamps: dict[int, int] = {}
    for name in WORKER_FIELDS:
        for message in reader.messages(name):
            assert isinstance(message, FlowField | Route)
            stamps[message.request] = message.stamp_ns
    return stamps


class WithoutFrames:
    """A sink that leaves the camera images in the parent session, which the replay names by hash."""

    def __init__(self, writer: SessionWriter) -> None:
        self._writer = writer

    def write(self, tick: Tick) -> None:
        self._writer.write(replace(tick, frame=None))


class WorkerCheck:
    """Does each recorded work order again and compares the adopted result with its topic's tolerance."""

    def __init__(self, pipeline: Pipeline, start: Tick, order: Tick | None, comparison: Comparison) -> None:
        self._pipeline = pipeline
        self._made: dict[int, FlowField | Route] = {}
        self._asked = start.mission.request if start.mission is not None else 0
        self._last = start
        self._taken = {0}  # results that can not be made again; 0: fields of an earlier session
        self.comparison = comparison
        self.results: list[str] = []
        if order is None or order.mission is None:
            return
        wanted, seen = order.mission.wanted, order.observations
        if wanted == WorkOrder.REFINE and seen is not None and seen.stamp_ns > order.mission.requested_ns:
            # Ordered before this piece of a run begins, from fewer observations than are repeated in it.
            self._taken.add(order.mission.request)
            self.results.append(
                f"{BY_FIELD[ANSWERED_BY[WorkOrder.REFINE]].path}: ordered in the part before, taken as recorded"
            )
        else:
            self._made[order.mission.request] = work(pipeline, order)

    def see(self, tick: Tick) -> None:
        """Take note of one tick: new orders are worked on, adopted results compared."""
        for name in WORKER_FIELDS:
            adopted = getattr(tick, name)
            if adopted is None or adopted is getattr(self._last, name) or adopted.request in self._taken:
                continue
            made = self._made.pop(adopted.request, None)
            made = replace(made, stamp_ns=tick.stamp_ns) if made is not None else None
            topic = BY_FIELD[name]
            found = self.comparison.add_pair(topic, adopted, made, tick.stamp_ns)
            how = "identical" if found is None else f"{'DIFFERENT' if found.beyond else 'within tolerance'}: {found}"
            self.results.append(printable(f"{topic.path} {adopted.method}: {how}"))
        mission = tick.mission
        if mission is not None and mission.wanted and mission.request > self._asked:
            self._asked = mission.request
            self._made[mission.request] = work(self._pipeline, tick)
        self._last = tick

    @property
    def same(self) -> bool:
        """Whether every result could be made again."""
        return self.comparison.same


def _order_under_way(reader: SessionReader, start: Tick) -> Tick | None:
    """The tick of an order that was on its way at the starting tick, with what was known when it was given.

    Where a piece of a run begins after that, with what it repeats: the same but for observations made meanwhile.
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
    """Refine and plan after the last frame what the recording ended too early to adopt, or never asked for."""
    mission = last.mission
    if mission is None or last.assumed is None:
        return last
    stamp_ns = last.stamp_ns + 1
    tick = replace(last, stamp_ns=stamp_ns, event=None)
    number = mission.request
    if "refined" in stale and "refine" in config.mission.phases and last.refined is None:
        number += 1
        order = replace(mission, stamp_ns=stamp_ns, wanted="refine", request=number, requested_ns=stamp_ns)
        refined = work(pipeline, replace(tick, mission=order))
        assert isinstance(refined, FlowField)
        tick = replace(tick, refined=refined)
    wants_route = "plan" in config.mission.phases or "navigate" in config.mission.phases
    planned = last.route is not None and last.route is not recorded.route and mission.phase in ("navigate", "done")
    if "route" in stale and wants_route and (tick.refined is not last.refined or not planned):
        assert last.estimate is not None
        order = replace(
            mission,
            stamp_ns=stamp_ns,
            wanted="route",
            request=number + 1,
            requested_ns=stamp_ns,
            start_um=planned_from(recorded, last),
        )
        route = work(pipeline, replace(tick, mission=order))
        assert isinstance(route, Route)
        tick = replace(tick, route=route)
    return tick if tick.refined is not last.refined or tick.route is not last.route else last


def planned_from(recorded: Tick, last: Tick) -> NDArray[np.float64]:
    """Where the recorded route began, else where the robot is."""
    if recorded.route is not None and recorded.route.reachable and recorded.mission is not None:
        return np.array(recorded.route.waypoints_um[0], np.float64)
    assert last.estimate is not None
    return last.estimate.position_um


def intact(reader: SessionReader) -> tuple[bool, list[str]]:
    """Whether the session's files hold what was recorded, by their digests, and lines that say so."""
    lines = []
    same = True
    for file, faults in digest_faults(reader.path).items():
        if faults is None:
            lines.append(printable(f"{file.name}: no digest, recorded by an older flowrec"))
        elif faults:
            same = False
            lines += [printable(f"{file.name}: DIFFERENT from its digest: {fault}") for fault in faults]
    return same, lines or ["all messages and the head are as the digest says"]


def verdict(done: Replayed) -> tuple[bool, list[str]]:
    """Lines that say how the replay compares with the recording, and whether it is the same."""
    comparison = done.comparison
    lines = comparison.lines()
    same, first = comparison.same, comparison.first
    identical = comparison.identical
    if done.worker_check is not None:
        results = done.worker_check.comparison
        lines.extend(done.worker_check.results)
        same, identical, first = same and results.same, identical and results.identical, first or results.first
    if done.digest is not None:
        same = same and done.digest[0]
        lines.extend(done.digest[1])
    if done.frames_missing:
        lines.append(f"{done.frames_missing} frames are not in the file; their recorded tracks stood in")
    if first is not None:
        lines.append(f"first difference: {first}")
    lines.append(
        f"{comparison.ticks} ticks: "
        + ("NOT the same" if not same else "every tick identical" if identical else "the same within tolerance")
    )
    return same, lines


def verdict_json(done: Replayed) -> dict[str, Any]:
    """What `verdict` says, in numbers too."""
    same, lines = verdict(done)
    found = done.comparison.as_json()
    if done.worker_check is not None:
        results = done.worker_check.comparison.as_json()
        found["topics"] |= results["topics"]
        found["first"] = found["first"] or results["first"]
        found["identical"] = found["identical"] and results["identical"]
    return (
        found
        | {"same": same, "digest_faults": [] if done.digest is None or done.digest[0] else done.digest[1]}
        | {"lines": lines}
    )


def default_out(path: Path) -> Path:
    """SESSION_replay_001.mcap beside the session, the first number that is free."""
    for number in range(1, 1000):
        out = path.with_name(f"{path.stem}_replay_{number:03d}.mcap")
        if not out.exists():
            return out
    raise SessionError(f"{path.parent}: 999 replays of {path.name} are here; name one with --out")
