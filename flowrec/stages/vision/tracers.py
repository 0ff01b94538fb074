"""Frame to Tracers: the tracks of all bodies in view but the robot.

Each body is the state of a constant-velocity filter whose acceleration is white noise (Bar-Shalom, Li and Kirubarajan
2001, section 6.2), and which walks at random as a sphere of its radius does in the fluid. One assignment over all
bodies decides which spot is which body: it minimises the sum of d^2 / S + 2 ln S, the negative log-likelihood of a spot
at a distance d from where a body is expected with the variance S per component, where a body that is not seen costs the
limit of the gate. Pairs beyond the gate are not formed, and the pairs fall into groups without a common body or spot,
which are assigned one by one: the cost is linear in the number of bodies as long as few of them are near each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np

from flowrec.core import Bools, Floats, Frame, Ints, Range, Tracers, Track, seconds
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages.vision.spots import SpotSearch
from flowrec.stages.vision.walls import Walls, seen_walls

_RADIUS_SHARE = 0.25  # of the robot's radius, for tracers whose radius is not stated
_STD_PX = 0.15  # of a spot's place, per component
_SPEED_SHARE = 0.5  # of the robot's top speed: standard deviation of the velocity of a new body, per component
# Of that top speed: white acceleration over a second. In a bend of radius R it is v^2 / R for a time R / v: at three
# quarters of the top speed and ten radii of the robot, half. Four times as much follows spots of others.
_ACCELERATION_PER_S = 0.5
_DIFFUSION_UM3_MPA = (
    0.218  # k T / (6 pi) at 25 °C: over viscosity and radius it is a diffusion constant (Einstein 1905)
)
_GATE = 16.0  # largest d^2 / S: four standard deviations
_NEAR_ROBOT_RADII = 2.4  # a spot that is nearer to the robot is a part of its image, or of a ring around it
_EDGE_RADII = 6.0  # from an opening or the edge of the image, and as far as the flow goes in a frame: it came in there
_LEAST_AGE = 3  # images, from which on the stretches of a way count


class _Bodies(NamedTuple):
    """Columns of Tracers without stamp and next number."""

    id: Floats
    position_um: Floats
    velocity_um_s: Floats
    std_um: Floats
    velocity_std_um_s: Floats
    shared_um2_s: Floats
    age_frames: Floats
    lost_frames: Floats
    entered: Floats
    from_um: Floats
    from_s: Floats
    missed_s: Floats

    def only(self, which: Bools) -> _Bodies:
        return _Bodies(*(column[which] for column in self))


@dataclass(frozen=True, slots=True)
class TracerTracker:
    """Settings of the tracks of tracers; its memory is the previous Tracers."""

    # radius of the tracers; None: a quarter of the robot's
    radius_um: Annotated[float, Range(0.1, 1e4)] | None = None
    look: Literal["dark", "bright"] = "dark"  # brightness of the tracers relative to the background
    # contrast of a tracer over the noise of the filtered image, its median: bodies that cover a twentieth of the image
    # raise that, and then 3 finds them
    least_snr: Annotated[float, Range(1.0, 1e3)] = 6.0
    # largest ratio of the principal curvatures of a spot, which the edges of walls exceed; 0: any. It is 1.8 of a disc
    # that moves by its diameter while the image is exposed
    most_elongated: Annotated[float, Range(0.0, 1e3)] = 3.0
    keep_s: Annotated[float, Range(0.0, 60.0)] = 0.3  # time for which a tracer that is not seen is kept
    # length of the stretch over which the velocity of a tracer is one observation of the flow, in robot radii
    stretch_radii: Annotated[float, Range(0.1, 100.0)] = 1.0
    stretch_s: Annotated[float, Range(0.1, 1e3)] = 4.0  # the longest time of such a stretch

    def search(self, um_per_px: float, robot: Robot) -> SpotSearch:
        """The search for spots in an image of this scale."""
        radius_um = _RADIUS_SHARE * robot.radius_um if self.radius_um is None else self.radius_um
        return SpotSearch(radius_um / um_per_px, self.look == "dark", self.least_snr, self.most_elongated)

    def follow(
        self,
        previous: Tracers | None,
        track: Track | None,
        frame: Frame,
        chip: Chip,
        calibration: Calibration,
        robot: Robot,
        shift_px: tuple[float, float] = (0.0, 0.0),
        others: Sequence[Track] = (),
    ) -> Tracers:
        """The tracers in this frame. `track` is the robot's in the same frame, whose image no tracer is a part of.

        `shift_px` (columns, rows): how far the image lies from where the calibration holds. `others`: of other robots.
        """
        walls, calibration = seen_walls(chip, calibration, frame.image.shape, shift_px)
        px, _ = self.search(calibration.um_per_px, robot).find(frame.image, walls)
        for each in (track, *others):
            if each is not None and each.seen and len(px):
                apart_px = np.hypot(*(px - calibration.to_px(each.position_um)).T)
                px = px[apart_px > _NEAR_ROBOT_RADII * max(each.radius_px, robot.radius_um / calibration.um_per_px)]
        spots_um = calibration.to_um(px).reshape(-1, 2)
        now_s, next_id = seconds(frame.stamp_ns), 0
        std_um, dt = _STD_PX * calibration.um_per_px, frame.since_s(previous)
        bodies = _new_bodies(np.zeros((0, 2)), 0, np.zeros(0), std_um, robot, now_s)
        if previous is not None:
            next_id = previous.next_id
            radius_um = self.search(1.0, robot).radius_px
            bodies = _predict(previous, dt, robot, _DIFFUSION_UM3_MPA / (chip.viscosity_mpa_s * radius_um))
        rows, columns = assign(bodies.position_um, bodies.std_um**2 + std_um**2, spots_um)
        bodies = self._next_stretch(_correct(bodies, rows, spots_um[columns], std_um), robot, now_s, dt)
        kept = bodies.lost_frames * dt <= self.keep_s
        kept &= _in_view(bodies.position_um, walls, calibration)
        free = np.ones(len(spots_um), np.bool_)
        free[columns] = False
        margin_um = _EDGE_RADII * self.search(1.0, robot).radius_px + robot.max_speed_um_s * dt
        entered = _near_edge(spots_um[free], margin_um, chip, calibration, frame.image.shape) & (previous is not None)
        born = _new_bodies(spots_um[free], next_id, entered.astype(np.float64), std_um, robot, now_s)
        joined = _Bodies(*(np.concatenate(pair) for pair in zip(bodies.only(kept), born, strict=True)))
        return Tracers(frame.stamp_ns, **joined._asdict(), next_id=next_id + len(born.id))

    def _next_stretch(self, bodies: _Bodies, robot: Robot, now_s: float, dt: float) -> _Bodies:
        """Begin the next stretch of the way of each body that has ended one."""
        away_um = np.hypot(*(bodies.position_um - bodies.from_um).T)
        over = (away_um >= self.stretch_radii * robot.radius_um) | (now_s - bodies.from_s >= self.stretch_s)
        over = ((bodies.age_frames > _LEAST_AGE) & over) | (bodies.age_frames == _LEAST_AGE)
        over &= bodies.lost_frames == 0
        return bodies._replace(
            from_um=np.where(over[:, None], bodies.position_um, bodies.from_um),
            from_s=np.where(over, now_s, bodies.from_s),
            missed_s=np.where(over, 0.0, bodies.missed_s + dt * (bodies.lost_frames > 0.0)),
        )


def assign(expected: Floats, variance: Floats, spots: Floats, unlike: Floats | None = None) -> tuple[Ints, Ints]:
    """The assignment of spots to bodies: indices (k,) of bodies expected at (n, 2), and of their spots (m, 2).

    `variance` (n,) is that of the distance per component, `unlike` (n, m) what the look of a spot adds to the cost.
    """
    import scipy.optimize  # not at start-up
    import scipy.spatial

    none = np.zeros(0, np.intp)
    if not len(expected) or not len(spots):
        return none, none
    near = scipy.spatial.cKDTree(spots).query_ball_point(expected, np.sqrt(_GATE * variance), return_sorted=True)
    rows = np.repeat(np.arange(len(expected)), [len(each) for each in near])
    if not len(rows):
        return none, none
    columns = np.concatenate([np.asarray(each, np.intp) for each in near])
    # A body that is missed costs the limit of its gate, so the terms of S are left that tell bodies of one spot apart.
    cost = ((spots[columns] - expected[rows]) ** 2).sum(axis=1) / variance[rows] - _GATE
    cost += 2.0 * np.log(variance[rows] / variance.max())
    if unlike is not None:
        cost += unlike[rows, columns]
    alone = (np.bincount(rows, minlength=len(expected))[rows] == 1) & (
        np.bincount(columns, minlength=len(spots))[columns] == 1
    )
    alone &= cost < 1.0  # beyond that a body is rather missed
    found = [(rows[alone], columns[alone])]
    rows, columns, cost = rows[~alone], columns[~alone], cost[~alone]
    if len(rows):
        count = len(expected)
        graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, count + columns)), shape=(count + len(spots),) * 2)
        group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1][rows]
        order = np.argsort(group, kind="stable")
        for pairs in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            ours, row = np.unique(rows[pairs], return_inverse=True)
            theirs, column = np.unique(columns[pairs], return_inverse=True)
            costs = np.zeros((len(ours), len(theirs) + len(ours)))  # the last columns: a body is missed
            costs[:, : len(theirs)] = 1.0  # beyond the gate: worse than missed
            costs[row, column] = cost[pairs]
            chosen = scipy.optimize.linear_sum_assignment(costs)
            taken = (chosen[1] < len(theirs)) & (costs[chosen] < 1.0)
            found.append((ours[chosen[0][taken]], theirs[chosen[1][taken]]))
    both = [np.concatenate(part) for part in zip(*found, strict=True)]
    return both[0], both[1]


def _predict(previous: Tracers, dt: float, robot: Robot, diffusion_um2_s: float) -> _Bodies:
    """The bodies a time later, not seen; Brownian motion moves them beside their velocity."""
    p = previous
    jerk = (_ACCELERATION_PER_S * robot.max_speed_um_s) ** 2  # um2/s4 over a second: per s
    position, velocity = p.std_um**2, p.velocity_std_um_s**2
    shared = p.shared_um2_s + dt * velocity + jerk * dt**2 / 2.0
    position = position + 2.0 * dt * p.shared_um2_s + dt**2 * velocity + jerk * dt**3 / 3.0
    position += 2.0 * diffusion_um2_s * dt
    return _Bodies(
        p.id,
        p.position_um + dt * p.velocity_um_s,
        p.velocity_um_s,
        np.sqrt(position),
        np.sqrt(velocity + jerk * dt),
        shared,
        p.age_frames,
        p.lost_frames + 1.0,
        p.entered,
        p.from_um,
        p.from_s,
        np.zeros(p.count) if p.missed_s is None else p.missed_s,
    )


def _correct(bodies: _Bodies, rows: Ints, spots_um: Floats, std_um: float) -> _Bodies:
    """The bodies after those of `rows` were seen at spots (k, 2)."""
    position, velocity, shared = bodies.std_um**2, bodies.velocity_std_um_s**2, bodies.shared_um2_s.copy()
    place, speed = bodies.position_um.copy(), bodies.velocity_um_s.copy()
    total = position[rows] + std_um**2
    gain, gain_s = position[rows] / total, shared[rows] / total
    off = spots_um - place[rows]
    place[rows] += gain[:, None] * off
    speed[rows] += gain_s[:, None] * off
    velocity[rows] -= gain_s * shared[rows]
    shared[rows] *= 1.0 - gain
    position[rows] *= 1.0 - gain
    age, lost = bodies.age_frames.copy(), bodies.lost_frames.copy()
    age[rows] += 1.0
    lost[rows] = 0.0
    return bodies._replace(
        position_um=place,
        velocity_um_s=speed,
        std_um=np.sqrt(position),
        velocity_std_um_s=np.sqrt(velocity),
        shared_um2_s=shared,
        age_frames=age,
        lost_frames=lost,
    )


def _new_bodies(spots_um: Floats, first: int, entered: Floats, std_um: float, robot: Robot, now_s: float) -> _Bodies:
    """New bodies at spots (n, 2)."""
    count = len(spots_um)
    zeros = np.zeros(count)
    return _Bodies(
        first + np.arange(count, dtype=np.float64),
        spots_um,
        np.zeros((count, 2)),
        zeros + std_um,
        zeros + _SPEED_SHARE * robot.max_speed_um_s,
        zeros,
        zeros + 1.0,
        zeros,
        entered,
        spots_um,
        zeros + now_s,
        zeros,
    )


def _in_view(points_um: Floats, walls: Walls, calibration: Calibration) -> Bools:
    """(n,) which points lie in the image and in the fluid that it shows, by a pixel."""
    px = np.rint(calibration.to_px(points_um).reshape(-1, 2))
    x0, y0, x1, y1 = walls.box
    inside = (px[:, 0] >= x0) & (px[:, 0] < x1) & (px[:, 1] >= y0) & (px[:, 1] < y1)
    inside[inside] = walls.distance_px[tuple(px[inside].astype(np.intp).T[::-1])] > -1.0
    return inside


def _near_edge(
    points_um: Floats, margin_um: float, chip: Chip, calibration: Calibration, shape: tuple[int, ...]
) -> Bools:
    """(n,) which points are near the edge of the image or of the chip, where bodies come in."""
    size_um, margin_px = np.array(chip.size_um), margin_um / calibration.um_per_px
    px = calibration.to_px(points_um).reshape(-1, 2)
    near = (points_um < margin_um) | (points_um > size_um - margin_um)
    near |= (px < margin_px) | (px > np.array(shape[1::-1]) - 1.0 - margin_px)
    return np.asarray(near.any(axis=1))
