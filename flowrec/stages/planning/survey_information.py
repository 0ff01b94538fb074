"""The survey by information: the next stretch is the way that lowers the error of the flow most per second of travel.

From the start of the stretch a search finds the fastest way, in the middle of the channels, to everywhere. Its ends in
a number of places are compared, at several speeds, by the error that the flow would have after the observations on the
way (survey_design.py), in the flow along the ways to the goal and in the whole map. Only places are allowed from which
the goal can still be reached, even in a flow that is worse than believed, and where the robot can wait.

All this is on the chip. Routes, the start and the observations are where the camera measures them: where it shows the
channels by the most probable registration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flowrec.core import FlowField, Route
from flowrec.physics import FlowUncertainty, fluid_image
from flowrec.stages.planning.cost_rasters import Mask, Raster
from flowrec.stages.planning.free_space import FastFlowMargin, FreeSpace, spaces_by_margin
from flowrec.stages.planning.grid_search import TRAVEL_TIME, backtrack, best_first, directions
from flowrec.stages.planning.path_refinement import refine_path
from flowrec.stages.planning.problem import Endpoint, attach_goal, attach_start, with_ends
from flowrec.stages.planning.route import no_route, planning_speed_um_s, timed_route
from flowrec.stages.planning.survey_design import METHOD, Looks, Need, SurveyOrder, covariance_after
from flowrec.stages.planning.survey_memory import SurveyMemory
from flowrec.stages.planning.survey_places import central_pixels, far_from_openings, middle_weight

ENOUGH = "enough"  # the first word of the reason of a survey that is complete
_REACH_PX = 2  # of the search's edges
_SHORTEST_SHARE = 0.05  # of the crossing time: a stretch counts as if it took at least so long
_SHORTEST_RADII = 2.0  # distance of the end of a stretch from its start
_PATCH_RADII = 4.0  # about the width of a channel: looks so near to each other share the error of the model
_KEPT_TO_WAIT = 0.1  # of the robot's speed, where it waits

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """A way from the start of the stretch, and what it is worth."""

    path: Floats  # (n, 2) px
    speed_um_s: float
    duration_s: float
    error: float  # that the flow would have afterwards, relative


@dataclass(frozen=True, slots=True, eq=False)
class _Reach:
    """From where the goal can be reached."""

    togo_s: Floats  # (h*w,) s to the goal; inf: not from there
    waiting: Mask  # (h, w) where the robot is faster than the flow
    remark: str


@dataclass(frozen=True, slots=True)
class Information:
    """Its fields are settings of the survey."""

    speed_share: float
    clearance_margin_um: float | None
    swift: FastFlowMargin
    middle_pull: float
    outlet_gap_radii: float
    distance_um: float | None
    fast_share: float
    drift_share: float
    route_share: float
    detour_share: float
    robust_deviations: float
    model_share: float
    places: int
    worth: float
    memory_stretches: int

    def plan(self, order: SurveyOrder) -> Route:
        """The survey so far and its next stretch; the survey so far alone when no stretch is worth its time."""
        assert order.uncertainty is not None and order.sampling is not None and order.goal_um is not None
        believed = replace(
            order.field,
            velocity_um_s=fluid_image(order.chip.mask, order.uncertainty.mean_um_s.astype(np.float32)),
            error_share=order.uncertainty.error_share,
        )
        route = no_route(METHOD, "no stretch")
        # The margin is that of the fastest stretch.
        course_error = self.swift.course_error(order.robot, self.fast_share * order.robot.speed_limit_um_s, believed)
        for space, _, less in spaces_by_margin(
            order.chip, believed, order.robot, self.clearance_margin_um, course_error
        ):
            route = self._next(space, believed, order, order.uncertainty)
            if route.reachable:
                return replace(route, reason="; ".join(filter(None, (less, route.reason))))
        return route if order.present is None else _so_far(order.present, route.reason)

    def _next(self, space: FreeSpace, believed: FlowField, order: SurveyOrder, uncertainty: FlowUncertainty) -> Route:
        registration = uncertainty.registration
        start = attach_start(space, registration.on_chip(order.start_um[None])[0])
        if start.error:
            return no_route(METHOD, start.error)
        reach = self._reach(space, order, uncertainty, start)
        if reach is None:
            return no_route(METHOD, "in the flow as it is known, the goal can not be reached from here")
        looks, covariance = self._looks(space, order, uncertainty), uncertainty.covariance
        coming: Floats | None = None
        if order.present is not None:  # what the rest of it will show
            ahead = order.present.arrival_s >= order.progress_s
            rest = registration.on_chip(order.present.waypoints_um[ahead]), order.present.arrival_s[ahead]
            coming = looks.information(*rest)
            covariance, looks = covariance_after(covariance, coming), looks.after_way(*rest)
        need = self._need(space, order, uncertainty, start, reach)
        now = need.error(covariance, coming)
        finite = np.isfinite(reach.togo_s)
        crossing_s = float(reach.togo_s[finite].max(initial=1e-6))
        memory = SurveyMemory.of(order.present, uncertainty.mean_um_s, now, order.progress_s)
        trust = memory.trust(self.memory_stretches)
        best: _Stretch | None = None
        best_rate = self.worth / crossing_s
        for stretch in self._stretches(space, order, looks, covariance, coming, need, start, reach):
            took_s = max(stretch.duration_s, order.least_s, _SHORTEST_SHARE * crossing_s)
            rate = trust * (now - stretch.error) / took_s
            if rate > best_rate:
                best, best_rate = stretch, rate
        if best is None:
            said = f"{ENOUGH}: the flow is known to {100.0 * now:.1f} %, and no further stretch is worth its time"
            return no_route(METHOD, said) if order.present is None else _so_far(order.present, said)
        route = self._time_stretch(space, believed, best, start)
        if not route.reachable:
            return route
        said = f"from {100.0 * now:.1f} % to {100.0 * best.error:.1f} % of the flow in {route.arrival_s[-1]:.1f} s"
        remarks = filter(None, (start.remark, reach.remark, said))
        route = replace(route, waypoints_um=registration.to_measured(route.waypoints_um))
        route = replace(_join_stretch(order.present, route), reason="; ".join(remarks), more=True)
        return memory.with_stretch(route, best.error) if self.memory_stretches else route

    def _looks(self, space: FreeSpace, order: SurveyOrder, uncertainty: FlowUncertainty) -> Looks:
        """The observations so far."""
        assert order.sampling is not None
        patch_px = max(_PATCH_RADII * space.radius, 1.0)
        looks = Looks.none(uncertainty, order.sampling, order.chip, patch_px, self.model_share)
        made = order.observations
        if made is None or not len(made.std_um_s):
            return looks
        own = made.rolled_um_s if made.rolled_um_s is not None else np.zeros_like(made.flow_um_s)
        return looks.after_places(uncertainty.registration.on_chip(made.position_um), own)

    def _reach(
        self, space: FreeSpace, order: SurveyOrder, uncertainty: FlowUncertainty, start: Endpoint
    ) -> _Reach | None:
        """From where the goal can be reached, counting on a worse flow; None if not from the start."""
        px = space.um_per_px
        deviation = fluid_image(order.chip.mask, uncertainty.std_um_s.max(axis=1)) / px
        limit = order.robot.speed_limit_um_s / px
        flow = np.hypot(space.vx, space.vy)
        assert order.goal_um is not None
        goal = attach_goal(space, order.goal_um)
        if goal.error:
            return None
        speed = planning_speed_um_s(self.fast_share, order.robot) / px
        for deviations in dict.fromkeys((self.robust_deviations, 0.5 * self.robust_deviations, 0.0)):
            waiting = flow + deviations * deviation <= (1.0 - _KEPT_TO_WAIT) * limit
            # The way back in time: from the goal, against the flow.
            rasters = space.cost_rasters(speed, deviations * deviation)
            rasters = rasters._replace(clearance=space.clearance, vx=-space.vx, vy=-space.vy)
            togo, _ = best_first(rasters, np.ones_like(flow), TRAVEL_TIME, directions(_REACH_PX), goal.node, -1)
            if np.isfinite(togo[start.node]):
                fewer = deviations < self.robust_deviations
                return _Reach(togo, waiting, f"{deviations:g} deviations of the flow to spare" if fewer else "")
        return None

    def _need(
        self,
        space: FreeSpace,
        order: SurveyOrder,
        uncertainty: FlowUncertainty,
        start: Endpoint,
        reach: _Reach,
    ) -> Need:
        """The error of the map, and of the flow along the ways to the goal."""
        mask = order.chip.mask
        whole = np.ones(len(uncertainty.mean_um_s))
        if self.route_share == 0.0:
            return Need.of(uncertainty, (1.0, whole))
        speed = planning_speed_um_s(self.fast_share, order.robot) / space.um_per_px
        spent, _ = self._tree(space, speed, start, np.ones_like(space.clearance))
        total = spent + reach.togo_s
        fastest = float(reach.togo_s[start.node])
        longer = np.maximum(total - fastest, 0.0) / max(self.detour_share * fastest, 1e-9)
        along = np.where(np.isfinite(total), np.exp(-np.where(np.isfinite(total), longer, 0.0)), 0.0)
        return Need.of(
            uncertainty,
            (1.0 - self.route_share, whole),
            (self.route_share, along.reshape(mask.shape)[mask]),
        )

    def _tree(
        self, space: FreeSpace, speed: float, start: Endpoint, weight: Raster
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Cost (h*w,) and parents (h*w,) of the fastest ways from the start for a robot of `speed` px/s."""
        rasters = space.cost_rasters(speed)._replace(clearance=space.clearance)
        return best_first(rasters, weight, TRAVEL_TIME, directions(_REACH_PX), start.node, -1)

    def _stretches(
        self,
        space: FreeSpace,
        order: SurveyOrder,
        looks: Looks,
        covariance: Floats,
        ahead: Floats | None,
        need: Need,
        start: Endpoint,
        reach: _Reach,
    ) -> Iterator[_Stretch]:
        """The ways to compare: to each place, at each speed. `ahead`: what the rest of the present way will show."""
        px = space.um_per_px
        left_um = math.inf if self.distance_um is None else self.distance_um
        if order.present is not None:
            left_um -= _length(order.present.waypoints_um)
        weight = middle_weight(space, self.middle_pull)
        y, x = np.indices(space.free.shape)
        origin = space.pixel(start.node)
        away = np.hypot(x - origin[0], y - origin[1]) >= _SHORTEST_RADII * space.radius
        far = far_from_openings(order.chip, self.outlet_gap_radii * space.radius)
        allowed = far & away & reach.waiting & np.isfinite(reach.togo_s).reshape(far.shape)
        if not allowed.any():
            return
        shares = [self.speed_share, self.fast_share]
        if len(looks.uncertainty.rolled):
            shares.append(self.drift_share)
        for share in dict.fromkeys(shares):
            speed_um_s = planning_speed_um_s(share, order.robot)
            cost, parent = self._tree(space, speed_um_s / px, start, weight)
            reached = allowed & np.isfinite(cost).reshape(far.shape)
            for end in _spread(reached, space.clearance, self.places):
                path = backtrack(parent, end, space.width)
                arrival = _timing(space, path, speed_um_s / px)
                if arrival[-1] > order.left_s or _length(path) * px > left_um:
                    continue
                added = looks.information(path * px, arrival)
                after = covariance_after(covariance, added)
                error = need.error(after, added if ahead is None else ahead + added)
                yield _Stretch(path, speed_um_s, float(arrival[-1]), error)

    def _time_stretch(self, space: FreeSpace, believed: FlowField, stretch: _Stretch, start: Endpoint) -> Route:
        """The timed route of a stretch, off the pixels where that is possible."""
        px = space.um_per_px
        path = with_ends(space, stretch.path, start, None)
        rasters = space.cost_rasters(stretch.speed_um_s / px)._replace(clearance=space.clearance)
        route = no_route(METHOD, "")
        for candidate in (refine_path(path, rasters, middle_weight(space, self.middle_pull)), path):
            route = timed_route(METHOD, believed, candidate * px, stretch.speed_um_s)
            if route.reachable:
                break
        return route


