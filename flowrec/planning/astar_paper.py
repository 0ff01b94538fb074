"""The paper's flow-aware A*: its cost and its heuristic as printed, on the graph that its K-D tree builds.

    c = |dx| |dx / |dx| - v_cur / v_max|,   h = |goal - x| |(goal - x) / |goal - x| - v_cur / v_max|

The cost stays finite (2 |dx|) against a flow as fast as the robot, and the heuristic is not admissible
(science.md, section 3), so its routes are neither the fastest nor always possible. They are here to be compared with.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from flowrec.planning.zermelo import line_is_clear
from flowrec.system.numba_setup import compiled

Points = NDArray[np.float64]


def paper_cost(displacement: Points, velocity: Points, speed: float) -> NDArray[np.float64]:
    """(n,) printed cost of displacements (n, 2) that begin where the flow is velocity (n, 2); both c and h."""
    distance = np.hypot(displacement[:, 0], displacement[:, 1])
    unit = displacement / np.where(distance > 0.0, distance, 1.0)[:, None]
    difference = unit - velocity / speed
    return distance * np.hypot(difference[:, 0], difference[:, 1])


def adjacency(nodes: Points, radius: float, clearance: NDArray[np.float64], need: float) -> NDArray[np.int64]:
    """(m, 2) directed edges between nodes (n, 2), px, within a radius that touch or see each other past the walls."""
    pairs = cKDTree(nodes).query_pairs(radius, output_type="ndarray")
    pairs = pairs[_clear(clearance, nodes, pairs.astype(np.int64), need)]
    return np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)


def search_paper(
    nodes: Points, velocity: Points, edges: NDArray[np.int64], start: int, goal: int, speed: float
) -> NDArray[np.int64]:
    """Node numbers from start to goal (empty when there is no way); velocity (n, 2) and speed in px/s."""
    cost = paper_cost(nodes[edges[:, 1]] - nodes[edges[:, 0]], velocity[edges[:, 0]], speed)
    graph = csr_array((cost, (edges[:, 0], edges[:, 1])), shape=(len(nodes), len(nodes)))
    ahead = paper_cost(nodes[goal] - nodes, velocity, speed)
    parent = _best_first(graph.indptr.astype(np.int64), graph.indices.astype(np.int64), graph.data, ahead, start, goal)
    if start != goal and parent[goal] < 0:
        return np.zeros(0, np.int64)
    chain = [goal]
    while chain[-1] != start:
        chain.append(int(parent[chain[-1]]))
    return np.array(chain[::-1], np.int64)


@compiled
def _clear(clearance: NDArray[np.float64], nodes: Points, pairs: NDArray[np.int64], need: float) -> NDArray[np.bool_]:
    clear = np.zeros(len(pairs), np.bool_)
    for k in range(len(pairs)):
        a = pairs[k, 0]
        b = pairs[k, 1]
        x0, y0, x1, y1 = nodes[a, 0], nodes[a, 1], nodes[b, 0], nodes[b, 1]
        clear[k] = math.hypot(x1 - x0, y1 - y0) < 1.5 or line_is_clear(clearance, x0, y0, x1, y1, need)
    return clear


@compiled
def _best_first(
    first: NDArray[np.int64],
    others: NDArray[np.int64],
    cost: NDArray[np.float64],
    ahead: NDArray[np.float64],
    start: int,
    goal: int,
) -> NDArray[np.int64]:
    """A* over compressed rows, with a closed list that is never reopened, as the paper describes it."""
    spent = np.full(len(ahead), np.inf)
    parent = np.full(len(ahead), -1, np.int64)
    closed = np.zeros(len(ahead), np.bool_)
    spent[start] = 0.0
    heap = [(ahead[start], start)]
    while len(heap) > 0:
        _, node = heapq.heappop(heap)
        if closed[node]:
            continue
        closed[node] = True
        if node == goal:
            break
        for k in range(first[node], first[node + 1]):
            other = others[k]
            through = spent[node] + cost[k]
            if not closed[other] and through < spent[other]:
                spent[other] = through
                parent[other] = node
                heapq.heappush(heap, (through + ahead[other], other))
    return parent
