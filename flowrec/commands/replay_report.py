"""What a replay is worth: recorded and replayed beside each other, both judged on the replay's map."""

from __future__ import annotations

import math

import numpy as np

from flowrec.commands.record import length_um
from flowrec.commands.replay import Replayed
from flowrec.flow import sample
from flowrec.flow.sampling import relative_rmse
from flowrec.messages import FlowField, Observations, Route, Tick
from flowrec.planning import travel_time
from flowrec.run.jobs import no_observations
from flowrec.summary import Row, finite
from flowrec.topics import FLOW_FIELDS
from flowrec.units import seconds

_SAME_MAP = 1e-3  # of the largest speed: no table shows less


def residual_um_s(flow: FlowField, observations: Observations) -> float:
    """Root mean square of observed minus mapped flow, um/s, both components together."""
    miss = observations.flow_um_s - sample(flow, observations.position_um)
    return float(np.sqrt((miss**2).sum(axis=1).mean())) if len(miss) else math.nan


def before_and_after(done: Replayed) -> list[Row]:
    """Key, recorded, replayed: what the change is worth. Both are judged on the replay's map.

    Flow errors are shares of the true flow; a route that can not be followed on that map has no travel time.
    """
    was, now = done.recorded, done.replayed
    observations = now.observations or was.observations or no_observations(0)
    rows: list[Row] = [("map", _map_name(was), _map_name(now))]
    if done.true_field is not None:
        for name in FLOW_FIELDS:
            key = f"{name}_flow_error"
            rows.append((key, _flow_error(done, getattr(was, name)), _flow_error(done, getattr(now, name))))
    count = len(observations.position_um)
    if count and was.field is not None and now.field is not None:
        was_um_s, now_um_s = (residual_um_s(field, observations) for field in (was.field, now.field))
        rows.append(("observations", count, count))
        rows.append(("residual_um_s", finite(was_um_s), finite(now_um_s)))
    if was.route is not None or now.route is not None:
        rows.append(("planner", _planner(was.route), _planner(now.route)))
        rows.append(("route_length_um", _length(was.route), _length(now.route)))
        if now.field is not None:
            limit = done.config.plan.speed_share * done.config.robot.speed_limit_um_s
            was_s, now_s = (_time_on(route, now.field, limit) for route in (was.route, now.route))
            rows.append(("travel_time_on_replayed_map_s", was_s, now_s))
    was_control, now_control = done.recorded_config.control.method, done.config.control.method
    if was_control != now_control:
        rows.append(("controller", was_control, now_control))
    commands = done.commands
    rows.append(("commands_compared", None, commands.compared))
    rows.append(("commands_changed", None, commands.changed))
    if commands.changed:
        rows.append(("commands_difference_rms_um_s", None, commands.rms_um_s))
        first_ns = commands.first_ns
        rows.append(("first_changed_command_s", None, seconds(first_ns) if first_ns is not None else None))
    return rows


def refinement_told(done: Replayed) -> list[str]:
    """What the refinement of a replay did, in lines; where it left the recorded map as it was, why."""
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


def _largest_change(was: FlowField, now: FlowField) -> float:
    """Of the velocity, as a share of its largest component."""
    largest = float(np.abs(was.velocity_um_s).max())
    return float(np.abs(now.velocity_um_s - was.velocity_um_s).max()) / largest if largest else math.inf


def _flow_error(done: Replayed, flow: FlowField | None) -> float | None:
    if flow is None or done.true_field is None:
        return None
    return finite(float(relative_rmse(flow, done.true_field, done.chip.mask).v))


def _map_name(tick: Tick) -> str:
    return tick.field.method if tick.field is not None else "none"


def _planner(route: Route | None) -> str:
    return "none" if route is None else route.method if route.reachable else f"{route.method}: unreachable"


def _length(route: Route | None) -> float | None:
    return length_um(route) if route is not None and route.reachable else None


def _time_on(route: Route | None, flow: FlowField, limit_um_s: float) -> float | None:
    """None where there is no route, or it can not be followed."""
    if route is None or not route.reachable:
        return None
    arrival_s, feasible = travel_time(flow, route.waypoints_um, limit_um_s)
    return float(arrival_s[-1]) if feasible else None
