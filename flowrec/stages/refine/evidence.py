"""Gaussian evidence: how likely observations are under unknowns of unknown size, and what these unknowns then are.

The observations y (m,) are a sum of effects and noise, y ~ N(0, C) with

    C = R + sum_g s_g^2 G_g

Each effect g (boundary values, the robot's um per revolution, errors of the map along the channels, and others) has a
size s_g, one standard deviation of its unknowns, and a matrix G_g = D_g' D_g of its columns, or its own kernel. Sizes
are unknown themselves: ln s_g has a normal hyperprior. The marginal likelihood of the sizes (restricted likelihood for
the effects that are integrated out) is maximised by a quasi-Newton method; the posterior of the sizes around that mode
is a normal distribution with the expected information as its precision, corrected by importance weights at fixed
points (MacKay 1992; Rue, Martino and Chopin 2009 for the idea). The posterior of the unknowns is averaged
over the points, so an effect that the observations can not tell from another one widens the error bars by what it might
be: a mean over models, not the choice of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # its linalg and optimize load at first use, not at start-up

from flowrec.core import Floats

POINTS = 32  # at which the posterior of the sizes is integrated; a power of two above the number of sizes
RANGE = (-6.0, 4.0)  # of a ln size, in standard deviations of its hyperprior
NEGLIGIBLE = 1e-3  # weight of a point, relative to the largest, that is left out


@dataclass(frozen=True, eq=False)  # no slots, for the cached matrix
class Effect:
    """One kind of unknown, or of error, and the hyperprior of its size."""

    name: str
    median: float  # of the size s
    ln_std: float  # of ln s
    columns: Floats  # (unknowns, m) what a unit of each unknown does to the observations; (0, m) for a kernel
    kernel: Floats | None = None  # (m, m) of what no unknown stands for, in addition

    @cached_property
    def matrix(self) -> Floats:
        """(m, m) covariance that it adds at size 1."""
        return np.asarray(self.columns.T @ self.columns + (0.0 if self.kernel is None else self.kernel))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Posterior of the unknowns of all effects with columns, in order, averaged over their sizes."""

    evidence: float  # ln of the marginal likelihood
    mean: Floats  # (unknowns,)
    covariance: Floats  # (unknowns, unknowns)
    sizes: Floats  # (effects,) geometric posterior mean of each size
    ln_size_std: Floats  # (effects,)
    square_sizes: Floats  # (effects,) posterior mean of the square of each size


@dataclass(frozen=True, eq=False)  # no slots, for what is computed when it is first asked for
class Sizes:
    """The posterior of ln sizes as a normal distribution, and the ln evidence by Laplace's method."""

    mode: Floats  # (effects,)
    density: float  # ln of likelihood and hyperprior at the mode, but for the constant of the latter
    model: EffectModel

    @cached_property
    def covariance(self) -> Floats:
        """(effects, effects) the inverse of the expected information."""
        count = len(self.mode)
        inverse = np.linalg.inv(self.model.covariance(self.mode))
        # C^-1 G of each; of few unknowns in two thin products.
        parts = [
            inverse @ one.matrix if one.kernel is not None else (inverse @ one.columns.T) @ one.columns
            for one in self.model.effects
        ]
        scaled = 2.0 * np.exp(2.0 * self.mode)[:, None, None] * np.stack(parts)
        # Half of the traces of the products of each two.
        products = scaled.reshape(count, -1) @ scaled.transpose(0, 2, 1).reshape(count, -1).T
        information = np.diag(1.0 / self.model.ln_stds**2) + 0.25 * (products + products.T)
        return np.asarray(np.linalg.inv(information), np.float64)

    @cached_property
    def evidence(self) -> float:
        """By Laplace: the hyperprior's density is normalised, its constant is in the determinants."""
        spread = 0.5 * float(np.linalg.slogdet(self.covariance)[1])
        return self.density + spread - float(np.log(self.model.ln_stds).sum())


