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
MAX_ITERATIONS = 60  # from each start
LOG_ODDS = 2.0  # ln of the prior odds that a stated noise is right
FEWEST_FOR_CORRELATION = 8  # observations
MEDIAN = 2.0 * np.log(2.0)  # of chi squared with two degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class MixtureRegression:
    """Gaussian approximation of the posterior around its most probable point, in prior standard deviations."""

    mean: Floats  # (parameters,)
    covariance: Floats  # (parameters, parameters)
    inlier: Floats  # (n,) probability that an observation is an inlier
    energy: float  # minus ln of prior times likelihood, but for a constant
    noise_factor: float = 1.0  # at least 1: actual over stated standard deviation of the noise
    correlation_length: float = 1.0  # at least 1: of the residuals, in observations


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """misfit = z design + noise for parameters z ~ N(0, 1)."""

    design: Floats  # (parameters, n, 2)
    misfit: Floats  # (n, 2) observed minus prior mean
    variance: Floats  # (n,) of the noise of each component
    outlier_variance: float  # squared scale of an outlier's components

    def fit(self) -> MixtureRegression:
        """The most probable parameters, with the noise widened where the residuals ask for it."""
        best = self.at_stated_noise()
        # A few outliers do not change the median of the residuals; many do not change the quantile that leaves out
        # those with a low inlier probability. Try both; the more probable result wins, with prior odds for the stated
        # noise.
        for quantile in (0.5, 0.5 * float(best.inlier.mean())):
            found = best
            for _ in range(3):
                factor = self._noise_factor(found, quantile)
                if factor <= 1.02 * found.noise_factor:
                    break
                found = replace(
                    replace(self, variance=factor**2 * self.variance).at_stated_noise(), noise_factor=factor
                )
            best = min(best, found, key=lambda result: result.energy + LOG_ODDS * (result.noise_factor > 1.0))
        # The model's error is similar at neighbours: correlated observations count for fewer.
        correlation = self._correlation(best)
        if correlation > 0.0:
            best = self.refit(replace(best, correlation_length=(1.0 + correlation) / (1.0 - correlation)))
        return best

    def refit(self, found: MixtureRegression) -> MixtureRegression:
        """Fit again with the inlier probabilities, noise factor and correlation length of an earlier fit."""
        weight = found.inlier / (found.correlation_length * found.noise_factor**2 * self.variance)
        mean, covariance = self._gaussian(weight)
        return replace(found, mean=mean, covariance=covariance)

    def residual(self, mean: Floats) -> Floats:
        """(n, 2) misfit that parameters leave."""
        return self.misfit - np.tensordot(mean, self.design, axes=1)

    def at_stated_noise(self) -> MixtureRegression:
        """The most probable result of the three starts, with the stated noise."""
        count = len(self.variance)
        predictive = 0.5 * (self.design**2).sum(axis=(0, 2))
        results: list[MixtureRegression] = []
        for start in ("all", "annealed", "prior"):
            mean = np.zeros(len(self.design))
            if start == "all":
                mean, _ = self._gaussian(1.0 / self.variance)
            elif start == "annealed":
                for fraction in ANNEALING:
                    widened = self.variance + fraction * predictive
                    mean, _ = self._gaussian(self._inlier_probability(mean, widened, OUTLIERS) / widened)
            outliers = OUTLIERS
            for _ in range(MAX_ITERATIONS):
                inlier = self._inlier_probability(mean, self.variance, outliers)
                outliers = (OUTLIERS * OUTLIERS_WORTH + float((1.0 - inlier).sum())) / (OUTLIERS_WORTH + count)
                new, covariance = self._gaussian(inlier / self.variance)
                settled = float(np.abs(new - mean).max()) < 1e-3
                mean = new
                if settled:
                    break
            results.append(MixtureRegression(mean, covariance, inlier, self._energy(mean)))
            if start == "annealed" and float(np.abs(results[0].mean - mean).max()) < 1e-2:
                break  # both agree, so there is no wrong subset to converge to
        return min(results, key=lambda result: result.energy)

    def _correlation(self, found: MixtureRegression) -> float:
        """Correlation of each residual with the next, beyond what chance gives; at most 0.95."""
        scaled = self.residual(found.mean) * np.sqrt(found.inlier / self.variance)[:, None]
        count = len(scaled)
        square = float((scaled**2).sum())
        if count < FEWEST_FOR_CORRELATION or square == 0.0:
            return 0.0
        correlation = float((scaled[1:] * scaled[:-1]).sum()) / square
        return float(min(max(correlation - 2.0 / np.sqrt(2.0 * count), 0.0), 0.95))

    def _noise_factor(self, found: MixtureRegression, quantile: float) -> float:
        """Noise factor from one quantile of the residuals, less one standard deviation of its own uncertainty."""
        count = len(self.variance)
        free = max(count - 0.5 * float((1.0 - np.diag(found.covariance)).sum()), 0.25 * count)
        chi2 = (self.residual(found.mean) ** 2).sum(axis=1) / self.variance
        ratio = float(np.quantile(chi2, quantile)) / MEDIAN * count / free
        return float(np.sqrt(max(1.0, ratio / (1.0 + 1.44 / np.sqrt(count)))))

    def _gaussian(self, weight: Floats) -> tuple[Floats, Floats]:
        """Posterior mean and covariance for weights (n,): 1 / variance of Gaussian noise."""
        flat = self.design.reshape(len(self.design), -1)
        weighted = flat * np.repeat(weight, 2)
        covariance = np.asarray(np.linalg.inv(np.eye(len(flat)) + weighted @ flat.T), np.float64)
        return covariance @ (weighted @ self.misfit.ravel()), covariance

    def _inlier_probability(self, mean: Floats, variance: Floats, outliers: float) -> Floats:
        """(n,) for a fraction `outliers` of outliers and noise of variance (n,)."""
        square = (self.residual(mean) ** 2).sum(axis=1)
        odds = np.log(outliers / (1.0 - outliers))
        log_odds = odds + self._log_outlier_density(square) + 0.5 * square / variance + np.log(variance)
        return np.asarray(1.0 / (1.0 + np.exp(np.minimum(log_odds, 700.0))))

    def _log_outlier_density(self, square: Floats) -> Floats:
        """The ln density of an outlier at a squared distance, without the factor 1 / (2 pi) that inliers have too."""
        return np.asarray(-2.0 * np.log1p(0.5 * square / self.outlier_variance) - np.log(self.outlier_variance))

    def _energy(self, mean: Floats) -> float:
        """Minus ln posterior of the mixture, but for a constant."""
        square = (self.residual(mean) ** 2).sum(axis=1)
        inlier = np.log(1.0 - OUTLIERS) - 0.5 * square / self.variance - np.log(self.variance)
        outlier = np.log(OUTLIERS) + self._log_outlier_density(square)
        return float(0.5 * (mean**2).sum() - np.logaddexp(inlier, outlier).sum())
