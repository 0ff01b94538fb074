from dataclasses import replace

import numpy as np
import pytest
import torch

from flowrec.physics.flow.sampling import sample
from flowrec.stages.refine import PiUnet, Refiner
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.network_fit import FieldLoss
from flowrec.stages.refine.network_inputs import NetworkInputs
from flowrec.stages.refine.observation_operator import observation_operator, student_t_loss
from flowrec.stages.refine.pi_unet import HELD_OUT, Correction
from flowrec.stages.refine.residuals import Physics


def poiseuille(width, length):
    """Mask, velocity and pressure of a channel in units of px, V and mu V / px; pixel averages."""
    y = np.arange(width) + 0.5
    profile = y * (width - y) / width**2
    mask = np.zeros((width + 4, length))
    mask[2:-2] = 1.0
    velocity = np.zeros((2, *mask.shape))
    velocity[0, 2:-2] = profile[:, None]
    pressure = -2.0 / width**2 * np.arange(length) * mask
    return (
        torch.tensor(array, dtype=torch.float32) for array in (mask[None, None], velocity[None], pressure[None, None])
    )


def test_the_discrete_equations_vanish_on_poiseuille_flow():
    fluid, velocity, pressure = poiseuille(10, 12)
    inside = torch.zeros_like(fluid)
    inside[..., 1:-1, 1:-1] = 1.0
    residuals = Physics.of(fluid, inside, reynolds=3.0, friction=0.0).residuals(velocity, pressure)[0]
    # Away from the walls the five-point Laplacian of a parabola is exact: sign and scale of every term are right.
    assert residuals[:, 3:-3].abs().max() < 1e-6
    # The ghost value of a wall pixel is second order in v, so its Laplacian is off by 1 / 4 of 1 / width^2.
    assert residuals.abs().max() < 0.6 / 10**2
    wrong = Physics.of(fluid, inside, reynolds=3.0, friction=0.0).residuals(2 * velocity, pressure)[0]
    assert wrong[1, 5:-5].abs().max() > 1.9 / 10**2


def test_the_discrete_equations_vanish_on_a_stagnation_flow_and_a_shallow_chip_adds_its_drag():
    """v = (x, -y): (v . grad) v = (x, y), which the pressure -Re (x^2 + y^2) / 2 balances; no viscous force."""
    y, x = (axis - 7.5 for axis in np.mgrid[0:16, 0:16].astype(float))
    velocity = torch.tensor(np.stack([x, -y])[None], dtype=torch.float32)
    pressure = torch.tensor((-1.5 * (x**2 + y**2))[None, None], dtype=torch.float32)
    fluid, inside = torch.ones_like(pressure), torch.zeros_like(pressure)
    inside[..., 2:-2, 2:-2] = 1.0
    found = [Physics.of(fluid, inside, reynolds=3.0, friction=f).residuals(velocity, pressure)[0] for f in (0.0, 0.2)]
    within = np.s_[:, 3:-3, 3:-3]
    assert found[0][within].abs().max() < 1e-4
    drag = torch.cat([torch.zeros_like(velocity[0, :1]), 0.2 * velocity[0]])
    assert (found[1] - drag)[within].abs().max() < 1e-4


def test_the_loss_is_the_squared_residual_beyond_the_starts_and_the_likelihood_of_the_observations(twin):
    made = twin()
    assumed = made.assumed
    operator = observation_operator(made.observations, made.chip.mask, made.chip.um_per_px, assumed.wall_px)
    case = Case.of(assumed, operator, made.chip)
    inputs = NetworkInputs.of([case])
    deep = -torch.nn.functional.max_pool2d(-inputs.fluid * inputs.inside, 5, 1, 2)
    push = torch.zeros_like(inputs.pressure)
    push.view(-1)[int(deep.argmax())] = 1.0

    def loss(size, **settings):
        changed = inputs.velocity, inputs.pressure + size * push
        return FieldLoss(inputs, case, PiUnet(**settings), lambda _: changed)(push)

    start = float(loss(0.0)[0])
    assert start == pytest.approx(2.0 * 0.03 * student_t_loss(operator.misfit(assumed.velocity_um_s)), rel=1e-3)
    once, twice = (float(loss(size)[0]) - start for size in (1.0, 2.0))
    assert once > 0.0 and twice == pytest.approx(4.0 * once, rel=1e-3)
    # A pressure alone leaves the continuity as it is.
    assert float(loss(1.0, momentum_weight=0.0)[0]) == pytest.approx(start, rel=1e-6)
    assert float(loss(1.0, continuity_weight=0.0)[0]) - start == pytest.approx(once, rel=1e-6)
    hard = loss(0.0, observations="hard")[2][0, :2]
    measured = inputs.observed[0, 0] > 0.0
    moved = (hard - inputs.velocity[0])[:, measured]
    assert measured.sum() > 10 and torch.allclose(moved, inputs.innovation[0][:, measured], atol=0.03)


