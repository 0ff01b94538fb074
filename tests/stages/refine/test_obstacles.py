import re
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core.messages import Observations
from flowrec.physics.chip.openings import find_openings, guess_inlets
from flowrec.physics.chip.synthetic import bifurcation
from flowrec.physics.flow.sampling import relative_rmse, sample
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.refine import Assimilate, PiUnet, Refiner, doubts
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.discretisation_error import ModelError
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.noise import robust_noise
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.obstacles import Obstacle

SOLVER = FlowSolver()
# One step of the network leaves the field of the best hypothesis.
PLAIN, CORRECTED = Refiner("assimilate"), Refiner("pi_unet", pi_unet=PiUnet(iterations=1))
AT_UM = (3200.0, 3400.0)  # in the middle of the lower branch


def blocked(chip):
    """The lower half of the lower branch is solid over 0.4 mm."""
    y, x = np.indices(chip.mask.shape) * chip.um_per_px
    return replace(chip, mask=chip.mask & ~((np.abs(x - AT_UM[0]) < 200.0) & (y > AT_UM[1]) & (y < AT_UM[1] + 400.0)))


def observed(truth, chip, noise=0.03):
    """Along the upper half of the lower branch, and where inlet and outlet are."""
    rng = np.random.default_rng(3)
    x = np.concatenate([np.linspace(200.0, 900.0, 8), np.linspace(2400.0, 4000.0, 30), np.linspace(5500.0, 6200.0, 8)])
    points = np.stack([x, np.where((x > 2000.0) & (x < 4500.0), AT_UM[1] - 70.0, 2700.0)], axis=1)
    flow = np.array([sample(truth, point) for point in points])
    std = noise * float(np.sqrt((flow**2).sum(axis=1).mean()))
    flow = flow + rng.normal(0.0, std, flow.shape)
    return Observations(0, points, flow, np.full(len(points), std))


@pytest.fixture(scope="module")
def chip():
    """The bifurcation with pixels of 40 um."""
    fine = bifurcation()
    mask = fine.mask[::2, ::2]
    return replace(fine, mask=mask, um_per_px=2.0 * fine.um_per_px, openings=guess_inlets(find_openings(mask), 220.0))


@pytest.fixture(scope="module")
def assumed(chip):
    return SOLVER.solve(chip)


@pytest.mark.slow("refines with every doubt about the chip")
def test_a_branch_that_is_half_blocked_is_found_and_the_map_is_right_beside_it(chip, assumed):
    truth = SOLVER.solve(blocked(chip))
    observations = observed(truth, chip)
    plain, corrected = (method.refine(assumed, observations, chip, SOLVER) for method in (PLAIN, CORRECTED))
    before, after = (relative_rmse(field, truth, chip.mask).v for field in (plain, corrected))
    assert after < 0.8 * before
    found = dict(zip(corrected.parameter_names.split("; "), corrected.parameters, strict=True))
    assert (found["obstacle_x_um"], found["obstacle_y_um"]) == pytest.approx(AT_UM, abs=90.0)  # x and y are 200 apart
    said = re.search(r"a channel is partly blocked at \((\d+), (\d+)\) um", corrected.note)
    assert [float(one) for one in said.groups()] == pytest.approx(AT_UM, abs=90.0)
    true = truth.velocity_um_s[chip.mask]
    within = np.abs(corrected.velocity_um_s[chip.mask] - true) < 2.0 * corrected.std_um_s[chip.mask]
    assert within.mean() > 0.9


