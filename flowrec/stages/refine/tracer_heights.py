"""Observations of tracers at unknown heights, as observations of the flow's mean over the depth.

A tracer at the height z of a channel of depth h goes with c times the mean over the depth, between plates
c = 3/2 (1 - (2 z / h - 1)^2). At each moment beads are spread evenly over the depth: E c = 1, E c^2 = 6/5,
E c^3 = 54/35. A fast one passes more stretches of equal length (`tracer_stretches.py`) in the same time, so that over
stretches c has the mean E c^2 / E c = 1.2 and the variance E c^3 / E c - 1.2^2 = 0.103. This holds however often a
tracer was lost and found again, as long as stretches are chosen without regard to the length of ways: the longest are
those of the heights that flow fastest. A tracer stays near its height for some seconds, over which its observations
share one error: Gaussian here, of the size that the observations show (`HEIGHT` of causes.py). In a channel that is not
shallow the profile is flatter, and where no depth is stated it may be flat: the part of this scatter that tracers show
around an assumed flow is used for the mean.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from flowrec.core import Floats, FlowField, Observations, cells_at
from flowrec.physics import Chip, clearance_um, sample

MEAN, SCATTER = 1.2, float(np.sqrt(54.0 / 35.0 - 1.44))  # of c between plates, over stretches
# Of a tracer's speed, one standard deviation by which c differs along its way: it settles, and lags near side walls.
VARIES_SHARE = 0.1
# Pixels of the mask from a wall: nearer to it than walls may be off, a predicted speed says nothing of a tracer's.
LEAST_PX = 2.0
_HEIGHTS = 400  # of half a channel, by which quantiles of c are known to 0.5 %
_SLOWEST_SHARE = 0.1  # of the median speed: what is slower counts as if it went so fast
_FROM_FLAT = np.linspace(0.0, 1.0, 51)  # of profiles, from a flat one to that between plates
MOST = 60  # observations of all tracers: the time of a refinement grows with the square


def at_mean_height(observations: Observations, assumed: FlowField, chip: Chip) -> Observations:
    """The observations with those of tracers divided by the mean of c; themselves without tracers."""
    if observations.tracer is None:
        return observations
    clear_px = clearance_um(chip.mask, 1.0)
    away_px = cells_at(observations.position_um / chip.um_per_px, chip.mask.shape).interpolate(clear_px)
    observations = observations.only((observations.tracer < 0.0) | (away_px > LEAST_PX))
    assert observations.tracer is not None
    beads = observations.tracer >= 0.0
    if not beads.any():
        return observations
    mean_share = MEAN if chip.depth_um is not None else _mean_share(observations.only(beads), assumed)
    ours = np.flatnonzero(beads)
    middles = (np.arange(min(MOST, len(ours))) + 0.5) / min(MOST, len(ours))
    chosen = ours[(middles * len(ours)).astype(np.intp)]  # evenly in the order of their times
    observations = observations.only(np.concatenate([np.flatnonzero(~beads), chosen]))
    beads = np.arange(len(observations.std_um_s)) >= np.count_nonzero(~beads)
    mean = np.where(beads, mean_share, 1.0)
    flow_um_s = observations.flow_um_s / mean[:, None]
    varied = np.where(beads, VARIES_SHARE * np.hypot(*flow_um_s.T), 0.0)
    return replace(observations, flow_um_s=flow_um_s, std_um_s=np.hypot(observations.std_um_s / mean, varied))


def _mean_share(beads: Observations, assumed: FlowField) -> float:
    """Mean of c over the stretches of tracers: 1 in a flat profile, MEAN between plates.

    Between the two c is 1 + f (c of plates - 1), of which the mean is 1 + f^2 (MEAN - 1). f is that of the scatter that
    tracers show over time, each stretch by the ratio of its speed to the assumed one there: the range of the middle
    80 % over the median, which an assumed flow that is wrong by one factor leaves, and so does a tenth that lies still.
    By ways, of which some are of two tracers, it would be too small. In drawn samples the mean is at most 1 % off,
    between plates 2 % too small, because the slowest pass no stretch.
    """
    predicted = sample(assumed, beads.position_um)
    power = (predicted**2).sum(axis=1)
    flows = power > 0.05 * max(float(power.mean()), 1e-12)
    if np.count_nonzero(flows) < 3:
        return MEAN
    ratio = (predicted * beads.flow_um_s).sum(axis=1)[flows] / power[flows]
    lasted = 1.0 / np.maximum(ratio, _SLOWEST_SHARE * max(float(np.median(ratio)), 1e-9))
    return 1.0 + float(np.interp(_scatter(ratio, lasted), _scatters(), _FROM_FLAT)) ** 2 * (MEAN - 1.0)


@functools.cache
def _scatters() -> list[float]:
    """The scatter over time of each profile of _FROM_FLAT."""
    plates = 1.5 * (1.0 - ((np.arange(_HEIGHTS) + 0.5) / _HEIGHTS) ** 2)
    return [_scatter(1.0 + each * (plates - 1.0), np.ones(_HEIGHTS)) for each in _FROM_FLAT]


def _scatter(values: Floats, weight: Floats) -> float:
    """The range of the middle 80 % of weighted values over their median."""
    order = np.argsort(values)
    below = np.cumsum(weight[order])
    low, middle, high = values[order][np.searchsorted(below, np.array([0.1, 0.5, 0.9]) * below[-1])]
    return float(high - low) / max(abs(float(middle)), 1e-9)
