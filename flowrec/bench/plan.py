"""`flowrec bench plan`: every planner on the same trips, up and down, beside the time that nobody can beat.

All planners plan at the robot's full speed in the flow as it is, and the same judge (planning/route.py) times them.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from flowrec.bench.drive import drive
from flowrec.bench.figures import draw_plan
from flowrec.bench.harness import Cases, FigureFile, Names, Quick, Results, Seed, chosen
from flowrec.bench.trips import SPEED_UM_S, Trip, World, best_time, draw_trip, magnified, worlds, worlds_of
from flowrec.chip import clearance_um
from flowrec.errors import UsageError
from flowrec.interpolation import bilinear
from flowrec.messages import FlowField, Route
from flowrec.planning import Planner, travel_time
from flowrec.planning.free_space import FreeSpace, open_space
from flowrec.planning.planner import RrtSettings
from flowrec.terminal import progress, say, table

RATIOS = (0.5, 0.9, 1.3)  # fastest flow over the robot's speed
DIRECTIONS = ("down", "up")
FASTER = 1.1  # what the flow may really be, for the sections on robustness
SIDE_PX = 256
_SPEED_WORLDS = 3

FULL = Planner(speed_share=1.0, robust_deviations=0.0)
METHODS = {
    "time_field": FULL,
    "astar_time": replace(FULL, method="astar_time"),
    "astar_paper": replace(FULL, method="astar_paper"),
    "astar_paper:8": replace(FULL, method="astar_paper", paper_radius_px=1.5),
    "astar_length": replace(FULL, method="astar_length"),
    "astar_length:8": replace(FULL, method="astar_length", reach_px=1),
    "rrt": replace(FULL, method="rrt"),
    "rrt_star": replace(FULL, method="rrt_star"),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One trip by one planner. None where it says that there is no way, or plans one that nobody can follow."""

    world: str
    ratio: float
    direction: str
    method: str
    optimum_s: float | None
    time_s: float | None
    length_um: float | None
    clearance_um: float | None  # least along the path
    cpu_ms: float
    reason: str


def _installed(methods: Iterable[str]) -> list[str]:
    """Those that can run here; says which are left out."""
    trees = [name for name in methods if name.startswith("rrt")]
    if find_spec("ompl") is not None:
        return list(methods)
    say(f"left out: {', '.join(trees)}, which need OMPL 2: pip install 'flowrec[ompl]'")
    return [name for name in methods if name not in trees]


def measure(
    cases: Cases = None,
    trips: Annotated[int, typer.Option(min=1, help="Channels, one trip through each, down and up.")] = 40,
    tree_channels: Annotated[int, typer.Option("--trees", help="Channels in which rrt and rrt_star plan.")] = 10,
    tree_iterations: Annotated[int, typer.Option("--iterations", min=1, help="Iterations of rrt and rrt_star.")] = 4000,
    figure: FigureFile = None,
    methods: Names = None,
    seed: Seed = 0,
    quick: Quick = False,
    side_px: int = SIDE_PX,
) -> Results:
    """Rows per trip, flow, direction and planner, their summaries, robustness, policy and speed.

    rrt and rrt_star plan in the first `tree_channels` channels only. `quick` leaves out robustness, policy and speed.

    Raises
    ------
    UsageError
        If there are no cases or no such method, or a figure is wanted and matplotlib is not installed.
    """
    names = tuple(_installed(METHODS)) if methods is None else chosen("bench plan: no method", methods, METHODS)
    source = worlds(side_px, seed) if cases is None else worlds_of(cases)
    rows: list[Row] = []
    robust: list[dict[str, Any]] = []
    policy: list[dict[str, Any]] = []
    shown: list[tuple[World, Trip, dict[str, Route]]] = []
    with progress("planning", trips) as done:
        drawn = ((world, draw_trip(world, np.random.default_rng([k, seed, 5]))) for k, world in enumerate(source))
        fits = ((world, trip) for world, trip in drawn if trip is not None)
        for number, (world, trip) in enumerate(itertools.islice(fits, trips)):
            for ratio, direction in itertools.product(RATIOS, DIRECTIONS):
                field = world.field(ratio)
                ends = trip.ends(direction)
                optimum = best_time(world, field, *ends, SPEED_UM_S)[0]
                found = {}
                for method in names:
                    planner = METHODS[method]
                    if planner.method.startswith("rrt"):
                        if number >= tree_channels:
                            continue
                        planner = replace(planner, rrt=RrtSettings(iterations=tree_iterations))
                    row, found[method] = _one(world, field, ends, ratio, direction, method, planner, optimum)
                    rows.append(row)
                if ratio == 0.9 and direction == "up":
                    shown.append((world, trip, found))
                if quick:
                    continue
                robust += _robust(world, ratio, direction, ends)
                policy += _policy(world, ratio, direction, ends, optimum)
            done(number + 1)
    if not rows:
        raise UsageError(f"{cases}: no vessel case (*.npz) in it through which a trip leads")
    figures = {
        "rows": [asdict(row) for row in rows],
        "summary": {method: _summary([row for row in rows if row.method == method]) for method in names},
        "ratios": _ratios(rows, names),
        "robust": _share_of(robust),
        "policy": _policy_table(policy),
        "speed": None if quick else _speed(),
    }
    if figure is not None:
        draw_plan(figure, shown[:2], [asdict(row) for row in rows])
    return figures


