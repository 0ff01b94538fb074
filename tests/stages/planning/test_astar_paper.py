import itertools
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flowrec.stages.planning.cost_rasters import CostRasters
from flowrec.stages.planning.grid_search import PAPER, backtrack, best_first, offsets_within, paper_cost

SIDE, SPEED = 4, 2.0
NODES = np.array([(x, y) for y in range(SIDE) for x in range(SIDE)], float)
ONE = np.ones((SIDE, SIDE))


def printed(a, b, velocity):
    """The paper's cost, letter for letter."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    norm = math.hypot(dx, dy)
    if norm == 0:
        return 0.0
    return norm * math.hypot(dx / norm - velocity[0] / SPEED, dy / norm - velocity[1] / SPEED)


def search_paper(velocity, goal=SIDE * SIDE - 1, radius=1.5, clearance=9.0 * ONE):
    """Nodes from the first one to the goal, and the cost of the goal."""
    vx, vy = (np.ascontiguousarray(part.reshape(SIDE, SIDE)) for part in velocity.T)
    rasters = CostRasters(clearance > 0.0, clearance, 0.0, vx, vy, SPEED * ONE)
    cost, parent = best_first(rasters, ONE, PAPER, offsets_within(radius), 0, goal)
    return (backtrack(parent, goal, SIDE) @ [1, SIDE]).astype(int), cost[goal]


def test_cost_is_as_printed():
    rng = np.random.default_rng(1)
    for a, b, velocity in zip(*rng.normal(size=(3, 50, 2)), strict=True):
        assert paper_cost(*(b - a), *velocity, SPEED) == pytest.approx(printed(a, b, velocity), rel=1e-12)
    assert paper_cost(0.0, 0.0, 1.0, 1.0, SPEED) == 0.0
    against = paper_cost(3.0, 0.0, -SPEED, 0.0, SPEED)
    assert against == 6.0, "against a flow as fast as the robot it is 2 |dx|, where the truth is infinite"


@pytest.mark.parametrize("radius", [1.0, 1.5, 2.0, math.sqrt(5.0), 3.5, 7.07])
def test_the_offsets_within_a_radius_are_the_neighbours_of_a_kd_tree(radius):
    pixels = np.array([(x, y) for y in range(17) for x in range(17)])
    middle = pixels[len(pixels) // 2]
    found = pixels[cKDTree(pixels).query_ball_point(middle, radius)] - middle
    expected = {tuple(offset) for offset in found.tolist()} - {(0, 0)}
    assert {tuple(offset) for offset in offsets_within(radius).tolist()} == expected


def test_walls_hide_nodes_and_what_lies_behind_is_not_reached():
    walled = ONE * [0.5, -0.5, 0.5, 1.5]
    assert search_paper(np.zeros((len(NODES), 2)), SIDE * (SIDE - 1), 2.5, walled)[1] == 3.0
    assert np.isinf(search_paper(np.zeros((len(NODES), 2)), radius=2.5, clearance=walled)[1])


def test_search_finds_what_the_printed_algorithm_finds_and_in_still_fluid_what_brute_force_finds():
    for scale, seed in itertools.product((0.0, 0.3, 1.5), range(4)):
        velocity = scale * np.random.default_rng(seed).normal(size=(len(NODES), 2))
        chain, cost = search_paper(velocity)
        found = sum(printed(NODES[a], NODES[b], velocity[a]) for a, b in itertools.pairwise(chain))
        assert chain[0] == 0 and chain[-1] == len(NODES) - 1
        assert math.isclose(found, literal_astar(velocity), rel_tol=1e-12)
        assert math.isclose(found, cost, rel_tol=1e-12)
        if scale == 0.0:
            assert math.isclose(found, 3 * math.sqrt(2.0))


def literal_astar(velocity):
    """Open and closed lists as the paper describes them, with the node of least f taken by a plain search."""
    goal = len(NODES) - 1
    edges = [(a, b) for a, b in itertools.permutations(range(len(NODES)), 2) if np.hypot(*(NODES[b] - NODES[a])) < 1.5]
    spent, opened, closed = {0: 0.0}, {0}, set()
    while opened:
        node = min(opened, key=lambda n: (spent[n] + printed(NODES[n], NODES[goal], velocity[n]), n))
        if node == goal:
            return spent[goal]
        opened.remove(node)
        closed.add(node)
        for other in (b for a, b in edges if a == node):
            through = spent[node] + printed(NODES[node], NODES[other], velocity[node])
            if other not in closed and through < spent.get(other, math.inf):
                spent[other] = through
                opened.add(other)
    raise AssertionError("no way")
