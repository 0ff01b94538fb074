"""Ways of all surveys: candidate places in the middle of the channels, paths to them, and their routes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up

from flowrec.core import Floats, FlowField, Ints, Route
from flowrec.physics import Chip, distance_px
from flowrec.stages.planning.cost_rasters import Mask, Points, Raster
from flowrec.stages.planning.free_space import FastFlowMargin, FreeSpace, spaces_by_margin
from flowrec.stages.planning.grid_search import TRAVEL_TIME, directions, search
from flowrec.stages.planning.path_refinement import refine_path
from flowrec.stages.planning.problem import Endpoint, with_ends
from flowrec.stages.planning.route import timed_route, with_remarks
from flowrec.stages.planning.survey_design import SurveyOrder

METHOD = "survey"  # that the routes bear
_REACH_PX = 2  # of the search's edges


@dataclass(frozen=True, slots=True)
class SurveyWays:
    """The settings that all methods have, and the ways that follow from them.

    A method has `plan(order)`: the route of the survey, or no route with its reason. `more` of the route says whether
    another stretch is to be asked for on the way; it then begins as the route that the order holds as `present`, with
    the same times.
    """

    speed_share: float
    clearance_margin_um: float | None
    swift: FastFlowMargin
    middle_pull: float
    outlet_gap_radii: float

    def by_margin(
        self, order: SurveyOrder, field: FlowField, speed_um_s: float, stretch: Callable[[FreeSpace], Route]
    ) -> Route:
        """The stretch with the largest margin that leaves a way for a robot of a speed; else the last refusal."""
        course_error = self.swift.course_error(order.robot, speed_um_s, field)
        for space, _, less in spaces_by_margin(order.chip, field, order.robot, self.clearance_margin_um, course_error):
            route = stretch(space)
            if route.reachable:
                return with_remarks(route, less)
        return route

    def weight(self, space: FreeSpace) -> Raster:
        """(h, w) factor on the cost of a pixel: `1 + pull` next to a wall, least in the middle of the channel."""
        return 1.0 + self.middle_pull * (space.need / np.maximum(space.clearance, space.need)) ** 2

    def far_from_openings(self, space: FreeSpace, chip: Chip) -> Mask:
        """(h, w) pixels so far from every opening that a route may end there."""
        y, x = np.indices(chip.mask.shape)
        far = np.ones(chip.mask.shape, np.bool_)
        for opening in chip.openings:
            far &= distance_px(opening, x, y, chip.mask.shape) >= self.outlet_gap_radii * space.radius
        return far

    def timed_stretch(
        self, space: FreeSpace, field: FlowField, path: Points, start: Endpoint, speed_um_s: float
    ) -> Route:
        """The timed route along a path (n, 2) px of nodes, off the pixels where that is possible."""
        px = space.um_per_px
        path = with_ends(space, path, start, None)
        rasters = space.cost_rasters(speed_um_s / px)._replace(clearance=space.clearance)
        for candidate in (refine_path(path, rasters, self.weight(space)), path):
            route = timed_route(METHOD, field, candidate * px, speed_um_s)
            if route.reachable:
                break
        return route


def fastest_ways(
    space: FreeSpace, speed: float, node: int, weight: Raster | None = None, deviation: Raster | float = 0.0
) -> tuple[Floats, Ints]:
    """Cost (h*w,) and parents (h*w,) of the fastest ways from a node for a robot of `speed` px/s."""
    return search(space, TRAVEL_TIME, directions(_REACH_PX), speed, node, weight=weight, deviation=deviation)


def central_among(allowed: Mask, clearance: Raster) -> Mask:
    """(h, w) allowed pixels near the middle of a channel, or all allowed ones where none is.

    Within two pixels of such a pixel none has more than one pixel more clearance.
    """
    central = allowed & (clearance >= scipy.ndimage.maximum_filter(clearance, 5) - 1.0)
    return central if central.any() else allowed
