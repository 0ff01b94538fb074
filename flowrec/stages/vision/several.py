"""Frame to a Track for each of several robots, which may cross, touch and hide each other.

Each robot is expected where its estimate, the turns of the field and the flow put it. Robots apart from each other are
discs near these places (disc_search.py), and one assignment over all of them decides which disc is which robot: it
minimises d^2 / S + 2 ln S and the difference of the looks, size and darkness. Robots whose images touch are fitted
together (joint_fit.py). One that has been out of sight for long is looked for in the whole channel, where the others
leave a disc; the cost of a frame is linear in the number of robots.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Frame, Ints, Track, seconds
from flowrec.physics import Calibration, Robot
from flowrec.stages.vision.disc_search import Disc, DiscSearch, discs, tracked_radius_px
from flowrec.stages.vision.joint_fit import Body, distances, fit_jointly
from flowrec.stages.vision.tracers import assign
from flowrec.stages.vision.trackers import unseen
from flowrec.stages.vision.walls import Walls

_TOUCH = 1.25  # of the sum of two radii: nearer robots are fitted together
_SAME_RADII = 0.7  # between two discs that are one
_ENERGY_WEIGHT = 0.05  # of the newest look in the tracked one
_LOOKS = (0.12, 0.25)  # one sigma of ln radius and ln darkness of one robot
_MOST_UNLIKE = 9.0  # of the cost: beyond it a disc is an outlier of a robot's look
_GATE = 16.0  # as of `assign`: four standard deviations
_FIT_RADII = 0.02  # error of a fitted place
_EVERY = 10  # image in which robots other than the first one are looked for everywhere
_EVERYWHERE_UM = 1e6  # standard deviation of the place of a robot that may be anywhere
_BEHIND = 2.0  # sums of radii: a robot that was lost so near to one that is seen is behind it
_OWN_RADII = (
    3.0  # around a robot that was seen lately: a disc there is this robot, or none that is looked for everywhere
)
_FORBIDDEN = 1e3  # cost of a pair that is never formed


class Expected(NamedTuple):
    """The place at which a robot is expected in an image."""

    position_um: Floats  # (2,)
    std_um: float  # per component


class Sought(NamedTuple):
    """An image, where robots are sought in it, and by which search."""

    frame: Frame
    image: NDArray[Any]  # of 8 bit, the robots dark
    walls: Walls
    calibration: Calibration
    robot: Robot
    search: DiscSearch  # in the whole channel
    least_score: float  # of a robot near its expected place
    near_px: float  # least range of a search around an expected place
    reacquire_after: int
    noise: float


def first_tracks(sought: Sought, count: int, at_um: Sequence[Floats]) -> list[Track]:
    """The tracks of robots that nobody has seen yet: the best discs, each for the next of the places `at_um`.

    With one place alone the first robot is the disc that is nearest to it, then the others in order of their distance.
    """
    found = _apart(list(_everywhere(sought, 2 * count)), sought.robot.radius_um / sought.calibration.um_per_px)
    found = sorted(found, key=lambda disc: -disc.score * disc.darkness)
    if len(at_um) < count:
        found = found[:count]
    chosen: list[Disc | None] = []
    for at in [*at_um, *[at_um[0]] * (count - len(at_um))]:
        x, y = sought.calibration.to_px(at).tolist()
        nearest = min(found, key=lambda disc: math.hypot(disc.x - x, disc.y - y), default=None)
        chosen.append(nearest)
        found = [disc for disc in found if disc is not nearest]
    height, width = sought.frame.image.shape
    middle_um = sought.calibration.to_um(((width - 1) / 2, (height - 1) / 2))
    roi_px = np.array(sought.walls.box, np.float64)
    stamp_ns = sought.frame.stamp_ns
    nobody = Track(stamp_ns, False, middle_um, 0.0, 0, sought.search.nominal_px, roi_px)
    return [_see(sought, nobody, disc) if disc is not None else unseen(nobody, stamp_ns) for disc in chosen]


def next_tracks(sought: Sought, previous: Sequence[Track], expected: Sequence[Expected]) -> list[Track]:
    """The tracks of all robots in this image."""
    px = sought.calibration.to_px(np.array([each.position_um for each in expected])).reshape(-1, 2)
    um_per_px = sought.calibration.um_per_px
    std_um = np.hypot([each.std_um for each in expected], _FIT_RADII * sought.robot.radius_um)
    radii = np.array([track.radius_px for track in previous])
    apart = distances(px, radii)
    np.fill_diagonal(apart, np.inf)
    known = np.array([track.score > 0.0 for track in previous])
    apart[~known] = apart[:, ~known] = np.inf
    behind = apart[:, [track.seen for track in previous]].min(axis=1, initial=np.inf) < _BEHIND
    lost = ~known | (np.array([track.lost_frames > sought.reacquire_after for track in previous]) & ~behind)
    places: dict[int, Floats] = {}
    for group in _groups(apart[np.ix_(~lost, ~lost)] < _TOUCH):
        members = np.flatnonzero(~lost)[group].tolist()
        bodies = [
            Body(px[n], (float(std_um[n]) / um_per_px) ** 2, previous[n].radius_px, _darkness(sought, previous[n]))
            for n in members
        ]
        fitted = fit_jointly(sought.image, sought.walls, sought.search.margin_px, bodies)
        places |= {} if fitted is None else dict(zip(members, fitted, strict=True))
    alone = [n for n in range(len(previous)) if n not in places]
    found: list[Disc] = []
    for n in alone:
        if not lost[n]:
            found += _near(sought, previous[n], px[n], float(std_um[n]) / um_per_px)
    if lost[0] or (lost.any() and sought.frame.index % _EVERY == 0):
        found += _everywhere(sought, 2 * len(previous))
    taken = np.array(list(places.values())).reshape(-1, 2)
    found = [
        disc
        for disc in _apart(found, sought.search.nominal_px)
        if not (np.hypot(*(taken - (disc.x, disc.y)).T) < _SAME_RADII * sought.search.nominal_px).any()
    ]
    std_um = np.where(lost, [_lost_std_um(sought, track) for track in previous], std_um)
    variance = std_um[alone] ** 2 / um_per_px**2
    spots = np.array([(disc.x, disc.y) for disc in found]).reshape(-1, 2)
    unlike = np.array([[_unlike(sought, previous[n], disc) for disc in found] for n in alone])
    if lost.any() and found:
        away = np.hypot(*(spots[:, None] - px[~lost]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        unlike[np.ix_(lost[alone], away < _OWN_RADII * sought.search.nominal_px)] = _FORBIDDEN
    pairs = {alone[row]: found[column] for row, column in zip(*assign(px[alone], variance, spots, unlike), strict=True)}
    tracks = []
    for n, track in enumerate(previous):
        if n in places:
            moved = replace(track, position_um=sought.calibration.to_um(places[n]), seen=True, lost_frames=0)
            tracks.append(replace(moved, stamp_ns=sought.frame.stamp_ns))
        elif n in pairs:
            tracks.append(_see(sought, track, pairs[n]))
        else:
            tracks.append(unseen(track, sought.frame.stamp_ns))
    return tracks


def _lost_std_um(sought: Sought, track: Track) -> float:
    """Standard deviation of the place of a robot that was not seen for long: as far as it may have gone."""
    if track.seen_ns is None:
        return _EVERYWHERE_UM
    return sought.robot.radius_um + sought.robot.max_speed_um_s * seconds(sought.frame.stamp_ns - track.seen_ns)


def _near(sought: Sought, track: Track, at_px: Floats, std_px: float) -> list[Disc]:
    """The discs near the place of a robot that was seen lately."""
    x0, y0, x1, y1 = sought.walls.box
    x, y = at_px.tolist()
    range_px = min(max(math.sqrt(_GATE) * std_px, sought.near_px), 1e4)
    box = (
        max(math.floor(x - range_px), x0),
        max(math.floor(y - range_px), y0),
        min(math.ceil(x + range_px) + 1, x1),
        min(math.ceil(y + range_px) + 1, y1),
    )
    search = replace(sought.search, box=box, centre=(x, y), range_px=range_px, expected_px=track.radius_px)
    # Debris near it is told apart by its look.
    search = replace(search, least_score=sought.least_score, least_likeness=0.0)
    return list(discs(sought.image, sought.walls, search))


def _everywhere(sought: Sought, candidates: int) -> list[Disc]:
    """The discs in the whole channel."""
    search = replace(sought.search, candidates=max(candidates, sought.search.candidates))
    return list(discs(sought.image, sought.walls, search))


def _apart(found: list[Disc], radius_px: float) -> list[Disc]:
    """The discs without those that are another one, found once more."""
    kept: list[Disc] = []
    for disc in sorted(found, key=lambda disc: -disc.score):
        if all(math.hypot(disc.x - each.x, disc.y - each.y) > _SAME_RADII * radius_px for each in kept):
            kept.append(disc)
    return kept


def _groups(touching: Bools) -> list[Ints]:
    """The groups of two or more that touch, directly or through others."""
    from scipy.sparse.csgraph import connected_components  # not at start-up

    if not touching.any():
        return []
    label = connected_components(touching, directed=False)[1]
    groups = [np.flatnonzero(label == each) for each in range(label.max() + 1)]
    return [group for group in groups if len(group) > 1]


def _darkness(sought: Sought, track: Track) -> float:
    return math.sqrt(track.energy) * sought.noise


def _unlike(sought: Sought, track: Track, disc: Disc) -> float:
    """Cost of taking a disc for a robot of another look."""
    if track.energy <= 0.0:
        return 0.0
    size = math.log(disc.radius_px / track.radius_px) / _LOOKS[0]
    dark = math.log(max(disc.darkness, 1e-6) / _darkness(sought, track)) / _LOOKS[1]
    return min(size * size + dark * dark, _MOST_UNLIKE)


def _see(sought: Sought, track: Track, disc: Disc) -> Track:
    """The track of a robot that is a disc by itself."""
    first, energy = track.energy <= 0.0, (disc.darkness / sought.noise) ** 2
    before_px = disc.radius_px if first else track.radius_px
    return replace(
        track,
        stamp_ns=sought.frame.stamp_ns,
        seen=True,
        position_um=sought.calibration.to_um((disc.x, disc.y)),
        score=disc.score,
        lost_frames=0,
        radius_px=tracked_radius_px(before_px, disc, sought.search.nominal_px),
        energy=energy if first else track.energy + _ENERGY_WEIGHT * (energy - track.energy),
    )
