"""Rapidly-exploring random trees from OMPL 2: what a user might pick instead, for comparison.

    rrt       LaValle's, the first way that is found, as in the paper's comparison
    rrt_star  Karaman and Frazzoli's, with the travel time in the flow as its cost, until the samples are used up

The number of iterations is limited, not the time, and every plan seeds OMPL anew: the same request has the same
answer, on any machine. OMPL stays the judge of what it does; flow, walls and cost are asked of the same kernels as
every other planner's.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from flowrec.errors import UsageError
from flowrec.planning.free_space import Space
from flowrec.planning.zermelo import line_is_clear, segment_cost
from flowrec.ranges import Range, Seed, Share

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rrt:
    """Settings of both trees."""

    seed: Seed = 0
    iterations: Annotated[int, Range(1, 100_000_000)] = 20000  # at most; rrt stops at its first way
    range_px: Annotated[float, Range(0.1, 1e5)] = 12.0  # longest branch
    goal_bias: Share = 0.05  # share of the samples that are the goal itself

    def search(self, space: Space, start: Points, goal: Points, speed: float | None) -> Points | None:
        """(n, 2) px from start to goal, None when the iterations do not suffice; the fastest at a `speed` (px/s).

        Raises
        ------
        UsageError
            If OMPL is not installed.
        """
        base, geometric, util = _ompl()
        # OMPL warns that what was made before goes on as before; nothing that was is used again.
        util.RNG.setSeed(self.seed + 1)  # it takes 0 for no seed
        h, w = space.free.shape
        plane = base.RealVectorStateSpace(2)
        bounds = base.RealVectorBounds(2)
        for axis, size in enumerate((w, h)):
            bounds.setLow(axis, -0.5)
            bounds.setHigh(axis, size - 0.5)
        plane.setBounds(bounds)
        information = base.SpaceInformation(plane)

        class Motion(base.MotionValidator):  # type: ignore[misc,name-defined]
            def checkMotion(self, a: Any, b: Any, *_: Any) -> bool:  # noqa: N802
                return _passable(space, a[0], a[1], b[0], b[1])

        information.setStateValidityChecker(lambda state: space.clearance_at(np.array([state[0], state[1]])) > 0.0)
        information.setMotionValidator(Motion(information))
        information.setup()
        problem = base.ProblemDefinition(information)
        ends = []
        for point in (start, goal):
            state = information.allocState()
            state[0], state[1] = float(point[0]), float(point[1])
            ends.append(state)
        problem.setStartAndGoalStates(*ends, 0.5)
        if speed is None:
            planner = geometric.RRT(information)
        else:
            problem.setOptimizationObjective(_travel_time(base, information, space, speed))
            planner = geometric.RRTstar(information)
        planner.setRange(self.range_px)
        planner.setGoalBias(self.goal_bias)
        planner.setProblemDefinition(problem)
        planner.setup()
        counted = itertools.count()
        planner.solve(base.PlannerTerminationCondition(lambda: next(counted) >= self.iterations))
        if not problem.hasExactSolution():
            return None
        states = problem.getSolutionPath().getStates()
        return np.array([[state[0], state[1]] for state in states], np.float64)


def _passable(space: Space, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Whether the robot keeps its clearance along a segment."""
    return line_is_clear(space.clearance, x0, y0, x1, y1, space.need - 1e-9)


def _travel_time(base: Any, information: Any, space: Space, speed: float) -> Any:
    """OMPL's objective: Zermelo's time along each branch."""
    everywhere = np.full_like(space.clearance, speed)
    fastest = speed + float(np.hypot(space.vx, space.vy).max())

    class TravelTime(base.OptimizationObjective):  # type: ignore[misc]
        def stateCost(self, state: Any) -> Any:  # noqa: N802
            return base.Cost(0.0)

        def motionCost(self, a: Any, b: Any) -> Any:  # noqa: N802
            cost = segment_cost(space.vx, space.vy, everywhere, a[0], a[1], b[0], b[1], -1.0, 0.5)
            return base.Cost(cost)

        def motionCostHeuristic(self, a: Any, b: Any) -> Any:  # noqa: N802
            return base.Cost(math.hypot(b[0] - a[0], b[1] - a[1]) / fastest)

        def isSymmetric(self) -> bool:  # noqa: N802
            return False

    return TravelTime(information)


def _ompl() -> tuple[Any, Any, Any]:
    """OMPL's base, geometric and util parts, quiet.

    Raises
    ------
    UsageError
        If it is not installed.
    """
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        raise UsageError("plan: rrt and rrt_star need OMPL 2: pip install 'flowrec[ompl]'") from error
    util.setLogLevel(util.LogLevel.LOG_NONE)
    return base, geometric, util
