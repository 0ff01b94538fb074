"""`flowrec replay --refly`: close the loop that a replay leaves open, in a simulator whose flow is the replay's map."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from flowrec.commands.replay import Replayed, planned_from
from flowrec.errors import UsageError
from flowrec.messages import FlowField
from flowrec.pipeline import assemble
from flowrec.rigs.simulated.rig import SimulatedRig
from flowrec.run.loop import LockstepWorker, Preloaded, RunReport, Sink, run
from flowrec.session_writer import session_writer
from flowrec.summary import Row
from flowrec.terminal import say
from flowrec.topics import FLOW_FIELDS
from flowrec.units import seconds


def refly(done: Replayed, out: Path | None, overwrite: bool = False) -> list[Row]:
    """Fly the recorded and the replayed plan in a simulator whose true flow is the replay's map.

    Both start where the recorded route began and use the same seed; rows of key, recorded, replayed.
    """
    flow = done.replayed.field
    if flow is None or done.recorded.mission is None or done.recorded.route is None:
        raise UsageError(
            "--refly: the session has no map or no route to fly; replay it with --refine --plan astar_time"
        )
    start = tuple(float(value) for value in planned_from(done.recorded, done.replayed))
    flights = {
        "recorded": (done.recorded_config, done.recorded, None),
        "replayed": (done.config, done.replayed, out),
    }
    reports: dict[str, RunReport] = {}
    for name, (config, tick, target) in flights.items():
        assert len(start) == 2
        mission = replace(config.mission, phases=("plan", "navigate"), start=start, replan_error_um=None)
        flown = replace(config, mission=mission)
        pipeline = assemble(flown, done.chip)
        rig = SimulatedRig.of(pipeline, flown, true_field=flow)
        known: Mapping[str, FlowField] = {
            key: value for key in FLOW_FIELDS if (value := getattr(tick, key)) is not None
        }
        worker = Preloaded(LockstepWorker(pipeline, config.worker.adopt_after_s), known)
        sinks: list[Sink] = []
        with ExitStack() as stack:
            if target is not None:
                writer = stack.enter_context(
                    session_writer(target, flown, done.chip, parent=done.source, overwrite=overwrite)
                )
                sinks.append(writer)
            say(f"reflying as {name} ...")
            reports[name] = report = run(pipeline, rig, worker, sinks)
            if target is not None:
                writer.close({"outcome": report.outcome, "note": f"refly of {done.source.name}"})
    was, now = reports["recorded"], reports["replayed"]
    return [
        ("reflown_outcome", was.outcome, now.outcome),
        ("reflown_navigation_s", _navigation_s(was), _navigation_s(now)),
        ("reflown_planned_s", _planned_s(was), _planned_s(now)),
        ("reflown_contacts", was.contacts, now.contacts),
    ]


def _navigation_s(report: RunReport) -> float | None:
    """Time from the adopted route to the end."""
    mission, route = report.last.mission, report.last.route
    if mission is None or route is None or not mission.finished or not len(route.arrival_s):
        return None
    return seconds(mission.since_ns - route.stamp_ns)


def _planned_s(report: RunReport) -> float | None:
    route = report.last.route
    return float(route.arrival_s[-1]) if route is not None and len(route.arrival_s) else None
