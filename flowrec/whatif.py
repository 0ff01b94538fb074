"""What a replay is worth: recorded and replayed beside each other, both judged on the replay's map."""

from __future__ import annotations

import math

import numpy as np

from flowrec.flow import sample
from flowrec.flow.metrics import relative_rmse
from flowrec.messages import FlowField, Observations, Route, Tick
from flowrec.planning import travel_time
from flowrec.replay import Replayed
from flowrec.session import length_mm
from flowrec.units import seconds
from flowrec.work import no_observations


def residual_um_s(flow: FlowField, observations: Observations) -> float:
    """Root mean square of observed minus mapped flow, um/s, both components together."""
    miss = observations.flow_um_s - sample(flow, observations.position_um)
    return float(np.sqrt((miss**2).sum(axis=1).mean())) if len(miss) else math.nan


def before_and_after(done: Replayed) -> list[tuple[str, str, str]]:
    """Rows of quantity, recorded, replayed: what the change is worth."""
    was, now = done.recorded, done.replayed
    rows: list[tuple[str, str, str]] = []

    def flow_error(flow: FlowField | None) -> str:
        if flow is None or done.true_field is None:
            return "-"
        return f"{100 * relative_rmse(flow, done.true_field, done.chip.mask).v:.1f} %"

    observations = now.observations or was.observations or no_observations(0)
    rows.append(("map", _map_name(was), _map_name(now)))
    if done.true_field is not None:
        rows.append(("flow error, assumed", flow_error(was.assumed), flow_error(now.assumed)))
        rows.append(("flow error, refined", flow_error(was.refined), flow_error(now.refined)))
    if len(observations.position_um) and was.field is not None and now.field is not None:
        rows.append(
            (
                f"residual of {len(observations.position_um)} observations",
                f"{residual_um_s(was.field, observations):.1f} um/s",
                f"{residual_um_s(now.field, observations):.1f} um/s",
            )
        )
    if was.route is not None or now.route is not None:
        rows.append(("planner", _planner(was.route), _planner(now.route)))
        rows.append(("path length", _length(was.route), _length(now.route)))
        if now.field is not None:
            limit = done.config.plan.speed_share * done.config.robot.speed_limit_um_s
            rows.append(
                (
                    f"travel time on the {now.field.method} map",
                    _time_on(was.route, now.field, limit),
                    _time_on(now.route, now.field, limit),
                )
            )
    was_control, now_control = done.recorded_config.control.method, done.config.control.method
    if was_control != now_control:
        rows.append(("controller", was_control, now_control))
    commands = done.commands
    since = f", first at {seconds(commands.first_ns):.2f} s" if commands.first_ns is not None else ""
    rows.append(
        (
            "commands that differ",
            "-",
            f"{commands.changed} of {commands.compared} ticks (rms {commands.rms_um_s:.0f} um/s{since})",
        )
    )
    return rows


def _map_name(tick: Tick) -> str:
    return tick.field.method if tick.field is not None else "none"


def _planner(route: Route | None) -> str:
    return "none" if route is None else route.method if route.reachable else f"{route.method}: unreachable"


def _length(route: Route | None) -> str:
    return f"{length_mm(route):.2f} mm" if route is not None and route.reachable else "-"


def _time_on(route: Route | None, flow: FlowField, limit_um_s: float) -> str:
    if route is None or not route.reachable:
        return "-"
    arrival_s, feasible = travel_time(flow, route.waypoints_um, limit_um_s)
    return f"{arrival_s[-1]:.1f} s" if feasible else "can not be followed"
