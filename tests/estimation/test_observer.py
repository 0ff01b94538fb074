"""Observers against a robot whose flow is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from flowrec.estimation import Kalman, Luenberger, Observer, Sampler
from flowrec.messages import Applied, Estimate, Track
from flowrec.robot import Robot

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, um_per_rev=25.0)
RATE_HZ = 30.0


def track(index: int, position: NDArray[np.float64], seen: bool = True) -> Track:
    return Track(round(index * 1e9 / RATE_HZ), seen, position, 0.9, 0, 5.0, np.zeros(4))


def applied(index: int, moved_um: NDArray[np.float64]) -> Applied:
    return Applied(round(index * 1e9 / RATE_HZ), 0.0, 0.0, 0.0, np.zeros(3), moved_um / ROBOT.um_per_rev)


def lemniscate(time_s: float) -> NDArray[np.float64]:
    """The reference of the paper's tracking study, once around in 40 s."""
    sine, cosine = math.sin(2 * math.pi * time_s / 40.0), math.cos(2 * math.pi * time_s / 40.0)
    return np.array([1800.0 * cosine, 1500.0 * sine * cosine]) / (1.0 + sine**2)


def swim(
    observer: Observer,
    noise_um: float,
    seconds: float = 40.0,
    seed: int = 0,
    flow_noise: float = 0.0,
    swirl: float = 0.2,
):  # type: ignore[no-untyped-def]
    """A robot on the paper's lemniscate in its swirling flow, held there exactly: true flows and estimates."""
    rng = np.random.default_rng(seed)
    dt = 1.0 / RATE_HZ
    position, walk = lemniscate(0.0), np.zeros(2)
    before: Estimate | None = None
    truth, estimates, tracks, inputs = [], [], [], []
    for index in range(round(seconds * RATE_HZ)):
        moved = np.zeros(2)
        if index:
            flow = swirl * np.array([-position[1], position[0]]) + walk
            onward = lemniscate(index * dt)
            moved, position = onward - position - flow * dt, onward
            walk = walk + math.sqrt(flow_noise * dt) * rng.standard_normal(2)
        tracks.append(track(index, position + noise_um * rng.standard_normal(2)))
        inputs.append(applied(index, moved))
        before = observer.estimate(before, tracks[-1], inputs[-1], ROBOT)
        truth.append(swirl * np.array([-position[1], position[0]]) + walk)
        estimates.append(before)
    return np.array(truth), estimates, tracks, inputs


def rmse(truth: NDArray[np.float64], estimates: list[Estimate]) -> float:
    skip = len(truth) // 8
    flows = np.array([estimate.flow_um_s for estimate in estimates])
    return float(np.sqrt(np.square(flows - truth)[skip:].sum(axis=1).mean()))


def test_with_the_right_noise_the_normalised_innovation_squared_is_two() -> None:
    observer = Observer(kalman=Kalman(position_noise_um=10.0, flow_noise_um2_s3=1000.0, drift_um2_s=0.0))
    _, estimates, _, _ = swim(observer, 10.0, 120.0, flow_noise=1000.0, swirl=0.0)
    nis = np.array([estimate.nis for estimate in estimates[60:]])
    assert abs(np.nanmean(nis) - 2.0) < 3.0 * 2.0 / math.sqrt(len(nis))


def test_at_ten_um_noise_kalman_has_at_most_half_the_error_of_the_papers_observer() -> None:
    kalman = Observer(kalman=Kalman(position_noise_um=10.0, flow_noise_um2_s3=1000.0))
    best = min(
        rmse(*swim(Observer(method="luenberger", luenberger=Luenberger(gain)), 10.0)[:2]) for gain in (0.5, 1, 2, 3)
    )
    paper = rmse(*swim(Observer(method="luenberger"), 10.0)[:2])
    ours = rmse(*swim(kalman, 10.0)[:2])
    assert ours < 0.5 * paper
    assert ours < 0.7 * best


def test_a_steady_flow_is_found_without_bias_whatever_the_coils_did() -> None:
    observer = Observer()
    rng = np.random.default_rng(3)
    position, flow, before = np.zeros(2), np.array([120.0, -80.0]), None
    for index in range(300):
        moved = rng.uniform(-30.0, 30.0, 2) if index else np.zeros(2)
        position = position + moved + flow / RATE_HZ * bool(index)
        before = observer.estimate(before, track(index, position), applied(index, moved), ROBOT)
    assert before is not None
    np.testing.assert_allclose(before.flow_um_s, flow, atol=1.0)


@pytest.mark.parametrize("method", ["kalman", "luenberger"])
def test_an_observer_goes_on_from_any_message_as_if_it_had_never_stopped(method: str) -> None:
    observer = Observer(method=method)  # type: ignore[arg-type]
    _, estimates, tracks, inputs = swim(observer, 5.0, 4.0)
    again = Observer(method=method).estimate(estimates[70], tracks[71], inputs[71], ROBOT)  # type: ignore[arg-type]
    assert again.same_as(estimates[71])


def test_unseen_frames_widen_the_belief_and_have_no_innovation() -> None:
    observer = Observer()
    _, estimates, _, inputs = swim(observer, 2.0, 4.0)
    last = estimates[-1]
    for index in range(120, 150):
        lost = observer.estimate(last, track(index, last.measured_um, seen=False), applied(index, np.zeros(2)), ROBOT)
        assert math.isnan(lost.nis)
        assert lost.covariance[0, 0] > last.covariance[0, 0]
        assert np.linalg.eigvalsh(lost.covariance).min() > 0
        last = lost
    assert not last.seen


def test_an_outlier_is_not_believed_at_once_and_a_real_jump_soon_is() -> None:
    observer = Observer()
    _, estimates, _, _ = swim(observer, 1.0, 4.0)
    last, jump = estimates[-1], estimates[-1].position_um + np.array([400.0, 0.0])
    first = observer.estimate(last, track(120, jump), applied(120, np.zeros(2)), ROBOT)
    assert math.dist(first.position_um, jump) > 300.0
    for index in range(121, 140):
        first = observer.estimate(first, track(index, jump), applied(index, np.zeros(2)), ROBOT)
    assert math.dist(first.position_um, jump) < 20.0


def test_observations_are_spaced_out_and_honest_about_their_noise() -> None:
    sampler = Sampler()
    truth, estimates, _, _ = swim(Observer(kalman=Kalman(position_noise_um=2.0)), 2.0, 20.0)
    rows, before = None, None
    for estimate in estimates:
        after = sampler.collect(rows, before, estimate, ROBOT)
        if after is not rows:
            assert after is not None
            assert after.stamp_ns == estimate.stamp_ns
        rows, before = after, estimate
    assert rows is not None
    assert len(rows.position_um) > 50
    ways = np.linalg.norm(np.diff(rows.position_um, axis=0), axis=1)
    assert ways.min() >= sampler.spacing_radii * ROBOT.radius * 0.999
    true = np.column_stack((-0.2 * rows.position_um[:, 1], 0.2 * rows.position_um[:, 0]))
    pulls = (rows.flow_um_s - true) / rows.std_um_s[:, None]
    assert np.sqrt(np.mean(np.square(pulls[5:]))) < 1.5
