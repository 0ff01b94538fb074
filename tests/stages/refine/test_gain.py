"""The null model: one factor, its standard deviation, and the spread of the observations around it."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.physics.flow.sampling import sample
from flowrec.stages.refine import Refiner


def test_the_factor_is_found_and_its_std_is_that_of_repeated_surveys(twin):
    case = twin(truth=(130.0, 0.0, 0.0))
    factors, stds = [], []
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(case.observations.flow_um_s.shape)
        flow = sample(case.true, case.observations.position_um) + case.observations.std_um_s[:, None] * noise
        refined = Refiner("gain").refine(
            case.assumed, replace(case.observations, flow_um_s=flow), case.chip, case.solver
        )
        factors.append(float(refined.parameters[0]))
        stds.append(float(refined.parameter_std[0]))
    assert np.mean(factors) == pytest.approx(1.3, abs=0.01)
    assert np.std(factors) == pytest.approx(np.mean(stds), rel=0.4)


def test_a_flow_that_no_factor_explains_widens_the_error_bars_in_proportion_to_the_speed(twin):
    case = twin(truth=(130.0, 0.0, 0.0), noise=0.005)
    flow = case.observations.flow_um_s * np.where(np.arange(len(case.observations.std_um_s)) % 2, 0.8, 1.2)[:, None]
    refined = Refiner("gain").refine(case.assumed, replace(case.observations, flow_um_s=flow), case.chip, case.solver)
    fluid = np.linalg.norm(refined.velocity_um_s, axis=-1) > 1.0
    share = refined.std_um_s[fluid][:, 0] / np.linalg.norm(refined.velocity_um_s[fluid], axis=-1)
    # 20 % on one of two components.
    assert np.median(share) == pytest.approx(0.2 / np.sqrt(2.0), rel=0.2)
    assert np.median(share) * np.sqrt(2.0) == pytest.approx(refined.error_share, rel=0.1)


def test_the_boundary_values_that_it_states_are_those_of_its_flow(twin):
    case = twin(truth=(130.0, 0.0, 0.0), assumed=(100.0, 0.0, 0.002))
    refined = Refiner("gain").refine(case.assumed, case.observations, case.chip, case.solver)
    solved = case.solver.solve(case.chip.with_boundary(refined.boundary_values))
    assert not np.allclose(refined.boundary_values, case.assumed.boundary_values, rtol=0.05)
    for name in ("velocity_um_s", "pressure_pa"):
        values = getattr(solved, name)
        np.testing.assert_allclose(getattr(refined, name), values, atol=1e-3 * np.abs(values).max())
