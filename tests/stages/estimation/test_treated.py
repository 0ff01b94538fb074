"""What becomes of a survey before a refinement uses it: the paper's trimming, and smoothing afterwards."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Applied, Observations, Track, UsageError, as_read
from flowrec.physics import Robot
from flowrec.stages import (
    RESTART,
    SAMPLERS,
    SKIPPED,
    USED,
    Kalman,
    NoiseModel,
    Observer,
    Trimmed,
    observe,
    smooth,
    without_jumps,
)
from flowrec.stages.estimation import Sampler
from flowrec.stages.estimation.sampler import _polynomial

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, um_per_rev=25.0)
DT = 1.0 / 30.0


def survey(seed=0, noise=10.0, count=60):
    way = np.linspace(0.0, 3000.0, count)
    truth = np.column_stack([200.0 + 100.0 * np.sin(way / 800.0), 50.0 * np.cos(way / 900.0)])
    flow = truth + noise * np.random.default_rng(seed).standard_normal(truth.shape)
    return truth, Observations(7, np.column_stack([way, 0.1 * way]), flow, np.full(count, noise))


def test_trimming_smooths_and_shrugs_off_what_sticks_out():
    truth, observed = survey()
    flow = observed.flow_um_s.copy()
    flow[10::12] += [400.0, -300.0]
    treated = Trimmed().treat(replace(observed, flow_um_s=flow))
    assert treated.stamp_ns == 7 and len(treated.std_um_s) == 60
    assert np.sqrt(((treated.flow_um_s - truth) ** 2).mean()) < 9.0  # 84 before
    assert (treated.std_um_s >= 10.0).all()


def test_trimming_is_exact_on_a_polynomial_and_its_std_says_where_it_does_not_fit():
    _, observed = survey()
    way = observed.position_um[:, 0] / 1000.0
    parabola = np.column_stack([100.0 + 30.0 * way - 5.0 * way**2, 20.0 * way])
    smooth_ = Trimmed().treat(replace(observed, flow_um_s=parabola))
    np.testing.assert_allclose(smooth_.flow_um_s, parabola, atol=1e-6)
    step = np.where(way[:, None] < 1.5, [300.0, 0.0], [0.0, 300.0])
    bent = Trimmed().treat(replace(observed, flow_um_s=step))
    worst = np.abs(bent.flow_um_s - step).max(axis=1)
    assert (bent.std_um_s[worst > 60.0] > 15.0).all()


@pytest.mark.parametrize("over", ["window", "survey"])
def test_trimming_leaves_few_observations_as_they_are_and_no_nonsense(over):
    _, observed = survey(count=3)
    assert Trimmed(over=over).treat(observed).same_as(observed)
    _, many = survey(count=20)
    flow = many.flow_um_s.copy()
    flow[4] = np.nan
    with as_read():  # of a session from before such numbers were refused
        broken = replace(many, flow_um_s=flow)
    treated = Trimmed(over=over).treat(broken)
    assert len(treated.std_um_s) == 19 and np.isfinite(treated.flow_um_s).all()


def swim(seed, seconds=60.0, noise_um=4.0, q=2000.0):
    """A robot that is driven about in a flow that wanders as the filter believes; one second unseen."""
    rng = np.random.default_rng(seed)
    position, flow = np.zeros(2), np.array([80.0, -40.0])
    flows, tracks, inputs = [], [], []
    for index in range(round(seconds / DT)):
        moved = np.zeros(2)
        if index:
            moved = 300.0 * DT * np.array([math.cos(index * 0.01), math.sin(index * 0.013)])
            before = flow
            flow = flow + math.sqrt(q * DT) * rng.standard_normal(2)
            position = position + moved + 0.5 * (before + flow) * DT
        stamp = round(index * DT * 1e9)
        seen = not 600 <= index < 630
        tracks.append(Track(stamp, seen, position + noise_um * rng.standard_normal(2), 0.9, 0, 5.0, np.zeros(4)))
        inputs.append(Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), moved / ROBOT.um_per_rev))
        flows.append(flow)
    return np.array(flows), tracks, inputs


@pytest.mark.slow("many flights of the observer")
def test_the_smoother_is_better_than_the_filter_and_honest_about_it():
    kalman = Kalman(position_noise_um=4.0, flow_noise_um2_s3=2000.0, drift_um2_s=0.0)
    pulls, gains = [], []
    for seed in range(3):
        truth, tracks, inputs = swim(seed)
        smoothed = smooth(tracks, inputs, kalman, ROBOT)
        estimate, filtered = None, []
        for seen, done in zip(tracks, inputs, strict=True):
            estimate = Observer(kalman=kalman).estimate(estimate, seen, done, ROBOT)
            filtered.append(estimate.flow_um_s)
        late = slice(60, None)
        gains.append(np.std((smoothed.flow_um_s - truth)[late]) / np.std((np.array(filtered) - truth)[late]))
        observed = observe(smoothed, ROBOT)
        assert observed.radius_um == ROBOT.radius_um, "the flow carries it as a sphere of this size"
        at = [int(np.argmin(np.abs(smoothed.position_um - point).sum(axis=1))) for point in observed.position_um]
        pulls.append((observed.flow_um_s - truth[at]) / observed.std_um_s[:, None])
        assert len(at) > 20
    assert max(gains) < 0.75
    assert 0.8 < np.sqrt((np.concatenate(pulls) ** 2).mean()) < 1.2
    # Neighbours have noise of their own.
    assert np.mean([(p[1:] * p[:-1]).mean() for p in pulls]) < 0.4


def test_the_smoother_is_the_least_squares_of_all_frames_at_once():
    kalman = Kalman(position_noise_um=4.0, flow_noise_um2_s3=2000.0)
    _, tracks, inputs = swim(3, seconds=0.4)
    smoothed = smooth(tracks, inputs, kalman, ROBOT)
    count, estimate = len(tracks), None
    information, load = np.zeros((4 * count, 4 * count)), np.zeros(4 * count)
    for k, (seen, done) in enumerate(zip(tracks, inputs, strict=True)):
        here = slice(4 * k, 4 * k + 4)
        if estimate is None:
            estimate = kalman.estimate(None, seen, done, ROBOT)
            start = np.concatenate([estimate.position_um, estimate.flow_um_s])
            information[here, here] += np.linalg.inv(estimate.covariance)
            load[here] += np.linalg.solve(estimate.covariance, start)
            continue
        ahead, expected, _, jacobian = kalman.predict(estimate, seen, done, ROBOT)
        noise = expected - jacobian @ estimate.covariance @ jacobian.T
        own = ahead - jacobian @ np.concatenate([estimate.position_um, estimate.flow_um_s])
        step = np.hstack([-jacobian, np.eye(4)])
        both = slice(4 * k - 4, 4 * k + 4)
        information[both, both] += step.T @ np.linalg.solve(noise, step)
        load[both] += step.T @ np.linalg.solve(noise, own)
        information[here, here] += np.diag([1.0, 1.0, 0.0, 0.0]) / 16.0
        load[here] += np.append(seen.position_um, [0.0, 0.0]) / 16.0
        estimate = kalman.estimate(estimate, seen, done, ROBOT)
    covariance = np.linalg.inv(information)
    states = (covariance @ load).reshape(count, 4)
    np.testing.assert_allclose(np.hstack([smoothed.position_um, smoothed.flow_um_s]), states, rtol=1e-6, atol=1e-4)
    blocks = np.array([covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in range(count)])
    np.testing.assert_allclose(smoothed.covariance, blocks, rtol=1e-5, atol=1e-4)


def test_the_scatter_around_a_polynomial_is_that_of_the_values_however_few_they_are():
    rng, distance = np.random.default_rng(0), np.linspace(-4.0, 4.0, 6)
    found = [_polynomial(distance, rng.normal(0.0, 3.0, 6), np.ones(6), 2)[1] for _ in range(2000)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(3.0, rel=0.06)


def test_a_track_that_jumps_and_stays_is_another_stretch_from_where_it_jumped_on():
    time_s, rng = np.arange(60) * DT, np.random.default_rng(1)
    places = np.column_stack([100.0 * time_s, 0.0 * time_s]) + rng.normal(0.0, 0.3, (60, 2))
    places[20] += 50.0
    places[40:] += 80.0
    flags = without_jumps(time_s, places, np.zeros(60, np.int8), NoiseModel(0.1, 1.0, 100.0), 8.0)
    assert np.flatnonzero(flags == SKIPPED).tolist() == [20]
    assert np.flatnonzero(flags == RESTART).tolist() == [40]
    assert (np.delete(flags, [20, 40]) == USED).all()


def test_the_last_smoothed_frame_is_the_filters():
    kalman = Kalman(position_noise_um=4.0)
    _, tracks, inputs = swim(5, seconds=4.0)
    smoothed = smooth(tracks, inputs, kalman, ROBOT)
    estimate = None
    for seen, done in zip(tracks, inputs, strict=True):
        estimate = kalman.estimate(estimate, seen, done, ROBOT)
    np.testing.assert_allclose(smoothed.flow_um_s[-1], estimate.flow_um_s, rtol=1e-9)
    np.testing.assert_allclose(smoothed.position_um[-1], estimate.position_um, rtol=1e-9)
    np.testing.assert_allclose(smoothed.covariance[-1], estimate.covariance[:4, :4], rtol=1e-9)


@pytest.mark.parametrize("method", list(SAMPLERS))
def test_any_treatment_keeps_observations_finite_and_no_more_of_them(method):
    _, observed = survey()
    treated = Sampler(method=method).treat(observed)
    assert 0 < len(treated.std_um_s) <= len(observed.std_um_s)
    assert np.isfinite(treated.flow_um_s).all() and (treated.std_um_s > 0.0).all()


def test_a_treatment_that_is_not_in_the_table_is_an_error():
    with pytest.raises(UsageError, match=r"sampler\.method = 'trim': .* trimmed$"):
        Sampler(method="trim").treat(survey()[1])
