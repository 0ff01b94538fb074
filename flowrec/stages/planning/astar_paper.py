"""The paper's flow-aware A*: its cost and its heuristic as printed, on neighbours within a radius.

    c = |dx| |dx / |dx| - v / v_max|,   h = |goal - x| |(goal - x) / |goal - x| - v / v_max|

The cost stays finite (2 |dx|) against a flow as fast as the robot, and the heuristic is not admissible, so its routes
are neither the fastest nor always possible. It serves for comparison. The paper finds the neighbours with a K-D tree;
on pixels they are all offsets within the radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Route
from flowrec.stages.planning.grid_search import PAPER, shortest_path, too_fast_route
from flowrec.stages.planning.problem import Problem


@dataclass(frozen=True, slots=True)
class AstarPaper:
    """The paper's planner."""

    paper_radius_px: float
    reach_px: int  # of the shortest path, which the reason names if there is no route

    def plan(self, problem: Problem) -> Route:
        """The route of a problem."""
        path = shortest_path(problem, PAPER, offsets_within(self.paper_radius_px))
        return too_fast_route(problem, self.reach_px) if path is None else problem.timed(problem.with_ends(path))


def offsets_within(radius_px: float) -> NDArray[np.int64]:
    """(n, 2) offsets (x, y) of all pixels within a radius; 1.5 gives the 8 neighbours."""
    span = range(-math.floor(radius_px), math.floor(radius_px) + 1)
    return np.array([(a, b) for a in span for b in span if 0 < a * a + b * b <= radius_px * radius_px], np.int64)
