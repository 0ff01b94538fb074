"""Where a robot may be: the pixels far enough from the walls, and how points are attached to them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from flowrec.chip import clearance_um
from flowrec.chip.chip import Chip
from flowrec.chip.places import distance_um
from flowrec.errors import FlowError, UsageError
from flowrec.flow import sample
from flowrec.interpolation import bilinear
from flowrec.messages import FlowField
from flowrec.planning.zermelo import line_is_clear
from flowrec.ranges import Range
from flowrec.robot import Robot

Points = NDArray[np.float64]
Raster = NDArray[np.float64]

# A mask can not tell more closely than this where a wall is; ends of a route are not refused for less.
_SLACK_PX = 0.5
_NEAR_PX = 2.0
_EIGHT = np.ones((3, 3), np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """Free pixels of a chip for one clearance, with the flow on them, all in pixels and seconds."""

    clearance: Raster  # (h, w) to the nearest wall, negative in solid
    fluid: NDArray[np.bool_]  # (h, w)
    free: NDArray[np.bool_]  # (h, w) where the robot's centre may be: the nodes
    radius: float  # of the robot
    need: float  # clearance of nodes and of long edges
    swept: Raster  # (h, w) px that the robot takes up with how far it may drift
    room: Raster  # (h, w) the clearance that counts: less by what is swept beyond `need`
    vx: Raster  # (h, w)
    vy: Raster  # (h, w)
    um_per_px: float

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.free.shape[1])

    def room_at(self, point: Points) -> float:
        """What counts of the clearance (px) at a point (x, y) in px."""
        return bilinear(self.room, float(point[0]), float(point[1]))

    def clearance_at(self, point: Points) -> float:
        """Clearance (px) at a point (x, y) in px."""
        return bilinear(self.clearance, float(point[0]), float(point[1]))


@dataclass(frozen=True, slots=True, eq=False)
class End:
    """One end of a route: its node, and the point itself where the robot can be there."""

    node: int  # flat index; -1 when there is trouble
    point: Points | None  # (2,) px
    remark: str = ""
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Drift:
    """How far a robot may get off its course before that is seen and put right.

    The map's error carries it off all through the blind time, from what the camera sees to its effect, and it does not
    roll quite where it is told to. And a heading is held for a frame, so a bend is cut: by w^2 / 8 r for the way w over
    ground in a frame and a bend of radius r, here the robot's diameter.
    """

    map_error: float = 0.0  # share of the flow's speed
    heading_error_rad: float = 0.0
    blind_s: float = 0.0
    frame_s: float = 0.0
    speed_um_s: float = 0.0  # the robot's own, through the fluid
    radius_um: float = 1.0  # of the robot

    def um(self, field: FlowField) -> Raster:
        """(h, w) so far."""
        velocity = field.velocity_um_s.astype(np.float64)
        flow = np.hypot(velocity[..., 0], velocity[..., 1])
        way = self.frame_s * (flow + self.speed_um_s)
        astray_um_s = self.map_error * flow + self.heading_error_rad * self.speed_um_s
        return np.asarray(self.blind_s * astray_um_s + way**2 / (16.0 * self.radius_um))


@dataclass(frozen=True, slots=True)
class Swift:
    """What makes a flow too swift to be steered in; times are set when a run is resolved, and 0 where nobody did."""

    # share of the flow's speed that the map is thought to be wrong by
    map_error: Annotated[float, Range(0.0, 10.0)] = 0.2
    # by which the robot is thought to roll off its heading: three of its sigmas
    heading_error_rad: Annotated[float, Range(0.0, 0.5 * math.pi)] = 0.1
    frame_s: Annotated[float, Range(0.0, 10.0)] | None = None  # None: the camera's
    latency_s: Annotated[float, Range(0.0, 10.0)] | None = None  # from command to motion; None: the robot's

    def drift(self, robot: Robot, speed_um_s: float) -> Drift:
        """Of a robot that swims at a speed."""
        frame_s, latency_s = self.frame_s or 0.0, self.latency_s or 0.0
        blind_s = frame_s + latency_s
        return Drift(self.map_error, self.heading_error_rad, blind_s, frame_s, speed_um_s, robot.radius_um)


def open_space(chip: Chip, field: FlowField, radius_um: float, margin_um: float, drift: Drift = Drift()) -> Space:
    """The space of a robot that keeps a margin from the walls, and as much as it may drift where that is more.

    Raises
    ------
    UsageError
        If field and chip are not of the same pixels.
    FlowError
        If the field is not finite.
    """
    if field.velocity_um_s.shape[:2] != chip.mask.shape or not math.isclose(field.um_per_px, chip.um_per_px):
        raise UsageError(
            f"plan: the flow field has {field.velocity_um_s.shape[:2]} pixels of {field.um_per_px:g} um, chip "
            f"{chip.name!r} has {chip.mask.shape} of {chip.um_per_px:g} um; solve the flow on this chip"
        )
    if not np.isfinite(field.velocity_um_s).all():
        raise FlowError(f"plan: the flow field ({field.method}) is not finite everywhere; no route can be timed in it")
    # A mask without walls has infinite clearance, which bilinear weights of 0 would turn into NaN.
    far_px = float(sum(chip.mask.shape))
    clearance = np.minimum(clearance_um(chip.mask, chip.um_per_px).astype(np.float64) / chip.um_per_px, far_px)
    need = float((radius_um + margin_um) / chip.um_per_px)
    swept = (radius_um + drift.um(field)) / chip.um_per_px
    room = clearance - np.maximum(swept - need, 0.0)
    return Space(
        clearance=clearance,
        fluid=np.ascontiguousarray(chip.mask),
        free=chip.mask & (room >= need),
        radius=float(radius_um) / chip.um_per_px,
        need=need,
        swept=swept,
        room=room,
        vx=np.ascontiguousarray(field.velocity_um_s[..., 0], np.float64) / chip.um_per_px,
        vy=np.ascontiguousarray(field.velocity_um_s[..., 1], np.float64) / chip.um_per_px,
        um_per_px=float(chip.um_per_px),
    )


def with_margin(space: Space, margin_um: float) -> Space:
    """The same space for a robot that keeps another margin from the walls."""
    need = space.radius + margin_um / space.um_per_px
    room = space.clearance - np.maximum(space.swept - need, 0.0)
    return replace(space, need=need, room=room, free=space.fluid & (room >= need))


def attach_start(space: Space, point_um: Points) -> End:
    """Join the place where the robot is to the nodes, even when the flow has pushed it too near to a wall."""
    return _attach(space, "start", point_um, max(3.0 * space.need, 3.0))


def attach_goal(space: Space, point_um: Points) -> End:
    """Join the goal to the nodes; a robot that can not stand there must come within its own radius of it."""
    return _attach(space, "goal", point_um, max(space.radius, 1.0))


def joined_ends(space: Space, nodes: Points, start: End, goal: End | None) -> Points:
    """The path (n, 2) px with its true ends instead of the nodes that are nearest to them.

    An end takes the place of all nodes so near to it that going there first would only be a detour, which a flow
    faster than the robot may even forbid; as long as it sees the one after them.
    """
    path = nodes
    for end in (start, goal):
        if end is not None and end.point is not None:
            path = np.concatenate([end.point[None], path[_first_needed(space, path, end.point) :]])
        path = path[::-1]
    return path


def _first_needed(space: Space, path: Points, point: Points) -> int:
    """Number of the place on a path (n, 2) to which an end goes first."""
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


def why_apart(space: Space, a: int, b: int) -> str:
    """Why two nodes are not connected, '' when they are; names the narrowest place of the widest way."""
    if _joined(space.free, a, b):
        return ""
    widest = _bottleneck(space.clearance, a, b)
    if widest < 0.0:
        return "no channel leads from start to goal"
    column, row = _narrowest_place(space.clearance, widest, a, b)
    px = space.um_per_px
    return (
        f"the channel is too narrow at {column * px:.0f},{row * px:.0f} um: half its width there is "
        f"{widest * px:.0f} um and the robot needs {space.need * px:.0f} um"
    )


def too_swift(chip: Chip, field: FlowField, start_um: Points, goal_um: Points, radius_um: float, drift: Drift) -> str:
    """Why a robot that geometry lets through can not be steered on its way, '' when it can; names the worst place."""
    wide = open_space(chip, field, radius_um, 0.0)
    swept = (radius_um + drift.um(field)) / chip.um_per_px
    a, b = attach_start(wide, start_um).node, attach_goal(wide, goal_um).node
    if a < 0 or b < 0 or not _joined(wide.free, a, b):
        return ""
    # How many times over there is room: the best way is the one whose worst place has most.
    room = np.where(wide.free, wide.clearance / swept, -1.0)
    widest = _bottleneck(room, a, b)
    if not 0.0 < widest < 1.0:
        return ""
    column, row = _narrowest_place(room, widest, a, b)
    px = wide.um_per_px
    flow_um_s = float(np.hypot(wide.vx[row, column], wide.vy[row, column])) * px
    return (
        f"too swift to be steered at {column * px:.0f},{row * px:.0f} um: in a flow of {flow_um_s:.0f} um/s and with "
        f"{drift.speed_um_s:.0f} um/s of its own the robot may be {drift.um(field)[row, column]:.0f} um off its course "
        f"before that is put right, and the walls leave {wide.clearance[row, column] * px - radius_um:.0f} um; less "
        "latency (robot.delay_s), more frames (camera.rate_hz) or a slower flow would do"
    )


def swept_out(chip: Chip, field: FlowField, start_um: Points, drift: Drift, ramp_s: float) -> str:
    """Why a robot at the start leaves through an outlet before the coils are up, '' when it does not.

    The speed that the coils can drive grows to `drift.speed_um_s` in `ramp_s`, and until the blind time is over nothing
    is driven.
    """
    x, y = np.asarray(start_um, np.float64)
    flow_um_s = float(np.hypot(*sample(field, (x, y))))
    swept_um = flow_um_s * (drift.blind_s + 0.5 * ramp_s * min(flow_um_s / drift.speed_um_s, 1.0))
    for opening in chip.openings:
        if opening.kind == "outlet" and distance_um(chip, opening, (x, y)) < swept_um + drift.radius_um:
            return (
                f"the start {x:.0f},{y:.0f} um is too near the outlet {opening.side} {opening.first}-{opening.last}: "
                f"a flow of {flow_um_s:.0f} um/s carries the robot {swept_um:.0f} um before the coils are up; start "
                "farther in, or shorten coils.ramp_s"
            )
    return ""


def no_room(chip: Chip, field: FlowField, start_um: Points, goal_um: Points, robot: Robot) -> str:
    """Why a robot does not fit through from start to goal (2,), however near to the walls; '' when it does."""
    space = open_space(chip, field, robot.radius_um, 0.0)
    start, goal = attach_start(space, start_um), attach_goal(space, goal_um)
    return start.trouble or goal.trouble or why_apart(space, start.node, goal.node)


def narrowest(space: Space, start_um: Points, goal_um: Points) -> str:
    """What `why_apart` says of the pixels of two places, whether there is room at them or not; '' outside the fluid."""
    h, w = space.free.shape
    pixels = []
    for place_um in (start_um, goal_um):
        if not np.isfinite(place_um).all():
            return ""
        column, row = np.rint(place_um / space.um_per_px).astype(int)
        if not (0 <= column < w and 0 <= row < h and space.fluid[row, column]):
            return ""
        pixels.append(int(row * w + column))
    return why_apart(space, pixels[0], pixels[1])


def _attach(space: Space, name: str, point_um: Points, within: float) -> End:
    point = point_um / space.um_per_px
    h, w = space.free.shape
    where = f"{name} {point_um[0]:.0f},{point_um[1]:.0f} um"
    if not (np.isfinite(point).all() and -0.5 <= point[0] <= w - 0.5 and -0.5 <= point[1] <= h - 0.5):
        return End(-1, None, trouble=f"{where} is outside the chip")
    room = space.clearance_at(point)
    if room <= 0.0:
        return End(-1, None, trouble=f"{where} is in a wall")
    if not space.free.any():
        return End(
            -1, None, trouble=f"no channel is wide enough: the robot needs {space.need * space.um_per_px:.0f} um"
        )
    node = _nearest_node(space, point, within)
    if node < 0:
        needs = f"the robot needs {space.need * space.um_per_px:.0f} um"
        return End(-1, None, trouble=f"{where} is {room * space.um_per_px:.0f} um from a wall and {needs}")
    if room >= min(space.need, space.radius) - _SLACK_PX:
        return End(node, point)
    remark = f"{where} is only {room * space.um_per_px:.0f} um from a wall: joined to the nearest place with room"
    # A start is where the robot is, so the route begins there all the same; a goal is replaced by its node.
    return End(node, point if name == "start" else None, remark)


def _nearest_node(space: Space, point: Points, within: float) -> int:
    """Flat index of the nearest node that is seen from a point through fluid; -1 if none is near."""
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


def _joined(allowed: NDArray[np.bool_], a: int, b: int) -> bool:
    """Whether two pixels (flat indices) are connected by allowed pixels, corners included."""
    parts = label(allowed, _EIGHT)[0].ravel()
    return bool(parts[a] == parts[b] != 0)


def _bottleneck(clearance: Raster, a: int, b: int) -> float:
    """The clearance (px) of the narrowest place on the widest way between two pixels; -1 without any way.

    It is one of the raster's values: bisection over them, one labelling a step.
    """
    flat = clearance.ravel()
    values = np.unique(flat[(flat > 0.0) & (flat <= min(flat[a], flat[b]))])
    if len(values) == 0 or not _joined(clearance >= values[0], a, b):
        return -1.0
    low, high = 0, len(values)
    while high - low > 1:
        middle = (low + high) // 2
        if _joined(clearance >= values[middle], a, b):
            low = middle
        else:
            high = middle
    return float(values[low])


def _narrowest_place(clearance: Raster, widest: float, a: int, b: int) -> tuple[int, int]:
    """The pixel (column, row) of just the bottleneck's clearance that lies most nearly between what it parts."""
    parts = label(clearance > widest, _EIGHT)[0]
    apart = np.zeros(clearance.shape)
    for node in (a, b):
        part = parts.ravel()[node]
        side = parts == part if part else np.arange(parts.size).reshape(parts.shape) == node
        apart += distance_transform_edt(~side)
    row, column = divmod(int(np.argmin(np.where(clearance == widest, apart, np.inf))), clearance.shape[1])
    return column, row


def margins_um(wanted_um: float | None, robot: Robot) -> tuple[float, ...]:
    """Clearances beside the robot's radius, to be tried in turn: what was asked for, else half of it, less, none."""
    return (0.5 * robot.radius_um, 0.25 * robot.radius_um, 0.0) if wanted_um is None else (wanted_um,)


def margin_remark(margin_um: float, tried_um: tuple[float, ...]) -> str:
    """What to say of a margin that had to be given up; '' for the one that was wanted."""
    if margin_um >= tried_um[0]:
        return ""
    return f"no room for the margin of {tried_um[0]:.0f} um, {margin_um:.0f} um kept"
