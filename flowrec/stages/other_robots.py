"""Several robots in one field: where each is expected, an observer for each, and how far the others are from walls.

The mission steers the first robot. The field drives the others as well, each by its own um per revolution, which its
observer estimates. One that is near a wall raises an alarm; while the last command drives it on towards that wall, the
speed of the command may be limited.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import (
    WALLS,
    Applied,
    Demand,
    Estimate,
    Floats,
    Floats32,
    FlowField,
    Message,
    Observations,
    Range,
    RobotWalls,
    Tick,
    Track,
    seconds,
)
from flowrec.physics import Robot
from flowrec.stages.control.controller import clearance_and_slope
from flowrec.stages.estimation import Observer, Sampler
from flowrec.stages.robot_topics import estimate_of, messages_of, observations_of_others, observations_topic, track_of
from flowrec.stages.vision import Expected

_OWN_ERROR = 0.3  # standard deviation of a robot's own displacement in a frame, as a ratio
_STD_RADII = 0.12  # least error of an expected place
_FARTHEST_UM = 1e5  # standard deviation of a place of which nothing is known
_SEEN_S = 1.0  # a robot that was not seen for longer may be anywhere
_UNEVEN = 0.07  # of its own speed: runs of a roller differ by 5 to 10 % in um per revolution
_OVER = 1.6  # of the distance at which an alarm begins: there it ends


@dataclass(frozen=True, slots=True)
class OtherRobots:
    """Robots beside the mission's one: their distance from the walls."""

    # alarm below this distance from the surface of another robot to a wall; None: half the robot's radius
    near_um: Annotated[float, Range(0.0, 1e5)] | None = None
    # Largest speed of the mission's robot through the fluid while another robot is so near to a wall and the command
    # drives it there. None: no limit
    speed_limit_um_s: Annotated[float, Range(1.0, 1e6)] | None = None
    # the motion of the others tells the flow, too; refinements find the um per revolution of each
    observe_flow: bool = True

    def collect(
        self,
        sampler: Sampler,
        last: Tick,
        estimates: Sequence[Estimate],
        walls: RobotWalls,
        robot: Robot,
        pump: Callable[[Observations | None, Observations | None], Observations | None],
    ) -> dict[str, Observations]:
        """The new flow observations of the other robots, by path; none of one that is near a wall or out of view.

        Parameters
        ----------
        pump : makes observations, given those before, to observations of the pump's nominal flow.
        """
        made: dict[str, Observations] = {}
        told = last.extra.of(WALLS, RobotWalls)
        if not self.observe_flow or told is None:
            return made
        known = observations_of_others(last)
        free = np.isfinite(walls.wall_um) & (walls.near == 0.0) & np.isfinite(told.wall_um) & (told.near == 0.0)
        for number in (np.flatnonzero(free) + 1).tolist():
            before = estimate_of(last, number)
            if before is None:
                continue
            past, now = as_stated(before, robot), as_stated(estimates[number - 1], robot)
            found = sampler.collect(known.get(number), past, now, robot)
            if found is not None and found is not known.get(number):
                found = pump(known.get(number), _with_unknown_response(found, past, now, robot))
            if found is not None and found is not known.get(number):
                made[observations_topic(number)] = found
        return made

    def watch(
        self,
        last: Tick,
        tracks: Sequence[Track],
        estimates: Sequence[Estimate],
        robot: Robot,
        radii_um: Sequence[float],
        clearance_um: Floats32,
        um_per_px: float,
    ) -> RobotWalls:
        """Distances of the other robots (n) from walls, by the command of the tick before.

        Parameters
        ----------
        radii_um : of each of them.
        clearance_um : (h, w) from each pixel centre of the chip to the nearest wall.
        """
        told, demand = last.extra.of(WALLS, RobotWalls), last.demand
        near_um = 0.5 * robot.radius_um if self.near_um is None else self.near_um
        rows = []
        for number, (track, estimate) in enumerate(zip(tracks, estimates, strict=True)):
            was_near = told is not None and bool(told.near[number])
            wall_um, away = _wall(estimate, track, radii_um[number], clearance_um, um_per_px)
            own_um_s = _command_of(demand, estimate, robot)
            near = wall_um < near_um * (_OVER if was_near else 1.0)  # False for NaN
            rows.append((wall_um, float(near), -float(own_um_s @ away)))
        distance_um, near_ones, towards_um_s = np.array(rows).reshape(-1, 3).T
        limited = self.speed_limit_um_s is not None and bool(((near_ones > 0.0) & (towards_um_s > 0.0)).any())
        limit_um_s = self.speed_limit_um_s if limited else None
        return RobotWalls(tracks[0].stamp_ns, distance_um, near_ones, towards_um_s, limit_um_s)