@pytest.mark.slow("trains a network")
def test_pi_unet_lowers_the_error_of_a_wrong_solution_by_a_third(twin):
    case = twin()
    printed = PiUnet(start="fvm", weights="none", finish="none", iterations=40)
    refined = Refiner("pi_unet", pi_unet=printed).refine(case.assumed, case.observations, case.chip, case.solver)
    assert case.error(refined) < 2.0 / 3.0 * case.error(case.assumed)
    assert not refined.velocity_um_s[~case.chip.mask].any()
    assert refined.method == "pi_unet"


def test_pi_unet_keeps_an_assimilated_field_that_explains_the_observations(twin):
    case = twin()
    assimilated = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    refined = Refiner("pi_unet").refine(case.assumed, case.observations, case.chip, case.solver)
    assert np.array_equal(refined.velocity_um_s, assimilated.velocity_um_s)
    assert "start kept" in refined.note and assimilated.note in refined.note


@pytest.mark.slow("the accuracy of the shipped weights on a vessel: ten seconds")
def test_a_closed_branch_is_found_by_the_assimilation_and_pi_unet_does_not_make_it_worse(twin):
    # The chip is not what its mask says: debris closes most of the upper branch, so the flow there is another one. No
    # boundary value explains that, the resistance of the branch does.
    case = twin(noise=0.02, every=2)
    mask = case.chip.mask.copy()
    mask[8:13, 30:50] = False
    real = case.solver.solve(replace(case.chip, mask=mask))
    points = case.observations.position_um
    case.true = real
    case.observations = replace(case.observations, flow_um_s=sample(real, points))
    assimilated = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    refined = Refiner("pi_unet").refine(case.assumed, case.observations, case.chip, case.solver)
    assert case.error(case.assumed) > 0.3 and case.error(assimilated) < 0.1
    # The cause is one place; the error bars allow for such places everywhere.
    assert 0.6 < assimilated.error_share / case.error(assimilated) < 2.5
    assert case.error(refined) <= 1.02 * case.error(assimilated)
    score = (refined.velocity_um_s - real.velocity_um_s)[mask] / refined.std_um_s[mask]
    assert np.mean(np.abs(score) < 2.0) > 0.9


