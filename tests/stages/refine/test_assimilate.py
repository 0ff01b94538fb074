from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from flowrec.core.declarations import as_read
from flowrec.core.errors import FlowError
from flowrec.core.messages import Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.flow.linear_solver import clear_cache
from flowrec.physics.flow.sampling import sample
from flowrec.physics.flow.solver import FlowSolver
from flowrec.physics.flow.uncertainty import Doubts
from flowrec.stages.refine import Assimilate, Refiner, assimilate, causes, uncertainty
from flowrec.stages.refine.assimilate import Hypotheses
from flowrec.stages.refine.discretisation_error import ModelError
from flowrec.stages.refine.field_variance import field_columns, prior_left_variance, prior_of
from flowrec.stages.refine.findings import findings
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.hypothesis import of_the_field
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.observation_operator import observation_operator


def test_assimilation_recovers_the_truth_from_noisy_observations(twin):
    case = twin()
    refined = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    assert case.error(case.assumed) > 0.2
    assert case.error(refined) < 0.05
    assert refined.boundary_values[0] == pytest.approx(130.0, rel=0.05)
    assert refined.method == "assimilate" and "inlet" not in refined.note


def test_assimilation_follows_inertia(twin):
    # Re about 20: Stokes modes alone can not explain the observations.
    case = twin(noise=0.01, scale=300.0)
    refined = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    stokes = Refiner().refine(case.assumed, case.observations, case.chip, FlowSolver(convection=False))
    assert case.error(refined) < 0.02
    assert case.error(refined) < 0.7 * case.error(stokes)  # errors along the channels take up some of the inertia


