"""Noise and gain found from what was recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Applied, Track, UsageError
from flowrec.measure import tune
from flowrec.measure.tuning import moving_noise, parked_noise
from flowrec.stages import Kalman, Observer, smooth
from tests.stages.estimation.lap import ROBOT, driven, vortex


def test_the_noise_of_a_parked_robot_is_found_under_its_drift_and_despite_jumps() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(300) / 30.0
    place = 4.0 * rng.standard_normal((300, 2)) + np.column_stack([15.0 * time, 3.0 * np.sin(time)])
    place[::90] += 300.0
    stamps = [round(at * 1e9) for at in time]
    tracks = [Track(at, True, where, 0.9, 0, 5.0, np.zeros(4)) for at, where in zip(stamps, place, strict=True)]
    rest = [Applied(at, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2)) for at in stamps]
    noise, rest_s = parked_noise(tracks, rest)
    assert noise == pytest.approx(4.0, rel=0.2)
    assert rest_s > 8.0
    driven = [replace(each, turns=np.ones(2)) for each in rest]
    assert np.isnan(parked_noise(tracks, driven)[0])


def test_the_drift_that_is_taken_off_a_parked_robot_takes_nothing_off_its_noise() -> None:
    rng = np.random.default_rng(3)
    stamps = [round(each * 1e9 / 20.0) for each in range(4000)]
    places = 2.0 * rng.standard_normal((4000, 2))
    tracks = [Track(at, True, where, 0.9, 0, 5.0, np.zeros(4)) for at, where in zip(stamps, places, strict=True)]
    rest = [Applied(at, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2)) for at in stamps]
    assert parked_noise(tracks, rest)[0] == pytest.approx(2.0, rel=0.07)


def test_an_interval_in_which_the_robot_was_driven_is_no_rest() -> None:
    rng = np.random.default_rng(4)
    stamps = [round(each * 1e9 / 30.0) for each in range(400)]
    driven = np.arange(400) % 10 == 9  # and 60 um farther each time
    places = 60.0 * np.cumsum(driven)[:, None] + rng.standard_normal((400, 2))
    tracks = [Track(at, True, where, 0.9, 0, 5.0, np.zeros(4)) for at, where in zip(stamps, places, strict=True)]
    turns = [Applied(at, 0.0, 0.0, 0.0, np.zeros(3), np.full(2, each)) for at, each in zip(stamps, driven, strict=True)]
    assert np.isnan(parked_noise(tracks, turns)[0]) and parked_noise(tracks, turns)[1] == 0.0


def test_places_of_a_robot_that_was_not_seen_add_nothing_to_the_noise_of_a_moving_one() -> None:
    rng = np.random.default_rng(6)
    stamps, seen = [round(each * 1e9 / 30.0) for each in range(400)], np.arange(400) % 6 != 0
    places = 2.0 * rng.standard_normal((400, 2)) + np.where(seen, 0.0, 90.0)[:, None]
    tracks = [
        Track(at, bool(each), where, 0.9, 0, 5.0, np.zeros(4))
        for at, each, where in zip(stamps, seen, places, strict=True)
    ]
    rest = [Applied(at, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2)) for at in stamps]
    assert moving_noise(tracks, rest, ROBOT) == pytest.approx(2.0, rel=0.2)


def test_a_position_of_something_else_counts_as_one_at_the_gate_and_not_by_its_distance() -> None:
    run = driven(6.0)
    tracks = [replace(each, position_um=each.position_um + 500.0 * (n % 20 == 0)) for n, each in enumerate(run.tracks)]
    tuned = tune(tracks[:80], run.applied[:80], ROBOT, Kalman(position_noise_um=6.0))
    assert tuned.nis_before <= Kalman().gate_nis


def test_tuning_finds_the_noise_of_a_driven_robot_and_brings_the_nis_to_two() -> None:
    run = driven(6.0)
    run.tracks[:] = run.tracks[:600]
    run.applied[:] = run.applied[:600]
    assert moving_noise(run.tracks, run.applied, ROBOT) == pytest.approx(6.0, rel=0.1)
    tuned = tune(run.tracks, run.applied, ROBOT, Kalman())
    assert tuned.source == "moving"
    assert tuned.nis == pytest.approx(2.0, abs=0.1)
    assert tuned.nis_before > 5.0
    assert tuned.sets[0].startswith("observer.kalman.position_noise_um=")
    with pytest.raises(UsageError, match="too few"):
        tune(run.tracks[:5], run.applied[:5], ROBOT, Kalman())


def test_the_gain_is_found_where_the_headings_vary() -> None:
    run = driven(10.0, gain=1.1)
    field = vortex()
    fixed = Kalman(position_noise_um=10.0)
    felt = replace(fixed, estimate_gain=True)
    blind = run.observed(Observer("kalman_map", kalman=fixed), field)
    found = run.observed(Observer("kalman_map", kalman=felt), field)
    assert blind[-1].um_per_rev is None
    assert found[-1].um_per_rev == pytest.approx(1.1 * ROBOT.um_per_rev, rel=0.02)
    assert found[-1].covariance.shape == (5, 5)
    flows = [np.array([each.flow_um_s for each in estimates]) for estimates in (blind, found)]
    assert run.rmse(flows[0]) > 20.0
    assert run.rmse(flows[1]) < 5.0
    mapless = run.observed(Observer(kalman=felt))
    assert run.rmse(np.array([each.flow_um_s for each in mapless])) < 0.65 * run.rmse(flows[0])


def test_on_a_straight_way_the_gain_is_not_pretended_to_be_known() -> None:
    run = driven(5.0)
    felt = Kalman(position_noise_um=5.0, estimate_gain=True)
    still = [replace(each, turns=np.zeros(2)) for each in run.applied[:200]]
    last = None
    for track, done in zip(run.tracks, still, strict=False):
        last = felt.estimate(last, replace(track, position_um=np.zeros(2)), done, ROBOT)
    assert last is not None
    assert np.sqrt(last.covariance[-1, -1]) > 0.14 * ROBOT.um_per_rev


def test_the_smoother_is_within_five_um_s_on_the_lemniscate() -> None:
    run = driven(10.0)
    smoothed = smooth(run.tracks, run.applied, Kalman(position_noise_um=10.0), ROBOT)
    assert run.rmse(smoothed.flow_um_s) < 5.0
