"""A planning problem: free space, flow, robot speed, and the two ends joined to the nodes of the free space."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowrec.core import FlowField, Route, bilinear
from flowrec.physics import Robot
from flowrec.stages.planning.cost_rasters import Points
from flowrec.stages.planning.free_space import FreeSpace
from flowrec.stages.planning.kernels import line_is_clear
from flowrec.stages.planning.route import timed_route

# A mask does not locate a wall better than this; an end of a route is not refused for less.
_WALL_TOLERANCE_PX = 0.5
_NEAR_PX = 2.0  # nodes so near to an end may be left out: a diagonal and a half


@dataclass(frozen=True, slots=True, eq=False)
class Endpoint:
    """One end of a route: its node, and the point itself where the robot can be there."""

    node: int  # flat index; -1 with an error
    point: Points | None  # (2,) px
    remark: str = ""
    error: str = ""

    def place(self, space: FreeSpace) -> Points:
        """(2,) px: the point itself, or its node."""
        return space.pixel(self.node) if self.point is None else self.point


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Input of a planning method: start and goal are connected by free pixels."""

    method: str  # name that the route bears
    space: FreeSpace
    field: FlowField
    start: Endpoint
    goal: Endpoint
    goal_um: Points  # (2,) as asked for
    robot: Robot
    margin_um: float
    speed_um_s: float  # through the fluid, that the route may count on

    @property
    def speed(self) -> float:
        """`speed_um_s` in px/s."""
        return self.speed_um_s / self.space.um_per_px

    def with_ends(self, path: Points) -> Points:
        """A path (n, 2) px between the two nodes, with the true ends instead of the nodes."""
        return with_ends(self.space, path, self.start, self.goal)

    def timed(self, path: Points, idle_um_s: float | None = None) -> Route:
        """The timed route along a path (n, 2) px."""
        return timed_route(self.method, self.field, path * self.space.um_per_px, self.speed_um_s, idle_um_s)


def attach_start(space: FreeSpace, point_um: Points) -> Endpoint:
    """Join the place (2,) um where the robot is to a node, even where the flow has pushed it too near to a wall."""
    return _attach(space, "start", point_um, max(3.0 * space.need, 3.0))


def attach_goal(space: FreeSpace, point_um: Points) -> Endpoint:
    """Join the goal (2,) um to a node; a robot that can not be there must come within its own radius of it."""
    return _attach(space, "goal", point_um, max(space.radius, 1.0))


def with_ends(space: FreeSpace, path: Points, start: Endpoint, goal: Endpoint | None) -> Points:
    """A path (n, 2) px with the true ends instead of the nodes nearest to them.

    An end replaces all nodes near it whose successor is in a clear line from it: to go to such a node first is a
    detour, which a flow faster than the robot may even forbid.
    """
    for end in (start, goal):
        if end is not None and end.point is not None:
            path = np.concatenate([end.point[None], path[_first_needed(space, path, end.point) :]])
        path = path[::-1]
    return path


def _first_needed(space: FreeSpace, path: Points, point: Points) -> int:
    """Index of the node on a path (n, 2) to which an end goes first."""
    chosen = 0
    if np.allclose(path[0], point):
        return min(1, len(path) - 1)
    for k in range(1, len(path)):
        if np.hypot(*(path[k - 1] - point)) > _NEAR_PX:
            break
        x, y = path[k]
        if line_is_clear(space.clearance, float(point[0]), float(point[1]), float(x), float(y), space.need):
            chosen = k
    return chosen


def _attach(space: FreeSpace, name: str, point_um: Points, within: float) -> Endpoint:
    point = point_um / space.um_per_px
    h, w = space.free.shape
    where = f"{name} {point_um[0]:.0f},{point_um[1]:.0f} um"
    needs = f"the robot needs {space.need * space.um_per_px:.0f} um"
    if not (np.isfinite(point).all() and -0.5 <= point[0] <= w - 0.5 and -0.5 <= point[1] <= h - 0.5):
        return Endpoint(-1, None, error=f"{where} is outside the chip")
    clearance = bilinear(space.clearance, *point)
    clearance_um = clearance * space.um_per_px
    if clearance <= 0.0:
        return Endpoint(-1, None, error=f"{where} is in a wall")
    if not space.free.any():
        return Endpoint(-1, None, error=f"no channel is wide enough: {needs}")
    node = _nearest_node(space, point, within)
    if node < 0:
        return Endpoint(-1, None, error=f"{where} is {clearance_um:.0f} um from a wall and {needs}")
    if clearance >= min(space.need, space.radius) - _WALL_TOLERANCE_PX:
        return Endpoint(node, point)
    remark = f"{where} is only {clearance_um:.0f} um from a wall: joined to the nearest place with room"
    # The robot is at the start, so the route begins there all the same; a goal is replaced by its node.
    return Endpoint(node, point if name == "start" else None, remark)


def _nearest_node(space: FreeSpace, point: Points, within: float) -> int:
    """Flat index of the nearest node to which a straight line from a point stays in fluid; -1 if none is within."""
    x, y = float(point[0]), float(point[1])
    left, top = max(0, math.floor(x - within)), max(0, math.floor(y - within))
    window = space.free[top : math.ceil(y + within) + 1, left : math.ceil(x + within) + 1]
    rows, columns = np.nonzero(window)
    distances = np.hypot(columns + left - x, rows + top - y)
    for k in np.argsort(distances, kind="stable"):
        if distances[k] > within:
            break
        column, row = int(columns[k]) + left, int(rows[k]) + top
        if line_is_clear(space.clearance, x, y, float(column), float(row), 0.0):
            return row * space.width + column
    return -1
