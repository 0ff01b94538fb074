"""The most probable parameters of a linear model from observations some of which are nonsense.

Each observation is either right, with Gaussian noise of its stated variance, or an outlier from a wide distribution
(a mixture; Box and Tiao, 1968): Student's with two degrees of freedom, so that how far off an outlier is hardly
matters. The weights are the probabilities of being right. A descent from one start can lock on a wrong subset, so
there are three (all observations at once; all noise widened by what the prior leaves open and narrowed step by step:
graduated non-convexity, Blake and Zisserman, 1987; and the prior itself), and the most probable end is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SHARE, SHARES_WORTH = 0.05, 20.0  # of outliers beforehand, and how many observations that belief is worth
ANNEALED = (1.0, 0.3, 0.1, 0.03, 0.01, 0.0)  # of the prior's predictive variance, added to the noise
ODDS = 2.0  # ln of the odds that a stated noise is right
LEAST_FOR_ALIKENESS = 8  # observations
MEDIAN = 2.0 * np.log(2.0)  # of chi squared with two degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Gaussian approximation of the posterior around its most probable point, in prior standard deviations."""

    mean: Floats  # (parameters,)
    covariance: Floats  # (parameters, parameters)
    trust: Floats  # (n,) probability that an observation is right
    noise_factor: float  # at least 1: how many times larger than stated the noise is
    copies: float  # at least 1: how many observations in a row say the same wrong thing
    energy: float  # minus ln of prior times likelihood, but for a constant

    def moved(self, design: Floats, misfit: Floats, variance: Floats) -> Fit:
        """The same for other misfits, with the same trust in each observation."""
        weight = self.trust / (self.copies * self.noise_factor**2 * variance)
        mean, covariance = _gaussian(design, misfit, weight)
        return replace(self, mean=mean, covariance=covariance)


def fit(design: Floats, misfit: Floats, variance: Floats, wide: float, max_iterations: int = 60) -> Fit:
    """Parameters z ~ N(0, 1) for misfit = z design + noise.

    Parameters
    ----------
    design : (parameters, n, 2)
    misfit : (n, 2) what was observed beyond the prior mean
    variance : (n,) of each component's noise
    wide : squared scale of an outlier's components
    """
    best = _best(design, misfit, variance, wide, max_iterations)
    # The median does not know of outliers if they are few; the quantile that leaves out those now distrusted does not
    # know of them if they are many. The more probable wins, and the stated noise by itself has the odds.
    for quantile in (0.5, 0.5 * float(best.trust.mean())):
        found = best
        for _ in range(3):
            factor = _noise_factor(design, misfit, variance, found, quantile)
            if factor <= 1.02 * found.noise_factor:
                break
            found = replace(_best(design, misfit, factor**2 * variance, wide, max_iterations), noise_factor=factor)
        if found.energy + ODDS * (found.noise_factor > 1.0) < best.energy + ODDS * (best.noise_factor > 1.0):
            best = found
    # What the model can not explain is alike in neighbours: they are fewer than they look.
    alike = _alikeness(misfit - np.tensordot(best.mean, design, axes=1), best.trust, variance)
    if alike > 0.0:
        few = (1.0 + alike) / (1.0 - alike)
        mean, covariance = _gaussian(design, misfit, best.trust / (few * best.noise_factor**2 * variance))
        best = replace(best, mean=mean, covariance=covariance, copies=few)
    return best


def _alikeness(left: Floats, trust: Floats, variance: Floats) -> float:
    """Correlation of what is left of each observation with that of the next, beyond what chance does; at most 0.95."""
    scaled = left * np.sqrt(trust / variance)[:, None]
    count = len(scaled)
    square = float((scaled**2).sum())
    if count < LEAST_FOR_ALIKENESS or square == 0.0:
        return 0.0
    found = float((scaled[1:] * scaled[:-1]).sum()) / square
    return float(min(max(found - 2.0 / np.sqrt(2.0 * count), 0.0), 0.95))


def _noise_factor(design: Floats, misfit: Floats, variance: Floats, found: Fit, quantile: float) -> float:
    """From one quantile of the misfits; one standard deviation of itself is let pass."""
    left = misfit - np.tensordot(found.mean, design, axes=1)
    count = len(variance)
    free = max(count - 0.5 * float((1.0 - np.diag(found.covariance)).sum()), 0.25 * count)
    seen = float(np.quantile((left**2).sum(axis=1) / variance, quantile)) / MEDIAN * count / free
    return float(np.sqrt(max(1.0, seen / (1.0 + 1.44 / np.sqrt(count)))))


def _best(design: Floats, misfit: Floats, variance: Floats, wide: float, max_iterations: int) -> Fit:
    count = len(variance)
    open_ = 0.5 * (design**2).sum(axis=(0, 2))
    ends = []
    for start in ("everything", "annealed", "prior"):
        if start == "annealed":
            mean = np.zeros(len(design))
            for share in ANNEALED:
                widened = variance + share * open_
                trust = _trust(misfit - np.tensordot(mean, design, axes=1), widened, wide, SHARE)
                mean, _ = _gaussian(design, misfit, trust / widened)
        elif start == "everything":
            mean, _ = _gaussian(design, misfit, 1.0 / variance)
        else:
            mean = np.zeros(len(design))
        share = SHARE
        for _ in range(max_iterations):
            left = misfit - np.tensordot(mean, design, axes=1)
            trust = _trust(left, variance, wide, share)
            share = (SHARE * SHARES_WORTH + float((1.0 - trust).sum())) / (SHARES_WORTH + count)
            new, covariance = _gaussian(design, misfit, trust / variance)
            settled = float(np.abs(new - mean).max()) < 1e-3
            mean = new
            if settled:
                break
        energy = _energy(misfit - np.tensordot(mean, design, axes=1), variance, wide, mean)
        ends.append(Fit(mean, covariance, trust, 1.0, 1.0, energy))
        if start == "annealed" and float(np.abs(ends[0].mean - mean).max()) < 1e-2:
            break  # both agree: there is nothing to lock on
    return min(ends, key=lambda end: end.energy)


def _gaussian(design: Floats, misfit: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance for weights (n,)."""
    flat = design.reshape(len(design), -1)
    weighted = flat * np.repeat(weight, 2)
    covariance = np.asarray(np.linalg.inv(np.eye(len(design)) + weighted @ flat.T), np.float64)
    return covariance @ (weighted @ misfit.ravel()), covariance


def _trust(left: Floats, variance: Floats, wide: float, share: float) -> Floats:
    """(n,) probability of being right."""
    square = (left**2).sum(axis=1)
    wrong = np.log(share / (1.0 - share)) + _wrong(square, wide) + 0.5 * square / variance + np.log(variance)
    return np.asarray(1.0 / (1.0 + np.exp(np.minimum(wrong, 700.0))))


def _wrong(square: Floats, wide: float) -> Floats:
    """The ln density of an outlier at the squared distance; as of a right one, without 1 / (2 pi)."""
    return np.asarray(-2.0 * np.log1p(0.5 * square / wide) - np.log(wide))


def _energy(left: Floats, variance: Floats, wide: float, mean: Floats) -> float:
    """Minus ln posterior of the mixture, but for a constant."""
    square = (left**2).sum(axis=1)
    right = np.log(1.0 - SHARE) - 0.5 * square / variance - np.log(variance)
    return float(0.5 * (mean**2).sum() - np.logaddexp(right, np.log(SHARE) + _wrong(square, wide)).sum())
