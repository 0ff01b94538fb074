"""Null models: where their few assumptions hold they find the flow, and the scores of all models are published ones."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from flowrec.bench.harness import flow_scores
from flowrec.bench.null_models import NULL_MODELS, NullModel
from flowrec.bench.vessels import MASK_ERRORS
from flowrec.core.errors import FlowError
from flowrec.core.messages import Observations
from flowrec.physics import ChipSettings, FlowSolver, load_chip, sample


@pytest.fixture(scope="module")
def world():
    """A bifurcation of half its size, its assumed flow, the true one, and observations with 2 % noise in both arms.

    Beside it lies a pixel of fluid that no opening reaches, as a threshold leaves it in the mask of a picture.
    """
    chip = load_chip(ChipSettings())
    mask = chip.mask[::2, ::2].copy()
    mask[2, 2] = True
    chip = replace(
        chip,
        mask=mask,
        openings=tuple(replace(o, first=(o.first + 1) // 2, last=o.last // 2) for o in chip.openings),
    )
    solver = FlowSolver()
    assumed = solver.solve(chip)
    values = chip.boundary_values.copy()
    values[0] *= 1.3
    true = solver.solve(chip.with_boundary(values))
    rows, columns = np.nonzero(chip.mask)
    seen = np.arange(7, len(rows), 23)
    places = chip.um_per_px * np.column_stack([columns, rows])[seen].astype(float)
    flow = sample(true, places).astype(float)
    std = 0.02 * np.sqrt((flow**2).sum(axis=1).mean())
    flow += std * np.random.default_rng(0).standard_normal(flow.shape)
    return chip, solver, assumed, true, Observations(0, places, flow, np.full(len(places), std))


@pytest.mark.parametrize("name", NULL_MODELS)
def test_a_null_model_finds_a_pump_that_is_a_third_too_fast_and_states_its_error(world, name):
    chip, solver, assumed, true, seen = world
    found = NullModel(name).refine(assumed, seen, chip, solver)
    scores = flow_scores(found, true.velocity_um_s, chip.mask)
    assert flow_scores(assumed, true.velocity_um_s, chip.mask)["error"] > 0.2
    assert scores["error"] < 0.05
    assert scores["within_2_sigma"] > 0.9 and scores["crps"] < 0.03
    outside = found.velocity_um_s[~chip.mask]
    assert not outside.any()


@pytest.mark.parametrize("name", ["modes", "network"])
def test_one_observation_in_five_that_is_nonsense_does_not_pull_a_robust_null_model(world, name):
    chip, solver, assumed, true, seen = world
    flow = seen.flow_um_s.copy()
    flow[::5] = [-300.0, 300.0]
    found = NullModel(name).refine(assumed, replace(seen, flow_um_s=flow), chip, solver)
    assert flow_scores(found, true.velocity_um_s, chip.mask)["error"] < 0.06


def test_without_an_observation_a_null_model_refuses(world):
    chip, solver, assumed, _, _ = world
    with pytest.raises(FlowError, match="no observations"):
        NullModel("modes").refine(
            assumed, Observations(0, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)), chip, solver
        )


def test_the_score_of_a_right_gaussian_is_its_published_expectation(world):
    chip, _, assumed, true, _ = world
    rng, size = np.random.default_rng(1), 7.0
    noise = size * rng.standard_normal(true.velocity_um_s.shape)
    found = replace(assumed, velocity_um_s=(true.velocity_um_s + noise).astype(np.float32))
    found = replace(found, std_um_s=np.full_like(found.velocity_um_s, size))
    scores = flow_scores(found, true.velocity_um_s, chip.mask)
    rms = np.sqrt((true.velocity_um_s[chip.mask] ** 2).sum(axis=1).mean())
    assert scores["crps"] == pytest.approx(size / np.sqrt(np.pi) / rms, rel=0.03)  # Gneiting and Raftery 2007
    assert scores["within_2_sigma"] == pytest.approx(2.0 * scipy.special.ndtr(2.0) - 1.0, abs=0.01)
    assert scores["stated_over_true"] == pytest.approx(1.0, rel=0.02)
    assert scores["error"] == pytest.approx(np.sqrt(2.0) * size / rms, rel=0.02)
    alone = flow_scores(replace(found, std_um_s=None), true.velocity_um_s, chip.mask)
    assert alone["crps"] == pytest.approx(size * np.sqrt(2.0 / np.pi) / rms, rel=0.03)
    assert alone["within_2_sigma"] is None and alone["stated_over_true"] is None


@pytest.mark.parametrize(("name", "least", "most"), [("otsu", 0.8, 1.3), ("adaptive", 0.8, 1.6)])
def test_the_mask_of_a_picture_has_the_channels_of_the_true_one_with_other_walls(world, name, least, most):
    mask = world[0].mask
    found = MASK_ERRORS[name](mask)
    assert least < found.sum() / mask.sum() < most and (found & mask).sum() > 0.9 * min(mask.sum(), found.sum())
    assert (found != mask).any() and (MASK_ERRORS[name](mask) == found).all()
