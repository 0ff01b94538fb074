"""The fit of a linear model against linear least squares with the prior as observations of its own."""

import numpy as np
import pytest

from flowrec.stages.refine.mixture_regression import OUTLIERS, Model

WIDE = 1e6  # outliers would lie far beyond everything here


def case(seed, parameters=4, count=12, std=0.5, scale=0.1):
    """Observations of parameters z ~ N(0, 1), so few and so noisy that the prior counts for about as much."""
    rng = np.random.default_rng(seed)
    design = scale * rng.standard_normal((parameters, count, 2))
    misfit = np.tensordot(rng.standard_normal(parameters), design, axes=1) + std * rng.standard_normal((count, 2))
    return design, misfit, np.full(count, std**2)


def least_squares(design, misfit, variance, share):
    """Mean and covariance of min |z|^2 + sum share |misfit - z design|^2 / variance, by stacking the prior's rows."""
    weight = np.sqrt(np.repeat(share / variance, 2))
    flat = design.reshape(len(design), -1) * weight
    stacked = np.vstack([flat.T, np.eye(len(design))])
    wanted = np.concatenate([misfit.ravel() * weight, np.zeros(len(design))])
    mean = np.linalg.lstsq(stacked, wanted, rcond=None)[0]
    return mean, np.linalg.inv(stacked.T @ stacked)


@pytest.mark.parametrize("seed", range(5))
def test_the_fit_is_that_of_least_squares_with_one_row_per_prior(seed):
    design, misfit, variance = case(seed)
    found = Model(design, misfit, variance, WIDE).fit()
    assert found.inlier.min() > 0.9
    mean, covariance = least_squares(
        design, misfit, found.correlation_length * found.noise_factor**2 * variance, found.inlier
    )
    assert 0.2 < np.diag(covariance).mean() < 0.9, "neither the prior nor the observations rule"
    np.testing.assert_allclose(found.mean, mean, atol=2e-3)
    np.testing.assert_allclose(found.covariance, covariance, rtol=2e-3, atol=1e-4)


def test_what_no_observation_reaches_keeps_its_prior():
    design, misfit, variance = case(1)
    design[2] = 0.0
    found = Model(design, misfit, variance, WIDE).fit()
    assert found.mean[2] == pytest.approx(0.0, abs=1e-12)
    assert found.covariance[2, 2] == pytest.approx(1.0)


def test_moved_misfits_move_the_mean_as_least_squares_says():
    design, misfit, variance = case(2)
    found = Model(design, misfit, variance, WIDE).fit()
    moved = Model(design, 2.0 * misfit, variance, WIDE).refit(found)
    mean, covariance = least_squares(
        design, 2.0 * misfit, found.correlation_length * found.noise_factor**2 * variance, found.inlier
    )
    np.testing.assert_allclose(moved.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(moved.covariance, covariance, rtol=1e-9)


def test_the_energy_is_minus_the_ln_of_prior_times_likelihood():
    def posterior(found, design, misfit, variance):
        left = ((misfit - np.tensordot(found.mean, design, axes=1)) ** 2).sum(axis=1)
        right = (1.0 - OUTLIERS) / (2.0 * np.pi * variance) * np.exp(-0.5 * left / variance)
        # Student's with two degrees of freedom in two dimensions.
        wrong = OUTLIERS / (2.0 * np.pi * WIDE) * (1.0 + 0.5 * left / WIDE) ** -2.0
        return -np.log(right + wrong).sum() + 0.5 * (found.mean**2).sum() - len(variance) * np.log(2.0 * np.pi)

    cases = [case(seed, std=0.1) for seed in (3, 4)]
    fits = [Model(*each, WIDE).fit() for each in cases]
    assert all(found.noise_factor == 1.0 for found in fits)
    for found, each in zip(fits, cases, strict=True):
        assert found.energy == pytest.approx(posterior(found, *each), abs=2e-2)