@pytest.mark.slow("refines with every doubt about the chip")
def test_the_survey_doubts_the_branch_that_carries_too_little_and_then_the_place_that_was_seen(chip, assumed):
    truth = SOLVER.solve(blocked(chip))
    every = observed(truth, chip)
    x = every.position_um[:, 0]
    for seen, within_um, least in ((np.abs(x - AT_UM[0]) > 600.0, 2500.0, 0.5), (x > 0.0, 400.0, 0.8)):
        some = replace(
            every, position_um=every.position_um[seen], flow_um_s=every.flow_um_s[seen], std_um_s=every.std_um_s[seen]
        )
        doubts = PLAIN.uncertainty(assumed, some, chip, SOLVER).doubts
        rows, columns = np.nonzero(chip.mask)
        middle = np.hypot(*doubts.changes_um_s.transpose(2, 0, 1)).argmax(axis=1)
        places = np.stack([columns[middle], rows[middle]], axis=1) * chip.um_per_px
        near = np.hypot(*(places - AT_UM).T) < within_um
        lower = places[:, 1] > 2700.0
        assert doubts.probability[near & lower].sum() > least * doubts.probability.sum()
        assert doubts.probability.sum() > 0.5
    values = chip.boundary_values * np.array([1.2, 1.0])
    free = PLAIN.uncertainty(assumed, observed(SOLVER.solve(chip.with_boundary(values)), chip), chip, SOLVER)
    assert free.doubts.probability.sum() < 0.2


@pytest.mark.slow("refines with every doubt about the chip")
def test_where_nothing_is_blocked_the_map_is_that_of_the_assimilation(chip, assumed):
    values = chip.boundary_values * np.array([1.2, 1.0])
    truth = SOLVER.solve(chip.with_boundary(values))
    observations = observed(truth, chip)
    plain, corrected = (method.refine(assumed, observations, chip, SOLVER) for method in (PLAIN, CORRECTED))
    assert relative_rmse(corrected, truth, chip.mask).v == pytest.approx(
        relative_rmse(plain, truth, chip.mask).v, abs=0.002
    )
    assert "blocked" not in corrected.note


@pytest.mark.slow("refines with every doubt about the chip")
def test_three_observations_that_something_else_spoils_are_not_taken_for_an_obstacle(chip, assumed):
    # They are neighbours and eight standard deviations off: an obstacle is likelier by more than its prior says.
    truth = SOLVER.solve(chip.with_boundary(chip.boundary_values * np.array([1.2, 1.0])))
    observations = observed(truth, chip)
    flow = observations.flow_um_s.copy()
    flow[20:23] += 8.4 * observations.std_um_s[0] * np.array([-1.0, 0.6])
    observations = replace(observations, flow_um_s=flow)
    plain, corrected = (method.refine(assumed, observations, chip, SOLVER) for method in (PLAIN, CORRECTED))
    assert "blocked" not in corrected.note
    assert relative_rmse(corrected, truth, chip.mask).v < 2.0 * relative_rmse(plain, truth, chip.mask).v


def test_an_obstacle_closes_the_side_of_the_flow_that_it_names(chip):
    left = Obstacle(85.0, 80.0, (1.0, 0.0), 4.0, -1, 1.0, 1.5, 100.0).friction_per_um2(chip)
    whole = Obstacle(85.0, 80.0, (1.0, 0.0), 4.0, 0, 1.0, 1.5, 100.0).friction_per_um2(chip)
    rows, columns = np.nonzero(left)
    assert rows.max() == 85  # image rows grow downwards: left of a flow to the right is above
    assert (columns.min(), columns.max()) == (75, 85)
    assert left[:, 75].sum() < 0.8 * left[:, 80].sum(), "a deposit is round"
    assert whole.sum() > 2.0 * left.sum()
    assert not whole[~chip.mask].any()


def test_where_observations_say_nothing_a_channel_is_partly_blocked_as_likely_as_before(twin, monkeypatch):
    case = twin()
    model = flow_model(Assimilate(), ModelError(), case.chip, case.solver)
    operator = observation_operator(case.observations, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    observed = Observed.of(model, operator)
    monkeypatch.setattr(doubts, "deposits_um_s", lambda *_: np.zeros((12, len(model.base), 2), np.float32))
    found = doubts.doubted_places(observed, robust_noise(observed), case.solver, 0.4)
    assert len(found.probability) == 12 and found.probability.sum() == pytest.approx(0.4)