def corrected(case, monkeypatch, fields, std=None, **settings):
    """The result of PI-UNet where the network gives these fields, all with the pressure 7 Pa; `std` is of the last."""
    found = [Correction("made up", each, np.full(each.shape[:2], 7.0)) for each in fields]
    found[-1] = replace(found[-1], std_um_s=std)
    monkeypatch.setattr(PiUnet, "corrections", lambda *_: found)
    operator = observation_operator(case.observations, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    stated = replace(case.assumed, std_um_s=np.full_like(case.assumed.velocity_um_s, 3.0))
    problem = RefinementProblem(case.assumed, operator, case.chip, case.solver, lambda _: (stated, operator))
    return PiUnet(**settings).fit(problem)


def test_of_two_corrections_the_balanced_one_is_taken_and_the_networks_where_that_predicts_worse(twin, monkeypatch):
    case = twin()
    halfway = 0.5 * (case.assumed.velocity_um_s + case.true.velocity_um_s)
    std = np.full_like(halfway, 2.0)
    best = corrected(case, monkeypatch, [halfway, case.true.velocity_um_s], std, start="fvm")
    np.testing.assert_allclose(best.velocity_um_s, case.true.velocity_um_s, atol=1e-3)
    assert np.all(best.std_um_s == 2.0) and np.all(best.pressure_pa == 7.0) and "% of it" not in best.note
    network = corrected(case, monkeypatch, [halfway, 2.0 * case.true.velocity_um_s], std, start="fvm")
    np.testing.assert_allclose(network.velocity_um_s, halfway, atol=1e-3)
    assert network.std_um_s is None
    kept = corrected(case, monkeypatch, [2.0 * halfway, 2.0 * halfway], std, start="fvm")
    assert "start kept, a correction did not predict" in kept.note and kept.std_um_s is None


def test_a_correction_is_judged_by_observations_that_it_has_not_used(twin, monkeypatch):
    case = twin()
    field = case.true.velocity_um_s.copy()
    for place_um in case.observations.position_um[HELD_OUT // 2 :: HELD_OUT]:
        column, row = np.rint(place_um / case.chip.um_per_px).astype(int)
        field[row - 1 : row + 2, column - 1 : column + 2] *= -1.0
    assert "did not predict" in corrected(case, monkeypatch, [field], start="fvm").note


def test_of_a_correction_of_what_is_nearly_noise_a_part_is_taken_and_the_rest_is_in_the_error_bar(twin, monkeypatch):
    case = twin(noise=0.3, truth=(118.0, 0.0, 0.0), seed=1)
    std = np.full_like(case.true.velocity_um_s, 2.0)
    part = corrected(case, monkeypatch, 2 * [case.true.velocity_um_s], std, start="fvm")
    assert "50% of it" in part.note
    change = case.true.velocity_um_s - case.assumed.velocity_um_s
    np.testing.assert_allclose(part.velocity_um_s, case.assumed.velocity_um_s + 0.5 * change, atol=1e-3)
    np.testing.assert_allclose(part.std_um_s, np.hypot(1.0, 0.5 * change), rtol=1e-5)
    np.testing.assert_allclose(part.pressure_pa, 0.5 * (case.assumed.pressure_pa + 7.0), rtol=1e-5)


def test_a_start_with_error_bars_stays_within_those_of_its_correction(twin, monkeypatch):
    case = twin()
    result = corrected(case, monkeypatch, [case.true.velocity_um_s])
    change = case.true.velocity_um_s - case.assumed.velocity_um_s
    np.testing.assert_allclose(result.std_um_s, np.hypot(3.0, change), rtol=1e-4)
    power = np.sqrt((result.std_um_s**2).sum() / (result.velocity_um_s**2).sum())
    assert result.error_share == pytest.approx(power, rel=1e-5)


@pytest.mark.slow("fits a network")
def test_a_robot_that_slips_is_not_taken_for_an_error_of_the_field(twin):
    case = twin(noise=0.02)
    points = case.observations.position_um
    heading = np.gradient(points, axis=0)
    rolled = 400.0 * heading / np.linalg.norm(heading, axis=1, keepdims=True)
    slipping = case.observations.flow_um_s - 0.3 * rolled
    observations = replace(
        case.observations, flow_um_s=slipping, rolled_um_s=rolled, time_s=0.2 * np.arange(len(points))
    )
    assimilated = Refiner().refine(case.assumed, observations, case.chip, case.solver)
    refined = Refiner("pi_unet").refine(case.assumed, observations, case.chip, case.solver)
    assert "less per revolution" in assimilated.note
    assert np.array_equal(refined.velocity_um_s, assimilated.velocity_um_s), refined.note


@pytest.mark.slow("trains four networks")
@pytest.mark.parametrize("settings", [{"observations": "hard", "near_wall": "hard"}, {"near_wall": "free"}])
def test_the_printed_variants_run_and_give_the_same_bytes_twice(twin, settings):
    case = twin(noise=0.0)
    refiner = Refiner("pi_unet", pi_unet=PiUnet(start="fvm", weights="none", finish="none", iterations=10, **settings))
    threads = torch.get_num_threads()
    first, second = (refiner.refine(case.assumed, case.observations, case.chip, case.solver) for _ in range(2))
    assert first.same_as(second)
    assert torch.get_num_threads() == threads
    assert case.error(first) < case.error(case.assumed)


@pytest.mark.slow("fits a network three times")
def test_the_finish_gives_the_same_bytes_twice_and_bears_outliers(twin):
    case = twin()
    flow = case.observations.flow_um_s.copy()
    flow[::6] += [-600.0, 900.0]
    spoiled = replace(case.observations, flow_um_s=flow)
    refiner = Refiner("pi_unet", pi_unet=PiUnet(start="fvm"))
    first, second = (refiner.refine(case.assumed, spoiled, case.chip, case.solver) for _ in range(2))
    assert first.same_as(second)
    assert case.error(first) < 0.3 * case.error(case.assumed)
    assert "balanced" in first.note


def test_the_jacobian_is_the_derivative_of_the_discrete_equations():
    fluid, velocity, pressure = poiseuille(7, 9)
    physics = Physics.of(fluid, torch.ones_like(fluid), reynolds=3.0, friction=0.1)
    image = torch.cat([velocity, pressure], dim=1)
    change = 1e-3 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0)) * fluid
    more, less = image + change, image - change
    wanted = 0.5 * (physics.residuals(more[:, :2], more[:, 2:]) - physics.residuals(less[:, :2], less[:, 2:]))
    found = physics.jacobian(image) @ change.numpy().ravel()
    assert np.allclose(found, wanted.numpy().ravel(), atol=1e-6)
