"""Tracers to Observations: the mean velocity of each tracer over each stretch of its way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flowrec.core import Floats, Observations, Tracers

AtNominal = Callable[[Observations, Floats, Floats], Observations | None]

CAPACITY = 2000  # beyond it some tracers are left out, evenly over the run
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # multiples of it, less their whole parts, spread evenly (Weyl 1916)
_LEAST_MOVED = 5.0  # standard deviations of the distance: what has not moved so far is stuck
SETTLED_FRAMES = 2.0  # a first stretch begins with the third image, see vision/tracers.py: before, it may be noise
# Of the time of a stretch, without an image that shows the tracer. In two surveys of 50 beads 45 % of the stretches
# that were missed for longer were of no body, or of two, and 0.8 % of the others.
MOST_MISSED_SHARE = 0.1
_FLOOR_UM_S = 2.0  # least sigma of an observation


def collect_stretches(
    previous: Observations | None,
    before: Tracers | None,
    tracers: Tracers | None,
    at_nominal: AtNominal | None = None,
) -> Observations | None:
    """The observations after this frame; the previous object itself when no stretch has ended.

    A stretch has ended for each tracer of `tracers` that begins another one, see `Tracers.from_um`. The place is the
    middle of its ends, the standard deviation that of their difference. One that has not moved tells no flow: it sticks
    to the floor. One that images do not show for a part of it may be of no body, or of two. `at_nominal` makes
    observations, of the times at which they began and ended, those of the flow of the map.
    """
    if before is None or tracers is None or tracers is before or not before.count:
        return previous
    where = np.searchsorted(before.id, tracers.id)  # numbers are in order
    known = before.id[np.minimum(where, before.count - 1)] == tracers.id
    old = where[known]
    began_s, ended_s = before.from_s[old], tracers.from_s[known]
    began_um, ended_um = before.from_um[old], tracers.from_um[known]
    std_um = np.sqrt(2.0) * tracers.std_um[known]
    # The first stretch begins where the velocity has settled.
    settled = before.age_frames[old] > SETTLED_FRAMES
    moved = np.hypot(*(ended_um - began_um).T) > _LEAST_MOVED * std_um
    over = (ended_s > began_s) & moved & settled
    if before.missed_s is not None:
        over &= before.missed_s[old] <= MOST_MISSED_SHARE * (ended_s - began_s)
    if not over.any():
        return previous
    lasted_s = (ended_s - began_s)[over]
    new = Observations(
        tracers.stamp_ns,
        0.5 * (began_um + ended_um)[over],
        (ended_um - began_um)[over] / lasted_s[:, None],
        np.hypot(std_um[over] / lasted_s, _FLOOR_UM_S),
        None,
        0.5 * (began_s + ended_s)[over],
        None,
        tracers.id[known][over],
        tracers.entered[known][over],
    )
    told = new if at_nominal is None else at_nominal(new, began_s[over], ended_s[over])
    if told is None or previous is None:
        return previous if told is None else told
    return _some_tracers(previous.followed_by(told))


def _some_tracers(observations: Observations) -> Observations:
    """CAPACITY of the observations: all of some tracers, which are the same at each call and began at all times."""
    assert observations.tracer is not None
    if len(observations.tracer) <= CAPACITY:
        return observations
    order = np.argsort(observations.tracer * _GOLDEN % 1.0, kind="stable")
    return observations.only(np.sort(order[:CAPACITY]))
