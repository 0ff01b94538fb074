"""`python -m tests.perf.planning`: CPU time of a plan on 512 x 512 pixels, compared with scipy's Dijkstra.

The chips are random vessels as seen by cameras of two and four times the resolution: the time depends on the number of
free pixels. The least of several runs that take turns. The reference is two runs of Dijkstra with their graph.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from flowrec.bench.harness import Results, run
from flowrec.bench.plan import SIDE_PX
from flowrec.bench.trips import SPEED_UM_S, Trip, TripCase, draw_trip, world_of, worlds
from flowrec.core.terminal import progress, say
from flowrec.stages.planning import Planner
from flowrec.stages.planning.free_space import FreeSpace, open_space


def magnified(world: TripCase) -> TripCase | None:
    """The same chip as a camera of twice the resolution sees it; the robot is as big as before, in um."""
    mask = world.chip.mask.repeat(2, axis=0).repeat(2, axis=1)
    openings = tuple(replace(o, first=2 * o.first, last=2 * o.last + 1) for o in world.chip.openings)
    chip = replace(world.chip, mask=mask, openings=openings, um_per_px=0.5 * world.chip.um_per_px)
    made = world_of(chip, k=1)
    return None if made is None else replace(made, robot=world.robot)


def measure(
    per_size: Annotated[int, typer.Option("--worlds", min=1, help="Chips of each resolution.")] = 3,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each.")] = 7,
    side_px: int = SIDE_PX,
) -> Results:
    """CPU times by chip, in ms, in the order of their free pixels."""
    rows = []
    with progress("planning", 2 * per_size) as done:
        for drawn_px, times in ((side_px, 1), (side_px // 2, 2)):
            for world, trip in itertools.islice(_magnified_trips(drawn_px, times), per_size):
                rows.append(measured(world, trip, repeats))
                done(len(rows))
    return {"rows": sorted(rows, key=lambda row: row["free"])}


def _magnified_trips(side_px: int, times: int) -> Iterator[tuple[TripCase, Trip]]:
    for drawn in worlds(side_px, 100):
        world: TripCase | None = drawn
        for _ in range(times):
            world = None if world is None else magnified(world)
        trip = None if world is None else draw_trip(world, np.random.default_rng(0))
        if world is not None and trip is not None:
            yield world, trip


def measured(world: TripCase, trip: Trip, repeats: int) -> dict[str, Any]:
    """The least CPU times in ms of a plan and of Dijkstra on one chip."""
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


def show(results: Results) -> None:
    """Print a line per chip."""
    for line in results["rows"]:
        width, height = line["pixels"]
        say(
            f"{width} x {height} pixels, {line['free']} of them free: a plan takes {line['plan_ms']:.0f} ms of CPU, "
            f"{line['plan_over_two_dijkstra']:.2f} times two runs of scipy's Dijkstra with their graph "
            f"({line['dijkstra_ms']:.0f} ms each)"
        )


if __name__ == "__main__":
    run(measure, show)
