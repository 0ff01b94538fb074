"""Noise of the observations: outliers, a factor on what is stated, and means of neighbours where there are many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.mixture_regression import Model
from flowrec.stages.refine.observation_operator import ObservationOperator

MOST_OBSERVATIONS = 120  # of which the evidence is computed: more are first averaged along the way
LEAST_STD = 1e-3  # of the typical observed speed: no observation is more accurate
LEAST_INLIER = 1e-6  # probability: the noise of an observation is divided by it
OUTLIER_SCALE = 3.0  # size of an outlier's components over the typical component of the observations
OUTLIER_NATS = 2.0 * float(np.log(OUTLIER_SCALE / 0.15))  # of two components; the noise is 15 % of the typical speed
NOISE = ("noise", 0.7, 0.6)  # size of the stated noise: name, median, ln_std; a filter states what is safe
NOISIER = 1.3  # noise over the stated one from which on it is reported, and a shaking stage is tried


@dataclass(frozen=True, slots=True, eq=False)
class Robust:
    """Noise of the observations without their outliers."""

    variance: Floats  # (n,) of each component, stated
    inlier: Floats  # (n,) probability
    factor: float  # actual over stated standard deviation


def robust_noise(observed: Observed) -> Robust:
    """Outliers and a common factor of the noise, by a mixture model in which every effect has its usual size."""
    here = observed.operator
    effects = observed.effects(observed.model.base, None)
    design = np.concatenate([2.0 * effect.median * effect.columns for effect in effects if len(effect.columns)])
    variance = noise_variance(here)
    power = (here.flow_um_s**2).sum(axis=1)
    wide = OUTLIER_SCALE**2 * 0.5 * float(np.median(power)) + float(here.std_um_s.max()) ** 2 + 1e-9
    misfit = here.flow_um_s - here.predict(observed.model.base)
    # Effects with a kernel (changes in time, errors of the grid and of the profile) have no columns: their variance is
    # added to that of the noise.
    local = sum(
        (
            effect.median**2 * 0.5 * np.diag(effect.kernel).reshape(-1, 2).sum(axis=1)
            for effect in effects
            if effect.kernel is not None
        ),
        np.zeros(here.count),
    )
    found = Model(design.reshape(len(design), -1, 2), misfit, variance + local, wide).fit()
    return Robust(variance, np.maximum(found.inlier, LEAST_INLIER), found.noise_factor)


def noise_variance(operator: ObservationOperator) -> Floats:
    """(n,) stated variance of each component."""
    # A std of 0 in solid would be a contradiction that no noise explains.
    least = LEAST_STD**2 * float(np.median((operator.flow_um_s**2).sum(axis=1))) + 1e-12
    return np.asarray(operator.std_um_s**2 + least)


def outlying(robust: Robust) -> float:
    """Reduction of a hypothesis's evidence for its outliers, in nats.

    The noise variance of an observation is divided by its probability to be an inlier, so the evidence already contains
    a loss of -ln(inlier) for each one that is not averaged with others; that part is not subtracted twice.
    """
    nats = OUTLIER_NATS * float((1.0 - robust.inlier).sum())
    return nats if len(robust.inlier) > MOST_OBSERVATIONS else nats + float(np.log(robust.inlier).sum())


def groups(operator: ObservationOperator) -> NDArray[np.intp]:
    """(n,) number of the mean that each observation is a part of, in order; each tracer's is one by itself.

    Neighbours along the way of a robot show nearly the same flow, one tracer and the next do not.
    """
    count = operator.count
    tracers = 0 if operator.tracer is None else int(np.count_nonzero(operator.tracer >= 0.0))
    rolled = count - tracers
    means = min(max(MOST_OBSERVATIONS - tracers, 1), rolled)
    return np.concatenate([np.arange(rolled) * means // max(rolled, 1), means + np.arange(tracers)])


def averages(robust: Robust, operator: ObservationOperator) -> Floats:
    """(m, 2 n) weighted means of neighbours along the way, x and y of each in turn; the identity for few."""
    count = operator.count
    group = groups(operator)
    weight = robust.inlier / robust.variance
    matrix = np.zeros((group[-1] + 1, count))
    matrix[group, np.arange(count)] = weight
    return np.kron(matrix / matrix.sum(axis=1, keepdims=True), np.eye(2))
