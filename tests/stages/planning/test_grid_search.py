"""A* on pixels against Dijkstra's algorithm of SciPy on a graph that is built without the code under test."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from flowrec.stages.planning.cost_rasters import CostRasters
from flowrec.stages.planning.grid_search import LENGTH, TRAVEL_TIME, backtrack, best_first, directions


def ground_speed(along, flow, speed):
    """Along unit vectors (n, 2) in flows (n, 2), from the triangle of velocities; nan where there is none."""
    helping = (along * flow).sum(axis=1)
    across2 = (flow**2).sum(axis=1) - helping**2
    with np.errstate(invalid="ignore"):
        ground = helping + np.sqrt(speed**2 - across2)
    return np.where(ground > 0.0, ground, np.nan)


def graph(free, vx, vy, weight, reach, speed, timed):
    """(h w, h w) costs of all edges, where they are finite."""
    h, w = free.shape
    flow = np.stack([vx, vy], axis=-1)
    edges = []
    for di, dj in directions(reach):
        j, i = np.nonzero(free)
        there = (i + di >= 0) & (i + di < w) & (j + dj >= 0) & (j + dj < h)
        j, i = j[there], i[there]
        open_ = free[j + dj, i + di]
        j, i = j[open_], i[open_]
        b, a = j + dj, i + di
        cost = np.full(len(j), np.hypot(di, dj))
        if timed:
            along = np.tile([di, dj] / np.hypot(di, dj), (len(j), 1))
            # The middle of an edge lies in the middle of a pixel's side, of a pixel's square, or on a pixel.
            low = np.stack([j + dj // 2, i + di // 2])
            corners = [flow[low[0] + p * (dj % 2), low[1] + q * (di % 2)] for p in (0, 1) for q in (0, 1)]
            middle = np.mean(corners, axis=0)
            paces = [1.0 / ground_speed(along, each, speed) for each in (flow[j, i], middle, flow[b, a])]
            cost = cost * (paces[0] + 4.0 * paces[1] + paces[2]) / 6.0
        cost = cost * 0.5 * (weight[j, i] + weight[b, a])
        known = np.isfinite(cost)
        edges.append(np.stack([j * w + i, b * w + a, cost])[:, known])
    rows, columns, costs = np.concatenate(edges, axis=1)
    return sp.csr_array((costs, (rows.astype(int), columns.astype(int))), shape=(h * w, h * w))


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("reach", [1, 2, 3])
def test_astar_finds_the_cost_that_dijkstra_finds_on_random_grids(reach, timed):
    rng = np.random.default_rng(reach)
    for _ in range(6):
        h, w, speed = 17, 23, 1.0
        free = rng.uniform(size=(h, w)) > 0.15
        # Strong flow that helps on the way: the fastest ground speed is far above the robot's own.
        vx, vy = 1.5 * rng.uniform(-0.3, 1.0, (h, w)), rng.uniform(-0.6, 0.6, (h, w))
        weight = rng.uniform(1.0, 1.3, (h, w)) if rng.uniform() < 0.5 else np.ones((h, w))
        clearance = np.full((h, w), 50.0)
        costs = graph(free, vx, vy, weight, reach, speed, timed)
        start = int(rng.choice(np.flatnonzero(free[:, 0]))) * w
        exact = dijkstra(costs, indices=start)
        known = np.flatnonzero(np.isfinite(exact) & (np.arange(h * w) % w > 5))
        goals = rng.choice(known, 12, replace=False)
        rasters = CostRasters(free, clearance, 1.0, vx, vy, np.full((h, w), speed))
        cost_kind = TRAVEL_TIME if timed else LENGTH
        everywhere, _ = best_first(rasters, weight, cost_kind, directions(reach), start, -1)
        np.testing.assert_allclose(everywhere, exact, rtol=1e-9)
        for goal in goals:
            cost, parent = best_first(rasters, weight, cost_kind, directions(reach), start, int(goal))
            assert cost[goal] == pytest.approx(exact[goal], rel=1e-9)
            nodes = backtrack(parent, int(goal), w).astype(int) @ [1, w]
            assert nodes[0] == start and nodes[-1] == goal
            assert sum(costs[a, b] for a, b in pairwise(nodes)) == pytest.approx(exact[goal])


def test_an_edge_whose_flow_is_too_fast_is_not_walked_and_what_lies_behind_is_not_reached():
    free = np.ones((3, 9), bool)
    vx = np.zeros((3, 9))
    vx[:, 4] = -2.0
    none, one = np.zeros((3, 9)), np.ones((3, 9))
    rasters = CostRasters(free, 9.0 * one, 1.0, vx, none, one)
    cost, _ = best_first(rasters, one, TRAVEL_TIME, directions(1), 9, -1)
    assert np.isfinite(cost.reshape(3, 9)[:, :3]).all() and np.isinf(cost.reshape(3, 9)[:, 4:]).all()
