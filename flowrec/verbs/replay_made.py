"""Products of `flowrec replay`: a session, its tables, a list of changes, and flights of both plans."""

from __future__ import annotations

import html
import math
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    comparison_for_people,
    progress,
    say,
    seconds,
    table,
    warn,
)
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, Preloaded, ReplayPair, RunControl, RunReport, Sink, before_after, run
from flowrec.stages import assemble, facts_of, other_packages
from flowrec.store import Session, files_behind, named_beside, session_writer
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.replay_change import Change
from flowrec.verbs.replay_result import Replayed
from flowrec.verbs.session_replay import planned_from, replay_session

if TYPE_CHECKING:
    import pandas
    import pyarrow as pa


_SAME_MAP = 1e-3  # of the largest speed: smaller changes are not visible in any table


class BeforeAfter(tuple[Row, ...]):
    """Rows of key, recorded and replayed value; the keys carry the unit. As text and in a notebook it is a table."""

    __slots__ = ()

    def to_pandas(self) -> pandas.DataFrame:
        """The columns recorded and replayed, a row a key; UsageError if pandas is not installed."""
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise UsageError("to_pandas needs pandas, which is not installed: pip install 'flowrec[export]'") from error
        columns = {"recorded": [row[1] for row in self], "replayed": [row[2] for row in self]}
        return pandas.DataFrame(columns, index=pandas.Index([row[0] for row in self], name="quantity"), dtype=object)

    def __str__(self) -> str:
        shown = [("", "recorded", "replayed"), *comparison_for_people(self)]
        widths = [max(len(row[column]) for row in shown) for column in range(3)]
        return "\n".join(f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c:>{widths[2]}}" for a, b, c in shown)

    def _repr_html_(self) -> str:
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
            for row in comparison_for_people(self)
        )
        return f"<table><tr><th></th><th>recorded</th><th>replayed</th></tr>{rows}</table>"


class Replay(Replayed):
    """A `Replayed`, with all messages of the replay.

    Attributes
    ----------
    file : the session of the replay; None if none was written.
    result : the same, open, without images unless they were asked for. Without `out` it is a temporary file, which goes
        when this object goes.
    before_after : what the replay changed: errors, routes, times, commands; and how both plans were flown.
    """

    file: Path | None
    _reflown: list[Row]

    @classmethod
    def of(cls, done: Replayed, file: Path | None, reflown: Sequence[Row] = ()) -> Replay:
        """A finished replay, its file, and rows about the flights of both plans."""
        made = cls(**{each.name: getattr(done, each.name) for each in fields(Replayed)})
        made.file, made._reflown = file, list(reflown)
        return made

    @cached_property
    def result(self) -> Session:
        if self.file is None:
            raise UsageError("this verification wrote no session: it only compares")
        return Session(self.file)

    def table(self, topic: str) -> pa.Table:
        """All messages of one topic of the replay, as `Session.table`."""
        return self.result.table(topic)

    @cached_property
    def before_after(self) -> BeforeAfter:
        return BeforeAfter([*before_after(self), *self._reflown])

    @property
    def _remarks(self) -> list[str]:
        return [*self.packages, *refinement_remarks(self)]

    def changes_as_json(self) -> dict[str, Any]:
        """Changes of the replay, for JSON."""
        report = self.report
        figures = {"wall_s": report.wall_s, "duration_s": report.duration_s, "ticks": report.ticks}
        rows = [dict(zip(("quantity", "recorded", "replayed"), row, strict=True)) for row in self.before_after]
        doubts = {"doubts": "; ".join(self.doubts)} if self.doubts else {}
        return {"refinement": self._remarks, "rows": rows} | figures | {"covered": self.covered.as_json()} | doubts

    def show_changes(self, name: str) -> None:
        """Print what the replay changed, and what is doubtful of it."""
        report = self.report
        table(f"Replay of {name}", ("", "recorded", "replayed"), comparison_for_people(self.before_after))
        length = f"({report.duration_s:.1f} s) replayed in {report.wall_s:.1f} s"
        of_these = "; the figures are of those" if self.covered.stopped else ""
        say(f"{self.covered.text} {length}{of_these} -> {self.file}")
        for line in self._remarks:
            say(line)
        for doubt in self.doubts:
            warn(f"doubtful: {doubt}")


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
        return Replay.of(replay_session(session, change, from_s, verify=True, control=control), None)
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
        done = replay_session(session, change, from_s, verify, out, overwrite, frames, control)
        whole = not done.covered.stopped
        made = Replay.of(done, out, refly(done, flight) if fly and whole else ())
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
