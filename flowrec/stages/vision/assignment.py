"""The robot and its neighbours of the frame before among the candidates of an image.

All candidates are assigned at once, to the robot and to the neighbours, at the least sum of costs (global nearest
neighbour, Bar-Shalom and Li 1995): the best match alone would jump to an identical neighbour. Where two meet in one
image, the neighbour is remembered at its place until they part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, Track
from flowrec.stages.vision.learned import KNOWN_LOOK, LEAST_ENERGY, RECENT_GAIN, Candidates

# Costs of an assignment, as -ln of its likelihood.
_SIMILARITY_COST, _MOTION_COST, _MISSED_COST, _IMPOSSIBLE = 8.0, 1.5, 9.0, 1e3
_NEIGHBOUR_MISSED_COST = 6.0  # the same of a neighbour that is not seen again
_ISOLATED_RADII = 2.2  # no neighbour is nearer
EXPECTED_FRAMES = 3  # for which a velocity goes on
_FADE = 0.9  # of the energy of a neighbour that is in one image with the robot, in a frame
_SUM_LOW = 0.65  # least energy of such an image relative to the sum
_GAIN = 0.3  # of the velocity


@dataclass(frozen=True, slots=True)
class ExpectedMotion:
    """Expected position of the robot, after a track whose place was `place_px` (2,)."""

    previous: Track
    place_px: Floats
    radius_px: float
    frame_s: float  # since that track
    expected_px: Floats  # (2,)
    spread_px: float  # typical distance from there

    @classmethod
    def after(cls, previous: Track, place_px: Floats, radius_px: float, frame_s: float) -> ExpectedMotion:
        """The motion since a track: its velocity goes on for three frames at most, then it may be anywhere near."""
        frames = 1 + previous.lost_frames
        moved = previous.velocity_px_s * frame_s * frames if previous.lost_frames < EXPECTED_FRAMES else 0.0
        spread_px = max(previous.spread_px, 0.15 * radius_px + 0.3) * frames
        return cls(previous, place_px, radius_px, frame_s, place_px + moved, spread_px)


def assign_objects(found: Candidates, motion: ExpectedMotion, range_px: float) -> tuple[int | None, Floats]:
    """The candidate that is the robot when all objects of the frame before are assigned at once; None: no one is.

    Besides the neighbours (k, 3) that are no candidate.
    """
    previous = motion.previous
    count = len(found.energy)
    neighbours = previous.neighbours_px.reshape(-1, 3)
    if not count:
        return None, neighbours
    costs = np.full((1 + len(neighbours), count + 1 + len(neighbours)), _IMPOSSIBLE)
    distance2 = ((found.px - motion.expected_px) ** 2).sum(axis=1)
    costs[0, :count] = _SIMILARITY_COST * (1.0 - found.similarity) + _move_cost(
        found, motion, distance2, previous.energy
    )
    costs[0, :count][distance2 > range_px**2] = _IMPOSSIBLE
    costs[0, count] = _MISSED_COST
    for row, (x, y, energy) in enumerate(neighbours.tolist(), 1):
        distance2 = ((found.px - (x, y)) ** 2).sum(axis=1)
        costs[row, :count] = _move_cost(found, motion, distance2, energy)
        costs[row, count + row] = _NEIGHBOUR_MISSED_COST
    from scipy.optimize import linear_sum_assignment  # not at start-up

    chosen = linear_sum_assignment(costs)[1]
    missed = neighbours[chosen[1:] >= count]
    return (int(chosen[0]) if chosen[0] < count else None), missed


def find_merged(
    found: Candidates, which: int | None, motion: ExpectedMotion, missed: Floats
) -> tuple[int, Floats, Floats] | None:
    """The image that is the robot and missed neighbours (k, 3) together: it is near both and has the sum of energies.

    Its number, and in px the place (2,) of the robot and those neighbours (k, 3); None: there is no such image.

    `which` is the candidate that is the robot; None: the one nearest to where it is expected, which then may be taken
    for a neighbour. Its centroid is that of all, and they lie to each other as before:
        centroid = sum(E_i p_i) / sum(E_i), p_robot - p_i = expected - p_i before.
    """
    previous, radius_px = motion.previous, motion.radius_px
    if which is None:
        if not len(found.energy) or previous.lost_frames >= EXPECTED_FRAMES:
            return None
        which = int(np.hypot(*(found.px - motion.expected_px).T).argmin())
        missed = previous.neighbours_px.reshape(-1, 3)
    elif found.similarity[which] >= KNOWN_LOOK:
        return None
    centroid = found.px[which]
    near = hidden_neighbours(missed, centroid, radius_px)
    total = previous.energy + float(near[:, 2].sum())
    if not len(near) or math.dist(centroid, motion.expected_px) > radius_px:
        return None
    # The second term: beside a much stronger neighbour the sum does not tell whether the robot is there.
    if not _SUM_LOW < float(found.energy[which]) / total < 1.0 / _SUM_LOW or previous.energy < (1 - _SUM_LOW) * total:
        return None
    offsets = motion.expected_px - near[:, :2]
    place_px = centroid + (near[:, 2:] * offsets).sum(axis=0) / total
    return which, place_px, np.column_stack([place_px - offsets, near[:, 2]])


def hidden_neighbours(missed: Floats, place_px: Floats, radius_px: float) -> Floats:
    """Those of the missed neighbours (k, 3) that are at the robot's place: they may come out of its image again.

    They fade, since one that has gone out of focus does not come out.
    """
    near = missed[np.hypot(*(missed[:, :2] - place_px).T) < radius_px]
    kept = near[near[:, 2] > LEAST_ENERGY]
    return np.column_stack([kept[:, :2], _FADE * kept[:, 2]])


def _move_cost(found: Candidates, motion: ExpectedMotion, distance2: Floats, energy: float) -> Floats:
    """Cost (n,) of a move and of a change of energy: a heavy tail, because robots and neighbours jump at times."""
    changed = np.abs(np.log(found.energy / max(energy, 1e-6)))
    return _MOTION_COST * np.log1p(distance2 / motion.spread_px**2) + changed


def similar(found: Candidates, which: int, motion: ExpectedMotion) -> bool:
    """True if a candidate of unknown look is the robot by its place and energy: it has turned."""
    ratio = float(found.energy[which]) / max(motion.previous.energy, 1e-6)
    near = math.dist(found.px[which], motion.expected_px) < 1.5 * motion.radius_px
    return motion.previous.lost_frames < EXPECTED_FRAMES and near and 0.25 < ratio < 4.0


def with_motion(track: Track, motion: ExpectedMotion, to_px: Floats, energy: float) -> Track:
    """The track with its fields on the motion, after the robot went to a place (2,)."""
    previous, dt = motion.previous, motion.frame_s
    frames = 1 + previous.lost_frames
    velocity = (to_px - motion.place_px) / (dt * frames) if dt > 0.0 else previous.velocity_px_s
    missed_px = math.dist(to_px, motion.expected_px) / frames
    ratio = max(energy, 1e-6) / max(previous.energy, 1e-6)
    return replace(
        track,
        velocity_px_s=previous.velocity_px_s + _GAIN * (velocity - previous.velocity_px_s),
        spread_px=previous.spread_px + RECENT_GAIN * (missed_px - previous.spread_px),
        energy=max(previous.energy, 1e-6) * ratio**RECENT_GAIN,
    )


def neighbours_of(found: Candidates, robot: int | None) -> Floats:
    """Place and energy (3 k,) of all candidates but the robot."""
    rows = np.column_stack((found.px, found.energy))
    return np.delete(rows, [] if robot is None else robot, axis=0).ravel()


def move_neighbours(previous: Track, by_px: Floats) -> Track:
    """A track as the next image shows it, which lies `by_px` (2,) farther: the neighbours are places in the image."""
    if not previous.neighbours_px.size or not by_px.any():
        return previous
    moved = previous.neighbours_px.reshape(-1, 3) + np.array([by_px[0], by_px[1], 0.0])
    return replace(previous, neighbours_px=moved.ravel())


def is_isolated(neighbours_px: Floats, place_px: Floats, radius_px: float) -> bool:
    """True if no neighbour is so near that it is in the robot's views."""
    offsets = neighbours_px.reshape(-1, 3)[:, :2] - place_px
    return not len(offsets) or float(np.hypot(*offsets.T).min()) > _ISOLATED_RADII * radius_px
