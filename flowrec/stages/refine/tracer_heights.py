"""Observations of tracers at unknown heights, as observations of the flow's mean over the depth.

A tracer at the height z of a channel of depth h goes with c times the mean over the depth, between plates
c = 3/2 (1 - (2 z / h - 1)^2). Beads that are spread evenly over the depth have E c = 1, E c^2 = 6/5, E c^3 = 54/35.
So have those that are in view at the first image. As many come in at each height as flow through there, so c of
those that came in later has the mean E c^2 / E c = 1.2 and the variance E c^3 - 1.2^2 = 0.103; they make up most of a
long run. A tracer stays at its height, so one error belongs to all of its observations: Gaussian here, of the size that
the observations show (`HEIGHT` of causes.py). In a channel that is not shallow the profile is flatter, and where no
depth is stated it may be flat: the part of this scatter that tracers show around an assumed flow is used for the mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Floats, FlowField, Ints, Observations, cells_at
from flowrec.physics import Chip, clearance_um, sample

EVEN = (1.0, float(np.sqrt(0.2)))  # mean and standard deviation of c of tracers in view at first
ENTERED = (1.2, float(np.sqrt(54.0 / 35.0 - 1.44)))  # of those that came in later
MOST_EACH = 6  # observations of one tracer: more tell no more of the flow than its height permits
# Of a tracer's speed, one standard deviation by which c differs along its way: it settles, and lags near side walls.
VARIES_SHARE = 0.1
# Pixels of the mask from a wall: nearer to it than walls may be off, a predicted speed says nothing of a tracer's.
LEAST_PX = 2.0
_HEIGHTS = 400  # of half a channel, by which quantiles of c are known to 0.5 %
MOST = 60  # observations of all tracers: the time of a refinement grows with the square


def at_mean_height(observations: Observations, assumed: FlowField, chip: Chip) -> Observations:
    """The observations with those of tracers divided by the mean of c; themselves without tracers."""
    if observations.tracer is None or observations.entered is None:
        return observations
    clear_px = clearance_um(chip.mask, 1.0)
    away_px = cells_at(observations.position_um / chip.um_per_px, chip.mask.shape).interpolate(clear_px)
    observations = observations.only((observations.tracer < 0.0) | (away_px > LEAST_PX))
    assert observations.tracer is not None
    observations = observations.only(_few_of_each(observations.tracer))
    tracer, entered = observations.tracer, observations.entered
    assert tracer is not None and entered is not None
    beads = tracer >= 0.0
    if not beads.any():
        return observations
    flat = 1.0 if chip.depth_um is not None else _profile_share(observations.only(beads), assumed)
    mean = 1.0 + flat * (np.where(entered > 0.0, ENTERED[0], EVEN[0]) - 1.0)
    mean = np.where(beads, mean, 1.0)
    flow_um_s = observations.flow_um_s / mean[:, None]
    varied = np.where(beads, VARIES_SHARE * np.hypot(*flow_um_s.T), 0.0)
    return replace(observations, flow_um_s=flow_um_s, std_um_s=np.hypot(observations.std_um_s / mean, varied))


def _few_of_each(tracer: Floats) -> Ints:
    """(k,) indices of the observations of the robot, then of the longest ways of tracers, evenly along each.

    A way of few stretches is often that of no body, or of parts of two. Of ways as long as each other the latest count.
    """
    numbers, ways = np.unique(tracer[tracer >= 0.0], return_counts=True)
    longest = np.argsort(ways, kind="stable")[::-1][:MOST]
    each = min(max(MOST // max(len(longest), 1), 1), MOST_EACH)
    chosen = [np.flatnonzero(tracer < 0.0)]
    for number in np.sort(numbers[longest]):
        own = np.flatnonzero(tracer == number)
        inner = (np.arange(min(each, len(own))) + 0.5) / min(each, len(own))
        chosen.append(own[(inner * len(own)).astype(np.intp)])
    return np.concatenate(chosen)


def _profile_share(beads: Observations, assumed: FlowField) -> float:
    """Part of the variance of c between plates that the tracers show, from 0 for a flat profile to 1.

    By the ratio of each tracer's speed to the assumed one there, and the range of its middle 80 % over its median: an
    assumed flow that is wrong by one factor leaves it, and so does a tenth of tracers that lie still.
    """
    predicted = sample(assumed, beads.position_um)
    assert beads.tracer is not None and beads.entered is not None
    index = np.unique(beads.tracer, return_inverse=True)[1]
    along = np.bincount(index, (predicted * beads.flow_um_s).sum(axis=1))
    power = np.bincount(index, (predicted**2).sum(axis=1))
    flows = power > 1e-6 * max(float(power.max()), 1e-12)
    if np.count_nonzero(flows) < 3:
        return 1.0
    ratio = along[flows] / power[flows]
    came_in = float(np.bincount(index, beads.entered)[flows].astype(bool).mean())
    height = (np.arange(_HEIGHTS) + 0.5) / _HEIGHTS
    plates = 1.5 * (1.0 - height**2)
    shown = _scatter(ratio, np.ones(len(ratio))) / _scatter(plates, 1.0 - came_in + came_in * plates)
    return float(np.clip(shown**2, 0.0, 1.0))


def _scatter(values: Floats, weight: Floats) -> float:
    """The range of the middle 80 % of weighted values over their median."""
    order = np.argsort(values)
    below = np.cumsum(weight[order])
    low, middle, high = values[order][np.searchsorted(below, np.array([0.1, 0.5, 0.9]) * below[-1])]
    return float(high - low) / max(abs(float(middle)), 1e-9)
