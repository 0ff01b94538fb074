"""The stated error of a refined map against its error where the model is right, over truths drawn from its prior."""

import numpy as np
import pytest

from flowrec.stages.refine import Assimilate, Refiner
from tests.stages.refine.planted import SOLVER, Laboratory, chip


@pytest.fixture(scope="module")
def maps():
    """Refined maps and their truths: inlet and outlet pressures differ from the assumed ones as the prior has it."""
    stated, method = chip(), Refiner(assimilate=Assimilate(doubt_walls=False, doubt_depth=False))
    assumed = SOLVER.solve(stated)
    drop_pa = float(np.ptp(assumed.pressure_pa[stated.mask]))
    found = []
    for seed in range(12):
        off = np.random.default_rng([seed, 7]).standard_normal(3) * [25.0, 0.1 * drop_pa, 0.1 * drop_pa]
        true = SOLVER.solve(chip(tuple(np.array([100.0, 0.0, 0.0]) + off)))
        refined = method.refine(assumed, Laboratory().survey(true, seed, count=40), stated, SOLVER)
        found.append((refined, (refined.velocity_um_s - true.velocity_um_s)[stated.mask], true))
    return stated.mask, found


def test_the_error_bars_of_a_map_are_as_wide_over_its_errors_as_was_measured(maps):
    mask, found = maps
    pulls = [error / refined.std_um_s[mask] for refined, error, _ in found]
    # They promise 1. Measured: 0.28, so the bars are 3.6 times too wide where the model is right, because nothing that
    # was observed says so of walls that no robot has touched. Halved or doubled they are another promise.
    assert 0.2 < np.sqrt(np.mean(np.square(pulls))) < 0.38
    assert np.mean(np.abs(pulls) < 2.0) > 0.99


def test_the_expected_error_of_a_map_is_as_large_over_its_error_as_was_measured(maps):
    mask, found = maps
    errors = [np.linalg.norm(error) / np.linalg.norm(true.velocity_um_s[mask]) for _, error, true in found]
    expected = [refined.error_share for refined, _, _ in found]
    assert 0.2 < np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(expected))) < 0.42  # measured: 0.30


def test_what_is_found_besides_the_flow_is_nothing_within_its_error(maps):
    _, found = maps
    pulls = []
    for refined, _, _ in found:
        names = refined.parameter_names.split("; ")
        signed = [names.index(name) for name in ("um_per_rev_share", "heading_deg", "um_per_px_share", "angle_deg")]
        pulls.append(refined.parameters[signed] / refined.parameter_std[signed])
    assert 0.2 < np.sqrt(np.mean(np.square(pulls))) < 0.6  # measured: 0.35
