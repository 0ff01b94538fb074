"""The survey downstream: a path with the flow, in the middle of the channel, over a limited distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flowrec.core import FlowField, Route
from flowrec.physics import Chip
from flowrec.stages.planning.free_space import FastFlowMargin, FreeSpace, spaces_by_margin
from flowrec.stages.planning.grid_search import TRAVEL_TIME, backtrack, directions, search
from flowrec.stages.planning.path_refinement import refine_path
from flowrec.stages.planning.problem import attach_start, with_ends
from flowrec.stages.planning.route import no_route, planning_speed_um_s, timed_route
from flowrec.stages.planning.survey_design import METHOD, SurveyOrder
from flowrec.stages.planning.survey_places import central_pixels, far_from_openings, middle_weight

# Default length of the survey, as a fraction of the path with the largest work of the flow.
_SHARE, _SHARE_WITH_JUNCTIONS = 0.125, 0.5


@dataclass(frozen=True, slots=True)
class Downstream:
    """A path with the flow that brings the robot past as much of it as the distance allows.

    A streamline may end in a stagnation point or circle behind a step. So every node is reached on its fastest path
    from the start (Dijkstra's algorithm on travel time, at a higher cost near walls), and of the paths short enough the
    one is taken with the largest work of the flow, the integral of v . dl. It follows the main stream through every
    junction and can neither stop nor circle. Its fields are settings of the survey.
    """

    distance_um: float | None
    share: float | None
    speed_share: float
    clearance_margin_um: float | None
    swift: FastFlowMargin
    middle_pull: float
    outlet_gap_radii: float

    def plan(self, order: SurveyOrder) -> Route:
        """The one stretch of this survey."""
        chip, robot, field = order.chip, order.robot, order.field
        speed_um_s = planning_speed_um_s(self.speed_share, robot)
        course_error = self.swift.course_error(robot, speed_um_s, field)
        for space, _, less in spaces_by_margin(chip, field, robot, self.clearance_margin_um, course_error):
            route = self._downstream(space, field, order.start_um, chip, speed_um_s, self.distance_um)
            if route.reachable:
                return replace(route, reason="; ".join(filter(None, (less, route.reason))))
        return route

    def _downstream(
        self,
        space: FreeSpace,
        field: FlowField,
        start_um: NDArray[np.float64],
        chip: Chip,
        speed_um_s: float,
        limit_um: float | None,
    ) -> Route:
        start = attach_start(space, start_um)
        if start.error:
            return no_route(METHOD, start.error)
        px = space.um_per_px
        weight = middle_weight(space, self.middle_pull)
        cost, parent = search(space, TRAVEL_TIME, directions(2), speed_um_s / px, start.node, weight=weight)
        length, work = _along_tree(cost, parent, space)
        far = far_from_openings(chip, self.outlet_gap_radii * space.radius)
        allowed = np.isfinite(cost) & (work > 0.0) & far.ravel()
        allowed[start.node] = False
        if not allowed.any():
            return no_route(METHOD, "nothing lies downstream of the start before the chip ends")
        by_junctions = _SHARE if len(chip.openings) <= 2 else _SHARE_WITH_JUNCTIONS
        share = self.share if self.share is not None else by_junctions
        limit_px = share * length[_most_work(work, allowed)] if limit_um is None else limit_um / px
        allowed &= length <= limit_px
        if not allowed.any():
            return no_route(
                METHOD, f"there is no place to survey within {limit_px * px:.0f} um downstream of the start"
            )
        central = allowed & central_pixels(space.clearance).ravel()
        end = _most_work(work, central if central.any() else allowed)
        path = with_ends(space, backtrack(parent, end, space.width), start, None)
        rasters = space.cost_rasters(speed_um_s / px)._replace(clearance=space.clearance)
        for candidate in (refine_path(path, rasters, weight), path):
            route = timed_route(METHOD, field, candidate * px, speed_um_s)
            if route.reachable:
                return replace(route, reason=start.remark)
        return route


def _along_tree(
    cost: NDArray[np.float64], parent: NDArray[np.int64], space: FreeSpace
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length (h*w,) in px and work of the flow (h*w,) in px2/s along the path to each node of the search's tree."""
    length, work = np.zeros(len(cost)), np.zeros(len(cost))
    vx, vy = space.vx.ravel(), space.vy.ravel()
    # A parent costs less than its children, so in the order of cost one pass is enough.
    for node in np.argsort(cost, kind="stable")[: int(np.isfinite(cost).sum())]:
        before = parent[node]
        if before < 0:
            continue
        dx = node % space.width - before % space.width
        dy = node // space.width - before // space.width
        length[node] = length[before] + np.hypot(dx, dy)
        work[node] = work[before] + 0.5 * (dx * (vx[node] + vx[before]) + dy * (vy[node] + vy[before]))
    return length, work


def _most_work(work: NDArray[np.float64], allowed: NDArray[np.bool_]) -> int:
    """The allowed node (flat index) with the largest work of the flow along its path."""
    return int(np.argmax(np.where(allowed, work, -np.inf)))