@dataclass(frozen=True, eq=False)  # no slots, for the stacked matrices
class EffectModel:
    """Observations y (m,) with noise of covariance R (m, m), and the effects that may explain them."""

    y: Floats
    noise: Floats
    effects: Sequence[Effect]

    def sizes(self, start: Floats | None = None) -> Sizes:
        """The most probable sizes and their uncertainty."""
        medians, stds = self.ln_medians, self.ln_stds

        # In standard deviations of the hyperprior, because these differ by a factor of 65.
        def cost(scaled: Floats) -> tuple[float, Floats]:
            value, gradient = self._likelihood(medians + stds * scaled)
            return -value + 0.5 * float(scaled @ scaled), scaled - stds * gradient

        begin = np.zeros(len(stds)) if start is None else np.clip((start - medians) / stds, *RANGE)
        options = {"maxiter": 40, "ftol": 1e-5}
        found = scipy.optimize.minimize(
            cost, begin, jac=True, method="L-BFGS-B", bounds=[RANGE] * len(stds), options=options
        )
        return Sizes(np.asarray(medians + stds * found.x, np.float64), -float(found.fun), self)

    def posterior(self, sizes: Sizes) -> Posterior:
        """The unknowns, averaged over the sizes."""
        columns = np.concatenate([effect.columns for effect in self.effects])
        owner = np.repeat(np.arange(len(self.effects)), [len(effect.columns) for effect in self.effects])
        medians, stds = self.ln_medians, self.ln_stds
        normal = _points(len(medians))
        root = np.linalg.cholesky(sizes.covariance)
        points = sizes.mode + normal @ root.T
        points = np.clip(points, medians + RANGE[0] * stds, medians + RANGE[1] * stds)
        ln_weight = np.empty(len(points))
        factors = [self._factorise(point) for point in points]
        for index, (point, (factor, solved)) in enumerate(zip(points, factors, strict=True)):
            value = -0.5 * float(self.y @ solved) - float(np.log(np.diag(factor)).sum())
            value -= 0.5 * len(self.y) * np.log(2.0 * np.pi)
            ln_prior = -0.5 * float((((point - medians) / stds) ** 2).sum()) - float(np.log(stds).sum())
            ln_proposal = -0.5 * float(normal[index] @ normal[index]) - float(np.log(np.diag(root)).sum())
            ln_weight[index] = value + ln_prior - ln_proposal
        top = float(ln_weight.max())
        weight = np.exp(ln_weight - top)
        # One point that outweighs all others is an accident of the sampling: no weight above the mean of the rest.
        weight = np.minimum(weight, np.sqrt(float(weight.mean()) * float(weight.max())))
        evidence = top + float(np.log(np.exp(ln_weight - top).mean()))
        weight /= weight.sum()
        mean, square = np.zeros(len(columns)), np.zeros((len(columns), len(columns)))
        for share, point, (factor, solved) in zip(weight, points, factors, strict=True):
            if share < NEGLIGIBLE * weight.max():
                continue
            variance = np.exp(2.0 * point)[owner]
            effect = variance[:, None] * columns
            one = effect @ solved
            half = scipy.linalg.solve_triangular(factor, effect.T, lower=True, check_finite=False)
            mean += share * one
            square += share * (np.diag(variance) - half.T @ half + np.outer(one, one))
        covariance = square - np.outer(mean, mean)
        centre = weight @ points
        spread = np.sqrt(np.maximum(weight @ (points - centre) ** 2, 0.0))
        square_sizes = weight @ np.exp(2.0 * points)
        return Posterior(evidence, mean, 0.5 * (covariance + covariance.T), np.exp(centre), spread, square_sizes)

    def most_probable(self, sizes: Sizes) -> Floats:
        """(unknowns,) at the most probable sizes."""
        _, solved = self._factorise(sizes.mode)
        return np.concatenate(
            [
                np.exp(2.0 * ln_size) * (effect.columns @ solved)
                for effect, ln_size in zip(self.effects, sizes.mode, strict=True)
            ]
        )

    def covariance(self, ln_sizes: Floats) -> Floats:
        """(m, m) of the observations at sizes of the effects."""
        sum_of_effects = np.exp(2.0 * ln_sizes) @ self.matrices.reshape(len(self.matrices), -1)
        return np.asarray(self.noise + sum_of_effects.reshape(self.noise.shape))

    @cached_property
    def matrices(self) -> Floats:
        """(effects, m, m) what each effect adds to the covariance at size 1."""
        return np.stack([effect.matrix for effect in self.effects])

    @property
    def ln_medians(self) -> Floats:
        """(effects,) of the sizes."""
        return np.log([effect.median for effect in self.effects])

    @property
    def ln_stds(self) -> Floats:
        """(effects,) of ln sizes."""
        return np.array([effect.ln_std for effect in self.effects])

    def _factorise(self, ln_sizes: Floats) -> tuple[Floats, Floats]:
        """Cholesky factor (m, m) of the covariance, and the covariance's inverse times y.

        LAPACK's routines are called as they are: the checks of scipy.linalg take as long as a factor of 100 x 100.
        """
        factor, failed = scipy.linalg.lapack.dpotrf(self.covariance(ln_sizes), lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError(f"the covariance of the observations is not positive definite ({failed})")
        return factor, scipy.linalg.lapack.dpotrs(factor, self.y, lower=1)[0]

    def _likelihood(self, ln_sizes: Floats) -> tuple[float, Floats]:
        """Ln N(y; 0, C) and its gradient (effects,) by ln size."""
        factor, solved = self._factorise(ln_sizes)
        value = -0.5 * float(self.y @ solved) - float(np.log(np.diag(factor)).sum())
        # Of the symmetric inverse one triangle is computed, the other is zero; all that follows is a sum over both.
        inverse, _ = scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
        inverse *= 2.0
        np.einsum("ii->i", inverse)[:] *= 0.5
        # s^2 (u^T G u - trace(C^-1 G)) with u = C^-1 y, of all effects at once.
        both = np.multiply.outer(solved, solved) - inverse.T  # in the order of the matrices in memory
        gradient = np.exp(2.0 * ln_sizes) * (self.matrices.reshape(len(self.matrices), -1) @ both.ravel())
        return value - 0.5 * len(self.y) * np.log(2.0 * np.pi), gradient


def gains_of_trials(columns: Floats, covariance: Floats, y: Floats, sizes: Sequence[float]) -> Floats:
    """(k,) ln evidence gained by each of k effects on top of what else may explain y, of covariance (m, m).

    `columns` (k, unknowns, m); summed over trial sizes.
    """
    inverse = np.linalg.inv(covariance)
    precision = columns @ inverse @ columns.transpose(0, 2, 1)
    score = columns @ (inverse @ y)
    gains = []
    for size in sizes:
        inner = np.eye(columns.shape[1]) + size**2 * precision
        explained = (score * np.linalg.solve(inner, score[..., None])[..., 0]).sum(axis=1)
        gains.append(0.5 * size**2 * explained - 0.5 * np.linalg.slogdet(inner)[1])
    return np.asarray(np.logaddexp.reduce(gains, axis=0))


def _points(dimensions: int) -> Floats:
    """(POINTS or more, dimensions) corners of a cube, +1 and -1: mean and covariance are those of a standard normal.

    Columns of a Hadamard matrix are orthogonal to each other and to the first, which is constant (the design of
    Plackett and Burman 1946). The points lie at the distance sqrt(dimensions), where a normal distribution has its
    mass. (Of a Halton sequence in seventeen dimensions the first 32 points are correlated ramps.)
    """
    count = POINTS
    while count <= dimensions:
        count *= 2
    return np.asarray(scipy.linalg.hadamard(count)[:, 1 : dimensions + 1], np.float64)
