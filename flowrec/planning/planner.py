"""The planner stage: the way to a goal through a flow, or the honest answer that there is none."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from dataclasses import field as setting
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.chip.chip import Chip
from flowrec.errors import UsageError
from flowrec.messages import FlowField, Route
from flowrec.planning.astar_paper import adjacency, search_paper
from flowrec.planning.cost_rasters import Terrain, interpolated
from flowrec.planning.eikonal import descend, time_field, with_band
from flowrec.planning.free_space import (
    End,
    Space,
    Swift,
    attach_goal,
    attach_start,
    joined_ends,
    margin_remark,
    margins_um,
    narrowest,
    open_space,
    too_swift,
    why_apart,
    with_margin,
)
from flowrec.planning.grid_search import backtrack, directions, search
from flowrec.planning.path_refinement import SPACING_PX, relax
from flowrec.planning.route import no_route, planning_speed_um_s, timed_route, too_fast
from flowrec.planning.rrt import Rrt
from flowrec.ranges import OneOf, PositiveShare, Range, Share, check_ranges
from flowrec.robot import Robot

Method = Literal["time_field", "astar_time", "astar_paper", "astar_length", "rrt", "rrt_star"]
Cost = Literal["time", "energy"]
Points = NDArray[np.float64]

_LEAST_SHARE = 0.02
_CLOSER = ((6000, 4), (12000, 2))  # of fewer free pixels each is looked at so many times as closely,
_LARGEST_PX = 2_000_000  # as long as all of the chip has no more than these
# A policy needs points between the pixels where the robot is small: the way along the wall lies between them.
_POINTS_PER_RADIUS = 3.0
_FINEST = 4


@dataclass(frozen=True, slots=True)
class Planner:
    """The fastest way through a flow (science.md, section 3), and beside it what it is compared with.

    time_field: the time to go from everywhere, the way down it, then a local refinement of the path. The route keeps
        the field: its slope is a policy, -grad T the best heading wherever the robot is pushed.
    astar_time: exact travel time on the pixels, admissible heuristic, then a local refinement of the path.
    astar_paper: cost and heuristic as the paper prints them, neighbours by K-D tree; with paper_radius_px = 1.5 they
        are the 8 around a pixel.
    astar_length: the shortest way, blind to the flow.
    rrt, rrt_star: OMPL's, the first for any way, as in the paper, the second for the fastest.

    Energy as the cost, a wider berth around flow that may be faster than believed, and a time to go belong to
    time_field.
    """

    method: Method = "time_field"
    cost: Cost = "time"
    # swimming at this speed takes as much power as being there; None: half of V
    idle_speed_um_s: Annotated[float, Range(0.01, 1e6)] | None = None
    # kept from the walls beside the robot's radius; None: half of it
    clearance_margin_um: Annotated[float, Range(0.0, 1e4)] | None = None
    swift: Swift = setting(default_factory=Swift)  # more is kept where the flow is swift
    speed_share: PositiveShare = 0.85  # of the robot's speed limit; the rest is left to the controller
    policy_share: PositiveShare = 1.0  # of the robot's speed limit in the route's time to go: a policy keeps no reserve
    # Of that margin in the time to go. Against the flow the fastest way is along the wall, and a policy, which no
    # reference drags there, keeps off it by itself; a robot that tracks a route needs all of the margin.
    policy_margin_share: Share = 0.2
    # of the flow, by which it may be worse than believed; fewer where no way is left
    robust_deviations: Annotated[float, Range(0.0, 100.0)] = 1.0
    # one deviation of a flow that does not know its own, as a share of its speed
    flow_error_share: Annotated[float, Range(0.0, 10.0)] = 0.05
    # steps of astar_time and astar_length: 1, 2, 3 give 8, 16, 32 directions
    reach_px: Annotated[int, OneOf(1, 2, 3)] = 3
    paper_radius_px: Annotated[float, Range(1.0, 100.0)] = 3.5  # neighbours of astar_paper
    refine: bool = True  # the path of time_field and astar_time
    rrt: Rrt = setting(default_factory=Rrt)

    def plan(self, field: FlowField, start_um: ArrayLike, goal_um: ArrayLike, chip: Chip, robot: Robot) -> Route:
        """Route from start to goal, both (2,) um; stamp and request are 0.

        A reachable route may carry a remark in `reason`. A start too near to a wall is joined to the nearest
        place with room; where a channel leaves no room for the usual margin, half of it is kept, or none. A margin
        that was asked for is kept.

        Raises
        ------
        UsageError
            If the robot has no speed, a setting makes no sense, or field and chip do not fit together.
        FlowError
            If the field is not finite.
        """
        speed_um_s = planning_speed_um_s(self.speed_share, robot)
        self._check()
        start_at, goal_at = np.asarray(start_um, np.float64), np.asarray(goal_um, np.float64)
        margins = margins_um(self.clearance_margin_um, robot)
        drift = self.swift.drift(robot, robot.speed_limit_um_s)
        trouble = ""
        for margin_um in margins:
            space = open_space(chip, field, robot.radius_um, margin_um, drift)
            start, goal = attach_start(space, start_at), attach_goal(space, goal_at)
            trouble = start.trouble or goal.trouble or why_apart(space, start.node, goal.node)
            if not trouble:
                if self.method == "time_field":
                    route, deviations = self._by_time_field(space, field, start, goal, speed_um_s)
                    if route.reachable and self.cost == "time":
                        near = with_margin(space, self.policy_margin_share * margin_um)
                        route = self._with_policy(route, near, field, goal_at, deviations, robot)
                else:
                    route = self._by_nodes(space, field, start, goal, speed_um_s)
                lean = margin_remark(margin_um, margins)
                remarks = [lean, start.remark, goal.remark, route.reason]
                return replace(route, reason="; ".join(remark for remark in remarks if remark))
        if self.clearance_margin_um is not None:
            trouble = narrowest(space, start_at, goal_at) or trouble
        swift = too_swift(chip, field, start_at, goal_at, robot.radius_um, drift)
        return no_route(self.method, swift or trouble)

    def _check(self) -> None:
        if self.cost == "energy" and self.method != "time_field":
            raise UsageError(f"plan: {self.method} knows no energy; cost = 'energy' goes with method = 'time_field'")
        check_ranges(self, "plan")

    def _by_time_field(
        self, space: Space, field: FlowField, start: End, goal: End, speed_um_s: float
    ) -> tuple[Route, float]:
        """The route between two ends that geometry connects, and the deviations of the flow that it has to spare."""
        px = space.um_per_px
        idle_um_s = None
        if self.cost == "energy":
            idle_um_s = 0.5 * speed_um_s if self.idle_speed_um_s is None else float(self.idle_speed_um_s)
        area = int(space.free.sum())
        closest = next((k for few, k in _CLOSER if area < few and k * k * space.free.size <= _LARGEST_PX), 1)
        target = _place(space, goal.node) if goal.point is None else goal.point
        first = _place(space, start.node)
        if start.point is not None and space.room_at(start.point) >= space.need:
            first = start.point
        deviation = _deviation(space, field, self.flow_error_share)
        tries = tuple(dict.fromkeys((self.robust_deviations, 0.5 * self.robust_deviations, 0.0)))
        # Where nothing is found, half a pixel may decide: looked at more closely before anything is given up.
        for deviations, closer in itertools.product(tries, (closest, 2 * closest)):
            terrain = _terrain(space, speed_um_s / px, deviations * deviation, idle_um_s)
            fine = terrain.finer(closer)
            times = time_field(fine, closer * target)
            path = None
            if np.isfinite(times[::closer, ::closer].ravel()[start.node]):
                path = descend(fine, times, closer * first, closer * target)
            if path is not None:
                path = path / closer
            elif deviations == 0.0 and closer > closest:
                path = self._search(space, "astar_time", start.node, goal.node, speed_um_s / px)
            if path is None:
                continue
            route = self._refined(terrain, field, joined_ends(space, path, start, goal), speed_um_s, idle_um_s, closer)
            if not route.reachable:
                continue
            if deviations < tries[0]:
                spared = f"{deviations:g} of {tries[0]:g} deviations of the flow" if deviations else "nothing"
                route = replace(route, reason=f"no way but against nearly all the robot has: {spared} to spare")
            return route, deviations
        return self._too_fast(space, field, start, goal, speed_um_s), 0.0

    def _with_policy(
        self, route: Route, space: Space, field: FlowField, goal_um: Points, deviations: float, robot: Robot
    ) -> Route:
        """The route with the time to go to its goal, also from where the robot is nearer to the walls than it may be.

        Where none is known from its start, the route is left as it is: better a path than no way.
        """
        px = space.um_per_px
        finest = max(math.isqrt(_LARGEST_PX // space.free.size), 1)
        closer = min(max(math.ceil(_POINTS_PER_RADIUS / space.radius), 1), _FINEST, finest)
        goal = attach_goal(space, goal_um)
        target = _place(space, goal.node) if goal.point is None else goal.point
        speed = planning_speed_um_s(self.policy_share, robot) / px
        fine = _terrain(space, speed, deviations * _deviation(space, field, self.flow_error_share), None).finer(closer)
        times = time_field(fine, closer * target)
        clearance = closer * interpolated(space.clearance, closer)
        policy = with_band(times, fine.free, clearance, fine.need, closer * speed).astype(np.float32)
        column, row = np.rint(closer * route.waypoints_um[0] / px).astype(int)
        if not np.isfinite(policy[row, column]):
            return route
        return replace(route, time_to_go_s=policy, time_to_go_um_per_px=px / closer)

    def _refined(
        self,
        terrain: Terrain,
        field: FlowField,
        path: Points,
        speed_um_s: float,
        idle_um_s: float | None,
        closer: int = 1,
    ) -> Route:
        """The timed route along a path (n, 2) px after its refinement, or before it where that can not be done."""
        px = field.um_per_px
        if self.refine:
            even = np.ones_like(terrain.clearance)
            flow = (
                terrain.clearance,
                terrain.need,
                terrain.vx,
                terrain.vy,
                even,
                terrain.speed,
                terrain.idle,
                SPACING_PX / closer,
            )
            route = timed_route(self.method, field, relax(path, *flow) * px, speed_um_s, "", idle_um_s)
            if route.reachable:
                return route
        return timed_route(self.method, field, path * px, speed_um_s, "", idle_um_s)

    def _by_nodes(self, space: Space, field: FlowField, start: End, goal: End, speed_um_s: float) -> Route:
        """The route between two ends that geometry connects, by one of the methods it is compared with."""
        px = space.um_per_px
        nodes = self._search(space, self.method, start.node, goal.node, speed_um_s / px)
        if nodes is None:
            if self.method.startswith("rrt"):
                return no_route(self.method, f"{self.method} found no way in {self.rrt.iterations} iterations")
            return self._too_fast(space, field, start, goal, speed_um_s)
        path = joined_ends(space, nodes, start, goal)
        if self.method == "astar_time":
            return self._refined(_terrain(space, speed_um_s / px, 0.0, None), field, path, speed_um_s, None)
        return timed_route(self.method, field, path * px, speed_um_s, "")

    def _too_fast(self, space: Space, field: FlowField, start: End, goal: End, speed_um_s: float) -> Route:
        shortest = self._search(space, "astar_length", start.node, goal.node, 1.0)
        assert shortest is not None, "free pixels that touch are joined by edges"
        return no_route(self.method, too_fast(field, shortest * space.um_per_px, speed_um_s))

    def _search(self, space: Space, method: Method, start: int, goal: int, speed: float) -> Points | None:
        """(n, 2) points from node to node, None when the search finds no way; speed in px/s."""
        if method in ("rrt", "rrt_star"):
            return self.rrt.search(
                space, _place(space, start), _place(space, goal), speed if method == "rrt_star" else None
            )
        if method == "astar_paper":
            rows, columns = np.nonzero(space.free)
            nodes = np.column_stack([columns, rows]).astype(np.float64)
            number = {int(flat): k for k, flat in enumerate(rows * space.width + columns)}
            velocity = np.column_stack([space.vx[rows, columns], space.vy[rows, columns]])
            edges = adjacency(nodes, self.paper_radius_px, space.clearance, space.need)
            chain = search_paper(nodes, velocity, edges, number[start], number[goal], speed)
            return nodes[chain] if len(chain) else None
        cost, parent = search(
            space.free,
            space.clearance,
            space.need,
            space.vx,
            space.vy,
            np.ones_like(space.clearance),
            directions(self.reach_px),
            start,
            goal,
            speed,
            method == "astar_time",
        )
        return backtrack(parent, goal, space.width) if np.isfinite(cost[goal]) else None


def _terrain(space: Space, speed: float, deviation: NDArray[np.float64] | float, idle_um_s: float | None) -> Terrain:
    """What time_field searches: the space for a robot whose speed (px/s) must also outdo so much of the flow."""
    # Where the flow is not known to within the robot's speed, a little is left: nothing is known against drifting.
    left = np.maximum(np.full_like(space.clearance, speed) - deviation, _LEAST_SHARE * speed)
    idle = -1.0 if idle_um_s is None else idle_um_s / space.um_per_px
    return Terrain(space.free, space.room, space.need, space.vx, space.vy, left, idle)


def _deviation(space: Space, field: FlowField, flow_error_share: float) -> NDArray[np.float64]:
    """(h, w) px/s one standard deviation of the flow in its worst direction, as the field states it, else a share."""
    if field.std_um_s is not None:
        return np.asarray(field.std_um_s.max(axis=-1) / field.um_per_px, np.float64)
    return flow_error_share * np.sqrt(space.vx * space.vx + space.vy * space.vy)


def _place(space: Space, node: int) -> Points:
    """(2,) px of a node."""
    return np.array([node % space.width, node // space.width], np.float64)
