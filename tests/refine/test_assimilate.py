import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.messages import Observations
from flowrec.refine import Assimilate, Refiner


def test_assimilation_recovers_the_truth_from_noisy_observations(twin):
    case = twin()
    refined = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    assert case.error(case.assumed) > 0.2
    assert case.error(refined) < 0.04
    assert refined.boundary_values[0] == pytest.approx(130.0, rel=0.04)
    assert refined.method == "assimilate" and "inlet" not in refined.note


def test_assimilation_follows_inertia(twin):
    # Re about 20: Stokes modes alone can not explain the observations.
    case = twin(noise=0.01, scale=300.0)
    refined = Refiner().refine(case.assumed, case.observations, case.chip, case.solver)
    stokes = Refiner().refine(case.assumed, case.observations, case.chip, FlowSolver(convection=False))
    assert case.error(refined) < 0.02
    assert case.error(refined) < 0.5 * case.error(stokes)


def test_outliers_do_not_pull_the_field(twin):
    case = twin()
    flow = case.observations.flow_um_s.copy()
    flow[::6] += [-600.0, 900.0]
    spoiled = replace(case.observations, flow_um_s=flow)
    robust = Refiner().refine(case.assumed, spoiled, case.chip, case.solver)
    gaussian = Refiner(assimilate=Assimilate(tail=1e6)).refine(case.assumed, spoiled, case.chip, case.solver)
    assert case.error(robust) < 0.06 < case.error(gaussian)


def test_error_bars_cover_the_truth_and_shrink_with_observations(twin):
    settings = Assimilate(model_error_share=0.003)  # the twin's model is right
    scores, widths = [], []
    for seed in range(8):
        truth = np.array([100.0, 0.0, 0.0]) + np.random.default_rng(50 + seed).standard_normal(3) * [25.0, 0.003, 0.003]
        case = twin(truth=truth, seed=seed)
        refined = Refiner(assimilate=settings).refine(case.assumed, case.observations, case.chip, case.solver)
        busy = np.linalg.norm(case.true.velocity_um_s, axis=-1) > 20.0
        scores.append((refined.velocity_um_s - case.true.velocity_um_s)[busy] / refined.std_um_s[busy])
        widths.append(np.median(refined.std_um_s[busy]))
    spread = np.sqrt(np.mean([np.mean(score**2) for score in scores]))
    assert 0.4 < spread < 1.6
    assert np.mean(np.abs(np.concatenate(scores)) < 2.0) > 0.85
    few = twin(every=20)
    wide = Refiner(assimilate=settings).refine(few.assumed, few.observations, few.chip, few.solver)
    assert np.median(wide.std_um_s[busy]) > 1.5 * np.mean(widths)


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
    useless = Observations(
        0, [[5, 5], [-90, 3], [240, 240], [240, 240]], [[1, 1], [1, 1], [np.nan, 1], [1, 1]], [1, 1, 1, -1]
    )
    for observations in (nothing, useless):
        for method in ("assimilate", "pi_unet"):
            refined = Refiner(method).refine(case.assumed, observations, case.chip, case.solver)
            assert refined.note.startswith("not refined")
            assert replace(refined, note="").same_as(replace(case.assumed, note=""))


def test_the_same_input_gives_the_same_bytes_and_keeps_stamp_and_request(twin):
    case = twin()
    assumed = replace(case.assumed, stamp_ns=77, request=5)
    first, second = (Refiner().refine(assumed, case.observations, case.chip, case.solver) for _ in range(2))
    assert first.same_as(second)
    assert (first.stamp_ns, first.request) == (77, 5)


def test_a_chip_that_is_assumed_to_stand_still_is_refused(twin):
    case = twin(assumed=(0.0, 0.0, 0.0))
    with pytest.raises(FlowError, match="stand still"):
        Refiner().refine(case.assumed, case.observations, case.chip, case.solver)


def test_torch_is_not_imported_before_the_network_runs():
    code = "import sys, flowrec.refine; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
