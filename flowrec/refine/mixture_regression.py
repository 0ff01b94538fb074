"""Robust linear regression with a mixture noise model: most probable parameters from observations with outliers.

Each observation is either an inlier, with Gaussian noise of its stated variance, or an outlier from a wide distribution
(Box and Tiao, 1968): Student's with two degrees of freedom, so the distance of an outlier hardly matters. The weights
are the probabilities of being an inlier. An iteration from one start can converge to a wrong subset, so there are three
starts: all observations at once; all noise widened by the prior's predictive variance and narrowed step by step
(graduated non-convexity, Blake and Zisserman, 1987); and the prior. The most probable result is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

OUTLIERS, OUTLIERS_WORTH = 0.05, 20.0  # prior fraction of outliers, and how many observations that prior is worth
ANNEALING = (1.0, 0.3, 0.1, 0.03, 0.01, 0.0)  # of the prior's predictive variance, added to the noise
LOG_ODDS = 2.0  # ln of the prior odds that a stated noise is right
FEWEST_FOR_CORRELATION = 8  # observations
MEDIAN = 2.0 * np.log(2.0)  # of chi squared with two degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Gaussian approximation of the posterior around its most probable point, in prior standard deviations."""

    mean: Floats  # (parameters,)
    covariance: Floats  # (parameters, parameters)
    inlier: Floats  # (n,) probability that an observation is an inlier
    noise_factor: float  # at least 1: actual over stated standard deviation of the noise
    correlation_length: float  # at least 1: of the residuals, in observations
    energy: float  # minus ln of prior times likelihood, but for a constant

    def with_misfit(self, design: Floats, misfit: Floats, variance: Floats) -> Regression:
        """The same for another misfit, with the same inlier probabilities."""
        weight = self.inlier / (self.correlation_length * self.noise_factor**2 * variance)
        mean, covariance = _gaussian(design, misfit, weight)
        return replace(self, mean=mean, covariance=covariance)


def fit(
    design: Floats, misfit: Floats, variance: Floats, outlier_variance: float, max_iterations: int = 60
) -> Regression:
    """Parameters z ~ N(0, 1) for misfit = z design + noise.

    Parameters
    ----------
    design : (parameters, n, 2)
    misfit : (n, 2) observed minus prior mean
    variance : (n,) of the noise of each component
    outlier_variance : squared scale of an outlier's components
    """
    best = _best(design, misfit, variance, outlier_variance, max_iterations)
    # A few outliers do not change the median of the residuals; many do not change the quantile that leaves out those
    # with a low inlier probability. Try both; the more probable result wins, with prior odds for the stated noise.
    for quantile in (0.5, 0.5 * float(best.inlier.mean())):
        found = best
        for _ in range(3):
            factor = _noise_factor(design, misfit, variance, found, quantile)
            if factor <= 1.02 * found.noise_factor:
                break
            widened = _best(design, misfit, factor**2 * variance, outlier_variance, max_iterations)
            found = replace(widened, noise_factor=factor)
        if found.energy + LOG_ODDS * (found.noise_factor > 1.0) < best.energy + LOG_ODDS * (best.noise_factor > 1.0):
            best = found
    # The model's error is similar at neighbours: correlated observations count for fewer.
    correlation = _correlation(misfit - np.tensordot(best.mean, design, axes=1), best.inlier, variance)
    if correlation > 0.0:
        best = replace(best, correlation_length=(1.0 + correlation) / (1.0 - correlation))
        best = best.with_misfit(design, misfit, variance)
    return best


def _correlation(residual: Floats, inlier: Floats, variance: Floats) -> float:
    """Correlation of each residual with the next, beyond what chance gives; at most 0.95."""
    scaled = residual * np.sqrt(inlier / variance)[:, None]
    count = len(scaled)
    square = float((scaled**2).sum())
    if count < FEWEST_FOR_CORRELATION or square == 0.0:
        return 0.0
    found = float((scaled[1:] * scaled[:-1]).sum()) / square
    return float(min(max(found - 2.0 / np.sqrt(2.0 * count), 0.0), 0.95))


