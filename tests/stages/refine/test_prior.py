"""The prior against the solver: the flow of a chip whose fluid and boundary values are those of a draw."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flowrec.core.messages import Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.chip.fluid import CarreauYasuda, PowerLaw
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.refine import Assimilate, Refiner
from flowrec.stages.refine.discretisation_error import ModelError
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.hypothesis import HypothesisFit
from flowrec.stages.refine.prior import Prior, PriorSettings

SETTINGS = PriorSettings()


def seen(field, chip):
    return field.velocity_um_s[chip.mask].astype(float)


@pytest.fixture
def driven(twin):
    """A chip that an inlet and two pressures drive about as much."""
    return twin(assumed=(100.0, 0.004, -0.004)).chip


def test_a_thicker_fluid_moves_the_flow_as_the_solver_says_at_the_same_pressures(driven):
    solver = FlowSolver(convection=False)
    response = solver.sensitivities(driven)
    prior = Prior.of(SETTINGS, driven, 0.01)
    count = len(driven.openings)
    z = np.zeros(len(prior.effect))
    z[count] = 1.0
    predicted = np.tensordot(prior.offset(z), response.modes, axes=1)
    step = 0.02
    thick, thin = (
        seen(solver.solve(driven.with_boundary(driven.boundary_values, float(np.exp(sign * step)))), driven)
        for sign in (1, -1)
    )
    slope = 0.30 * (thick - thin) / (2.0 * step)
    assert np.abs(slope).max() > 2.0, "the pressures drive some of the flow"
    np.testing.assert_allclose(predicted, slope, atol=2e-3 * np.abs(slope).max())


def test_a_deeper_channel_moves_the_flow_as_the_solver_says(driven):
    solver, chip = FlowSolver(convection=False), replace(driven, depth_um=100.0)
    prior = Prior.of(replace(SETTINGS, depth_std_share=0.1), chip, 0.01)
    z = np.zeros(len(prior.effect))
    z[prior.depth_index] = 1.0
    predicted = np.tensordot(prior.offset(z), solver.sensitivities(chip, friction=True).modes, axes=1)
    step = 0.02
    deep, flat = (
        seen(solver.solve(replace(chip, depth_um=100.0 * float(np.exp(sign * step)))), chip) for sign in (1, -1)
    )
    slope = 0.1 * (deep - flat) / (2.0 * step)
    assert np.abs(slope).max() > 1.0, "the depth matters"
    np.testing.assert_allclose(predicted, slope, atol=5e-3 * np.abs(slope).max())


def test_the_chip_of_a_draw_has_the_flow_that_the_linear_model_predicts(driven):
    solver = FlowSolver(convection=False)
    response = solver.sensitivities(driven)
    prior = Prior.of(SETTINGS, driven, 0.01)
    rng = np.random.default_rng(4)
    for _ in range(4):
        z = 0.5 * rng.standard_normal(len(prior.effect))
        drawn = prior.chip(driven, z)
        np.testing.assert_allclose(drawn.viscosity_mpa_s, np.exp(0.30 * z[len(driven.openings)]))
        predicted = response.base + np.tensordot(prior.offset(z), response.modes, axes=1)
        # Exact: without inertia the flow is linear in the parameters.
        np.testing.assert_allclose(predicted, seen(solver.solve(drawn), driven), atol=1e-3)


def test_a_change_of_the_viscosity_alone_leaves_the_pressures_as_they_are(driven):
    prior = Prior.of(SETTINGS, driven, 0.01)
    z = np.zeros(len(prior.effect))
    z[len(driven.openings)] = 0.01
    drawn = prior.chip(driven, z)
    # The product of two changes is left, of second order.
    np.testing.assert_allclose(drawn.boundary_values, driven.boundary_values, rtol=2.0 * (0.30 * 0.01) ** 2)


@pytest.mark.slow("refines with two laws of viscosity")
def test_the_law_of_viscosity_is_found_where_the_flow_tells_it_and_left_open_where_not():
    def exponent(depth_um, least_px, length=64):
        mask = np.zeros((28, length), bool)
        mask[2:-2] = True
        openings = (Opening("left", 2, 25, "inlet", 120.0), Opening("right", 2, 25, "outlet", 0.0))
        chip = Chip("wide", mask, 20.0, openings, 1.0, 1000.0, depth_um, "pixel", law=PowerLaw(0.8))
        truth = FlowSolver().solve(replace(chip, law=PowerLaw(0.5)))
        rows = np.arange(2 + least_px, 26 - least_px)  # as far from the walls as the robot is
        row, column = np.nonzero(np.add.outer(3 * rows, np.arange(length)) % 17 == 0)
        row = row + rows[0]
        flow = truth.velocity_um_s[row, column] + np.random.default_rng(3).normal(0.0, 4.0, (len(row), 2))
        places = np.stack([column, row], axis=1) * 20.0
        seen = Observations(0, places, flow, np.full(len(row), 4.0))
        found = Refiner("assimilate").refine(FlowSolver().solve(chip), seen, chip, FlowSolver())
        index = found.parameter_names.split("; ").index("viscosity_exponent")
        assert "viscosity exponent" in found.note
        return found.parameters[index], found.parameter_std[index]

    value, std = exponent(None, 0)
    assert abs(value - 0.5) < 3.0 * std < 0.2
    # In a shallow channel every fluid has the same plug.
    value, std = exponent(20.0, 4)
    assert std > 0.1


def test_a_closed_inlet_is_as_uncertain_as_the_fastest_open_one(driven):
    inlets = tuple(
        replace(one, kind="inlet", value=value) for one, value in zip(driven.openings[:2], (100.0, 0.0), strict=True)
    )
    prior = Prior.of(SETTINGS, replace(driven, openings=(*inlets, driven.openings[2])), 0.01)
    assert prior.effect[0, 0] == prior.effect[1, 1] == SETTINGS.inlet_std_share * 100.0


def test_a_chip_without_a_depth_has_no_unknown_of_its_depth(driven):
    solver = FlowSolver(convection=False)
    modes = solver.sensitivities(driven, friction=True).modes
    assert len(modes) == len(Prior.of(replace(SETTINGS, depth_std_share=0.1), driven, 0.01).effect[0])


def test_the_doubt_about_the_error_of_the_grid_is_an_unknown_of_the_size_that_is_set(driven):
    solver = FlowSolver(k=2, convection=False)
    once, twice = (flow_model(Assimilate(), ModelError(share_std=std), driven, solver).known[-1] for std in (0.1, 0.2))
    assert np.abs(once).max() > 0.0
    np.testing.assert_array_equal(twice, 2.0 * once)


def test_a_parameter_that_enters_a_law_by_its_logarithm_has_the_error_of_its_logarithm_times_itself(driven):
    law = CarreauYasuda(0.5, 3.0, 0.5)
    names, count = law.unknowns, len(law.unknowns)
    prior = SimpleNamespace(law_stds=(0.2,) * count, law_index=0)
    model = SimpleNamespace(prior=prior, chip=replace(driven, law=law))
    unknowns = np.full(count, 1.5), 0.04 * np.eye(count)
    fit = SimpleNamespace(observed=SimpleNamespace(model=model), unknowns=lambda *_: unknowns)
    for name, (value, std) in zip(names, HypothesisFit.law.fget(fit).values(), strict=True):
        stated = float(getattr(law, name.removeprefix("ln ")))
        by_log = name.startswith("ln ")
        assert value == pytest.approx(stated * np.exp(0.3) if by_log else stated + 0.3)
        assert std == pytest.approx(0.04 * (value if by_log else 1.0))
    assert any(name.startswith("ln ") for name in names)