def _spread(allowed: Mask, clearance: Raster, most: int) -> list[int]:
    """Flat indices of at most so many places in the middle of channels, evenly spread: one in each square cell."""
    central = allowed & central_pixels(clearance)
    rows, columns = np.nonzero(central if central.any() else allowed)
    depth = clearance[rows, columns]
    size = 2
    while True:
        cells = (rows // size) * allowed.shape[1] + columns // size
        order = np.lexsort((-depth, cells))  # the deepest of each cell first
        first = order[np.unique(cells[order], return_index=True)[1]]
        if len(first) <= most:
            return [int(rows[k] * allowed.shape[1] + columns[k]) for k in first]
        size += max(size // 2, 1)


def _length(path: Floats) -> float:
    """Length of a path (n, 2), in its units."""
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def _timing(space: FreeSpace, path: Floats, speed: float) -> Floats:
    """(n,) s at which a robot of `speed` px/s passes the nodes of a path (n, 2) px, on the flow of the nodes."""
    nodes = path.astype(np.intp)
    velocity = np.column_stack([space.vx[nodes[:, 1], nodes[:, 0]], space.vy[nodes[:, 1], nodes[:, 0]]])
    legs = np.diff(path, axis=0)
    length = np.hypot(legs[:, 0], legs[:, 1])
    unit = legs / length[:, None]
    flow = 0.5 * (velocity[1:] + velocity[:-1])
    along = (unit * flow).sum(axis=1)
    across = unit[:, 0] * flow[:, 1] - unit[:, 1] * flow[:, 0]
    ground = along + np.sqrt(np.maximum(speed**2 - across**2, 0.0))
    return np.concatenate([[0.0], np.cumsum(length / np.maximum(ground, 1e-3 * speed))])


def _join_stretch(present: Route | None, stretch: Route) -> Route:
    """The present way, with its times, and the stretch behind it."""
    if present is None:
        return stretch
    return replace(
        stretch,
        waypoints_um=np.concatenate([present.waypoints_um, stretch.waypoints_um[1:]]),
        arrival_s=np.concatenate([present.arrival_s, present.arrival_s[-1] + stretch.arrival_s[1:]]),
    )


def _so_far(present: Route, reason: str) -> Route:
    """The present way without another stretch."""
    return replace(present, reason=reason, more=False)
