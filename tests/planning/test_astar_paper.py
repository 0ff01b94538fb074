import itertools
import math

import numpy as np

from flowrec.planning.astar_paper import adjacency, paper_cost, search_paper

SIDE, SPEED = 4, 2.0
NODES = np.array([(x, y) for y in range(SIDE) for x in range(SIDE)], float)
CLEAR = np.full((SIDE, SIDE), 9.0)


def printed(a, b, velocity):
    """The paper's cost, letter for letter."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    norm = math.hypot(dx, dy)
    if norm == 0:
        return 0.0
    return norm * math.hypot(dx / norm - velocity[0] / SPEED, dy / norm - velocity[1] / SPEED)


def test_cost_is_as_printed():
    rng = np.random.default_rng(1)
    a, b, velocity = rng.normal(size=(3, 50, 2))
    np.testing.assert_allclose(
        paper_cost(b - a, velocity, SPEED), [printed(*row) for row in zip(a, b, velocity, strict=True)]
    )
    against = paper_cost(np.array([[3.0, 0.0]]), np.array([[-SPEED, 0.0]]), SPEED)
    assert against[0] == 6.0, "against a flow as fast as the robot it is 2 |dx|, where the truth is infinite"


def test_a_kd_tree_radius_of_one_and_a_half_pixels_gives_the_eight_neighbours_and_walls_hide_nodes():
    edges = adjacency(NODES, 1.5, CLEAR, 0.0)
    assert len(edges) == 2 * (2 * SIDE * (SIDE - 1) + 2 * (SIDE - 1) ** 2)
    walled = CLEAR.copy()
    walled[:, 1] = -9.0
    assert not any(NODES[a, 0] < 1 < NODES[b, 0] for a, b in adjacency(NODES, 2.5, walled, 0.0))


def test_search_finds_what_the_printed_algorithm_finds_and_in_still_fluid_what_brute_force_finds():
    edges = adjacency(NODES, 1.5, CLEAR, 0.0)
    for scale, seed in itertools.product((0.0, 0.3, 1.5), range(4)):
        velocity = scale * np.random.default_rng(seed).normal(size=(len(NODES), 2))
        chain = search_paper(NODES, velocity, edges, 0, len(NODES) - 1, SPEED)
        found = sum(printed(NODES[a], NODES[b], velocity[a]) for a, b in itertools.pairwise(chain))
        assert math.isclose(found, literal_astar(velocity, edges), rel_tol=1e-12)
        if scale == 0.0:
            assert math.isclose(found, 3 * math.sqrt(2.0))


def literal_astar(velocity, edges):
    """Open and closed lists as the paper tells it, with the node of least f taken by a plain search."""
    goal = len(NODES) - 1
    spent, opened, closed = {0: 0.0}, {0}, set()
    while opened:
        node = min(opened, key=lambda n: (spent[n] + printed(NODES[n], NODES[goal], velocity[n]), n))
        if node == goal:
            return spent[goal]
        opened.remove(node)
        closed.add(node)
        for other in (int(b) for a, b in edges if a == node):
            through = spent[node] + printed(NODES[node], NODES[other], velocity[node])
            if other not in closed and through < spent.get(other, math.inf):
                spent[other] = through
                opened.add(other)
    raise AssertionError("no way")
