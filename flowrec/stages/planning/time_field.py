"""The planner by the time to go: solve the eikonal equation, descend it, refine the path; its slope is the policy.

The heading that reduces the time to go most, -grad T, is the best one wherever the robot is pushed, so the route keeps
T for the controller. T counts on the flow in its worst direction within some standard deviations; where that leaves no
way, fewer are tried.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, Route, bilinear
from flowrec.physics import RESERVE
from flowrec.stages.planning.cost_rasters import interpolate_raster
from flowrec.stages.planning.eikonal import descend, time_field
from flowrec.stages.planning.grid_search import TRAVEL_TIME, directions, shortest_path, too_fast_route
from flowrec.stages.planning.path_refinement import SPACING_PX, refined_route
from flowrec.stages.planning.problem import Problem, attach_goal
from flowrec.stages.planning.route import planning_speed_um_s
from flowrec.stages.planning.wall_band import extend_to_walls

_FINER = ((6000, 4), (12000, 2))  # with fewer free pixels than these, that many points per pixel,
_LARGEST_PX = 2_000_000  # as long as the rasters have no more points than these


@dataclass(frozen=True, slots=True)
class TimeField:
    """Its fields are settings of the planner."""

    cost: str
    idle_speed_um_s: float | None
    policy_share: float
    policy_margin_share: float
    policy_course_share: float
    wall_error_um: float | None
    policy_points_per_radius: float
    policy_points_per_px: int
    robust_deviations: float
    flow_error_share: float | None
    reach_px: int
    refine: bool

    def plan(self, problem: Problem) -> Route:
        """The route of a problem, with the time to go unless energy is the cost."""
        route, deviations = self._path(problem)
        if not route.reachable or self.cost == "energy":
            return route
        return self._with_time_to_go(route, problem, deviations)

    def _path(self, problem: Problem) -> tuple[Route, float]:
        """The route, and how many standard deviations of the flow it has to spare."""
        space = problem.space
        idle_um_s = None
        if self.cost == "energy":
            idle_um_s = 0.5 * problem.speed_um_s if self.idle_speed_um_s is None else float(self.idle_speed_um_s)
        area = int(space.free.sum())
        usual = next((k for few, k in _FINER if area < few and k * k * space.free.size <= _LARGEST_PX), 1)
        target = problem.goal.place(space)
        first = space.pixel(problem.start.node)
        if problem.start.point is not None and bilinear(space.usable_clearance, *problem.start.point) >= space.need:
            first = problem.start.point
        deviation = self._deviation(problem)
        tried = tuple(dict.fromkeys((self.robust_deviations, 0.5 * self.robust_deviations, 0.0)))
        # Half a pixel may decide whether there is a way: finer rasters are tried before fewer deviations.
        for deviations, finer in itertools.product(tried, (usual, 2 * usual)):
            rasters = space.cost_rasters(problem.speed, deviations * deviation, idle_um_s)
            fine = rasters.finer(finer)
            times = time_field(fine, finer * target)
            path = None
            if np.isfinite(times[::finer, ::finer].ravel()[problem.start.node]):
                path = descend(fine, times, finer * first, finer * target)
            if path is not None:
                path = path / finer
            elif deviations == 0.0 and finer > usual:
                path = shortest_path(problem, TRAVEL_TIME, directions(self.reach_px))
            if path is None:
                continue
            path = problem.with_ends(path)
            if self.refine:
                route = refined_route(problem, rasters, path, idle_um_s, SPACING_PX / finer)
            else:
                route = problem.timed(path, idle_um_s)
            if not route.reachable:
                continue
            if deviations < tried[0]:
                spared = f"{deviations:g} of {tried[0]:g} deviations of the flow" if deviations else "nothing"
                route = replace(route, reason=f"no way but against nearly all the robot has: {spared} to spare")
            return route, deviations
        return too_fast_route(problem, self.reach_px), 0.0

    def _with_time_to_go(self, route: Route, problem: Problem, deviations: float) -> Route:
        """The route with the time to go to its goal, also from places nearer to the walls than the robot may be.

        A route from whose start no time is known is returned as it is: a path without a policy is still a route.
        """
        space = problem.space.with_reserves(self.policy_course_share, self._policy_margin_um(problem))
        px = space.um_per_px
        finest = max(math.isqrt(_LARGEST_PX // space.free.size), 1)
        finer = min(max(math.ceil(self.policy_points_per_radius / space.radius), 1), self.policy_points_per_px, finest)
        target = attach_goal(space, problem.goal_um).place(space)
        speed = planning_speed_um_s(self.policy_share, problem.robot) / px
        fine = space.cost_rasters(speed, deviations * self._deviation(problem)).finer(finer)
        clearance = finer * interpolate_raster(space.clearance, finer)
        h, w = clearance.shape
        column, row = np.rint(finer * route.waypoints_um[0] / px).astype(int)
        column, row = min(max(column, 0), w - 1), min(max(row, 0), h - 1)  # half a pixel lies outside of the points
        # Two free pixels that touch at their corners are joined, but between them the robot may not fit: the wall
        # barrier would stop it there. Such a way is used only if there is no other.
        fits = fine.free & (clearance >= finer * space.radius)
        for free in (fits, fine.free):
            times = time_field(fine._replace(free=free), finer * target)
            policy = extend_to_walls(times, free, clearance, fine.need, finer * speed).astype(np.float32)
            if np.isfinite(policy[row, column]):
                return replace(route, time_to_go_s=policy, time_to_go_um_per_px=px / finer)
        return route

    def _policy_margin_um(self, problem: Problem) -> float:
        """Margin of the time to go from the walls, in addition to the robot's radius and its course error."""
        if self.wall_error_um is None:
            return problem.margin_um
        return min(max(self.policy_margin_share * problem.margin_um, self.wall_error_um), problem.margin_um)

    def _deviation(self, problem: Problem) -> Floats:
        """(h, w) px/s, one standard deviation of the flow; a ratio of its speed if the field states none."""
        field, space = problem.field, problem.space
        if field.std_um_s is not None:
            return np.asarray(field.std_um_s.max(axis=-1) / field.um_per_px, np.float64)
        return RESERVE.of(field, self.flow_error_share) * np.sqrt(space.vx * space.vx + space.vy * space.vy)
