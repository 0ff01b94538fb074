"""The survey downstream: a path with the flow, in the middle of the channel, over a limited distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, Ints, Route
from flowrec.stages.planning.cost_rasters import Mask
from flowrec.stages.planning.free_space import FreeSpace
from flowrec.stages.planning.grid_search import backtrack
from flowrec.stages.planning.problem import attach_start
from flowrec.stages.planning.route import no_route, planning_speed_um_s, with_remarks
from flowrec.stages.planning.survey_design import SurveyOrder
from flowrec.stages.planning.survey_ways import METHOD, SurveyWays, central_among, fastest_ways

# Default length of the survey, as a fraction of the path with the largest work of the flow.
_SHARE, _SHARE_WITH_JUNCTIONS = 0.125, 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Downstream(SurveyWays):
    """A path with the flow that brings the robot past as much of it as the distance allows.

    A streamline may end in a stagnation point or circle behind a step. So every node is reached on its fastest path
    from the start (Dijkstra's algorithm on travel time, at a higher cost near walls), and of the paths short enough the
    one is taken with the largest work of the flow, the integral of v . dl. It follows the main stream through every
    junction and can neither stop nor circle. Its fields are settings of the survey.
    """

    distance_um: float | None
    share: float | None

    def plan(self, order: SurveyOrder) -> Route:
        """The one stretch of this survey."""
        speed_um_s = planning_speed_um_s(self.speed_share, order.robot)
        return self.by_margin(order, order.field, speed_um_s, lambda space: self._stretch(space, order, speed_um_s))

    def _stretch(self, space: FreeSpace, order: SurveyOrder, speed_um_s: float) -> Route:
        start = attach_start(space, order.start_um)
        if start.error:
            return no_route(METHOD, start.error)
        px = space.um_per_px
        cost, parent = fastest_ways(space, speed_um_s / px, start.node, self.weight(space))
        length, work = _along_tree(cost, parent, space)
        allowed = np.isfinite(cost) & (work > 0.0) & self.far_from_openings(space, order.chip).ravel()
        allowed[start.node] = False
        if not allowed.any():
            return no_route(METHOD, "nothing lies downstream of the start before the chip ends")
        if self.distance_um is not None:
            limit_px = self.distance_um / px
        else:
            by_junctions = _SHARE if len(order.chip.openings) <= 2 else _SHARE_WITH_JUNCTIONS
            limit_px = (by_junctions if self.share is None else self.share) * length[_most_work(work, allowed)]
        allowed &= length <= limit_px
        if not allowed.any():
            return no_route(
                METHOD, f"there is no place to survey within {limit_px * px:.0f} um downstream of the start"
            )
        central = central_among(allowed.reshape(space.free.shape), space.clearance)
        end = _most_work(work, central.ravel())
        route = self.timed_stretch(space, order.field, backtrack(parent, end, space.width), start, speed_um_s)
        return with_remarks(route, start.remark) if route.reachable else route


def _along_tree(cost: Floats, parent: Ints, space: FreeSpace) -> tuple[Floats, Floats]:
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


def _most_work(work: Floats, allowed: Mask) -> int:
    """The allowed node (flat index) with the largest work of the flow along its path."""
    return int(np.argmax(np.where(allowed, work, -np.inf)))
