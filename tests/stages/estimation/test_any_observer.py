"""What every method of the observer stage promises."""

from dataclasses import fields, replace

import numpy as np
import pytest

from flowrec.core import Estimate
from flowrec.stages import OBSERVERS, Observer
from tests.stages.estimation.lap import ROBOT, driven, vortex

FRAMES = 90


def short_lap(noise_um=5.0):
    run = driven(noise_um)
    run.tracks[:], run.applied[:], run.flow_um_s = run.tracks[:FRAMES], run.applied[:FRAMES], run.flow_um_s[:FRAMES]
    return run


@pytest.mark.parametrize("field", [None, vortex(0.8)], ids=["without a map", "with a map"])
def test_from_any_recorded_estimate_on_the_next_one_is_the_same(any_observer, field):
    run = short_lap()
    estimates = run.observed(any_observer, field)
    for tick in (1, 20, FRAMES - 1):
        values = {each.name: getattr(estimates[tick - 1], each.name) for each in fields(Estimate)}
        recorded = Estimate(**{name: np.array(v) if isinstance(v, np.ndarray) else v for name, v in values.items()})
        again = replace(any_observer).estimate(recorded, run.tracks[tick], run.applied[tick], ROBOT, field)
        assert again.same_as(estimates[tick])


@pytest.mark.parametrize("field", [None, vortex(0.8)], ids=["without a map", "with a map"])
def test_a_missing_robot_is_a_value_and_estimates_stay_finite_and_symmetric(any_observer, field):
    run = short_lap()
    run.tracks[30:50] = [
        replace(track, seen=False, position_um=run.tracks[29].position_um) for track in run.tracks[30:50]
    ]
    for index, estimate in enumerate(run.observed(any_observer, field)):
        assert estimate.seen == (not 30 <= index < 50)
        assert np.isfinite(estimate.position_um).all() and np.isfinite(estimate.flow_um_s).all()
        assert np.array_equal(estimate.covariance, estimate.covariance.T)
        assert (np.linalg.eigvalsh(estimate.covariance) > -1e-9).all()


def test_an_unseen_robot_moves_by_its_turns_and_by_the_flow(any_observer):
    run = short_lap(noise_um=0.5)
    known = run.observed(any_observer, vortex())[-1]
    stamp = known.stamp_ns + 33_000_000
    turns = np.array([0.4, -0.2])
    last = replace(run.tracks[-1], stamp_ns=stamp, seen=False)
    moved = any_observer.estimate(known, last, replace(run.applied[-1], stamp_ns=stamp, turns=turns), ROBOT, vortex())
    expected = known.position_um + ROBOT.um_per_rev * turns + 0.033 * known.flow_um_s
    np.testing.assert_allclose(moved.position_um, expected, atol=0.5)
    assert not moved.seen


def test_the_covariance_grows_while_the_robot_is_not_seen_where_the_method_has_dynamics(any_observer):
    run = short_lap()
    known = run.observed(any_observer)[-1]
    stamps = [known.stamp_ns + 33_000_000 * k for k in range(1, 31)]
    estimate = known
    for stamp in stamps:
        track = replace(run.tracks[-1], stamp_ns=stamp, seen=False)
        estimate = any_observer.estimate(estimate, track, replace(run.applied[-1], stamp_ns=stamp), ROBOT)
    grown = np.diag(estimate.covariance)[:4] / np.diag(known.covariance)[:4]
    if any_observer.method == "luenberger":  # a nominal covariance
        np.testing.assert_allclose(grown[:2], 1.0)
    else:
        assert (grown > 2.0).all()


def test_after_three_seconds_the_error_of_the_flow_is_below_four_tenths(any_observer):
    run = short_lap()
    flows = np.array([estimate.flow_um_s for estimate in run.observed(any_observer, vortex())])
    error = np.hypot(*(flows[-10:] - run.flow_um_s[-10:]).T).mean()
    assert error < 0.4 * np.hypot(*run.flow_um_s[-10:].T).mean()


def test_the_option_of_each_row_is_the_section_of_its_settings():
    for row in OBSERVERS.values():
        assert isinstance(getattr(Observer(), row.options[0]), row.load())