def _one(
    world: World,
    field: FlowField,
    ends: tuple[NDArray[np.float64], NDArray[np.float64]],
    ratio: float,
    direction: str,
    method: str,
    planner: Planner,
    optimum: float,
) -> tuple[Row, Route]:
    began = time.process_time()
    route = planner.plan(field, *ends, world.chip, world.robot)
    cpu_ms = 1e3 * (time.process_time() - began)
    took = length = lowest = None
    if route.reachable:
        took = float(travel_time(field, route.waypoints_um, SPEED_UM_S)[0][-1])
        length = float(np.hypot(*np.diff(route.waypoints_um, axis=0).T).sum())
        gap = clearance_um(world.chip.mask, world.chip.um_per_px).astype(np.float64)
        lowest = min(bilinear(gap, *(float(c) for c in point)) for point in route.waypoints_um / field.um_per_px)
    possible = optimum if np.isfinite(optimum) else None
    return Row(world.name, ratio, direction, method, possible, took, length, lowest, cpu_ms, route.reason), route


def _summary(rows: list[Row]) -> dict[str, Any]:
    """Percent of the optimum per flow and direction, and what was not possible."""
    made = {}
    for ratio, direction in itertools.product(RATIOS, DIRECTIONS):
        some = [row for row in rows if (row.ratio, row.direction) == (ratio, direction)]
        percent = [100.0 * row.optimum_s / row.time_s for row in some if row.optimum_s and row.time_s]
        made[f"{ratio} {direction}"] = {
            "trips": len(some),
            "mean_percent": float(np.mean(percent)) if percent else None,
            "worst_percent": float(np.min(percent)) if percent else None,
            "best_percent": float(np.max(percent)) if percent else None,
            "failed": sum(row.optimum_s is not None and row.time_s is None for row in some),
            "no_way": sum(row.optimum_s is None for row in some),
            "mean_length_um": _mean([row.length_um for row in some]),
            "mean_time_s": _mean([row.time_s for row in some]),
            "median_cpu_ms": float(np.median([row.cpu_ms for row in some])) if some else None,
        }
    return made