def _with_unknown_response(made: Observations, past: Estimate, now: Estimate, robot: Robot) -> Observations:
    """Observations whose newest one has the error of a response that nobody has measured, besides its own.

    The robot follows the field later than the first one, by an unknown time of the order of the first one's delay:
    while its mean own motion changes, that time is a velocity. And its speed is not in proportion to the frequency.
    """
    dt = now.since_s(past)
    if not past.rolled_um_s.size or dt <= 0.0:
        return made
    late_um_s = robot.delay_s * math.hypot(*(now.rolled_um_s - past.rolled_um_s)) / dt
    std_um_s = made.std_um_s.copy()
    std_um_s[-1] = math.hypot(std_um_s[-1], late_um_s, _UNEVEN * math.hypot(*now.rolled_um_s))
    return replace(made, std_um_s=std_um_s)


def _command_of(demand: Demand | None, estimate: Estimate, robot: Robot) -> Floats:
    """Velocity (2,) through the fluid that the last command gives another robot, um/s."""
    if demand is None:
        return np.zeros(2)
    gain = 1.0 if estimate.um_per_rev is None else estimate.um_per_rev / robot.um_per_rev
    return gain * demand.velocity_um_s


def _wall(
    estimate: Estimate, track: Track, radius_um: float, clearance_um: Floats32, um_per_px: float
) -> tuple[float, Floats]:
    """Distance from the surface of a robot to the nearest wall, and the direction (2,) away from it; NaN if unknown."""
    unknown = track.seen_ns is None or seconds(track.stamp_ns - track.seen_ns) > _SEEN_S
    if unknown or not np.isfinite(estimate.position_um).all():
        return math.nan, np.zeros(2)
    middle_um, slope = clearance_and_slope(clearance_um, estimate.position_um / um_per_px)
    size = math.hypot(*slope)
    return middle_um - radius_um, slope / size if size > 0.0 else np.zeros(2)


def expected_unmoved(track: Track, robot: Robot, stamp_ns: int) -> Expected:
    """The place where a robot of which only tracks are known is expected: where it was, and as far as it swims."""
    far_um = robot.max_speed_um_s * max(seconds(stamp_ns - track.stamp_ns), 0.0)
    return Expected(track.position_um, min(math.hypot(far_um, _STD_RADII * robot.radius_um), _FARTHEST_UM))


def expected_robots(last: Tick, count: int, applied: Applied, stamp_ns: int, robot: Robot) -> list[Expected]:
    """The places where the robots are expected now: from those seen on the tick before, else from their estimates."""
    found = []
    for number in range(count):
        estimate, track = estimate_of(last, number), track_of(last, number)
        if estimate is None or track is None or not np.isfinite(estimate.position_um).all():
            found.append(Expected(np.zeros(2), _FARTHEST_UM))
            continue
        dt = seconds(stamp_ns - estimate.stamp_ns)
        um_per_rev = robot.um_per_rev if estimate.um_per_rev is None else estimate.um_per_rev
        own_um = um_per_rev * applied.turns
        p = estimate.covariance
        variance = 0.5 * dt**2 * np.trace(p[2:4, 2:4])
        if not track.seen:
            variance += 0.5 * np.trace(p[:2, :2] + 2.0 * dt * p[:2, 2:4])
        std_um = math.hypot(
            math.sqrt(max(variance, 0.0)), _OWN_ERROR * math.hypot(*own_um), _STD_RADII * robot.radius_um
        )
        place_um = (track.position_um if track.seen else estimate.position_um) + own_um + dt * estimate.flow_um_s
        found.append(Expected(place_um, min(std_um, _FARTHEST_UM)))
    return found


def as_stated(estimate: Estimate, robot: Robot) -> Estimate:
    """An estimate with a response of its own, as that of a robot of the stated um per revolution g0.

    With the estimated one, g, and the mean turns u per second, the flow becomes v + (g - g0) u. The sum of flow and own
    motion stays as it is: that is what images tell, whatever the response. The covariance is that of these unknowns.
    """
    if estimate.um_per_rev is None or not estimate.rolled_um_s.size:
        return estimate
    turns = estimate.rolled_um_s / estimate.um_per_rev
    jacobian = np.eye(len(estimate.covariance))
    jacobian[2:4, -1] = turns
    return replace(
        estimate,
        flow_um_s=estimate.flow_um_s + (estimate.um_per_rev - robot.um_per_rev) * turns,
        covariance=(jacobian @ estimate.covariance @ jacobian.T)[:-1, :-1],
        um_per_rev=None,
        rolled_um_s=robot.um_per_rev * turns,
    )


def observe_others(
    observer: Observer, last: Tick, tracks: Sequence[Track], applied: Applied, robot: Robot, flow: FlowField | None
) -> list[Estimate]:
    """The estimates of the other robots, each by an observer of its own that finds its um per revolution, too.

    Without a `flow` by one that uses no map: what that says of the flow is a measurement.
    """
    each = replace(observer, kalman=replace(observer.kalman, estimate_gain=True))
    return [
        each.estimate(estimate_of(last, number), track, applied, robot, flow)
        for number, track in enumerate(tracks, start=1)
    ]


def messages_of_others(tracks: Sequence[Track], estimates: Sequence[Estimate], walls: RobotWalls) -> dict[str, Message]:
    """The messages of the other robots, by path."""
    made: dict[str, Message] = {WALLS: walls}
    for number, (track, estimate) in enumerate(zip(tracks, estimates, strict=True), start=1):
        made |= messages_of(number, track, estimate)
    return made
