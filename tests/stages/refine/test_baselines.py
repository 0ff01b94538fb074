"""The paper's baselines: what each uses, what it must not use, and that it finds a known flow."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowrec.core.errors import FlowError
from flowrec.core.messages import Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.refine import Ni, Pinn, Refiner, Unet
from flowrec.stages.refine.case import Crop
from flowrec.stages.refine.network import CoordinateNet, trained_network
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.pinn import Collocation
from flowrec.stages.refine.weights import write_weights

QUICK = {
    "ni": Refiner("ni", ni=Ni(iterations=25, base_channels=8)),
    "pinn": Refiner("pinn", pinn=Pinn(iterations=60, points=128, width=24, depth=3, features=24)),
}
# Where it matters only what a method has used: that shows after the first iterations.
BRIEF = {
    "ni": replace(QUICK["ni"], ni=replace(QUICK["ni"].ni, iterations=3)),
    "pinn": replace(QUICK["pinn"], pinn=replace(QUICK["pinn"].pinn, iterations=3)),
}


def misfit(case, field):
    operator = observation_operator(case.observations, case.chip.mask, case.chip.um_per_px, case.true.wall_px)
    return float(((operator.predict(field.velocity_um_s.reshape(-1, 2)) - operator.flow_um_s) ** 2).sum())


@pytest.mark.parametrize("method", [pytest.param("ni", marks=pytest.mark.slow("fits a U-Net twice")), "pinn"])
def test_a_baseline_explains_its_observations_and_keeps_the_promises_of_a_refinement(twin, method):
    case = twin()
    threads, random = torch.get_num_threads(), torch.get_rng_state()
    first, second = (QUICK[method].refine(case.assumed, case.observations, case.chip, case.solver) for _ in range(2))
    still = replace(case.assumed, velocity_um_s=np.zeros_like(case.assumed.velocity_um_s))
    assert misfit(case, first) < 0.5 * misfit(case, still)
    assert first.same_as(second), "the same seed gives the same bytes"
    assert not first.velocity_um_s[~case.chip.mask].any() and not first.pressure_pa[~case.chip.mask].any()
    assert first.method == method and first.std_um_s is None and "observations" in first.note
    assert (first.stamp_ns, first.request) == (case.assumed.stamp_ns, case.assumed.request)
    assert torch.get_num_threads() == threads and torch.equal(torch.get_rng_state(), random)


@pytest.mark.parametrize("method", QUICK)
def test_a_baseline_without_initial_prediction_does_not_look_at_the_assumed_field(twin, method):
    case = twin()
    other = replace(
        case.assumed,
        velocity_um_s=-3.0 * case.assumed.velocity_um_s,
        pressure_pa=np.zeros_like(case.assumed.pressure_pa),
    )
    one, two = (
        BRIEF[method].refine(field, case.observations, case.chip, case.solver) for field in (case.assumed, other)
    )
    assert np.array_equal(one.velocity_um_s, two.velocity_um_s)
    assert np.array_equal(one.pressure_pa, two.pressure_pa)


def test_ni_knows_no_boundary_values_and_pinn_does(twin):
    case = twin()
    faster = case.chip.with_boundary(2.0 * case.chip.boundary_values)
    for method, same in (("ni", True), ("pinn", False)):
        one, two = (
            BRIEF[method].refine(case.assumed, case.observations, chip, case.solver) for chip in (case.chip, faster)
        )
        assert np.array_equal(one.velocity_um_s, two.velocity_um_s) == same


def test_another_seed_gives_another_field(twin):
    case = twin()
    settings = replace(QUICK["pinn"].pinn, iterations=3)
    one, two = (
        Refiner("pinn", pinn=replace(settings, seed=seed)).refine(
            case.assumed, case.observations, case.chip, case.solver
        )
        for seed in (0, 1)
    )
    assert not np.array_equal(one.velocity_um_s, two.velocity_um_s)


def test_ni_with_hard_observations_takes_the_measured_value_in_the_pixel(twin):
    case = twin(every=6)
    refiner = Refiner("ni", ni=replace(QUICK["ni"].ni, observations="hard", iterations=2))
    field = refiner.refine(case.assumed, case.observations, case.chip, case.solver)
    points = case.observations.position_um / case.chip.um_per_px
    clear = (np.abs(points - np.rint(points)) < 0.4).all(axis=1)  # nearer to one pixel than to any other
    columns, rows = np.rint(points[clear]).astype(int).T
    felt = case.observations.flow_um_s[clear]
    assert clear.sum() > 5 and np.allclose(field.velocity_um_s[rows, columns], felt, rtol=1e-5, atol=1e-3)


@pytest.mark.slow("trains a network for 500 iterations")
def test_pinn_finds_plane_poiseuille_from_six_observations_and_a_wrong_inlet():
    mask = np.zeros((18, 40), bool)
    mask[4:14] = True
    chip = Chip(
        "channel",
        mask,
        10.0,
        (Opening("left", 4, 13, "inlet", 130.0), Opening("right", 4, 13, "outlet", 0.0)),
        1.0,
        1000.0,
        walls="pixel",
    )
    # Mean over each pixel of 6 V s (1 - s).
    edge = np.linspace(0.0, 1.0, 11)
    profile = np.diff(3.0 * edge**2 - 2.0 * edge**3) * 10.0 * 100.0
    truth = np.zeros((*mask.shape, 2))
    truth[4:14, :, 0] = profile[:, None]
    points = np.array([[x, y] for x in (8, 20, 32) for y in (6, 9)], float)
    seen = Observations(0, 10.0 * points, truth[points[:, 1].astype(int), 0], np.full(6, 2.0))
    solver = FlowSolver()
    assumed = solver.solve(chip)
    # Not the usual weight: a velocity is soon found without its pressure.
    settings = Pinn(iterations=500, points=256, width=32, depth=3, features=16, momentum_weight=1.0)
    field = Refiner("pinn", pinn=settings).refine(assumed, seen, chip, solver)

    def error(other):
        return float(np.sqrt(((other.velocity_um_s - truth) ** 2).sum() / (truth**2).sum()))

    assert error(assumed) == pytest.approx(0.3, abs=0.01)
    assert error(field) < 0.1
    # dp/dx = -12 mu V / L^2, away from the inlet that contradicts the observations
    slope = np.polyfit(np.arange(15, 38) * 10e-6, field.pressure_pa[8, 15:38].astype(float), 1)[0]
    assert slope == pytest.approx(-12.0 * 1e-3 * 100e-6 / (100e-6) ** 2, rel=0.25)


def test_derivatives_carried_forward_are_those_of_differentiating_twice():
    torch.manual_seed(1)
    net = CoordinateNet(12, 3, 8, 0.7).double()
    points = torch.randn(5, 2, dtype=torch.float64, requires_grad=True)
    value, by_x, by_y, laplacian = net.jet(points)
    assert torch.allclose(value, net(points))
    for channel in range(3):
        (slope,) = torch.autograd.grad(net(points)[:, channel].sum(), points, create_graph=True)
        bend = sum(torch.autograd.grad(slope[:, axis].sum(), points, retain_graph=True)[0][:, axis] for axis in (0, 1))
        assert torch.allclose(torch.stack([by_x[:, channel], by_y[:, channel]], dim=1), slope)
        assert torch.allclose(laplacian[:, channel], bend)


def test_collocation_points_lie_where_they_belong(twin):
    chip = twin().chip
    points = Collocation.of(chip)
    # Every edge between fluid and solid once; the openings are none.
    pixels = chip.mask.astype(int)
    inner = np.abs(np.diff(pixels, axis=0)).sum() + np.abs(np.diff(pixels, axis=1)).sum()
    assert len(points.walls) == inner
    assert points.inlet_um_s.mean(axis=0) == pytest.approx([chip.openings[0].value, 0.0], rel=0.02)
    assert (points.inlets[:, 0] == -0.5).all()
    assert (points.outlets[: len(points.outlets) // 2, 0] == chip.mask.shape[1] - 0.5).all()
    inside, walls = points.draw(np.random.default_rng(0), 500)
    columns, rows = np.rint(inside).astype(int).T
    assert chip.mask[rows, columns].all()
    on_edge = np.isclose(np.abs(walls - np.floor(walls)), 0.5)
    assert on_edge.any(axis=1).all()


def test_a_crop_brings_every_fluid_pixel_back_to_its_place(twin):
    mask = twin().chip.mask
    image = np.where(mask, np.random.default_rng(0).standard_normal(mask.shape), 0.0)
    crop = Crop.around(mask)
    part = crop.part(image)
    assert all(length % 16 == 0 for length in part.shape)
    assert np.array_equal(crop.whole(part), image)


@pytest.mark.parametrize("method", QUICK)
def test_observations_of_fluid_at_rest_leave_the_assumed_field_and_say_so(twin, method):
    case = twin()
    still = replace(case.observations, flow_um_s=np.zeros_like(case.observations.flow_um_s))
    field = QUICK[method].refine(case.assumed, still, case.chip, case.solver)
    assert np.array_equal(field.velocity_um_s, case.assumed.velocity_um_s) and "stands still" in field.note


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize(
    "refiner", [Refiner("ni", ni=Ni(device="cuda")), Refiner("pinn", pinn=Pinn(device="cuda"))], ids=("ni", "pinn")
)
def test_a_missing_gpu_is_an_error_of_one_line(twin, refiner):
    case = twin()
    with pytest.raises(FlowError, match="'cpu'"):
        refiner.refine(case.assumed, case.observations, case.chip, case.solver)


def trained(tmp_path):
    """Weights of the right shapes that move the field; not trained, so their error is not known."""
    path = tmp_path / "any.safetensors"
    torch.manual_seed(0)
    network = trained_network()
    torch.nn.init.normal_(network.last.weight, std=0.05)
    write_weights(path, network, {})
    return path


def test_unet_corrects_the_assumed_field_by_what_was_observed_in_units_of_its_own(twin, tmp_path):
    case = twin()
    refiner = Refiner("unet", unet=Unet(weights=str(trained(tmp_path))))
    field = refiner.refine(case.assumed, case.observations, case.chip, case.solver)
    other = replace(case.observations, flow_um_s=-2.0 * case.observations.flow_um_s)
    assert not field.same_as(refiner.refine(case.assumed, other, case.chip, case.solver))
    assert not field.velocity_um_s[~case.chip.mask].any() and not field.pressure_pa[~case.chip.mask].any()
    assert field.method == "unet" and field.std_um_s is None and "observations" in field.note
    # Twice the flow in and seen, twice the flow out.
    double = replace(
        case.assumed, velocity_um_s=2.0 * case.assumed.velocity_um_s, pressure_pa=2.0 * case.assumed.pressure_pa
    )
    seen = case.observations
    faster = replace(seen, flow_um_s=2.0 * seen.flow_um_s, std_um_s=2.0 * seen.std_um_s)
    twice = refiner.refine(double, faster, case.chip, case.solver)
    assert np.allclose(twice.velocity_um_s, 2.0 * field.velocity_um_s, rtol=1e-3, atol=1e-2)


def test_missing_and_damaged_weights_are_errors_of_one_line(twin, tmp_path):
    case = twin()
    path = trained(tmp_path)

    def refine(weights):
        return Refiner("unet", unet=Unet(weights=str(weights))).refine(
            case.assumed, case.observations, case.chip, case.solver
        )

    with pytest.raises(FlowError, match=r"flowrec\.bench\.training"):
        refine(tmp_path / "nowhere.safetensors")
    whole = path.read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FlowError, match="safetensors"):
        refine(tmp_path / "cut.safetensors")


def test_the_shipped_unet_helps_a_little(twin):
    case = twin()
    field = Refiner("unet").refine(case.assumed, case.observations, case.chip, case.solver)
    assert case.error(field) < 0.9 * case.error(case.assumed)


def test_fluid_that_is_assumed_at_rest_stays_so_and_the_note_says_why(twin):
    case = twin()
    still = replace(case.assumed, velocity_um_s=np.zeros_like(case.assumed.velocity_um_s))
    field = Refiner("unet").refine(still, case.observations, case.chip, case.solver)
    assert not field.velocity_um_s.any() and "stands still" in field.note
