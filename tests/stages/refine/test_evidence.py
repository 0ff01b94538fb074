"""Evidence against draws of its own model, and against generalised least squares where the sizes are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from flowrec.stages.refine.evidence import Effect, EffectModel, _points
from flowrec.stages.refine.noise import MOST_OBSERVATIONS, OUTLIER_NATS, Robust, outlying


def drawn(seed, count=40, unknowns=6, size=0.3, noise=0.1, ln_std=1.0, median=0.3):
    """Observations of unknowns of one size, and the unknowns."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((unknowns, count))
    z = size * rng.standard_normal(unknowns)
    y = z @ columns + noise * rng.standard_normal(count)
    return EffectModel(y, noise**2 * np.eye(count), [Effect("effect", median, ln_std, columns)]), z


def test_with_known_sizes_the_posterior_is_that_of_generalised_least_squares():
    rng = np.random.default_rng(1)
    root = rng.standard_normal((30, 30))
    noise = 0.01 * root @ root.T + 0.02 * np.eye(30)
    one, two = rng.standard_normal((2, 3, 30))
    y = rng.standard_normal(30)
    evidence = EffectModel(y, noise, [Effect("one", 0.7, 1e-4, one), Effect("two", 0.2, 1e-4, two)])
    sizes = evidence.sizes()
    found = evidence.posterior(sizes)
    design = np.concatenate([one, two])
    precision = design @ np.linalg.solve(noise, design.T) + np.diag(np.repeat([0.7, 0.2], 3) ** -2.0)
    mean = np.linalg.solve(precision, design @ np.linalg.solve(noise, y))
    np.testing.assert_allclose(found.mean, mean, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(evidence.most_probable(sizes), mean, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-3, atol=1e-6)
    total = noise + 0.7**2 * one.T @ one + 0.2**2 * two.T @ two
    ln_density = -0.5 * (y @ np.linalg.solve(total, y) + np.linalg.slogdet(2.0 * np.pi * total)[1])
    assert found.evidence == pytest.approx(ln_density, abs=0.1)
    assert sizes.evidence == pytest.approx(ln_density, abs=0.1)


@pytest.mark.parametrize("size", [0.1, 0.3, 1.0])
def test_the_size_of_an_effect_is_recovered_from_what_it_does(size):
    found = [np.exp(drawn(seed, unknowns=12, size=size, count=60)[0].sizes().mode[0]) for seed in range(12)]
    assert np.median(found) == pytest.approx(size, rel=0.35)


@pytest.mark.parametrize("size", [0.03, 0.3, 1.5])
def test_two_standard_deviations_cover_what_the_model_draws_also_where_the_hyperprior_is_off(size):
    scores = []
    for seed in range(40):
        evidence, z = drawn(seed, count=10, unknowns=4, size=size, noise=0.3)
        found = evidence.posterior(evidence.sizes())
        scores.append((found.mean - z) / np.sqrt(np.diag(found.covariance)))
    assert 0.9 <= np.mean(np.abs(scores) < 2.0) <= (0.985 if size > 0.1 else 1.0)


def test_effects_that_look_alike_are_uncertain_alone_and_certain_together():
    rng = np.random.default_rng(3)
    column = rng.standard_normal((1, 40))
    y = 0.2 * column[0] + 0.01 * rng.standard_normal(40)
    twins = [Effect(name, 0.1, 1.0, column) for name in ("one", "two")]
    evidence = EffectModel(y, 1e-4 * np.eye(40), twins)
    found = evidence.posterior(evidence.sizes())
    alone, together = np.sqrt(found.covariance[0, 0]), np.sqrt(found.covariance.sum())
    assert alone > 0.05 and together < 0.01
    assert found.mean.sum() == pytest.approx(0.2, abs=0.01)
    assert abs(found.mean[0] - 0.2) < 2.5 * alone and abs(found.mean[0]) < 2.5 * alone


def test_the_points_of_the_sizes_have_the_moments_of_a_normal_distribution():
    for dimensions in (3, 18, 40):
        points = _points(dimensions)
        np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(points.T @ points / len(points), np.eye(dimensions), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_sizes_are_the_most_probable_ones(seed):
    # Two effects whose hyperpriors are off, and pull: an independent density has its maximum where the sizes are.
    from scipy.stats import multivariate_normal, norm

    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((2, 5, 40))
    y = 0.8 * rng.standard_normal(5) @ columns[0] + 0.02 * rng.standard_normal(5) @ columns[1]
    y = y + 0.1 * rng.standard_normal(40)
    effects = [Effect("large", 0.3, 0.4, columns[0]), Effect("small", 0.3, 0.7, columns[1])]

    def ln_density(ln_sizes):
        covariance = 0.01 * np.eye(40)
        ln_prior = 0.0
        for ln_size, effect in zip(ln_sizes, effects, strict=True):
            covariance = covariance + np.exp(2.0 * ln_size) * effect.columns.T @ effect.columns
            ln_prior += norm.logpdf(ln_size, np.log(effect.median), effect.ln_std)
        return multivariate_normal.logpdf(y, np.zeros(40), covariance) + ln_prior

    mode = EffectModel(y, 0.01 * np.eye(40), effects).sizes().mode
    best = minimize(lambda ln_sizes: -ln_density(ln_sizes), mode, method="Nelder-Mead").x
    assert mode == pytest.approx(best, abs=0.05)
    assert np.all(np.abs(mode - np.log([0.3, 0.3])) > 0.3), "the hyperpriors are off"


def test_the_sizes_are_known_as_well_as_the_expected_information_says():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(30, 30))
    few = Effect("few", 0.7, 0.5, rng.normal(size=(3, 30)))
    both = Effect("both", 0.2, 0.8, rng.normal(size=(2, 30)), 0.1 * root @ root.T)
    evidence = EffectModel(rng.normal(size=30), 0.3 * np.eye(30), [few, both])
    sizes = evidence.sizes()
    inverse = np.linalg.inv(evidence.covariance(sizes.mode))
    slopes = [2.0 * np.exp(2.0 * size) * one.matrix for size, one in zip(sizes.mode, (few, both), strict=True)]
    # Half of the trace of C^-1 dC C^-1 dC', of a normal distribution with zero mean, and the hyperprior's precision.
    information = [[0.5 * np.trace(inverse @ one @ inverse @ other) for other in slopes] for one in slopes]
    np.testing.assert_allclose(sizes.covariance, np.linalg.inv(information + np.diag([0.5**-2, 0.8**-2])), rtol=1e-9)


def test_an_unknown_that_nothing_observes_keeps_the_mean_square_of_the_sizes_of_its_effect():
    rng = np.random.default_rng(8)
    seen, other = rng.standard_normal((2, 1, 20))
    columns = np.concatenate([seen, np.zeros((1, 20))])
    y = 0.5 * seen[0] + 0.3 * rng.standard_normal(20)
    evidence = EffectModel(y, 0.09 * np.eye(20), [Effect("one", 0.3, 1.5, columns), Effect("other", 0.2, 1.0, other)])
    found = evidence.posterior(evidence.sizes())
    assert found.covariance[1, 1] == pytest.approx(found.square_sizes[0], rel=0.01)
    assert found.square_sizes[0] > 1.2 * found.sizes[0] ** 2


def test_what_outliers_cost_a_hypothesis_is_subtracted_once():
    robust = Robust(np.ones(MOST_OBSERVATIONS), np.full(MOST_OBSERVATIONS, 0.5), 1.0)
    nats = MOST_OBSERVATIONS * (0.5 * OUTLIER_NATS + np.log(0.5))
    assert outlying(robust) == pytest.approx(nats)
    # Of observations that are averaged with others the evidence does not hold the loss.
    more = replace(robust, inlier=np.append(robust.inlier, 1.0))
    assert outlying(more) == pytest.approx(nats - MOST_OBSERVATIONS * np.log(0.5))
