"""Files of `flowrec replay`, and flights of both plans."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from flowrec.core import FLOW_FIELDS, MCAP, RRD, Output, Phase, Row, SessionError, UsageError, progress, say, seconds
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, Preloaded, RunControl, RunReport, Sink, run
from flowrec.stages import assemble, facts_of, other_packages
from flowrec.store import Session, files_behind, named_beside, session_writer
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.replay_change import Change
from flowrec.verbs.replay_result import Replay
from flowrec.verbs.session_replay import planned_from, replay_session


def make_replay(
    session: Session | Path | str,
    change: Change,
    from_s: float | None,
    out: Path | None,
    *,
    verify: bool,
    overwrite: bool,
    frames: bool,
    control: Unattended | None,
    numbered: bool,
    fly: bool,
    rrd: bool,
) -> Replay:
    """Replay a session and write all outputs; parameters and errors as of `flowrec.replay`.

    Of a replay that was stopped nothing but its session is made.
    """
    session = Session.of(session)
    if verify and numbered and out is None:
        return replay_session(session, change, from_s, verify=True, control=control)
    with ExitStack() as stack:  # holds the temporary folder, until the object that is returned goes
        if out is None and numbered:
            out = _with_numbers(session.path)
        elif out is None:
            folder = Path(tempfile.mkdtemp(prefix="flowrec-replay-"))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            out = folder / f"{session.path.stem}_replay.mcap"
        file = Output(out, MCAP, tuple(files_behind(session.path)), overwrite)
        flight = replace(file, path=out.with_name(f"{out.stem}_refly{MCAP[0]}"))
        picture = replace(file, path=out.with_suffix(RRD[0]), suffixes=RRD)
        for output, wanted in ((file, True), (flight, fly), (picture, rrd)):
            if wanted:
                output.check()
        made = replay_session(session, change, from_s, verify, out, overwrite, frames, control)
        whole = not made.covered.stopped
        if fly and whole:
            made.reflown = refly(made, flight)
        if rrd and whole:
            from flowrec.exports import export  # late: it imports Rerun

            export(out, overwrite=overwrite)
        weakref.finalize(made, stack.pop_all().close)
    return made


def _with_numbers(path: Path) -> Path:
    """SESSION_replay_NNN.mcap with the first free number."""
    numbered = (named_beside(path, f"{path.stem}_replay_{number:03d}{MCAP[0]}") for number in range(1, 1000))
    out = next((name for name in numbered if not name.exists()), None)
    if out is None:
        raise SessionError(f"{path.parent}: 999 replays of {path.name} are here; name one with --out")
    return out


def refly(done: Replay, out: Output | None) -> list[Row]:
    """Fly the recorded and the replayed plan in a simulator, in the true flow of the session or else the replay's map.

    Both flights begin where the recorded route does and have the same seed; rows as of `before_after`. They go straight
    to the last goal and keep the last speed limit that the operator has set. `out`: session file of the flight of the
    replayed plan. Raises UsageError: there is no map or no route to fly.
    """
    if done.replayed.field is None or done.recorded.mission is None or done.recorded.route is None:
        raise UsageError(
            "--refly: the session has no map or no route to fly; replay it with --refine --plan astar_time"
        )
    other_packages(done.session.config, done.session.provenance)  # it flies with the recorded stages, too
    x_um, y_um = (float(value) for value in planned_from(done.recorded, done.replayed))
    start_um = (x_um, y_um)
    flow = "the map of the replay" if done.recorded.true_field is None else "the true flow of the session"
    say(f"reflying both plans in {flow}")
    with progress("reflying", 2, "flights") as flights:
        was = _fly_plan(done, "recorded", start_um, None)
        flights(1)
        now = _fly_plan(done, "replayed", start_um, out)
    return [
        ("reflown_outcome", was.outcome, now.outcome),
        ("reflown_navigation_s", _navigation_s(was), _navigation_s(now)),
        ("reflown_planned_s", _planned_s(was), _planned_s(now)),
        ("reflown_contacts", was.contacts, now.contacts),
    ]


def _fly_plan(done: Replay, name: str, start_um: tuple[float, float], out: Output | None) -> RunReport:
    """The flight of the "recorded" or the "replayed" plan, written to `out` if it is given."""
    session, last = done.session, done.recorded.mission
    config, tick = (session.config, done.recorded) if name == "recorded" else (done.config, done.replayed)
    assert last is not None
    mission = replace(
        config.mission,
        phases=(Phase.PLAN, Phase.NAVIGATE),
        start=start_um,
        # Another flight passes the places at other times, so it is not sent on when the recorded robot was.
        goal=(float(last.goal_um[0]), float(last.goal_um[1])),
        replan_error_um=None,
        wait_at_goal_s=0.0,
    )
    flown = replace(config, mission=mission)
    if config.camera.trace_walls:  # the registration was measured: it is that of the world
        seen = config.camera
        simulated = replace(
            config.simulated, um_per_px=seen.um_per_px, angle_deg=seen.angle_deg, centre_um=seen.centre_um
        )
        flown = replace(flown, simulated=simulated)
    pipeline = assemble(flown, session.chip)
    rig = SimulatedRig.of(pipeline, flown, true_field=done.recorded.true_field or done.replayed.field)
    known = {key: field for key in FLOW_FIELDS if (field := getattr(tick, key)) is not None}
    worker = Preloaded(LockstepWorker(pipeline, config.worker.adopt_after_s), known)
    sinks: list[Sink] = []
    with ExitStack() as stack:
        if out is not None:
            writer = session_writer(
                out, flown, session.chip, parent=session.path, facts=facts_of(flown, session.provenance)
            )
            sinks.append(stack.enter_context(writer))
        control = RunControl()
        if last.speed_limit_um_s is not None:
            control.limit_speed(last.speed_limit_um_s)
        flight = run(pipeline, rig, worker, sinks, control=control)
        if out is not None:
            writer.close({"outcome": flight.outcome, "note": f"refly of {session.path.name}"})
    return flight


def _navigation_s(flight: RunReport) -> float | None:
    """Time on the way to the goal, new routes included."""
    mission = flight.last.mission
    if mission is None or not mission.finished or flight.navigating_ns is None:
        return None
    return seconds(mission.since_ns - flight.navigating_ns)


def _planned_s(flight: RunReport) -> float | None:
    route = flight.last.route
    return route.lasts_s if route is not None and len(route.arrival_s) else None
