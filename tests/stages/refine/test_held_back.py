"""A refined flow is tested on observations that were held back, in closed form, and adopted only where it predicts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import flowrec
from flowrec.core.messages import Observations
from flowrec.physics.flow.sampling import sample
from flowrec.stages.refine import Ni, Refiner
from flowrec.stages.refine.held_back import BLOCKS, FEWEST, block_scores, blocks, worse
from flowrec.stages.refine.refiner import NO_FLOW, keep_flow


def refined_of(case, before=None, observations=None, **settings):
    observations = case.observations if observations is None else observations
    return Refiner(**settings).refine(case.assumed, observations, case.chip, case.solver, before)


def test_the_density_of_a_block_is_that_of_a_model_that_was_fitted_without_it():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((24, 24))
    covariance = root @ root.T + 0.5 * np.eye(24)
    y = rng.standard_normal(24)
    held = blocks(np.arange(12))
    assert [block.tolist() for block in held] == [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9], [10, 11]]
    for block, score in zip(held, block_scores(covariance, y, held), strict=True):
        out = np.ravel([[2 * index, 2 * index + 1] for index in block])
        rest = np.setdiff1d(np.arange(24), out)
        lever = covariance[np.ix_(out, rest)] @ np.linalg.inv(covariance[np.ix_(rest, rest)])
        from scipy.stats import multivariate_normal

        expected = multivariate_normal(lever @ y[rest], covariance[np.ix_(out, out)] - lever @ covariance[rest][:, out])
        assert score == pytest.approx(expected.logpdf(y[out]) / len(block), rel=1e-9)


def test_blocks_are_contiguous_and_few_observations_have_none():
    held = blocks(np.arange(50))
    assert len(held) == BLOCKS and np.array_equal(np.concatenate(held), np.arange(50))
    assert blocks(np.arange(FEWEST - 1)) == []


@pytest.mark.parametrize("method", ["assimilate", "gain"])
def test_where_the_assumed_flow_is_wrong_the_refined_one_predicts_what_was_held_back_better(twin, method):
    case = twin(truth=(150.0, 0.0, 0.0))
    found = refined_of(case, method=method)
    assert case.error(found) < 0.3 * case.error(case.assumed)
    assert found.log_score - found.log_score_before > 2.0 * found.log_score_error > 0.0
    assert Refiner(method).choose(found, case.assumed) is found


@pytest.mark.parametrize("method", ["assimilate", "gain"])
def test_where_the_assumed_flow_is_right_both_predict_alike(twin, method):
    case = twin(truth=(100.0, 0.0, 0.0))
    found = refined_of(case, method=method)
    assert abs(found.log_score - found.log_score_before) < 0.2 and not worse(found)


@pytest.mark.parametrize("method", ["assimilate", "gain"])
def test_a_map_in_use_that_predicts_better_stays_with_both_scores_and_the_reason(twin, method):
    """The pump was faster while the first half was observed; the map in use was made after that."""
    case = twin(truth=(100.0, 0.0, 0.004))
    made = case.observations
    count = len(made.std_um_s)
    time_s, faster = np.arange(count) * 0.5, np.where(np.arange(count) < count // 2, 2.5, 1.0)
    shown = Observations(0, made.position_um, made.flow_um_s * faster[:, None], made.std_um_s, None, time_s)
    in_use = replace(case.true, method="assimilate", stamp_ns=int(0.5 * count // 2 * 1e9), note="of the second half")
    found = refined_of(case, in_use, shown, method=method)
    assert case.error(found) > 0.2
    assert worse(found)
    kept = Refiner(method).choose(found, in_use)
    assert kept.refused == f"by {method} it predicts observations that were held back worse"
    assert (kept.log_score, kept.log_score_before) == (found.log_score, found.log_score_before)
    assert kept.log_score < kept.log_score_before
    same = replace(kept, refused="", log_score=None, log_score_before=None, log_score_error=None)
    assert same.same_as(in_use)
    assert Refiner(method, adopt="always").choose(found, in_use) is found


@pytest.mark.slow("refines three times")
def test_a_map_in_use_is_tested_on_what_was_made_after_it_alone(twin):
    case = twin()
    made = case.observations
    count = len(made.std_um_s)
    timed = replace(made, time_s=np.arange(count) * 0.5)
    for new, tested in ((FEWEST - 1, False), (3 * FEWEST, True)):
        in_use = replace(case.true, stamp_ns=int((0.5 * (count - new) - 0.25) * 1e9))
        found = refined_of(case, in_use, timed)
        assert (found.log_score is not None) is tested
        doubled = replace(in_use, velocity_um_s=2.0 * case.true.velocity_um_s)
        if tested:  # by its own flow, not by the assumed one
            assert refined_of(case, doubled, timed).log_score_before < found.log_score_before - 1.0
        said = f"not tested on observations that were held back: {new} are too few"
        assert (said in found.note) is not tested


def test_where_the_map_in_use_is_the_assumed_one_after_a_refusal_all_observations_test_the_next(twin):
    case = twin()
    timed = replace(case.observations, time_s=np.arange(len(case.observations.std_um_s)) * 0.5)
    after_all = replace(case.assumed, stamp_ns=10**12)
    refused = keep_flow(after_all, "by gain it predicts observations that were held back worse")
    found = refined_of(case, refused, timed, method="gain")
    first = refined_of(case, None, timed, method="gain")
    assert found.log_score_before == first.log_score_before is not None
    assert refined_of(case, after_all, timed, method="gain").log_score_before is None


def test_the_factor_that_predicts_a_block_is_that_of_the_others(twin):
    case = twin(truth=(150.0, 0.0, 0.0), noise=0.2)
    flow = sample(case.true, case.observations.position_um)  # no spread but the stated noise
    made = replace(case.observations, flow_um_s=flow)
    assumed, expected = sample(case.assumed, made.position_um), []
    for block in blocks(np.arange(len(flow))):
        others = refined_of(case, None, made.only(np.setdiff1d(np.arange(len(flow)), block)), method="gain")
        own, (factor,), (std,) = assumed[block].ravel(), others.parameters, others.parameter_std
        covariance = made.std_um_s[0] ** 2 * np.eye(len(own)) + std**2 * np.outer(own, own)
        from scipy.stats import multivariate_normal

        expected.append(multivariate_normal(factor * own, covariance).logpdf(flow[block].ravel()) / len(block))
    assert refined_of(case, None, made, method="gain").log_score == pytest.approx(np.mean(expected), abs=1e-5)


def test_a_session_from_before_the_test_replays_without_it():
    golden = flowrec.open(Path(__file__).parents[3] / "sessions" / "golden_moderate.mcap")
    assert golden.config.refine.adopt == "always" and Refiner().adopt == "predicts"


def test_a_correction_of_an_assimilated_flow_has_the_scores_of_its_start(twin):
    case = twin(truth=(150.0, 0.0, 0.0))
    start, found = refined_of(case), refined_of(case, method="pi_unet")
    assert "nothing to correct" in found.note
    assert (found.log_score, found.log_score_before) == (start.log_score, start.log_score_before)


def test_a_method_that_would_have_to_fit_again_says_that_it_was_not_tested(twin):
    case = twin()
    found = refined_of(case, method="ni", ni=Ni(iterations=6, base_channels=8))
    assert found.log_score is None and not worse(found)
    assert "not tested on observations that were held back: the method would have to fit again" in found.note


def test_without_the_test_a_flow_is_as_it_was_before_there_was_one(twin):
    case = twin()
    for method in ("assimilate", "gain"):
        plain, tested = refined_of(case, method=method, adopt="always"), refined_of(case, method=method)
        assert plain.log_score is None is plain.log_score_before
        assert replace(tested, log_score=None, log_score_before=None, log_score_error=None).same_as(plain)


def test_observations_that_are_not_those_of_a_flow_refine_nothing(twin):
    case = twin()
    found = refined_of(case, observes_flow=False)
    assert found.refused == NO_FLOW
    assert replace(found, refused="").same_as(case.assumed)
    assert float(np.abs(sample(found, case.observations.position_um)).max()) > 0.0
