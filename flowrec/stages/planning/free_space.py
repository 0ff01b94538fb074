"""Free space: the pixels where the robot's centre may be, and the flow on them.

A robot keeps its radius and a margin from the walls. Where the flow is fast it keeps more: as far as it may be off its
course before the camera has seen that and the controller has corrected it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import Floats, FlowError, FlowField, Range, UsageError
from flowrec.physics import COURSE, Chip, Robot, clearance_um
from flowrec.stages.planning.cost_rasters import CostRasters, Mask, Raster

_LEAST_SPEED_RATIO = 0.02  # of the robot's speed, left where the flow may be wrong by more than that speed


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """Free pixels of a chip for one robot and margin, with the flow on them; lengths in px, times in s."""

    clearance: Raster  # (h, w) distance to the nearest wall, negative in solid
    fluid: Mask  # (h, w)
    free: Mask  # (h, w) where the robot's centre may be: the nodes of a search
    radius: float  # of the robot
    need: float  # clearance of nodes and of long edges: radius and margin
    swept: Raster  # (h, w) radius of the robot and its course error
    usable_clearance: Raster  # (h, w) clearance, less by what `swept` exceeds `need`
    vx: Raster  # (h, w) px/s
    vy: Raster  # (h, w) px/s
    um_per_px: float

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.free.shape[1])

    def pixel(self, node: int) -> Floats:
        """(2,) px of a node, which is a flat index of the rasters."""
        return np.array([node % self.width, node // self.width], np.float64)

    def with_reserves(self, course_share: float, margin_um: float) -> FreeSpace:
        """The free space of a robot that keeps a fraction of the course error and another margin from the walls."""
        less = replace(self, swept=self.radius + course_share * (self.swept - self.radius))
        return less.with_need(self.radius + margin_um / self.um_per_px)

    def with_need(self, need: float) -> FreeSpace:
        """The free space of a robot that needs another clearance (px)."""
        usable = self.clearance - np.maximum(self.swept - need, 0.0)
        return replace(self, need=need, usable_clearance=usable, free=self.fluid & (usable >= need))

    def cost_rasters(
        self, speed: float, deviation: Raster | float = 0.0, idle_um_s: float | None = None
    ) -> CostRasters:
        """Rasters of a search, for a robot of `speed` (px/s) of which `deviation` (px/s) is kept against a worse flow.

        Where the deviation exceeds the speed a little speed is left: no speed helps against an unknown flow.
        """
        left = np.maximum(np.full_like(self.clearance, speed) - deviation, _LEAST_SPEED_RATIO * speed)
        idle = -1.0 if idle_um_s is None else idle_um_s / self.um_per_px
        return CostRasters(self.free, self.usable_clearance, self.need, self.vx, self.vy, left, idle)


@dataclass(frozen=True, slots=True)
class CourseError:
    """Largest distance of a robot from its course before that is seen and corrected.

    The error of the map and of the heading act during the blind time, from what the camera sees to the effect of the
    correction. And as a heading is held for a frame, a bend is cut: by s^2 / 8 r for the way s over ground in a frame
    and a bend of radius r, here the robot's diameter.
    """

    map_error: float = 0.0  # ratio to the flow's speed
    heading_error_rad: float = 0.0
    blind_s: float = 0.0
    frame_s: float = 0.0
    speed_um_s: float = 0.0  # the robot's own, through the fluid
    radius_um: float = 1.0  # of the robot

    def um(self, field: FlowField) -> Raster:
        """(h, w) course error in um."""
        velocity = field.velocity_um_s.astype(np.float64)
        flow = np.hypot(velocity[..., 0], velocity[..., 1])
        way = self.frame_s * (flow + self.speed_um_s)
        off_um_s = self.map_error * flow + self.heading_error_rad * self.speed_um_s
        return self.blind_s * off_um_s + way**2 / (16.0 * self.radius_um)


@dataclass(frozen=True, slots=True)
class FastFlowMargin:
    """Settings of the course error; the times are filled in when a run is resolved, and are 0 before."""

    # ratio of the map's error to the flow's speed; None: from the map
    map_error: Annotated[float, Range(0.0, 10.0)] | None = None
    # three standard deviations of the rolling direction
    heading_error_rad: Annotated[float, Range(0.0, 1.5708)] = 0.1
    frame_s: Annotated[float, Range(0.0, 10.0)] | None = None  # time between two images; None: the camera's
    latency_s: Annotated[float, Range(0.0, 10.0)] | None = None  # time from command to motion; None: the robot's

    def course_error(self, robot: Robot, speed_um_s: float, field: FlowField | None = None) -> CourseError:
        """The course error of a robot that swims at a speed; without a field that of a map whose error is not known."""
        frame_s, latency_s = self.frame_s or 0.0, self.latency_s or 0.0
        map_error = COURSE.of(field, self.map_error)
        return CourseError(map_error, self.heading_error_rad, frame_s + latency_s, frame_s, speed_um_s, robot.radius_um)


def open_space(
    chip: Chip, field: FlowField, radius_um: float, margin_um: float, course_error: CourseError = CourseError()
) -> FreeSpace:
    """The free space of a robot that keeps a margin from the walls, or its course error where that is more.

    Raises
    ------
    UsageError
        If field and chip do not have the same pixels.
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
    px = float(chip.um_per_px)
    # A mask without walls has infinite clearance, which bilinear weights of 0 would turn into NaN.
    clearance = np.minimum(clearance_um(chip.mask, px).astype(np.float64) / px, float(sum(chip.mask.shape)))
    vx, vy = (np.ascontiguousarray(field.velocity_um_s[..., c], np.float64) / px for c in (0, 1))
    fluid = np.ascontiguousarray(chip.mask)
    swept = (radius_um + course_error.um(field)) / px
    radius = float(radius_um) / px
    space = FreeSpace(clearance, fluid, fluid, radius, radius, swept, clearance, vx, vy, px)
    return space.with_need(float((radius_um + margin_um) / px))


def spaces_by_margin(
    chip: Chip, field: FlowField, robot: Robot, wanted_um: float | None, course_error: CourseError
) -> Iterator[tuple[FreeSpace, float, str]]:
    """Free space, margin in um and remark for each margin to try in turn.

    That is the wanted margin; if none is given, half of the robot's radius, a quarter, none. Errors as `open_space`.
    """
    radius_um = robot.radius_um
    margins = (0.5 * radius_um, 0.25 * radius_um, 0.0) if wanted_um is None else (wanted_um,)
    for margin_um in margins:
        less = f"no room for the margin of {margins[0]:.0f} um, {margin_um:.0f} um kept"
        yield (
            open_space(chip, field, radius_um, margin_um, course_error),
            margin_um,
            less if margin_um < margins[0] else "",
        )
