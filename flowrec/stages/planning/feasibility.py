"""Error texts for routes that do not exist: the narrowest place, or where the flow is too fast to steer."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up

from flowrec.core import FlowField
from flowrec.physics import Chip, Robot, distance_um, sample
from flowrec.stages.planning.cost_rasters import Mask, Points, Raster
from flowrec.stages.planning.free_space import CourseError, FreeSpace, open_space
from flowrec.stages.planning.problem import Endpoint, attach_goal, attach_start

_EIGHT = np.ones((3, 3), np.int64)


def joined_ends(space: FreeSpace, start_um: Points, goal_um: Points) -> tuple[Endpoint, Endpoint, str]:
    """Start and goal (2,), joined to nodes; and the error text if one of them is not, or they are not connected."""
    start, goal = attach_start(space, start_um), attach_goal(space, goal_um)
    return start, goal, start.error or goal.error or why_apart(space, start.node, goal.node)


def why_apart(space: FreeSpace, a: int, b: int) -> str:
    """Error text if two nodes are not connected, else ''; names the narrowest place of the widest way."""
    if _are_connected(space.free, a, b):
        return ""
    widest = _bottleneck(space.clearance, a, b)
    if widest < 0.0:
        return "no channel leads from start to goal"
    column, row = _bottleneck_pixel(space.clearance, widest, a, b)
    px = space.um_per_px
    return (
        f"the channel is too narrow at {column * px:.0f},{row * px:.0f} um: half its width there is "
        f"{widest * px:.0f} um and the robot needs {space.need * px:.0f} um"
    )


def too_swift(chip: Chip, field: FlowField, start_um: Points, goal_um: Points, course_error: CourseError) -> str:
    """Error text if the flow is too fast to control the robot along the way, else ''; names the worst place.

    The worst place is where the clearance is the smallest multiple of what the robot and its course error take.
    """
    radius_um = course_error.radius_um
    wide = open_space(chip, field, radius_um, 0.0)
    off_um = course_error.um(field)
    a, b = attach_start(wide, start_um).node, attach_goal(wide, goal_um).node
    if a < 0 or b < 0 or not _are_connected(wide.free, a, b):
        return ""
    multiple = np.where(wide.free, wide.clearance / ((radius_um + off_um) / chip.um_per_px), -1.0)
    widest = _bottleneck(multiple, a, b)
    if not 0.0 < widest < 1.0:
        return ""
    column, row = _bottleneck_pixel(multiple, widest, a, b)
    px = wide.um_per_px
    flow_um_s = float(np.hypot(wide.vx[row, column], wide.vy[row, column])) * px
    return (
        f"too swift to be steered at {column * px:.0f},{row * px:.0f} um: in a flow of {flow_um_s:.0f} um/s and with "
        f"{course_error.speed_um_s:.0f} um/s of its own the robot may be {off_um[row, column]:.0f} um off its course "
        f"before that is put right, and the walls leave {wide.clearance[row, column] * px - radius_um:.0f} um; less "
        "latency (robot.delay_s), more frames (camera.rate_hz) or a slower flow would do"
    )


def swept_out(chip: Chip, field: FlowField, start_um: Points, course_error: CourseError, ramp_s: float) -> str:
    """Error text if a robot at the start leaves through an outlet before the coils are up, else ''.

    The speed that the coils can drive grows to `course_error.speed_um_s` within `ramp_s`, after the blind time.
    """
    x, y = np.asarray(start_um, np.float64)
    flow_um_s = float(np.hypot(*sample(field, (x, y))))
    swept_um = flow_um_s * (course_error.blind_s + 0.5 * ramp_s * min(flow_um_s / course_error.speed_um_s, 1.0))
    for opening in chip.openings:
        if opening.kind == "outlet" and distance_um(chip, opening, (x, y)) < swept_um + course_error.radius_um:
            return (
                f"the start {x:.0f},{y:.0f} um is too near the outlet {opening.side} {opening.first}-{opening.last}: "
                f"a flow of {flow_um_s:.0f} um/s carries the robot {swept_um:.0f} um before the coils are up; start "
                "farther in, or shorten coils.ramp_s"
            )
    return ""


def no_room(chip: Chip, field: FlowField, start_um: Points, goal_um: Points, robot: Robot) -> str:
    """Error text if a robot does not fit through from start to goal (2,) even without a margin, else ''."""
    return joined_ends(open_space(chip, field, robot.radius_um, 0.0), start_um, goal_um)[2]


def narrowest(space: FreeSpace, start_um: Points, goal_um: Points) -> str:
    """`why_apart` for the pixels of two places, free or not; '' outside the fluid."""
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


def _are_connected(allowed: Mask, a: int, b: int) -> bool:
    """True if two pixels (flat indices) are connected by allowed pixels, corners included."""
    parts = scipy.ndimage.label(allowed, _EIGHT)[0].ravel()
    return bool(parts[a] == parts[b] != 0)


def _bottleneck(clearance: Raster, a: int, b: int) -> float:
    """The lowest clearance on the way between two pixels whose lowest is largest; -1 if there is no way.

    It is one of the raster's values: bisection over them, one labelling a step.
    """
    flat = clearance.ravel()
    values = np.unique(flat[(flat > 0.0) & (flat <= min(flat[a], flat[b]))])
    if len(values) == 0 or not _are_connected(clearance >= values[0], a, b):
        return -1.0
    too_high = range(1, len(values))
    return float(values[bisect_left(too_high, True, key=lambda k: not _are_connected(clearance >= values[k], a, b))])


def _bottleneck_pixel(clearance: Raster, widest: float, a: int, b: int) -> tuple[int, int]:
    """(column, row) of the pixel of just the bottleneck's clearance that lies most nearly between the two sides."""
    parts = scipy.ndimage.label(clearance > widest, _EIGHT)[0]
    apart = np.zeros(clearance.shape)
    for node in (a, b):
        part = parts.ravel()[node]
        side = parts == part if part else np.arange(parts.size).reshape(parts.shape) == node
        apart += scipy.ndimage.distance_transform_edt(~side)
    row, column = divmod(int(np.argmin(np.where(clearance == widest, apart, np.inf))), clearance.shape[1])
    return column, row
