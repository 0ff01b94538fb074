"""The survey's route: downstream along the assumed flow, in the middle of the channel, for a limited distance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

from flowrec.chip.chip import Chip, Opening
from flowrec.messages import FlowField, Route
from flowrec.planning.free_space import Space, Swift, attach_start, joined_ends, margin_remark, margins_um, open_space
from flowrec.planning.grid_search import backtrack, directions, search
from flowrec.planning.path_refinement import relax
from flowrec.planning.route import no_route, planning_speed_um_s, timed_route
from flowrec.ranges import PositiveShare, Range
from flowrec.robot import Robot

_METHOD = "survey"
Raster = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SurveyPlanner:
    """A drive with the flow that brings the robot past as much of it as the distance allows.

    Streamlines stop in stagnation and circle behind steps; so instead every node is reached on its fastest way from
    the start (Dijkstra on travel time, dearer near walls), and among the ways short enough the one is taken along
    which the flow helps most: the largest work of the flow, the integral of v . dl. It follows the main stream
    through every junction and can neither stop nor circle.
    """

    distance_um: Annotated[float, Range(1.0, 1e7)] | None = None  # None: the share below of the longest way downstream
    share: PositiveShare | None = None  # None: an eighth; half where several inlets or outlets are to be told apart
    # of the robot's speed limit: slower than travelling, for more to be seen on the way
    speed_share: PositiveShare = 0.5
    clearance_margin_um: Annotated[float, Range(0.0, 1e4)] | None = None  # None: half of the robot's radius
    swift: Swift = field(default_factory=Swift)  # as the planner's
    # how much dearer, as a share, a pixel next to the wall is than one in the middle
    middle_pull: Annotated[float, Range(0.0, 1e3)] = 2.0
    outlet_gap_radii: Annotated[float, Range(0.0, 1e3)] = 3.0  # left between the end of the route and any opening

    def plan(
        self, field: FlowField, start_um: ArrayLike, chip: Chip, robot: Robot, distance_um: float | None = None
    ) -> Route:
        """Route (stamp and request 0) downstream from a start (2,) um, at most `distance_um` long.

        Raises
        ------
        UsageError
            If the robot has no speed, or field and chip do not fit together.
        FlowError
            If the field is not finite.
        """
        speed_um_s = planning_speed_um_s(self.speed_share, robot)
        limit_um = distance_um if distance_um is not None else self.distance_um
        at = np.asarray(start_um, np.float64)
        margins = margins_um(self.clearance_margin_um, robot)
        drift = self.swift.drift(robot, speed_um_s)
        route = no_route(_METHOD, "")
        for margin_um in margins:
            space = open_space(chip, field, robot.radius_um, margin_um, drift)
            route = self._downstream(space, field, at, chip, speed_um_s, limit_um)
            if route.reachable:
                lean = margin_remark(margin_um, margins)
                return replace(route, reason="; ".join(remark for remark in (lean, route.reason) if remark))
        return route

    def _downstream(
        self,
        space: Space,
        field: FlowField,
        start_um: NDArray[np.float64],
        chip: Chip,
        speed_um_s: float,
        limit_um: float | None,
    ) -> Route:
        start = attach_start(space, start_um)
        if start.trouble:
            return no_route(_METHOD, start.trouble)
        px = space.um_per_px
        weight = self._weight(space)
        cost, parent = search(
            space.free,
            space.clearance,
            space.need,
            space.vx,
            space.vy,
            weight,
            directions(2),
            start.node,
            -1,
            speed_um_s / px,
            True,
        )
        length, work = _along_tree(cost, parent, space)
        allowed = np.isfinite(cost) & (work > 0.0) & ~_near_openings(space, chip, self.outlet_gap_radii).ravel()
        allowed[start.node] = False
        if not allowed.any():
            return no_route(_METHOD, "nothing lies downstream of the start before the chip ends")
        longest_px = length[_best(work, allowed)]
        limit_px = self._share(chip) * longest_px if limit_um is None else limit_um / px
        allowed &= length <= limit_px
        if not allowed.any():
            return no_route(
                _METHOD, f"there is no place to survey within {limit_px * px:.0f} um downstream of the start"
            )
        central = allowed & _middle(space.clearance).ravel()
        end = _best(work, central if central.any() else allowed)
        nodes = backtrack(parent, end, space.width)
        path = joined_ends(space, nodes, start, None)
        smooth = relax(
            path, space.clearance, space.need, space.vx, space.vy, weight, np.full_like(weight, speed_um_s / px)
        )
        for candidate in (smooth, path):
            route = timed_route(_METHOD, field, candidate * px, speed_um_s, start.remark)
            if route.reachable:
                break
        return route

    def _share(self, chip: Chip) -> float:
        if self.share is not None:
            return self.share
        return 0.125 if len(chip.openings) <= 2 else 0.5

    def _weight(self, space: Space) -> Raster:
        """(h, w) >= 1: what time costs, most next to the walls, least in the middle of the channel."""
        nearness = space.need / np.maximum(space.clearance, space.need)
        return 1.0 + self.middle_pull * nearness**2


def _along_tree(
    cost: NDArray[np.float64], parent: NDArray[np.int64], space: Space
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length (h*w,) in px and work of the flow (h*w,) in px2/s along the way to each node of the search's tree."""
    length, work = np.zeros(len(cost)), np.zeros(len(cost))
    vx, vy = space.vx.ravel(), space.vy.ravel()
    # Parents are settled before their children, so in order of cost one pass is enough.
    for node in np.argsort(cost, kind="stable")[: int(np.isfinite(cost).sum())]:
        before = parent[node]
        if before < 0:
            continue
        dx = node % space.width - before % space.width
        dy = node // space.width - before // space.width
        length[node] = length[before] + np.hypot(dx, dy)
        work[node] = work[before] + 0.5 * (dx * (vx[node] + vx[before]) + dy * (vy[node] + vy[before]))
    return length, work


def _best(work: NDArray[np.float64], allowed: NDArray[np.bool_]) -> int:
    """The allowed node (flat index) along the way to which the flow helps most."""
    return int(np.argmax(np.where(allowed, work, -np.inf)))


def _middle(clearance: Raster) -> NDArray[np.bool_]:
    """(h, w) pixels near the middle between walls: two pixels on, no other is more than one farther from them."""
    return np.asarray(clearance >= maximum_filter(clearance, 5) - 1.0)


def _near_openings(space: Space, chip: Chip, gap_radii: float) -> NDArray[np.bool_]:
    """(h, w) pixels nearer to an opening than the gap."""
    h, w = space.free.shape
    y, x = np.mgrid[0:h, 0:w]
    near = np.zeros((h, w), np.bool_)
    for opening in chip.openings:
        column, row = _nearest_on(opening, x, y)
        near |= np.hypot(x - column, y - row) < gap_radii * space.radius
    return near


def _nearest_on(
    opening: Opening, x: NDArray[np.int64], y: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The nearest point of an opening's border run to each pixel."""
    h, w = x.shape
    if opening.side in ("left", "right"):
        edge = -0.5 if opening.side == "left" else w - 0.5
        return np.full((h, w), edge), np.clip(y, opening.first, opening.last).astype(np.float64)
    edge = -0.5 if opening.side == "top" else h - 0.5
    return np.clip(x, opening.first, opening.last).astype(np.float64), np.full((h, w), edge)
