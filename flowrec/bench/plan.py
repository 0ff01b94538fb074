"""`flowrec bench plan`: every planner on the same trips, downstream and upstream, compared with the least time.

All planners plan at the robot's full speed in the true flow; `travel_time` times all of them.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.figures import draw_plan
from flowrec.bench.harness import Cases, FigureFile, Names, Quick, Results, Seed, choose_names
from flowrec.bench.reserves import (
    least_clearance_um,
    policies_with_reserves,
    routes_with_reserves,
    show_reserves,
    summarised_policies,
    summarised_routes,
)
from flowrec.bench.trips import SPEED_UM_S, Points, TripCase, best_time, draw_trip, worlds, worlds_of
from flowrec.core import FlowField, Route, UsageError, progress, say, table
from flowrec.stages import PLANNERS, Planner, travel_time, with_row

RATIOS = (0.5, 0.9, 1.3)  # fastest flow over the robot's speed
REGIMES = {f"{ratio} {direction}": (ratio, direction) for ratio in RATIOS for direction in ("down", "up")}
DRAWN = "0.9 up"
SIDE_PX = 256

FULL = Planner(speed_share=1.0, robust_deviations=0.0)
# The rows of PLANNERS, and two with 8 directions. The null model is astar_length, the shortest path without the flow.
METHODS = {name: with_row(FULL, PLANNERS, name) for name in PLANNERS.usable()} | {
    "astar_paper:8": replace(FULL, method="astar_paper", paper_radius_px=1.5),
    "astar_length:8": replace(FULL, method="astar_length", reach_px=1),
}
TREES = [name for name, row in PLANNERS.items() if "rrt" in row.options]


def installed_methods(methods: Iterable[str]) -> tuple[str, ...]:
    """The methods whose packages are installed; says which are left out."""
    missing = [name for name in methods if (extra := PLANNERS[METHODS[name].method].extra) and find_spec(extra) is None]
    if missing:
        say(f"left out: {', '.join(missing)}, which need OMPL 2: pip install 'flowrec[ompl]'")
    return tuple(name for name in methods if name not in missing)


def measure(
    cases: Cases = None,
    trips: Annotated[int, typer.Option(min=1, help="Channels, one trip through each, down and up.")] = 40,
    tree_channels: Annotated[int, typer.Option("--trees", min=0, help="Channels in which rrt and rrt_star plan.")] = 10,
    tree_iterations: Annotated[int, typer.Option("--iterations", min=1, help="Iterations of rrt and rrt_star.")] = 4000,
    figure: FigureFile = None,
    methods: Names = None,
    seed: Seed = 0,
    quick: Quick = False,
    side_px: int = SIDE_PX,
) -> Results:
    """Rows by trip, regime and planner, their summaries, and the tables of reserves unless `quick`.

    Raises UsageError if there is no case with a trip, or no such method.
    """
    names = installed_methods(METHODS) if methods is None else choose_names("bench plan: no method", methods, METHODS)
    source = worlds(side_px, seed) if cases is None else worlds_of(cases)
    rows: list[dict[str, Any]] = []
    robust: list[dict[str, Any]] = []
    policy: list[dict[str, Any]] = []
    examples = []
    with progress("planning", trips, "trips") as done:
        drawn = ((world, draw_trip(world, np.random.default_rng([k, seed, 5]))) for k, world in enumerate(source))
        with_trip = ((world, trip) for world, trip in drawn if trip is not None)
        for number, (world, trip) in enumerate(itertools.islice(with_trip, trips)):
            for regime, (ratio, direction) in REGIMES.items():
                field, ends = world.field(ratio), trip.ends(direction)
                least_s = best_time(world, field, *ends, SPEED_UM_S)[0]
                routes = {}
                for method in names:
                    planner = METHODS[method]
                    if planner.method in TREES:
                        if number >= tree_channels:
                            continue
                        planner = replace(planner, rrt=replace(planner.rrt, iterations=tree_iterations))
                    row, routes[method] = plan_trip(planner, world, field, ends)
                    common = {"world": world.name, "ratio": ratio, "direction": direction, "method": method}
                    rows.append(common | {"optimum_s": least_s if np.isfinite(least_s) else None} | row)
                if regime == DRAWN:
                    examples.append((world, trip, routes))
                if not quick:
                    robust += routes_with_reserves(world, regime, ratio, ends)
                    policy += policies_with_reserves(world, regime, ratio, ends, least_s)
            done(number + 1)
    if not rows:
        raise UsageError(f"{cases}: no vessel case (*.npz) in it through which a trip leads")
    if figure is not None:
        draw_plan(figure, examples[:2], rows)
    return {
        "rows": rows,
        "summary": {method: summary([row for row in rows if row["method"] == method]) for method in names},
        "ratios": _ratios(rows, names),
        "robust": summarised_routes(robust),
        "policy": summarised_policies(policy),
    }


def plan_trip(
    planner: Planner, world: TripCase, field: FlowField, ends: tuple[Points, Points]
) -> tuple[dict[str, Any], Route]:
    """Time, length and least clearance of a route, None if there is none or nobody can follow it; its CPU time."""
    began = time.process_time()
    route = planner.plan(field, *ends, world.chip, world.robot)
    cpu_ms = 1e3 * (time.process_time() - began)
    time_s = length_um = clearance_um = None
    if route.reachable:
        time_s = float(travel_time(field, route.waypoints_um, SPEED_UM_S)[0][-1])
        length_um = float(np.hypot(*np.diff(route.waypoints_um, axis=0).T).sum())
        clearance_um = least_clearance_um(world, route.waypoints_um)
    found = {"time_s": time_s, "length_um": length_um, "clearance_um": clearance_um}
    return found | {"cpu_ms": cpu_ms, "reason": route.reason}, route


def _in_regime(rows: Sequence[dict[str, Any]], regime: str) -> list[dict[str, Any]]:
    return [row for row in rows if (row["ratio"], row["direction"]) == REGIMES[regime]]


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """By regime: % of the least time, trips without a route, mean length and time."""
    made = {}
    for regime in REGIMES:
        some = _in_regime(rows, regime)
        percent = [100.0 * row["optimum_s"] / row["time_s"] for row in some if row["optimum_s"] and row["time_s"]]
        made[regime] = {
            "trips": len(some),
            "mean_percent": _mean(percent),
            "worst_percent": min(percent, default=None),
            "best_percent": max(percent, default=None),
            "failed": sum(row["optimum_s"] is not None and row["time_s"] is None for row in some),
            "no_way": sum(row["optimum_s"] is None for row in some),
            "mean_length_um": _mean([row["length_um"] for row in some]),
            "mean_time_s": _mean([row["time_s"] for row in some]),
            "median_cpu_ms": float(np.median([row["cpu_ms"] for row in some])) if some else None,
        }
    return made


def _ratios(rows: list[dict[str, Any]], methods: Sequence[str]) -> dict[str, dict[str, float | None]]:
    """By method and regime: travel time over that of time_field, mean over the trips that both can do."""
    made: dict[str, dict[str, float | None]] = {method: {} for method in methods}
    for regime in REGIMES:
        some = _in_regime(rows, regime)
        own = {row["world"]: row["time_s"] for row in some if row["method"] == "time_field"}
        for method in methods:
            times = [(row["time_s"], own.get(row["world"])) for row in some if row["method"] == method]
            made[method][regime] = _mean([a / b for a, b in times if a and b])
    return made


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def show(results: Results) -> None:
    """Print the tables; the single trips are in the JSON."""

    def cell(line: dict[str, Any]) -> str:
        if line["mean_percent"] is None:
            return "-" if not line["failed"] else f"none of {line['failed']}"
        lost = f", {line['failed']} lost" if line["failed"] else ""
        return f"{line['mean_percent']:.1f} ({line['worst_percent']:.1f}){lost}"

    table(
        "% of the least time: mean (worst), trips without a route; by fastest flow over the robot's speed, direction",
        ("planner", *REGIMES),
        [(method, *(cell(line) for line in lines.values())) for method, lines in results["summary"].items()],
    )
    table(
        "Travel time over that of time_field",
        ("planner", *REGIMES),
        [
            (method, *("-" if ratio is None else f"{ratio:.3f}" for ratio in ratios.values()))
            for method, ratios in results["ratios"].items()
        ],
    )
    if results["robust"]:
        show_reserves(results["robust"], results["policy"], list(REGIMES))