def _noise_factor(design: Floats, misfit: Floats, variance: Floats, found: Regression, quantile: float) -> float:
    """Noise factor from one quantile of the residuals, less one standard deviation of its own uncertainty."""
    residual = misfit - np.tensordot(found.mean, design, axes=1)
    count = len(variance)
    free = max(count - 0.5 * float((1.0 - np.diag(found.covariance)).sum()), 0.25 * count)
    ratio = float(np.quantile((residual**2).sum(axis=1) / variance, quantile)) / MEDIAN * count / free
    return float(np.sqrt(max(1.0, ratio / (1.0 + 1.44 / np.sqrt(count)))))


def _best(design: Floats, misfit: Floats, variance: Floats, outlier_variance: float, max_iterations: int) -> Regression:
    """The most probable result of the three starts, with a noise factor of 1."""
    count = len(variance)
    predictive = 0.5 * (design**2).sum(axis=(0, 2))
    results: list[Regression] = []
    for start in ("all", "annealed", "prior"):
        mean = np.zeros(len(design))
        if start == "all":
            mean, _ = _gaussian(design, misfit, 1.0 / variance)
        elif start == "annealed":
            for fraction in ANNEALING:
                widened = variance + fraction * predictive
                residual = misfit - np.tensordot(mean, design, axes=1)
                inlier = _inlier_probability(residual, widened, outlier_variance, OUTLIERS)
                mean, _ = _gaussian(design, misfit, inlier / widened)
        outliers = OUTLIERS
        for _ in range(max_iterations):
            residual = misfit - np.tensordot(mean, design, axes=1)
            inlier = _inlier_probability(residual, variance, outlier_variance, outliers)
            outliers = (OUTLIERS * OUTLIERS_WORTH + float((1.0 - inlier).sum())) / (OUTLIERS_WORTH + count)
            new, covariance = _gaussian(design, misfit, inlier / variance)
            settled = float(np.abs(new - mean).max()) < 1e-3
            mean = new
            if settled:
                break
        energy = _energy(misfit - np.tensordot(mean, design, axes=1), variance, outlier_variance, mean)
        results.append(Regression(mean, covariance, inlier, 1.0, 1.0, energy))
        if start == "annealed" and float(np.abs(results[0].mean - mean).max()) < 1e-2:
            break  # both agree, so there is no wrong subset to converge to
    return min(results, key=lambda result: result.energy)


def _gaussian(design: Floats, misfit: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Posterior mean and covariance for weights (n,): 1 / variance of Gaussian noise."""
    flat = design.reshape(len(design), -1)
    weighted = flat * np.repeat(weight, 2)
    covariance = np.asarray(np.linalg.inv(np.eye(len(design)) + weighted @ flat.T), np.float64)
    return covariance @ (weighted @ misfit.ravel()), covariance


def _inlier_probability(residual: Floats, variance: Floats, outlier_variance: float, outliers: float) -> Floats:
    """(n,) for a fraction `outliers` of outliers."""
    square = (residual**2).sum(axis=1)
    outlier = _log_outlier_density(square, outlier_variance)
    log_odds = np.log(outliers / (1.0 - outliers)) + outlier + 0.5 * square / variance + np.log(variance)
    return np.asarray(1.0 / (1.0 + np.exp(np.minimum(log_odds, 700.0))))


def _log_outlier_density(square: Floats, outlier_variance: float) -> Floats:
    """The ln density of an outlier at a squared distance, without the factor 1 / (2 pi) that inliers have too."""
    return np.asarray(-2.0 * np.log1p(0.5 * square / outlier_variance) - np.log(outlier_variance))


def _energy(residual: Floats, variance: Floats, outlier_variance: float, mean: Floats) -> float:
    """Minus ln posterior of the mixture, but for a constant."""
    square = (residual**2).sum(axis=1)
    inlier = np.log(1.0 - OUTLIERS) - 0.5 * square / variance - np.log(variance)
    outlier = np.log(OUTLIERS) + _log_outlier_density(square, outlier_variance)
    return float(0.5 * (mean**2).sum() - np.logaddexp(inlier, outlier).sum())
