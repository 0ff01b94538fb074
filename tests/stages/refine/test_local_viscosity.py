"""The PI loss and its direct solution for a viscosity that depends on the shear rate."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowrec.core.errors import FlowError
from flowrec.core.messages import Observations
from flowrec.physics.chip.fluid import CarreauYasuda, PowerLaw
from flowrec.physics.flow.sampling import relative_rmse
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.refine import Pinn
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.gauss_newton import balance
from flowrec.stages.refine.local_viscosity import LocalViscosity
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.residuals import Physics
from tests.physics.flow.conftest import crossing_chip


@pytest.fixture(scope="module")
def flows():
    """Two crossing channels of a thinning fluid: chip, assumed flow, true flow, and what is seen upstream."""
    chip = replace(crossing_chip(bottom_pa=0.01), walls="smooth", law=PowerLaw(0.5))
    mask = chip.mask
    truth = FlowSolver().solve(chip.with_boundary(chip.boundary_values * [0.6, 1.6, 1.0, 1.0]))
    seen = mask & (np.add.outer(np.arange(40), 3 * np.arange(48)) % 5 == 0)
    seen[:, 30:] = seen[26:] = False
    row, column = np.nonzero(seen)
    places = np.stack([column, row], axis=1) * chip.um_per_px
    found = Observations(0, places, truth.velocity_um_s[row, column].astype(np.float64), np.full(len(row), 1.0))
    return chip, FlowSolver().solve(chip), truth, observation_operator(found, mask, chip.um_per_px, truth.wall_px)


def images(seed, size=9):
    rng = torch.Generator().manual_seed(seed)
    fluid = torch.ones(1, 1, size, size, dtype=torch.float64)
    fluid[..., 2, :] = fluid[..., 5:7, 1:4] = 0.0
    image = torch.rand(1, 3, size, size, generator=rng, dtype=torch.float64) * fluid
    return fluid, image


def test_laws_of_constant_viscosity_have_the_newtonian_residuals():
    fluid, image = images(1)
    inside = torch.zeros_like(fluid)
    inside[..., 1:-1, 1:-1] = 1.0
    newtonian = Physics.of(fluid, inside, 3.0, 0.2).residuals(image[:, :2], image[:, 2:])
    local = LocalViscosity(CarreauYasuda(0.4, 1.0, infinite_share=1.0), 5.0, 0.3, 1.0)
    found = Physics.of(fluid, inside, 3.0, 0.2, local).residuals(image[:, :2], image[:, 2:])
    torch.testing.assert_close(found, newtonian, rtol=0.0, atol=1e-13)


def test_the_gradient_of_the_loss_holds_that_of_the_viscosity():
    fluid, image = images(2)
    physics = Physics.of(fluid, torch.ones_like(fluid), 3.0, 0.2, LocalViscosity(PowerLaw(0.5), 5.0, 0.3, 0.4))
    assert torch.autograd.gradcheck(
        lambda v: physics.residuals(v * fluid, image[:, 2:]), image[:, :2].clone().requires_grad_(), fast_mode=True
    )


def residual_size(flow, operator, chip):
    """Root mean square residual of a flow in the momentum equations of a chip, over its largest pressure gradient."""
    case = Case.of(flow, operator, chip, cropped=False)
    fluid, inside, v, p = (
        torch.from_numpy(np.array(a, np.float64))[None, None]
        for a in (case.fluid, case.inside, np.moveaxis(case.velocity, -1, 0), case.pressure)
    )
    residuals = Physics.of(fluid, inside, case.reynolds, case.friction, case.viscosity).residuals(v[0], p)
    largest = np.abs(np.gradient(case.pressure)).max()
    return float(residuals[0, 1:].square().mean().sqrt()) / largest


def test_the_flow_of_the_solver_satisfies_the_equations_of_its_law_only(flows):
    chip, _, truth, operator = flows
    assert residual_size(truth, operator, chip) < 0.5 * residual_size(truth, operator, replace(chip, law=None))


@pytest.mark.parametrize("law", [None, PowerLaw(0.5)])
def test_the_flow_of_the_solver_satisfies_the_equations_of_its_depth_only(flows, law):
    chip, _, _, operator = flows
    shallow = replace(chip, depth_um=40.0, law=law)
    flow = FlowSolver().solve(shallow)
    own, deeper, flatter = (
        residual_size(flow, operator, replace(shallow, depth_um=depth)) for depth in (40.0, 70.0, 25.0)
    )
    assert own < 0.6 * min(deeper, flatter)


def test_a_thinning_fluid_between_two_plates_has_the_pressure_gradient_of_its_law(flows):
    chip = replace(flows[0], depth_um=20.0, um_per_px=10.0)
    speed, depth, px, n = 200.0, 20.0, 10.0, 0.5
    local = LocalViscosity.of(chip, speed, px)
    at_plate = 2.0 * (2.0 + 1.0 / n) * speed / depth  # 1/s
    gradient = 2.0 * at_plate**n / depth * px**2 / (speed * local.scale)
    fluid = torch.ones(1, 1, 9, 9, dtype=torch.float64)
    flow = torch.cat([fluid, 0.0 * fluid], 1)
    pressure = -gradient * torch.arange(9.0, dtype=torch.float64).expand(1, 1, 9, 9)
    residuals = Physics.of(fluid, fluid, 0.0, 12.0 * (px / depth) ** 2, local).residuals(flow, pressure)
    assert residuals[0, 1, 3:6, 3:6].abs().max() < 0.01 * gradient


@pytest.mark.slow("balances a flow of two laws")
def test_balancing_with_the_law_is_better_than_without(flows):
    chip, assumed, truth, operator = flows

    def error(of):
        case = Case.of(assumed, operator, of)
        velocity, _ = case.dimensional(*balance(case)[:2])
        found = replace(assumed, velocity_um_s=velocity.astype(np.float32))
        return relative_rmse(found, truth, chip.mask).v

    before = relative_rmse(assumed, truth, chip.mask).v
    assert error(chip) < 0.1 * before
    assert error(chip) < 0.6 * error(replace(chip, law=None))


def test_the_pinn_refuses_a_viscosity_that_varies(flows):
    chip, assumed, _, operator = flows
    with pytest.raises(FlowError, match="the PINN knows constant viscosities only"):
        Pinn().fit(RefinementProblem(assumed, operator, chip, FlowSolver(), lambda: assumed))
