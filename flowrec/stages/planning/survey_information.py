"""The survey by information: the next stretch is the way that lowers the error of the flow most per second of travel.

From the start of the stretch a search finds the fastest way, in the middle of the channels, to everywhere. Its ends in
a number of places are compared, at several speeds, by the error that the flow would have after the observations on the
way (survey_design.py), in the flow along the ways to the goal and in the whole map. Only places are allowed from which
the goal can still be reached, even in a flow that is worse than believed, and where the robot can wait.

All this is on the chip. Routes, the start and the observations are where the camera measures them: where it shows the
channels by the most probable registration.

The information gained on earlier stretches is compared with what was predicted of them.
Observations that lower the squared relative error of a flow from a^2 to b^2 move its most probable value: over all
observations that may be made, the mean square of that move is a^2 - b^2 (law of total variance). A model that is wrong
promises falls that do not come true: its stated error stays, and its map does not move. While one of the two does what
was expected, looking is still of use: a map that moves although its stated error does not fall is one that was doubted.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, FlowField, Route
from flowrec.physics import FlowUncertainty, fluid_image
from flowrec.stages.planning.cost_rasters import Mask, Points, Raster
from flowrec.stages.planning.free_space import FreeSpace
from flowrec.stages.planning.grid_search import backtrack
from flowrec.stages.planning.problem import Endpoint, attach_goal, attach_start
from flowrec.stages.planning.route import along_and_spare, no_route, planning_speed_um_s, with_remarks
from flowrec.stages.planning.survey_design import Looks, Need, Sampling, SurveyOrder, covariance_after
from flowrec.stages.planning.survey_ways import METHOD, SurveyWays, central_among, fastest_ways

MOST_PLACES = 500  # of a map of which the move is taken; it is as smooth as the modes of the flow
_STATED, _EXPECTED, _MOVED, _PROGRESS, _END = range(5)  # columns of `Route.stretches`


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMemory:
    """Earlier stretches of a survey, on which the choice of its next stretch depends."""

    stretches: Floats  # (m, 5) so far, as in `Route.stretches`
    flow_um_s: Floats  # (k, 2) most probable flow now, in some places
    stated: float  # relative error of the flow now
    moved: float  # by which the most probable flow has changed since the choice before, relative
    progress_s: float  # along the route now

    @classmethod
    def of(cls, present: Route | None, mean_um_s: Floats, stated: float, progress_s: float) -> SurveyMemory:
        """The memory in the present route, and what is believed now: flow (n, 2) and error."""
        flow = mean_um_s[:: len(mean_um_s) // MOST_PLACES + 1]
        before = None if present is None else present.survey_flow_um_s
        if present is None or before is None or present.stretches is None or before.shape != flow.shape:
            return cls(np.zeros((0, 5)), flow, stated, 0.0, progress_s)
        square = float((flow**2).sum())
        moved = np.sqrt(float(((flow - before) ** 2).sum()) / max(square, 1e-300))
        return cls(present.stretches, flow, stated, float(moved), progress_s)

    def trust(self, count: int) -> float:
        """Ratio, 0 to 1, of actual to predicted gain of the latest `count` stretches: the better of two ratios.

        The error has fallen by the difference of the least errors that were stated before them and since, because each
        observation moves what is stated up or down. The map has moved since; what was expected of a stretch counts by
        the part of it that was travelled in that time, because the next one is chosen before its end.
        """
        rows = len(self.stretches)
        if not 0 < count <= rows:
            return 1.0
        stated, expected = np.append(self.stretches[:, _STATED], self.stated), self.stretches[:, _EXPECTED]
        first = rows + 1 - count
        fall = float(stated[:first].min() - stated[first:].min())
        expected_fall = float((stated[:-1] - expected)[-count:].sum())
        moves = np.append(self.stretches[:, _MOVED], self.moved)[-count:]
        travelled = self._travelled_fractions(self.progress_s) - self._travelled_fractions(
            float(self.stretches[-count, _PROGRESS])
        )
        expected_square = float(travelled @ (stated[:-1] ** 2 - expected**2))
        square = float((moves**2).sum())
        return min(max(fall / max(expected_fall, 1e-300), square / max(expected_square, 1e-300), 0.0), 1.0)

    def _travelled_fractions(self, progress_s: float) -> Floats:
        """(m,) part of each stretch that lies before a place of the route."""
        end_s = self.stretches[:, _END]
        begin_s = np.concatenate([[0.0], end_s[:-1]])
        return np.clip((progress_s - begin_s) / (end_s - begin_s), 0.0, 1.0)

    def with_stretch(self, route: Route, expected: float) -> Route:
        """The route with this memory and one more stretch, after which an error is expected."""
        row = [self.stated, expected, self.moved, self.progress_s, route.lasts_s]
        return replace(route, stretches=np.concatenate([self.stretches, [row]]), survey_flow_um_s=self.flow_um_s)


ENOUGH = "enough"  # the first word of the reason of a survey that is complete
_SHORTEST_SHARE = 0.05  # of the crossing time: a stretch counts as if it took at least so long
_SHORTEST_RADII = 2.0  # distance of the end of a stretch from its start
_PATCH_RADII = 4.0  # about the width of a channel: looks so near to each other share the error of the model
_KEPT_TO_WAIT = 0.1  # of the robot's speed, where it waits


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """A way from the start of the stretch, and what it is worth."""

    path: Floats  # (n, 2) px
    speed_um_s: float
    duration_s: float
    error: float  # that the flow would have afterwards, relative


@dataclass(frozen=True, slots=True, eq=False)
class _Site:
    """The place where a stretch begins, and those from where the goal can be reached."""

    space: FreeSpace
    order: SurveyOrder
    uncertainty: FlowUncertainty
    start: Endpoint
    togo_s: Floats  # (h*w,) s to the goal; inf: not from there
    waiting: Mask  # (h, w) where the robot is faster than the flow
    remark: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Information(SurveyWays):
    """Its fields are settings of the survey."""

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
        uncertainty, sampling, goal_um = order.uncertainty, order.sampling, order.goal_um
        assert uncertainty is not None and sampling is not None and goal_um is not None
        believed = replace(
            order.field,
            velocity_um_s=fluid_image(order.chip.mask, uncertainty.mean_um_s.astype(np.float32)),
            error_share=uncertainty.error_share,
        )

        def stretch(space: FreeSpace) -> Route:
            start = attach_start(space, uncertainty.registration.on_chip(order.start_um[None])[0])
            if start.error:
                return no_route(METHOD, start.error)
            site = self._site(space, order, uncertainty, start, goal_um)
            if site is None:
                return no_route(METHOD, "in the flow as it is known, the goal can not be reached from here")
            return self._next(site, believed, self._looks(site, sampling))

        # The margin is that of the fastest stretch.
        route = self.by_margin(order, believed, self.fast_share * order.robot.speed_limit_um_s, stretch)
        return route if route.reachable else _so_far(order.present, route.reason)

    def _next(self, site: _Site, believed: FlowField, looks: Looks) -> Route:
        """The survey so far and the best next stretch from a site, after the looks so far."""
        order, registration, covariance = site.order, site.uncertainty.registration, site.uncertainty.covariance
        coming: Floats | None = None
        if order.present is not None:  # what the rest of it will show
            ahead = order.present.arrival_s >= order.progress_s
            rest = registration.on_chip(order.present.waypoints_um[ahead]), order.present.arrival_s[ahead]
            coming = looks.information(*rest)
            covariance, looks = covariance_after(covariance, coming), looks.after_way(*rest)
        need = self._need(site)
        now = need.error(covariance, coming)
        crossing_s = float(site.togo_s[np.isfinite(site.togo_s)].max(initial=1e-6))
        memory = SurveyMemory.of(order.present, site.uncertainty.mean_um_s, now, order.progress_s)
        trust = memory.trust(self.memory_stretches)
        best: _Stretch | None = None
        best_rate = self.worth / crossing_s
        for stretch in self._stretches(site, looks, covariance, coming, need):
            took_s = max(stretch.duration_s, order.least_s, _SHORTEST_SHARE * crossing_s)
            rate = trust * (now - stretch.error) / took_s
            if rate > best_rate:
                best, best_rate = stretch, rate
        if best is None:
            said = f"{ENOUGH}: the flow is known to {100.0 * now:.1f} %, and no further stretch is worth its time"
            return _so_far(order.present, said)
        route = self.timed_stretch(site.space, believed, best.path, site.start, best.speed_um_s)
        if not route.reachable:
            return route
        said = f"from {100.0 * now:.1f} % to {100.0 * best.error:.1f} % of the flow in {route.lasts_s:.1f} s"
        route = replace(route, waypoints_um=registration.to_measured(route.waypoints_um), reason=said, more=True)
        route = with_remarks(_join_stretch(order.present, route), site.start.remark, site.remark)
        return memory.with_stretch(route, best.error) if self.memory_stretches else route

    def _looks(self, site: _Site, sampling: Sampling) -> Looks:
        """The observations so far."""
        patch_px = max(_PATCH_RADII * site.space.radius, 1.0)
        looks = Looks.none(site.uncertainty, sampling, site.order.chip, patch_px, self.model_share)
        made = site.order.observations
        if made is None or not len(made.std_um_s):
            return looks
        own = made.rolled_um_s if made.rolled_um_s is not None else np.zeros_like(made.flow_um_s)
        return looks.after_places(site.uncertainty.registration.on_chip(made.position_um), own)

    def _site(
        self, space: FreeSpace, order: SurveyOrder, uncertainty: FlowUncertainty, start: Endpoint, goal_um: Points
    ) -> _Site | None:
        """From where the goal can be reached, counting on a worse flow; None if not from the start."""
        px = space.um_per_px
        deviation = fluid_image(order.chip.mask, uncertainty.std_um_s.max(axis=1)) / px
        limit = order.robot.speed_limit_um_s / px
        flow = np.hypot(space.vx, space.vy)
        goal = attach_goal(space, goal_um)
        if goal.error:
            return None
        speed = planning_speed_um_s(self.fast_share, order.robot) / px
        back = replace(space, vx=-space.vx, vy=-space.vy)  # in time: from the goal, against the flow
        for deviations in dict.fromkeys((self.robust_deviations, 0.5 * self.robust_deviations, 0.0)):
            togo, _ = fastest_ways(back, speed, goal.node, deviation=deviations * deviation)
            if np.isfinite(togo[start.node]):
                waiting = flow + deviations * deviation <= (1.0 - _KEPT_TO_WAIT) * limit
                fewer = deviations < self.robust_deviations
                remark = f"{deviations:g} deviations of the flow to spare" if fewer else ""
                return _Site(space, order, uncertainty, start, togo, waiting, remark)
        return None

    def _need(self, site: _Site) -> Need:
        """The error of the map, and of the flow along the ways to the goal."""
        mask = site.order.chip.mask
        whole = np.ones(len(site.uncertainty.mean_um_s))
        if self.route_share == 0.0:
            return Need.of(site.uncertainty, (1.0, whole))
        speed = planning_speed_um_s(self.fast_share, site.order.robot) / site.space.um_per_px
        total = fastest_ways(site.space, speed, site.start.node)[0] + site.togo_s
        fastest = float(site.togo_s[site.start.node])
        longer = np.maximum(total - fastest, 0.0) / max(self.detour_share * fastest, 1e-9)
        along = np.where(np.isfinite(total), np.exp(-np.where(np.isfinite(total), longer, 0.0)), 0.0)
        shares = (1.0 - self.route_share, whole), (self.route_share, along.reshape(mask.shape)[mask])
        return Need.of(site.uncertainty, *shares)

    def _stretches(
        self, site: _Site, looks: Looks, covariance: Floats, ahead: Floats | None, need: Need
    ) -> Iterator[_Stretch]:
        """The ways to compare: to each place, at each speed. `ahead`: what the rest of the present way will show."""
        space, order = site.space, site.order
        px = space.um_per_px
        left_um = math.inf if self.distance_um is None else self.distance_um
        if order.present is not None:
            left_um -= _length(order.present.waypoints_um)
        y, x = np.indices(space.free.shape)
        origin = space.pixel(site.start.node)
        away = np.hypot(x - origin[0], y - origin[1]) >= _SHORTEST_RADII * space.radius
        allowed = away & site.waiting & np.isfinite(site.togo_s).reshape(away.shape)
        allowed &= self.far_from_openings(space, order.chip)
        if not allowed.any():
            return
        shares = [self.speed_share, self.fast_share]
        if len(site.uncertainty.rolled):
            shares.append(self.drift_share)
        for share in dict.fromkeys(shares):
            speed_um_s = planning_speed_um_s(share, order.robot)
            cost, parent = fastest_ways(space, speed_um_s / px, site.start.node, self.weight(space))
            reached = allowed & np.isfinite(cost).reshape(allowed.shape)
            for end in _spread(reached, space.clearance, self.places):
                path = backtrack(parent, end, space.width)
                arrival = _timing(space, path, speed_um_s / px)
                if arrival[-1] > order.left_s or _length(path) * px > left_um:
                    continue
                added = looks.information(path * px, arrival)
                after = covariance_after(covariance, added)
                error = need.error(after, added if ahead is None else ahead + added)
                yield _Stretch(path, speed_um_s, float(arrival[-1]), error)


def _spread(allowed: Mask, clearance: Raster, most: int) -> list[int]:
    """Flat indices of at most so many places in the middle of channels, evenly spread: one in each square cell."""
    rows, columns = np.nonzero(central_among(allowed, clearance))
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
    along, spare = along_and_spare(0.5 * (velocity[1:] + velocity[:-1]), legs, speed)
    ground = along + np.sqrt(np.maximum(spare, 0.0))
    return np.concatenate([[0.0], np.cumsum(np.hypot(*legs.T) / np.maximum(ground, 1e-3 * speed))])


def _join_stretch(present: Route | None, stretch: Route) -> Route:
    """The present way, with its times, and the stretch behind it."""
    if present is None:
        return stretch
    return replace(
        stretch,
        waypoints_um=np.concatenate([present.waypoints_um, stretch.waypoints_um[1:]]),
        arrival_s=np.concatenate([present.arrival_s, present.arrival_s[-1] + stretch.arrival_s[1:]]),
    )


def _so_far(present: Route | None, reason: str) -> Route:
    """The present way without another stretch; no route where the survey has not begun."""
    return no_route(METHOD, reason) if present is None else replace(present, reason=reason, more=False)
