"""The planner by the time to go: solve the eikonal equation, descend it, refine the path; its slope is the policy.

The heading that reduces the time to go most, -grad T, is the best one wherever the robot is pushed, so the route keeps
T for the controller. T counts on the flow in its worst direction within some standard deviations; where that leaves no
way, fewer are tried.

T is extended to the fluid nearer to the walls than the robot should be, so that -grad T leads back. Layer by layer from
the free pixels, a pixel gets the largest time of its neighbours one layer nearer to them, plus a penalty for the
clearance that it lacks. So no path through the band is shorter, and where two free regions meet in a passage too narrow
for the robot, the band is closed.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, Ints, Route, bilinear, compiled
from flowrec.physics import RESERVE
from flowrec.stages.planning.cost_rasters import NEIGHBOUR_X, NEIGHBOUR_Y, Mask, Raster, interpolate_raster
from flowrec.stages.planning.eikonal import descend, time_field
from flowrec.stages.planning.grid_search import TRAVEL_TIME, directions, shortest_path, too_fast_route
from flowrec.stages.planning.path_refinement import SPACING_PX, refined_route
from flowrec.stages.planning.problem import Problem, attach_goal
from flowrec.stages.planning.route import planning_speed_um_s

# A lacking pixel of clearance costs this many times what a pixel takes in still fluid: then -grad T leads out of the
# band within some 20 degrees of straight.
_BAND_PENALTY = 3.0
_LEAST_PENALTY = 0.05  # px
# A step between neighbours that costs more than swimming this far connects two regions through too narrow a passage.
_TORN_PX = 30.0


def extend_to_walls(times: Raster, free: Mask, clearance: Raster, need: float, speed: float) -> Raster:
    """The times (h, w) with those of the fluid outside `free`; clearance and `need` in px, `speed` in px/s."""
    # A border of solid pixels without a time spares the kernel the question whether a neighbour exists.
    padded = np.pad(times, 1, constant_values=np.inf)
    solid = np.pad(clearance, 1, constant_values=-1.0)
    inside = np.pad(free, 1)
    # Breadth-first from the free pixels beside the band: the number of steps from them, -1 before they are counted.
    # Made here, because numba takes seconds to compile `where`.
    layer = np.where(inside, 0, -1)
    _fill_band(padded, inside, layer, solid, need, _BAND_PENALTY / speed, _TORN_PX / speed)
    band = padded[1:-1, 1:-1]
    # Beyond the border nothing is known, and no camera looks there: half a pixel counts as lacking.
    half = 0.5 * _BAND_PENALTY / speed
    for edge, inner in ((band[0], band[1]), (band[-1], band[-2]), (band[:, 0], band[:, 1]), (band[:, -1], band[:, -2])):
        np.maximum(edge, inner + half, out=edge, where=np.isfinite(edge) & np.isfinite(inner))
    return band


@compiled
def _fill_band(
    times: Raster, free: Mask, layer: Ints, clearance: Raster, need: float, penalty: float, torn: float
) -> None:
    """Set the times of the band in place; `layer` is 0 in free pixels, -1 elsewhere. Arrays have a solid border."""
    fluid = clearance > 0.0
    rows, columns, border, tail = _count_layers(times, free, fluid, layer)
    for m in range(border, tail):
        j = rows[m]
        i = columns[m]
        # Neighbours along the axes first: a diagonal one is also farther up or down the channel.
        for diagonal in range(2):
            worst = -1.0
            for k in range(diagonal, 8, 2):
                a = i + NEIGHBOUR_X[k]
                b = j + NEIGHBOUR_Y[k]
                if layer[b, a] == layer[j, i] - 1 and (fluid[j, a] or fluid[b, i]) and math.isfinite(times[b, a]):
                    lacking = max(min(clearance[b, a], need) - clearance[j, i], _LEAST_PENALTY)
                    worst = max(worst, times[b, a] + penalty * lacking)
            if worst >= 0.0:
                times[j, i] = worst
                break
    closed = np.zeros(tail, np.bool_)
    for m in range(border, tail):
        j = rows[m]
        i = columns[m]
        for k in range(8):
            a = i + NEIGHBOUR_X[k]
            b = j + NEIGHBOUR_Y[k]
            if math.isfinite(times[b, a]) and abs(times[b, a] - times[j, i]) > torn:
                closed[m] = closed[m] or fluid[j, a] or fluid[b, i]
    for m in range(border, tail):
        if closed[m]:
            times[rows[m], columns[m]] = math.inf


@compiled
def _count_layers(times: Raster, free: Mask, fluid: Mask, layer: Ints) -> tuple[Ints, Ints, int, int]:
    """Number the layers of the band in place, breadth first from the free pixels beside it.

    Returns
    -------
    rows, columns : pixels in the order of their layers: before `border` the free ones, up to `tail` those of the band.
    """
    h, w = free.shape
    rows = np.empty(h * w, np.int64)
    columns = np.empty(h * w, np.int64)
    tail = 0
    for j in range(1, h - 1):
        for i in range(1, w - 1):
            if not free[j, i] or not math.isfinite(times[j, i]):
                continue
            for k in range(8):
                a = i + NEIGHBOUR_X[k]
                b = j + NEIGHBOUR_Y[k]
                if fluid[b, a] and not free[b, a]:
                    rows[tail] = j
                    columns[tail] = i
                    tail += 1
                    break
    border = tail
    head = 0
    while head < tail:
        j = rows[head]
        i = columns[head]
        head += 1
        for k in range(8):
            a = i + NEIGHBOUR_X[k]
            b = j + NEIGHBOUR_Y[k]
            # Between two solid pixels that touch at their corners there is no way.
            if fluid[b, a] and layer[b, a] < 0 and (fluid[j, a] or fluid[b, i]):
                layer[b, a] = layer[j, i] + 1
                rows[tail] = b
                columns[tail] = a
                tail += 1
    return rows, columns, border, tail


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
