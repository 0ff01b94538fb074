"""Reserves in `flowrec bench plan`: what planning for a faster flow costs, and what it saves if the flow is faster.

Two tables: routes planned at a lower speed or against a faster flow, and the policy -grad T driven in the assumed flow
and in a faster one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from flowrec.bench.trips import SPEED_UM_S, Points, TripCase
from flowrec.core import Floats, FlowField, Route, bilinear, compiled, table
from flowrec.physics import clearance_um
from flowrec.stages import Planner, travel_time

FASTER = 1.1  # the true flow over the assumed one
_TIME_LIMIT_S = 100.0  # of a driven policy
_STEP_PX = 0.1
Lines = list[dict[str, Any]]


def routes_with_reserves(world: TripCase, regime: str, ratio: float, ends: tuple[Points, Points]) -> Lines:
    """One trip planned with several reserves: its time in the assumed flow, and if a faster flow still lets it through.

    The trip is timed at the robot's full speed. One deviation is a tenth of the flow's speed.
    """
    lines = []
    field, faster = world.field(ratio), world.field(FASTER * ratio)
    for share, deviations in itertools.product((1.0, 0.85), (0.0, 0.5, 1.0)):
        planner = Planner(speed_share=share, robust_deviations=deviations, flow_error_share=FASTER - 1.0)
        route = planner.plan(field, *ends, world.chip, world.robot)
        time_s, kept = np.inf, False
        if route.reachable:
            time_s = float(travel_time(field, route.waypoints_um, SPEED_UM_S)[0][-1])
            kept = travel_time(faster, route.waypoints_um, SPEED_UM_S)[1]
        setting = f"share {share:g}, {deviations:g} deviations"
        lines.append({"setting": setting, "regime": regime, "world": world.name, "time_s": time_s, "kept": kept})
    return lines


def policies_with_reserves(
    world: TripCase, regime: str, ratio: float, ends: tuple[Points, Points], least_s: float
) -> Lines:
    """-grad T driven at full speed in the assumed flow and in a faster one, with T for several speeds and flows."""
    lines = []
    for share, deviations in ((0.85, 0.0), (0.85, 0.5), (0.85, 1.0), (1.0, 0.0), (1.0, 1.0)):
        planner = Planner(policy_share=share, robust_deviations=deviations, flow_error_share=FASTER - 1.0)
        route = planner.plan(world.field(ratio), *ends, world.chip, world.robot)
        if route.time_to_go_s is None:
            continue
        for scale in (1.0, FASTER):
            flow = world.field(scale * ratio)
            time_s, path = drive(route, flow, *ends, SPEED_UM_S, 1.5 * world.chip.um_per_px, _TIME_LIMIT_S)
            touches = least_clearance_um(world, path) < world.robot.radius_um - 0.5 * flow.um_per_px
            setting = f"T at {share:g}, {deviations:g} deviations"
            line = {"setting": setting, "regime": regime, "flow": scale, "time_s": time_s, "touches": touches}
            lines.append(line | {"least_s": least_s if scale == 1.0 else None})
    return lines


def least_clearance_um(world: TripCase, path_um: Points) -> float:
    """The least distance to a wall along a path (n, 2)."""
    gap = clearance_um(world.chip.mask, world.chip.um_per_px).astype(np.float64)
    return float(min(bilinear(gap, float(x), float(y)) for x, y in path_um / world.chip.um_per_px))


def summarised_routes(lines: Lines) -> Lines:
    """By setting and regime: fractions of trips planned and kept, mean cost in % of the time without reserve."""
    without = {
        (line["world"], line["regime"]): line["time_s"] for line in lines if line["setting"] == "share 1, 0 deviations"
    }
    summary = []
    for (setting, regime), some in _group_lines(lines, "setting", "regime").items():
        planned = [line for line in some if np.isfinite(line["time_s"])]
        costs = [line["time_s"] / without[line["world"], regime] - 1.0 for line in planned]
        kept = sum(line["kept"] for line in planned) / max(len(planned), 1)
        cost_percent = 100.0 * float(np.mean(costs)) if costs else None
        row = {"setting": setting, "regime": regime, "planned": len(planned) / len(some), "kept": kept}
        summary.append(row | {"cost_percent": cost_percent})
    return summary


def summarised_policies(lines: Lines) -> Lines:
    """By setting, flow and regime: runs, arrivals, runs that touched a wall, mean % of the least time."""
    summary = []
    for (setting, flow, regime), some in _group_lines(lines, "setting", "flow", "regime").items():
        arrived = [line for line in some if np.isfinite(line["time_s"])]
        percent = [100.0 * line["least_s"] / line["time_s"] for line in arrived if line["least_s"]]
        mean_percent, touched = float(np.mean(percent)) if percent else None, sum(line["touches"] for line in some)
        row = {"setting": setting, "flow": flow, "regime": regime, "runs": len(some), "arrived": len(arrived)}
        summary.append(row | {"touched": touched, "mean_percent": mean_percent})
    return summary


def _group_lines(lines: Lines, *keys: str) -> dict[tuple[Any, ...], Lines]:
    groups: dict[tuple[Any, ...], Lines] = {}
    for line in lines:
        groups.setdefault(tuple(line[key] for key in keys), []).append(line)
    return groups


def show_reserves(robust: Lines, policy: Lines, regimes: Sequence[str]) -> None:
    """Print both tables."""

    def cost(line: dict[str, Any]) -> str:
        percent = "-" if line["cost_percent"] is None else f"{line['cost_percent']:.1f}"
        return f"{percent} %, {100 * line['kept']:.0f} of {100 * line['planned']:.0f}"

    def arrivals(line: dict[str, Any] | None) -> str:
        if line is None:
            return "-"
        percent = "" if line["mean_percent"] is None else f" {line['mean_percent']:.1f}"
        return f"{line['arrived']}/{line['runs']}{percent}" + (f" t{line['touched']}" if line["touched"] else "")

    routes = {(line["setting"], line["regime"]): line for line in robust}
    runs = {(line["setting"], line["flow"], line["regime"]): line for line in policy}
    table(
        f"Routes with reserves: cost in the assumed flow, % kept of those planned if it is {FASTER:g} times as fast",
        ("setting", *regimes),
        [
            (setting, *(cost(routes[setting, regime]) for regime in regimes))
            for setting in dict.fromkeys(setting for setting, _ in routes)
        ],
    )
    table(
        "-grad T at full speed: arrived of those planned, % of the least time, t: touched a wall",
        ("time to go", "flow", *regimes),
        [
            (setting, f"{flow:g}", *(arrivals(runs.get((setting, flow, regime))) for regime in regimes))
            for setting, flow in dict.fromkeys((setting, flow) for setting, flow, _ in runs)
        ],
    )


def drive(
    route: Route,
    flow: FlowField,
    start_um: Points,
    goal_um: Points,
    speed_um_s: float,
    within_um: float,
    time_limit_s: float,
) -> tuple[float, Points]:
    """The time until a robot that follows -grad T is near the goal, inf if it is not in time; its path (n, 2) in um.

    dx/dt = -V grad T / |grad T| + v by Heun's method; where T is unknown the heading stays.
    """
    px = flow.um_per_px
    vx, vy = (np.ascontiguousarray(flow.velocity_um_s[..., c], np.float64) / px for c in (0, 1))
    assert route.time_to_go_s is not None
    times = np.ascontiguousarray(route.time_to_go_s, np.float64)
    finer = px / (route.time_to_go_um_per_px or px)  # pixels of T per pixel of the flow
    ends = np.concatenate([start_um, goal_um]).astype(np.float64) / px
    arrival, path = _drive(times, finer, vx, vy, ends, speed_um_s / px, within_um / px, time_limit_s)
    return arrival, path * px


@compiled
def _heading(times: Floats, x: float, y: float) -> tuple[float, float]:
    """The direction of -grad T from the pixels around a point; (0, 0) if too few are known."""
    h, w = times.shape
    i = min(max(int(x), 0), w - 2)
    j = min(max(int(y), 0), h - 2)
    a = min(max(x - i, 0.0), 1.0)
    b = min(max(y - j, 0.0), 1.0)
    gx = gy = wx = wy = 0.0
    for k in range(2):
        if math.isfinite(times[j + k, i]) and math.isfinite(times[j + k, i + 1]):
            weight = b if k else 1.0 - b
            gx += weight * (times[j + k, i + 1] - times[j + k, i])
            wx += weight
        if math.isfinite(times[j, i + k]) and math.isfinite(times[j + 1, i + k]):
            weight = a if k else 1.0 - a
            gy += weight * (times[j + 1, i + k] - times[j, i + k])
            wy += weight
    gx = gx / wx if wx > 0.0 else 0.0
    gy = gy / wy if wy > 0.0 else 0.0
    size = math.hypot(gx, gy)
    return (-gx / size, -gy / size) if size > 0.0 else (0.0, 0.0)


@compiled
def _drive(
    times: Floats, finer: float, vx: Floats, vy: Floats, ends: Floats, speed: float, within: float, time_limit: float
) -> tuple[float, Floats]:
    x, y, goal_x, goal_y = ends
    h, w = vx.shape
    path = np.empty((20000, 2))
    count = 0
    elapsed = 0.0
    hx = hy = 0.0
    n = 0
    while elapsed < time_limit:
        if n % 10 == 0 and count < len(path):
            path[count, 0] = x
            path[count, 1] = y
            count += 1
        n += 1
        if math.hypot(goal_x - x, goal_y - y) <= within:
            return elapsed, path[:count]
        fx, fy = _heading(times, finer * x, finer * y)
        if fx != 0.0 or fy != 0.0:
            hx, hy = fx, fy
        ux = speed * hx + bilinear(vx, x, y)
        uy = speed * hy + bilinear(vy, x, y)
        dt = _STEP_PX / (speed + math.hypot(ux, uy))
        px = x + dt * ux
        py = y + dt * uy
        fx, fy = _heading(times, finer * px, finer * py)
        if fx == 0.0 and fy == 0.0:
            fx, fy = hx, hy
        x += 0.5 * dt * (ux + speed * fx + bilinear(vx, px, py))
        y += 0.5 * dt * (uy + speed * fy + bilinear(vy, px, py))
        elapsed += dt
        if x < -0.5 or y < -0.5 or x > w - 0.5 or y > h - 0.5:
            break
    return math.inf, path[:count]