@pytest.mark.parametrize("nonsense", ["scattered", "one way", "beside the inlet"])
def test_outliers_do_not_pull_the_field(twin, nonsense):
    case = twin()
    flow = case.observations.flow_um_s.copy()
    count = len(flow)
    rng = np.random.default_rng(3)
    if nonsense == "scattered":
        wrong = rng.choice(count, int(0.3 * count), replace=False)
        flow[wrong] = 300.0 * rng.standard_normal((len(wrong), 2))
    elif nonsense == "one way":
        flow[::4] = [-200.0, 300.0]
    else:
        flow[: count // 5] = [-200.0, 300.0]
    spoiled = replace(case.observations, flow_um_s=flow)
    refined = Refiner().refine(case.assumed, spoiled, case.chip, case.solver)
    assert case.error(refined) < 0.06
    assert "distrusted as outliers" in refined.note


def test_walls_that_the_observations_contradict_are_moved(twin):
    case = twin()
    truth = case.true
    narrow = binary_erosion(case.chip.mask, border_value=1)
    openings = tuple(replace(o, first=o.first + 1, last=o.last - 1) for o in case.chip.openings)
    case.true = case.solver.solve(replace(case.chip, mask=narrow, openings=openings).with_boundary([130.0, 0.0, 0.004]))
    flow = sample(case.true, case.observations.position_um)
    flow += 2.0 * np.random.default_rng(1).standard_normal(flow.shape)
    observed = replace(case.observations, flow_um_s=flow, std_um_s=np.full(len(flow), 2.0))
    moved = Refiner().refine(case.assumed, observed, case.chip, case.solver)
    kept = Refiner(assimilate=Assimilate(doubt_walls=False)).refine(case.assumed, observed, case.chip, case.solver)
    assert "too wide" in moved.note
    assert case.error(moved) < 0.3 * case.error(kept)
    # Flux, not speed: the chip's inlet is 8 px wide, the true one 6.
    assert moved.boundary_values[0] == pytest.approx(130.0 * 6 / 8, rel=0.05)
    case.true = truth
    right = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    assert "mask" not in right.note


def test_error_bars_cover_the_truth_and_shrink_with_observations(twin):
    settings = Assimilate(model=ModelError(coarse_share=0.003))  # the twin's model is right
    scores, widths = [], []
    for seed in range(8):
        truth = np.array([100.0, 0.0, 0.0]) + np.random.default_rng(50 + seed).standard_normal(3) * [25.0, 0.003, 0.003]
        case = twin(truth=truth, seed=seed)
        refined = Refiner(assimilate=settings).refine(case.assumed, case.observations, case.chip, case.solver)
        busy = np.linalg.norm(case.true.velocity_um_s, axis=-1) > 20.0
        scores.append((refined.velocity_um_s - case.true.velocity_um_s)[busy] / refined.std_um_s[busy])
        widths.append(np.median(refined.std_um_s[busy]))
    spread = np.sqrt(np.mean([np.mean(score**2) for score in scores]))
    # The walls of the twin are right, but nothing in the middle of a channel says so.
    assert 0.25 < spread < 1.6
    assert np.mean(np.abs(np.concatenate(scores)) < 2.0) > 0.85
    few = twin(every=20)
    wide = Refiner(assimilate=settings).refine(few.assumed, few.observations, few.chip, few.solver)
    assert np.median(wide.std_um_s[busy]) > 1.5 * np.mean(widths)


def test_error_bars_beside_walls_cover_a_wall_that_is_a_pixel_off_where_no_robot_has_been(twin, monkeypatch):
    case = twin()
    # The upper wall of every channel lies a pixel lower.
    mask = case.chip.mask & np.roll(case.chip.mask, 1, axis=0)
    mask[0] = case.chip.mask[0]
    openings = tuple(replace(o, first=o.first + (o.side != "bottom")) for o in case.chip.openings)
    case.true = case.solver.solve(replace(case.chip, mask=mask, openings=openings).with_boundary([130.0, 0.0, 0.004]))
    flow = sample(case.true, case.observations.position_um)
    observed = replace(case.observations, flow_um_s=flow, std_um_s=np.full(len(flow), 2.0))

    def covered():
        settings = Assimilate(doubt_walls=False)
        refined = Refiner(assimilate=settings).refine(case.assumed, observed, case.chip, case.solver)
        score = (refined.velocity_um_s - case.true.velocity_um_s)[case.chip.mask] / refined.std_um_s[case.chip.mask]
        return np.mean(np.abs(score) < 2.0)

    with_walls = covered()
    monkeypatch.setattr(causes, "WALLS", (1e-3, 1e-3))
    without = covered()
    # A pixel is three and a half times what is usual.
    assert with_walls > 0.7
    assert with_walls > without + 0.1


def test_walls_that_are_off_leave_as_much_doubt_within_the_width_of_a_channel_as_along_it():
    mask = np.zeros((14, 48), bool)
    mask[3:11] = True
    openings = (Opening("left", 3, 10, "inlet", 100.0), Opening("right", 3, 10, "outlet", 0.0))
    model = flow_model(
        Assimilate(), ModelError(), Chip("straight", mask, 10.0, openings, 1.0, 1e3, walls="pixel"), FlowSolver()
    )
    columns, covariance = prior_of(model)
    every_column = np.diag(covariance)[:, None, None] * columns**2
    along, within = np.zeros((2, *mask.shape))
    along[mask] = every_column[-len(model.resistance) :].sum(axis=0)[:, 0]
    within[mask] = prior_left_variance(model)[:, 0] - model.error_std**2
    assert (within[6:8] > along[6:8]).all()  # in the middle, where moving the profile sideways changes nothing


def test_the_note_names_the_openings_that_no_observation_reached(twin):
    case = twin()
    stem = case.observations.position_um[:, 0] < 150.0
    seen = Observations(
        0, *(getattr(case.observations, name)[stem] for name in ("position_um", "flow_um_s", "std_um_s"))
    )
    refined = Refiner().refine(case.assumed, seen, case.chip, case.solver)
    assert "outlet 1 (right)" in refined.note and "outlet 2 (bottom)" in refined.note and "inlet" not in refined.note


def test_without_a_usable_observation_the_assumed_field_comes_back(twin):
    case = twin()
    nothing = Observations(0, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    # In solid, off the chip, not a number.
    with as_read():
        useless = Observations(
            0, [[5, 5], [-90, 3], [240, 240], [240, 240]], [[1, 1], [1, 1], [np.nan, 1], [1, 1]], [1, 1, 1, -1]
        )
    for observations in (nothing, useless):
        for method in ("assimilate", "pi_unet"):
            refined = Refiner(method).refine(case.assumed, observations, case.chip, case.solver)
            assert refined.note.startswith("not refined")
            assert replace(refined, note="", std_um_s=None, error_share=None).same_as(replace(case.assumed, note=""))
            # A quarter of the inlet's speed, in the stem.
            assert refined.std_um_s[24, 5, 0] == pytest.approx(0.25 * case.assumed.velocity_um_s[24, 5, 0], rel=0.05)
    assert "2 without finite numbers and 2 outside the fluid" in refined.note


def test_the_same_input_gives_the_same_bytes_and_keeps_stamp_and_request(twin):
    case = twin()
    assumed = replace(case.assumed, stamp_ns=77, request=5)
    first, second = (Refiner().refine(assumed, case.observations, case.chip, case.solver) for _ in range(2))
    assert first.same_as(second)
    assert (first.stamp_ns, first.request) == (77, 5)


@pytest.mark.slow("refines twice without cached results")
def test_the_cache_changes_no_result(twin):
    case = twin(scale=300.0)
    doubled = replace(case.observations, flow_um_s=2.0 * case.observations.flow_um_s)
    Refiner().refine(case.assumed, doubled, case.chip, case.solver)
    warm = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    clear_cache()
    cold = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    assert warm.same_as(cold)


@pytest.mark.slow("refines four times")
def test_copies_of_an_observation_count_once_and_a_std_that_is_too_small_is_widened(twin):
    case = twin()
    plain = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    fields = ("position_um", "flow_um_s", "std_um_s")
    thrice = Observations(0, *(np.concatenate([getattr(case.observations, name)] * 3) for name in fields))
    again = Refiner().refine(case.assumed, thrice, case.chip, case.solver)
    assert np.median(again.std_um_s[case.chip.mask] / plain.std_um_s[case.chip.mask]) > 0.95
    claimed = replace(case.observations, std_um_s=case.observations.std_um_s / 5.0)
    widened = Refiner().refine(case.assumed, claimed, case.chip, case.solver)
    assert "times more than their std says" in widened.note
    assert case.error(widened) < 0.05
    busy = np.linalg.norm(case.true.velocity_um_s, axis=-1) > 20.0
    score = (widened.velocity_um_s - case.true.velocity_um_s)[busy] / widened.std_um_s[busy]
    assert np.abs(score).max() < 4.0


def test_many_observations_in_one_square_say_no_more_of_the_model_than_one_and_in_many_squares_they_do(
    twin, monkeypatch
):
    # The stem is 8 px wide; where the observations' own noise is far below the model's error only that counts.
    monkeypatch.setattr(causes, "LOCAL", (1.0, 1e-3))
    monkeypatch.setattr(assimilate, "AS_STATED_SHARE", 1e-9)
    case = twin()
    settings = Assimilate(model=ModelError(coarse_share=0.1), doubt_walls=False)

    def posterior_std(columns, rows):
        points = 10.0 * np.array([[x, y] for x in columns for y in rows], float)
        flow = sample(case.assumed, points) + 0.3 * np.random.default_rng(0).standard_normal(points.shape)
        observed = Observations(0, points, flow, np.full(len(points), 0.3))
        operator = observation_operator(observed, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
        best = settings.hypotheses(operator, case.chip, case.solver).best
        return np.sqrt(best.unknowns("boundary")[1][0, 0])

    one = posterior_std([8], [24])
    square = posterior_std(range(8, 12), range(24, 27))
    squares = posterior_std(range(2, 14, 4), range(20, 28))
    assert square > 0.6 * one
    assert squares < 0.6 * one


@pytest.mark.parametrize("error", [0.0, 0.3])
def test_a_world_that_is_as_stated_is_believed_by_evidence_alone(twin, error):
    case, rng = twin(truth=np.array([130.0, 0.0, 0.0])), np.random.default_rng(3)
    points = 10.0 * np.array([[x, y] for x in (4, 12, 20, 45, 70) for y in (22, 24, 26)], float)
    rolled = 150.0 * np.stack([np.cos(np.arange(15.0)), np.sin(np.arange(15.0))], axis=1)
    resisted = 1.0 + error * np.repeat(rng.standard_normal(5), 3)[:, None]
    flow = resisted * sample(case.true, points) - 0.5 * error * rolled + 0.5 * rng.standard_normal(points.shape)
    made = Observations(0, points, flow, np.full(len(points), 0.5), rolled, np.arange(15.0))
    operator = observation_operator(made, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    every = Assimilate().hypotheses(operator, case.chip, case.solver)
    as_stated = sum(weight for one, weight in zip(every.found, every.weights, strict=True) if one.observed.usual < 1.0)
    assert (as_stated > 0.5) == (error == 0.0), as_stated


@pytest.mark.parametrize("which", ["one", "two that contradict", "one far too fast", "std of 0", "huge std"])
def test_few_or_odd_observations_never_make_the_field_worse(twin, which):
    case = twin(noise=0.0)
    seen = case.observations
    points, flow, std = seen.position_um[5:6], seen.flow_um_s[5:6], np.array([2.0])
    if which == "two that contradict":
        points, flow, std = np.repeat(points, 2, axis=0), np.concatenate([flow, -3.0 * flow]), np.array([2.0, 2.0])
    elif which == "one far too fast":
        flow = 12.0 * flow
    elif which == "std of 0":
        points, flow, std = seen.position_um, seen.flow_um_s, np.zeros(len(seen.std_um_s))
    elif which == "huge std":
        std = np.array([1e7])
    refined = Refiner().refine(case.assumed, Observations(0, points, flow, std), case.chip, case.solver)
    assert np.isfinite(refined.velocity_um_s).all() and np.isfinite(refined.std_um_s).all()
    assert case.error(refined) <= 1.001 * case.error(case.assumed)
    assert which != "huge std" or "nothing about inlet 0" in refined.note


@pytest.mark.parametrize("width", [8, 32])  # of the lower inlet, with as much inflow
def test_the_note_says_that_only_two_inlets_together_are_seen(width):
    mask = np.zeros((30, 60), bool)
    mask[11:19, 20:] = True
    mask[:19, 20:28] = mask[11:, 20 : 20 + width] = True
    openings = (
        Opening("top", 20, 27, "inlet", 100.0),
        Opening("bottom", 20, 19 + width, "inlet", 800.0 / width),
        Opening("right", 11, 18, "outlet", 0.0),
    )
    chip = Chip("tee", mask, 10.0, openings, 1.0, 1000.0, walls="pixel")
    solver = FlowSolver()
    assumed, true = solver.solve(chip), solver.solve(chip.with_boundary([130.0, 880.0 / width, 0.0]))
    points = np.column_stack([np.linspace(540.0, 590.0, 8), np.full(8, 145.0)])
    observed = Observations(0, points, sample(true, points), np.full(8, 2.0))
    note = Refiner().refine(assumed, observed, chip, solver).note
    assert "of inlet 0 (top) and inlet 1 (bottom) they see only the flow together" in note


def test_a_skewed_inlet_is_found_where_it_may_be_one(twin):
    case = twin(noise=0.0)
    shaped = case.solver.sensitivities(case.chip, shapes=True)
    skew = shaped.modes[len(case.chip.openings) + 1]
    image = np.zeros((*case.chip.mask.shape, 2))
    image[case.chip.mask] = shaped.base + 40.0 * skew
    # No flux of its own: the sum over the eight centres of a parabola is 1 + 1 / (2 * 8^2) times its flux.
    assert np.abs(image[20:28, 0, 0].mean() - 100.0 * (1.0 + 1.0 / 128.0)) < 1e-3
    case.true = replace(case.assumed, velocity_um_s=image)
    points = np.array([[x, y] for x in (0.0, 10.0, 30.0) for y in range(205, 275, 10)], float)
    observed = Observations(0, points, sample(case.true, points), np.full(len(points), 1.0))
    plain, free = (
        Refiner(assimilate=Assimilate(inlet_shape_std=std)).refine(case.assumed, observed, case.chip, case.solver)
        for std in (0.0, 0.3)
    )
    assert case.error(free) < 0.3 * case.error(plain)


@pytest.mark.slow("refines for every depth")
def test_an_unknown_depth_is_found_where_it_may_be_one(twin):
    case = twin()
    chip = replace(case.chip, depth_um=60.0)
    case.true = case.solver.solve(replace(chip, depth_um=45.0))
    points = np.array([[x, y] for x in range(60, 180, 20) for y in range(205, 275, 10)], float)
    observed = Observations(0, points, sample(case.true, points), np.full(len(points), 0.5))
    assumed = case.solver.solve(chip)
    settings = Assimilate(model=ModelError(coarse_share=0.003))
    plain, free = (
        Refiner(assimilate=replace(settings, depth_std_share=share)).refine(assumed, observed, chip, case.solver)
        for share in (0.0, 0.3)
    )
    assert case.error(free) < 0.5 * case.error(plain)


def test_a_chip_that_is_assumed_to_stand_still_is_refused(twin):
    case = twin(assumed=(0.0, 0.0, 0.0))
    with pytest.raises(FlowError, match="stand still"):
        Refiner().refine(case.assumed, case.observations, case.chip, case.solver)


def test_the_mean_flow_is_the_sum_of_its_columns_times_the_mean_unknowns(twin):
    case = twin(noise=0.02)
    operator = observation_operator(case.observations, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    found = Assimilate().hypotheses(operator, case.chip, case.solver).best
    columns, model = field_columns(found), found.observed.model
    mean = model.base + model.expansion.pixels(found.remainder.flux)
    mean = mean + np.tensordot(found.posterior.mean[: len(columns)], columns, axes=1)
    assert np.abs(mean - found.flow).max() < 1e-3 * np.abs(found.flow).max()


def test_less_what_the_registration_does_the_observations_lie_on_the_flow(twin):
    case = twin(noise=0.001)
    moved = replace(case.observations, position_um=case.observations.position_um + np.array([0.0, 22.0]))
    operator = observation_operator(moved, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    every = Assimilate().hypotheses(operator, case.chip, case.solver)
    best = every.best
    flow_um_s, std_um_s = of_the_field(best)
    stated = operator.with_walls(every.best.observed.model.expansion.wall_px).on_fluid(case.chip.mask)
    off = flow_um_s - stated.predict(every.best.flow)
    assert np.sqrt((off**2).mean()) < 0.01 * np.sqrt((flow_um_s**2).mean())
    noise = best.robust.factor**2 * best.robust.variance / best.robust.inlier
    _, noisier = of_the_field(replace(best, robust=replace(best.robust, factor=2.0 * best.robust.factor)))
    np.testing.assert_allclose(noisier**2 - std_um_s**2, 3.0 * noise, rtol=1e-6)


def test_what_the_observations_can_not_tell_is_within_the_bars_of_the_map_and_of_what_was_found(twin, monkeypatch):
    case = twin()
    operator = observation_operator(case.observations, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    best = Assimilate().hypotheses(operator, case.chip, case.solver).best
    first, mean = 0, best.posterior.mean.copy()
    for effect in best.effects:
        mean[first : first + len(effect.columns)] += 0.04 * (effect.name == "scale")
        first += len(effect.columns)
    other = replace(best, flow=best.flow + 10.0, posterior=replace(best.posterior, mean=mean))
    problem = RefinementProblem(case.assumed, operator, case.chip, case.solver, assimilated=None)
    monkeypatch.setattr(uncertainty, "doubted_places", lambda *_: Doubts.none(len(best.flow)))
    fields, unsure = [], []
    for weights in (np.array([1.0, 0.0]), np.array([0.5, 0.5])):
        every = Hypotheses([best, other], weights, np.array([1.0, 0.0]), case.chip.mask)
        monkeypatch.setattr(Assimilate, "hypotheses", lambda *_, every=every: every)
        fields.append(Assimilate().fit(problem))
        unsure.append(Refiner().uncertainty(case.assumed, case.observations, case.chip, case.solver).std_um_s)
    sure, torn = (field.std_um_s[case.chip.mask].astype(float) for field in fields)
    np.testing.assert_allclose(torn**2 - sure**2, 0.5 * 10.0**2, rtol=1e-3)
    np.testing.assert_allclose(unsure[1] ** 2 - unsure[0] ** 2, 0.5 * 10.0**2, rtol=1e-3)
    (value, std), (other_value, wider) = (
        findings([best, other], weights).of("um_per_px_share")
        for weights in (np.array([1.0, 0.0]), np.array([0.5, 0.5]))
    )
    assert other_value - value == pytest.approx(0.02)
    assert wider**2 - std**2 == pytest.approx(0.02**2)


def test_the_pressures_of_a_refined_map_are_those_of_its_inflow_and_its_fluid(twin):
    case = twin(noise=0.01, assumed=(100.0, 0.004, -0.004), truth=(100.0, 0.006, -0.006))  # as of a thinner fluid
    settings = Assimilate(doubt_walls=False, doubt_depth=False, inlet_std_share=0.02, outlet_std_share=0.01)
    solver = FlowSolver(convection=False)
    refined = Refiner(assimilate=settings).refine(case.assumed, case.observations, case.chip, solver)
    chip = case.chip.with_boundary(refined.boundary_values, refined.viscosity_mpa_s)
    solved = solver.solve(chip).pressure_pa
    assert abs(refined.viscosity_mpa_s / case.chip.viscosity_mpa_s - 1.0) > 0.1
    np.testing.assert_allclose(refined.pressure_pa, solved, atol=0.01 * np.ptp(solved))


@pytest.mark.slow("refines a flow with strong inertia")
def test_a_fit_whose_inertia_frozen_factors_can_not_follow_keeps_the_last_step_that_shrank(twin):
    case = twin(noise=0.01, scale=2500.0, assumed=(30.0, 0.0, 0.0))  # Re of 170, from a quarter of it
    refined = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    assert case.error(refined) < 0.5 * case.error(case.assumed)
