"""Report on a replay: recorded and replayed figures side by side, and both plans flown in a simulator."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from flowrec.core import (
    FLOW_FIELDS,
    MCAP,
    RRD,
    FlowField,
    Output,
    Phase,
    Row,
    SessionError,
    UsageError,
    progress,
    say,
    seconds,
)
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, Preloaded, ReplayPair, RunControl, RunReport, Sink, run
from flowrec.stages import assemble, facts_of, other_packages
from flowrec.store import files_behind, named_beside, session_writer
from flowrec.verbs.replay_result import Replayed
from flowrec.verbs.session_replay import planned_from

_SAME_MAP = 1e-3  # of the largest speed: smaller changes are not visible in any table


def refinement_remarks(done: ReplayPair) -> list[str]:
    """Lines about the refinement of a replay; why, if it left the recorded map unchanged."""
    was, now = done.recorded.refined, done.replayed.refined
    if now is None:
        return []
    lines = [f"{now.method}: {now.note}"] if now.note else []
    if was is None or now is was or _largest_change(was, now) > _SAME_MAP:
        return lines
    why = ""
    if now.method == "pi_unet" and done.config.refine.pi_unet.start == "assimilate":
        why = (
            ": pi_unet begins with the assimilated map and keeps it where it explains the observations; with "
            "--set refine.pi_unet.start=fvm it begins with the assumed flow, as in the paper"
        )
    return [*lines, f"the refined map is the recorded one, unchanged{why}"]


@dataclass(frozen=True, slots=True)
class Outputs:
    """The files that a replay writes.

    Attributes
    ----------
    session : of the replay.
    refly : of the flight of the replayed plan; None: it is not flown.
    rrd : for Rerun; None: it is not made.
    """

    session: Output
    refly: Output | None
    rrd: Output | None

    @classmethod
    def of(cls, path: Path, out: Path | None, overwrite: bool, *, refly: bool, rrd: bool) -> Self:
        """Those of a replay of `path` to `out`, by default SESSION_replay_NNN.mcap with the first free number.

        Raises
        ------
        OutputError : one of them may not be written.
        """
        numbered = (named_beside(path, f"{path.stem}_replay_{number:03d}{MCAP[0]}") for number in range(1, 1000))
        out = out or next((name for name in numbered if not name.exists()), None)
        if out is None:
            raise SessionError(f"{path.parent}: 999 replays of {path.name} are here; name one with --out")
        session = Output(out, MCAP, tuple(files_behind(path)), overwrite)
        outputs = cls(
            session,
            replace(session, path=out.with_name(f"{out.stem}_refly{MCAP[0]}")) if refly else None,
            replace(session, path=out.with_suffix(RRD[0]), suffixes=RRD) if rrd else None,
        )
        for output in (outputs.session, outputs.refly, outputs.rrd):
            if output is not None:
                output.check()
        return outputs


def refly(done: Replayed, out: Output | None) -> list[Row]:
    """Fly the recorded and the replayed plan in a simulator whose true flow is the replay's map.

    Both flights begin where the recorded route does and have the same seed; rows as of `before_after`. They go straight
    to the last goal and keep the last speed limit that the operator has set.

    Parameters
    ----------
    out : session file of the flight of the replayed plan.

    Raises
    ------
    UsageError : there is no map or no route to fly.
    """
    if done.replayed.field is None or done.recorded.mission is None or done.recorded.route is None:
        raise UsageError(
            "--refly: the session has no map or no route to fly; replay it with --refine --plan astar_time"
        )
    other_packages(done.session.config, done.session.provenance)  # it flies with the recorded stages, too
    x_um, y_um = (float(value) for value in planned_from(done.recorded, done.replayed))
    start_um = (x_um, y_um)
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


def _fly_plan(done: Replayed, name: str, start_um: tuple[float, float], out: Output | None) -> RunReport:
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
    pipeline = assemble(flown, session.chip)
    rig = SimulatedRig.of(pipeline, flown, true_field=done.replayed.field)
    known = {key: field for key in FLOW_FIELDS if (field := getattr(tick, key)) is not None}
    worker = Preloaded(LockstepWorker(pipeline, config.worker.adopt_after_s), known)
    sinks: list[Sink] = []
    with ExitStack() as stack:
        if out is not None:
            writer = session_writer(
                out, flown, session.chip, parent=session.path, facts=facts_of(flown, session.provenance)
            )
            sinks.append(stack.enter_context(writer))
        say(f"reflying as {name} ...")
        control = RunControl()
        if last.speed_limit_um_s is not None:
            control.limit_speed(last.speed_limit_um_s)
        flight = run(pipeline, rig, worker, sinks, control=control)
        if out is not None:
            writer.close({"outcome": flight.outcome, "note": f"refly of {session.path.name}"})
    return flight


def _largest_change(was: FlowField, now: FlowField) -> float:
    """Largest change of a velocity component relative to the largest component."""
    largest = float(np.abs(was.velocity_um_s).max())
    return float(np.abs(now.velocity_um_s - was.velocity_um_s).max()) / largest if largest else math.inf


def _navigation_s(flight: RunReport) -> float | None:
    """Time on the way to the goal, new routes included."""
    mission = flight.last.mission
    if mission is None or not mission.finished or flight.navigating_ns is None:
        return None
    return seconds(mission.since_ns - flight.navigating_ns)


def _planned_s(flight: RunReport) -> float | None:
    route = flight.last.route
    return float(route.arrival_s[-1]) if route is not None and len(route.arrival_s) else None
