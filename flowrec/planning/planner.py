"""The planner stage: the way to a goal through a flow, or the honest answer that there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.chip.chip import Chip
from flowrec.messages import FlowField, Route
from flowrec.planning.lattice import backtrack, directions, search
from flowrec.planning.paper import adjacency, search_paper
from flowrec.planning.relax import relax
from flowrec.planning.routes import no_route, planning_speed_um_s, timed_route, too_fast
from flowrec.planning.space import (
    End,
    Space,
    Swift,
    attach_goal,
    attach_start,
    finer,
    margin_remark,
    margins_um,
    open_space,
    too_swift,
    why_apart,
)
from flowrec.planning.time_field import descend, time_field, with_band
from flowrec.planning.zermelo import line_is_clear
from flowrec.robot import Robot

Method = Literal["time_field", "astar_time", "astar_paper", "astar_length"]
Points = NDArray[np.float64]
_POINTS_PER_RADIUS = 3.0
_FINEST = 4


@dataclass(frozen=True, slots=True)
class Planner:
    """The fastest way through a flow (science.md, section 3), and beside it what it is compared with.

    time_field: the time to go from everywhere, the way down it, then a local refinement of the path. The route keeps
        the field: its slope is a policy, -grad T the best heading wherever the robot is pushed.
    astar_time: exact travel time on the pixels, admissible heuristic, then a local refinement of the path.
    astar_paper: cost and heuristic as the paper prints them, neighbours by K-D tree.
    astar_length: the shortest way, blind to the flow.
    """

    method: Method = "astar_time"
    clearance_margin_um: float | None = None  # kept from the walls beside the robot's radius; None: half of it
    speed_share: float = 0.85  # of the robot's speed limit; the rest is left to the controller
    policy_share: float = 1.0  # of the robot's speed limit in the route's time to go: a policy keeps no reserve
    # Of that margin in the time to go. Against the flow the fastest way is along the wall, and a policy, which no
    # reference drags there, keeps off it by itself; a robot that tracks a route needs all of the margin.
    policy_margin_share: float = 0.2
    swift: Swift = field(default_factory=Swift)  # more is kept where the flow is swift
    reach_px: int = 3  # steps of astar_time and astar_length: 1, 2, 3 give 8, 16, 32 directions
    paper_radius_px: float = 3.5  # neighbours of astar_paper
    refine: bool = True  # the path of time_field and astar_time

    def plan(self, field: FlowField, start_um: ArrayLike, goal_um: ArrayLike, chip: Chip, robot: Robot) -> Route:
        """Route from start to goal, both (2,) um; stamp and request are 0.

        A reachable route may carry a remark in `reason`. A start too near to a wall is joined to the nearest
        place with room; where a channel leaves no room for the margin, half of it is kept, or none.

        Raises
        ------
        UsageError
            If the robot has no speed, or field and chip do not fit together.
        FlowError
            If the field is not finite.
        """
        speed_um_s = planning_speed_um_s(self.speed_share, robot)
        start_at, goal_at = np.asarray(start_um, np.float64), np.asarray(goal_um, np.float64)
        margins = margins_um(self.clearance_margin_um, robot)
        drift = self.swift.drift(robot, robot.speed_limit_um_s)
        trouble = ""
        for margin_um in margins:
            space = open_space(chip, field, robot.radius, margin_um, drift)
            start, goal = attach_start(space, start_at), attach_goal(space, goal_at)
            trouble = start.trouble or goal.trouble or why_apart(space, start.node, goal.node)
            if not trouble:
                lean = margin_remark(margin_um, margins)
                route = self._through(space, field, start, goal, speed_um_s)
                if self.method == "time_field" and route.reachable:
                    near = open_space(chip, field, robot.radius, self.policy_margin_share * margin_um, drift)
                    route = replace(route, time_to_go_s=self._time_to_go(near, attach_goal(near, goal_at), robot))
                remarks = [lean, start.remark, goal.remark, route.reason]
                return replace(route, reason="; ".join(remark for remark in remarks if remark))
        swift = too_swift(chip, field, start_at, goal_at, robot.radius, drift)
        return no_route(self.method, swift or trouble)

    def _through(self, space: Space, field: FlowField, start: End, goal: End, speed_um_s: float) -> Route:
        """The route between two ends that geometry connects."""
        px = space.um_per_px
        nodes = self._search(space, self.method, start.node, goal.node, speed_um_s / px)
        if nodes is None:
            shortest = self._search(space, "astar_length", start.node, goal.node, 1.0)
            assert shortest is not None, "free pixels that touch are joined by edges"
            return no_route(self.method, too_fast(field, shortest * px, speed_um_s))
        path = _between(space, nodes, start, goal)
        if self.method in ("time_field", "astar_time") and self.refine:
            even = np.ones_like(space.clearance)
            refined = relax(path, space.clearance, space.need, space.vx, space.vy, even, speed_um_s / px)
            route = timed_route(self.method, field, refined * px, speed_um_s, "")
            if route.reachable:
                return route
        return timed_route(self.method, field, path * px, speed_um_s, "")

    def _time_to_go(self, space: Space, goal: End, robot: Robot) -> NDArray[np.float32]:
        """The policy (s), also where the robot is nearer to the walls than the route.

        In a channel of few pixels the way along the wall, which is the fastest against the flow, lies between them: so
        there are k points to a pixel, as many as make the robot's radius three, and four at most.
        """
        k = min(max(math.ceil(_POINTS_PER_RADIUS / space.radius), 1), _FINEST)
        at = k * (_place(space, goal.node) if goal.point is None else goal.point)
        fine = finer(space, k)
        speed = planning_speed_um_s(self.policy_share, robot) / fine.um_per_px
        every = np.full_like(fine.clearance, speed)
        times = time_field(fine.free, fine.clearance, fine.need, fine.vx, fine.vy, every, at)
        return with_band(times, fine.free, fine.fluid, speed).astype(np.float32)

    def _down(self, space: Space, start: int, goal: int, speed: float) -> Points | None:
        """(n, 2) the way down the time to go; None where that is infinite."""
        every = np.full_like(space.clearance, speed)
        flow = (space.clearance, space.need, space.vx, space.vy, every)
        first, last = _place(space, start), _place(space, goal)
        times = time_field(space.free, *flow, last, start)
        if not np.isfinite(times.ravel()[start]):
            return None
        path = descend(times, *flow, first, last)
        return self._search(space, "astar_time", start, goal, speed) if path is None else path

    def _search(self, space: Space, method: Method, start: int, goal: int, speed: float) -> Points | None:
        """(n, 2) points from node to node, None when the search finds no way; speed in px/s."""
        if method == "time_field":
            return self._down(space, start, goal, speed)
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
            method != "astar_length",
        )
        return backtrack(parent, goal, space.width) if np.isfinite(cost[goal]) else None


def _place(space: Space, node: int) -> Points:
    """(2,) px of a node."""
    return np.array([node % space.width, node // space.width], np.float64)


def _between(space: Space, nodes: Points, start: End, goal: End) -> Points:
    """The path (n, 2) px with its true ends, each in the place of its node where it sees the next one."""
    path = nodes
    for end in (start, goal):
        if end.point is not None:
            beyond = path[1] if len(path) > 1 else end.point
            (x0, y0), (x1, y1) = end.point, beyond
            sees = line_is_clear(space.clearance, x0, y0, x1, y1, space.need)
            path = np.concatenate([end.point[None], path[1:] if sees else path])
        path = path[::-1]
    return path