def _ratios(rows: list[Row], methods: Sequence[str]) -> dict[str, dict[str, float | None]]:
    """Travel time over that of time_field on the same trip, mean over the trips that both can do."""
    own = {(row.world, row.ratio, row.direction): row.time_s for row in rows if row.method == "time_field"}
    made: dict[str, dict[str, float | None]] = {}
    for method in methods:
        made[method] = {}
        for ratio, direction in itertools.product(RATIOS, DIRECTIONS):
            pairs = [
                (row.time_s, own.get((row.world, ratio, direction)))
                for row in rows
                if row.method == method and (row.ratio, row.direction) == (ratio, direction)
            ]
            made[method][f"{ratio} {direction}"] = _mean([a / b for a, b in pairs if a and b])
    return made


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _robust(
    world: World, ratio: float, direction: str, ends: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> list[dict[str, Any]]:
    """The same trip planned with more and more to spare: its time in the right flow, and whether a faster one loses it.

    The robot's full speed is what judges; one deviation is a tenth of the flow's speed.
    """
    made = []
    field, stronger = world.field(ratio), world.field(FASTER * ratio)
    for share, deviations in itertools.product((1.0, 0.85), (0.0, 0.5, 1.0)):
        planner = Planner(speed_share=share, robust_deviations=deviations, flow_error_share=FASTER - 1.0)
        route = planner.plan(field, *ends, world.chip, world.robot)
        took, kept = np.inf, False
        if route.reachable:
            took = float(travel_time(field, route.waypoints_um, SPEED_UM_S)[0][-1])
            kept = travel_time(stronger, route.waypoints_um, SPEED_UM_S)[1]
        made.append(
            {
                "setting": f"share {share:g}, {deviations:g} deviations",
                "key": (world.name, direction),
                "ratio": ratio,
                "direction": direction,
                "time_s": took,
                "kept": kept,
            }
        )
    return made


def _share_of(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    plain = {
        (*line["key"], line["ratio"]): line["time_s"] for line in lines if line["setting"] == "share 1, 0 deviations"
    }
    made = []
    for setting in dict.fromkeys(line["setting"] for line in lines):
        for ratio, direction in itertools.product(RATIOS, DIRECTIONS):
            some = [
                line
                for line in lines
                if (line["setting"], line["ratio"], line["direction"]) == (setting, ratio, direction)
            ]
            planned = [line for line in some if np.isfinite(line["time_s"])]
            costs = [line["time_s"] / plain[(*line["key"], ratio)] - 1.0 for line in planned]
            made.append(
                {
                    "setting": setting,
                    "regime": f"{ratio} {direction}",
                    "planned": len(planned) / max(len(some), 1),
                    "kept": sum(line["kept"] for line in planned) / max(len(planned), 1),
                    "cost_percent": 100.0 * float(np.mean(costs)) if costs else None,
                }
            )
    return made


def _policy(
    world: World,
    ratio: float,
    direction: str,
    ends: tuple[NDArray[np.float64], NDArray[np.float64]],
    optimum: float,
) -> list[dict[str, Any]]:
    """-grad T driven at full speed in the flow it was made for and in a faster one, for several speeds of T."""
    made = []
    within = 1.5 * world.chip.um_per_px
    for share, deviations in ((0.85, 0.0), (0.85, 0.5), (0.85, 1.0), (1.0, 0.0), (1.0, 1.0)):
        planner = Planner(policy_share=share, robust_deviations=deviations, flow_error_share=FASTER - 1.0)
        route = planner.plan(world.field(ratio), *ends, world.chip, world.robot)
        if route.time_to_go_s is None:
            continue
        for scale in (1.0, FASTER):
            flow = world.field(scale * ratio)
            best = optimum if scale == 1.0 else None
            took, path = drive(route, flow, *ends, SPEED_UM_S, within, 100.0)
            gap = clearance_um(world.chip.mask, flow.um_per_px).astype(np.float64)
            lowest = min(bilinear(gap, float(x), float(y)) for x, y in path / flow.um_per_px)
            made.append(
                {
                    "setting": f"T at {share:g}, {deviations:g} deviations",
                    "regime": f"{ratio} {direction}",
                    "flow": scale,
                    "time_s": took,
                    "optimum_s": best,
                    "touches": bool(lowest < world.robot.radius_um - 0.5 * flow.um_per_px),
                }
            )
    return made


def _policy_table(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    made = []
    for key in dict.fromkeys((line["setting"], line["flow"], line["regime"]) for line in lines):
        some = [line for line in lines if (line["setting"], line["flow"], line["regime"]) == key]
        arrived = [line for line in some if np.isfinite(line["time_s"])]
        percent = [100.0 * line["optimum_s"] / line["time_s"] for line in arrived if line["optimum_s"]]
        made.append(
            {
                "setting": key[0],
                "flow": key[1],
                "regime": key[2],
                "runs": len(some),
                "arrived": len(arrived),
                "touched": sum(line["touches"] for line in some),
                "mean_percent": float(np.mean(percent)) if percent else None,
            }
        )
    return made


def _speed() -> list[dict[str, Any]]:
    """CPU time of a full plan on 512 x 512 pixels, and of two Dijkstra runs of scipy with the making of their graph.

    Made-up chips as cameras of two and four times the resolution see them: what counts is how much of the picture is
    channel. The least of several runs that take turns.
    """
    lines = []
    for side_px, times in ((SIDE_PX, 1), (SIDE_PX // 2, 2)):
        found = 0
        for drawn in worlds(side_px, 100):
            world: World | None = drawn
            for _ in range(times):
                world = None if world is None else magnified(world)
            trip = None if world is None else draw_trip(world, np.random.default_rng(0))
            if world is None or trip is None:
                continue
            lines.append(_speed_on(world, trip))
            found += 1
            if found == _SPEED_WORLDS:
                break
    return sorted(lines, key=lambda line: line["free"])


def _speed_on(world: World, trip: Trip, repeats: int = 7) -> dict[str, Any]:
    field = world.field(0.9)
    planner = Planner()
    start, goal = trip.ends("up")
    space = open_space(world.chip, field, world.robot.radius_um, 0.5 * world.robot.radius_um)
    speed = 0.85 * SPEED_UM_S / space.um_per_px

    def cpu(action: Callable[[], object]) -> float:
        began = time.process_time()
        action()
        return 1e3 * (time.process_time() - began)

    planner.plan(field, start, goal, world.chip, world.robot)
    plans, runs = [], []
    for _ in range(repeats):
        plans.append(cpu(lambda: planner.plan(field, start, goal, world.chip, world.robot)))
        runs.append(cpu(lambda: _dijkstra(space, goal / space.um_per_px, speed)))
    return {
        "pixels": list(world.chip.mask.shape),
        "free": int(space.free.sum()),
        "plan_ms": min(plans),
        "dijkstra_ms": min(runs),
        "plan_over_two_dijkstra": min(plans) / (2.0 * min(runs)),
    }


def _dijkstra(space: FreeSpace, goal: NDArray[np.float64], speed: float) -> NDArray[np.float64]:
    """Time to go over 8 neighbours by scipy: graph and search."""
    free = space.free
    h, w = free.shape
    number = np.full((h, w), -1)
    number[free] = np.arange(int(free.sum()))
    vx, vy = space.vx[free], space.vy[free]
    ends, costs = [], []
    for dj, di in ((0, 1), (1, 0), (1, 1), (1, -1)):
        first = number[: h - dj, max(0, -di) : w - max(0, di)]
        second = number[dj:, max(0, di) : w + min(0, di)]
        both = (first >= 0) & (second >= 0)
        a, b = first[both], second[both]
        wx, wy = 0.5 * (vx[a] + vx[b]), 0.5 * (vy[a] + vy[b])
        length2 = float(di * di + dj * dj)
        for sign, (p, q) in ((1.0, (a, b)), (-1.0, (b, a))):
            along = sign * (di * wx + dj * wy)
            root = along**2 + (speed**2 - wx**2 - wy**2) * length2
            ground = along + np.sqrt(np.maximum(root, 0.0))
            possible = (root >= 0.0) & (ground > 1e-9)
            ends.append((q[possible], p[possible]))  # from the goal backwards
            costs.append(length2 / ground[possible])
    rows, columns = (np.concatenate(part) for part in zip(*ends, strict=True))
    graph = csr_array((np.concatenate(costs), (rows, columns)), shape=(len(vx), len(vx)))
    column, row = np.rint(goal).astype(int)
    return np.asarray(dijkstra(graph, indices=number[row, column], return_predecessors=True)[0])


def show(figures: dict[str, Any]) -> None:
    """Print the tables; all single trips are in the JSON."""
    regimes = [f"{ratio} {direction}" for ratio, direction in itertools.product(RATIOS, DIRECTIONS)]

    def cell(line: dict[str, Any]) -> str:
        if line["mean_percent"] is None:
            return "-" if not line["failed"] else f"none of {line['failed']}"
        lost = f", {line['failed']} lost" if line["failed"] else ""
        return f"{line['mean_percent']:.1f} ({line['worst_percent']:.1f}){lost}"

    table(
        "Percent of the least time: mean (worst), trips lost; fastest flow over the robot's speed, direction",
        ("planner", *regimes),
        [(method, *(cell(lines[regime]) for regime in regimes)) for method, lines in figures["summary"].items()],
    )
    table(
        "Travel time over that of time_field",
        ("planner", *regimes),
        [
            (method, *("-" if line[regime] is None else f"{line[regime]:.3f}" for regime in regimes))
            for method, line in figures["ratios"].items()
        ],
    )
    if figures["robust"]:
        _show_reserves(figures, regimes)
    for line in figures["speed"] or ():
        say(
            f"512 x 512 pixels, {line['free']} of them free: a full plan takes {line['plan_ms']:.0f} ms of CPU, "
            f"{line['plan_over_two_dijkstra']:.2f} times two runs of scipy's Dijkstra with their graph "
            f"({line['dijkstra_ms']:.0f} ms each)"
        )


def _show_reserves(figures: dict[str, Any], regimes: list[str]) -> None:
    table(
        f"Planned with some flow to spare: cost in the right flow, ways kept when it is {FASTER:g} times as fast",
        ("setting", *regimes),
        [
            (
                setting,
                *(
                    f"{'-' if line['cost_percent'] is None else format(line['cost_percent'], '.1f')} %, "
                    f"{100 * line['kept']:.0f} of {100 * line['planned']:.0f}"
                    for line in figures["robust"]
                    if line["setting"] == setting
                ),
            )
            for setting in dict.fromkeys(line["setting"] for line in figures["robust"])
        ],
    )
    table(
        "-grad T at full speed: arrived of those planned, percent of the least time, wall touched",
        ("time to go", "flow", *regimes),
        [
            (
                setting,
                f"{flow:g}",
                *(
                    next(
                        (
                            f"{line['arrived']}/{line['runs']}"
                            + ("" if line["mean_percent"] is None else f" {line['mean_percent']:.1f}")
                            + (f" t{line['touched']}" if line["touched"] else "")
                            for line in figures["policy"]
                            if (line["setting"], line["flow"], line["regime"]) == (setting, flow, regime)
                        ),
                        "-",
                    )
                    for regime in regimes
                ),
            )
            for setting, flow in dict.fromkeys((line["setting"], line["flow"]) for line in figures["policy"])
        ],
    )
