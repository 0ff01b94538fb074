"""Rapidly-exploring random trees of OMPL 2, for comparison.

    rrt       LaValle (1998): the first path found, as in the paper's comparison
    rrt_star  Karaman and Frazzoli (2011), with the travel time in the flow as its cost, until the iterations are used

The number of iterations is limited, not the time, and every plan seeds OMPL anew: the same problem has the same
solution on any machine. Clearance and cost come from the kernels of the other planners.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from ompl import base, geometric, util

from flowrec.core import Route, bilinear
from flowrec.stages.planning.cost_rasters import Points
from flowrec.stages.planning.free_space import FreeSpace
from flowrec.stages.planning.kernels import line_is_clear, segment_cost
from flowrec.stages.planning.planner import RrtSettings
from flowrec.stages.planning.problem import Problem
from flowrec.stages.planning.route import no_route


@dataclass(frozen=True, slots=True)
class Rrt:
    """The first path that the tree finds."""

    rrt: RrtSettings

    def plan(self, problem: Problem) -> Route:
        """The route of a problem."""
        path = self._search(problem)
        if path is None:
            reason = f"{problem.method} found no way in {self.rrt.iterations} iterations"
            return no_route(problem.method, reason)
        return problem.timed(problem.with_ends(path))

    def _tree(self, problem: Problem, definition: Any, information: Any) -> Any:
        """OMPL's planner."""
        return geometric.RRT(information)

    def _search(self, problem: Problem) -> Points | None:
        """(n, 2) px from node to node; None when the iterations do not suffice."""
        util.setLogLevel(util.LogLevel.LOG_NONE)
        # OMPL warns that objects made before keep the old seed; none of them is used again.
        util.RNG.setSeed(self.rrt.seed + 1)  # OMPL takes 0 for no seed
        space = problem.space
        h, w = space.free.shape
        plane = base.RealVectorStateSpace(2)
        bounds = base.RealVectorBounds(2)
        for axis, size in enumerate((w, h)):
            bounds.setLow(axis, -0.5)
            bounds.setHigh(axis, size - 0.5)
        plane.setBounds(bounds)
        information = base.SpaceInformation(plane)

        class Motion(base.MotionValidator):  # type: ignore[misc]
            def checkMotion(self, a: Any, b: Any, *_: Any) -> bool:  # noqa: N802
                return line_is_clear(space.clearance, a[0], a[1], b[0], b[1], space.need - 1e-9)

        information.setStateValidityChecker(lambda state: bilinear(space.clearance, state[0], state[1]) > 0.0)
        information.setMotionValidator(Motion(information))
        information.setup()
        definition = base.ProblemDefinition(information)
        ends = []
        for node in (problem.start.node, problem.goal.node):
            state = information.allocState()
            state[0], state[1] = map(float, space.pixel(node))
            ends.append(state)
        definition.setStartAndGoalStates(*ends, 0.5)
        tree = self._tree(problem, definition, information)
        tree.setRange(self.rrt.range_px)
        tree.setGoalBias(self.rrt.goal_bias)
        tree.setProblemDefinition(definition)
        tree.setup()
        counted = itertools.count()
        tree.solve(base.PlannerTerminationCondition(lambda: next(counted) >= self.rrt.iterations))
        if not definition.hasExactSolution():
            return None
        states = definition.getSolutionPath().getStates()
        return np.array([[state[0], state[1]] for state in states], np.float64)


class RrtStar(Rrt):
    """The fastest path that the tree finds within the iterations."""

    def _tree(self, problem: Problem, definition: Any, information: Any) -> Any:
        definition.setOptimizationObjective(_travel_time(information, problem.space, problem.speed))
        return geometric.RRTstar(information)


def _travel_time(information: Any, space: FreeSpace, speed: float) -> Any:
    """OMPL's objective: Zermelo's travel time along each branch."""
    everywhere = np.full_like(space.clearance, speed)
    fastest = speed + float(np.hypot(space.vx, space.vy).max())

    class TravelTime(base.OptimizationObjective):  # type: ignore[misc]
        def stateCost(self, state: Any) -> Any:  # noqa: N802
            return base.Cost(0.0)

        def motionCost(self, a: Any, b: Any) -> Any:  # noqa: N802
            return base.Cost(segment_cost(space.vx, space.vy, everywhere, -1.0, a[0], a[1], b[0], b[1], 0.5))

        def motionCostHeuristic(self, a: Any, b: Any) -> Any:  # noqa: N802
            return base.Cost(math.hypot(b[0] - a[0], b[1] - a[1]) / fastest)

        def isSymmetric(self) -> bool:  # noqa: N802
            return False

    return TravelTime(information)
