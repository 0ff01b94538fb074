"""Observers against a robot whose flow is known."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from flowrec.core import Applied, Estimate, FlowField, Track, as_read
from flowrec.stages import HealthMonitor, Kalman, Luenberger, Observer
from flowrec.stages.estimation import Sampler
from flowrec.stages.estimation.process_model import StateLayout, advance_covariance, propagate
from tests.stages.estimation.lap import RATE_HZ, ROBOT, across, lemniscate, vortex


def track(index: int, position: NDArray[np.float64], seen: bool = True) -> Track:
    return Track(round(index * 1e9 / RATE_HZ), seen, position, 0.9, 0, 5.0, np.zeros(4))


def applied(index: int, moved_um: NDArray[np.float64]) -> Applied:
    return Applied(round(index * 1e9 / RATE_HZ), 0.0, 0.0, 0.0, np.zeros(3), moved_um / ROBOT.um_per_rev)


def swim(
    observer: Observer,
    noise_um: float,
    seconds: float = 40.0,
    seed: int = 0,
    flow_noise: float = 0.0,
    swirl: float = 0.2,
    field: FlowField | None = None,
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
            onward = lemniscate(index * dt)
            flow = swirl * across(0.5 * (position + onward)) + walk
            moved, position = onward - position - flow * dt, onward
            walk = walk + math.sqrt(flow_noise * dt) * rng.standard_normal(2)
        tracks.append(track(index, position + noise_um * rng.standard_normal(2)))
        inputs.append(applied(index, moved))
        before = observer.estimate(before, tracks[-1], inputs[-1], ROBOT, field)
        truth.append(swirl * across(position) + walk)
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


def test_the_process_noise_is_that_of_van_loans_integral() -> None:
    # d(x, v) = (v, 0) dt + (s dW1, q dW2): exp of [[-A, Q], [0, A^T]] dt holds the covariance of one step (Van Loan,
    # 1978). For q = 1, s = 0 that is [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]].
    q, drift, dt = 1700.0, 40.0, 1.0 / RATE_HZ
    kalman = Kalman(position_noise_um=5.0, flow_noise_um2_s3=q, drift_um2_s=drift)
    first = kalman.estimate(None, track(0, np.zeros(2)), applied(0, np.zeros(2)), ROBOT)
    _, covariance, _, step = kalman.predict(first, track(1, np.zeros(2)), applied(1, np.zeros(2)), ROBOT)
    model, spread = np.zeros((4, 4)), np.diag([drift, drift, q, q])
    model[:2, 2:] = np.eye(2)
    block = expm(np.block([[-model, spread], [np.zeros((4, 4)), model.T]]) * dt)
    exact = block[4:, 4:].T @ block[:4, 4:]
    assert exact[0, 2] == pytest.approx(0.5 * q * dt**2)
    # Seconds to the ninth decimal, as stamps have them.
    np.testing.assert_allclose(covariance - step @ first.covariance @ step.T, exact, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("layout", [StateLayout(a, b) for a in (False, True) for b in (False, True)])
def test_a_step_has_the_derivative_of_its_motion_and_the_covariance_of_filterpy(layout: StateLayout) -> None:
    from filterpy.kalman import KalmanFilter

    rng, n, dt = np.random.default_rng(1), layout.size, 1.0 / RATE_HZ
    state = np.array([100.0, 50.0, 80.0, -30.0, 0.7, -0.4, 1.1][: 4 + 3 * layout.gradient] + [21.0] * layout.gain)
    turns = np.array([0.3, -0.2])

    def ahead(of: NDArray[np.float64]) -> NDArray[np.float64]:
        return propagate(of, layout, turns, 20.0, dt, None, False)[0]

    jacobian = propagate(state, layout, turns, 20.0, dt, None, False)[1]
    differences = np.column_stack([ahead(state + step) - ahead(state - step) for step in 0.5 * np.eye(n)])
    np.testing.assert_allclose(jacobian[2:], differences[2:], rtol=1e-9, atol=1e-9)
    # The position leaves out what the change of the flow within the step adds to it, which is of second order.
    second_order = 0.5 * dt * (jacobian[2:4] - np.eye(2, n, 2))
    np.testing.assert_allclose(jacobian[:2] + second_order, differences[:2], rtol=1e-9, atol=1e-9)
    root = rng.standard_normal((n, n))
    kalman = KalmanFilter(dim_x=n, dim_z=2)
    kalman.F, kalman.P = jacobian, root @ root.T
    noise = (*layout, dt, 300.0, 0.02, 0.1, 4.0)
    kalman.Q = advance_covariance(np.zeros((n, n)), jacobian, *noise)
    assert np.linalg.eigvalsh(kalman.Q).min() >= -1e-12
    assert np.count_nonzero(np.diag(kalman.Q)) == n
    kalman.predict()
    np.testing.assert_allclose(advance_covariance(root @ root.T, jacobian, *noise), kalman.P, rtol=1e-11, atol=1e-11)


def test_two_frames_without_the_robot_widen_the_belief_as_one_of_both_lengths() -> None:
    kalman = Kalman(position_noise_um=5.0, flow_noise_um2_s3=1700.0)
    _, estimates, _, _ = swim(Observer(kalman=kalman), 5.0, 2.0)
    last, none, nowhere = estimates[-1], np.zeros(2), np.full(2, 1e9)
    once = kalman.estimate(last, track(61, nowhere, seen=False), applied(61, none), ROBOT)
    twice = kalman.estimate(last, track(60, nowhere, seen=False), applied(60, none), ROBOT)
    twice = kalman.estimate(twice, track(61, nowhere, seen=False), applied(61, none), ROBOT)
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-6)
    np.testing.assert_allclose(twice.position_um, once.position_um, rtol=1e-6)


def test_at_ten_um_noise_kalman_has_less_than_half_the_error_of_the_best_luenberger() -> None:
    kalman = Observer(kalman=Kalman(position_noise_um=10.0))
    best = min(
        rmse(*swim(Observer(method="luenberger", luenberger=Luenberger(gain)), 10.0)[:2]) for gain in (0.5, 1, 2, 3)
    )
    assert rmse(*swim(kalman, 10.0)[:2]) < 0.5 * best


@pytest.mark.parametrize(("share", "noise_um", "limit_um_s"), [(1.0, 0.01, 0.3), (1.1, 10.0, 8.0)])
def test_with_a_map_what_it_misses_is_found(share: float, noise_um: float, limit_um_s: float) -> None:
    kalman = Kalman(position_noise_um=max(noise_um, 1.0))
    with_map = Observer(method="kalman_map", kalman=kalman)
    assert rmse(*swim(with_map, noise_um, field=vortex(share))[:2]) < limit_um_s
    without = Observer(method="kalman_map", kalman=kalman)
    _, mapless, tracks, inputs = swim(without, noise_um, 2.0)
    plain = Observer(kalman=kalman)
    assert mapless[-1].same_as(swim(plain, noise_um, 2.0)[1][-1])


def test_by_default_the_map_is_used_while_it_states_a_small_error_and_the_measured_flow_agrees_with_it() -> None:
    _, estimates, tracks, inputs = swim(Observer(), 1.0, 2.0, field=vortex(1.0))
    consistent = HealthMonitor().watch(None, None, estimates[-1], None, ROBOT)

    def after(before: Estimate, share: float | None = 0.03, method: str = "kalman_auto", **found: Any) -> Estimate:
        field = replace(vortex(1.0), error_share=share)
        health = replace(consistent, **found)
        return Observer(method=method).estimate(before, tracks[-1], inputs[-1], ROBOT, field, health)

    blind = estimates[-2]
    good = after(blind)
    assert good.same_as(after(blind, method="kalman_map")) and Observer().uses_map(good)
    for untrusted in (
        after(blind, share=None),
        after(blind, share=0.2),
        after(blind, alarm="nis; tracking"),
        after(blind, offset_share=-0.12),
    ):
        assert untrusted.same_as(after(blind, method="kalman")) and not Observer().uses_map(untrusted)
    assert Observer().uses_map(after(good, offset_share=-0.12)), "what is in use is not given up at once"
    assert not Observer().uses_map(after(good, offset_share=-0.2))


def test_what_observations_are_taken_from_does_not_know_the_map_that_the_estimate_corrects() -> None:
    _, plain, tracks, inputs = swim(Observer(method="kalman"), 3.0, 8.0)
    wrong, observer, sampler = vortex(1.6), Observer(method="kalman_map"), Sampler()
    before = mapless = taken = taken_plain = None
    for index, (seen, done) in enumerate(zip(tracks, inputs, strict=True)):
        field = wrong if index >= 60 else None  # a map that is adopted on the way
        now = observer.estimate(before, seen, done, ROBOT, field)
        mapless_now = observer.without_map(mapless, before, now, seen, done, ROBOT)
        assert (mapless_now is None) == (index < 60)
        if before is not None:
            assert Observer.measured_estimate(mapless_now, now).same_as(plain[index])
            taken = sampler.collect(
                taken, Observer.measured_estimate(mapless, before), Observer.measured_estimate(mapless_now, now), ROBOT
            )
            taken_plain = sampler.collect(taken_plain, plain[index - 1], plain[index], ROBOT)
        before, mapless = now, mapless_now
    assert taken is not None and len(taken.std_um_s) > 8 and taken.same_as(taken_plain)
    assert before is not None and math.dist(before.flow_um_s, plain[-1].flow_um_s) > 1.0, "the estimate itself does"


def test_another_map_does_not_make_the_estimate_jump() -> None:
    observer = Observer(method="kalman_map")
    _, estimates, tracks, inputs = swim(observer, 1.0, 4.0, field=vortex(1.2))
    old = observer.estimate(estimates[-2], tracks[-1], inputs[-1], ROBOT, vortex(1.2))
    new = observer.estimate(estimates[-2], tracks[-1], inputs[-1], ROBOT, vortex(0.9))
    assert math.dist(old.flow_um_s, new.flow_um_s) < 1.0


@pytest.mark.parametrize("method", ["kalman", "kalman_map"])
def test_an_observer_goes_on_from_another_ones_estimate(method: str) -> None:
    _, estimates, tracks, inputs = swim(Observer(method="luenberger"), 2.0, 4.0)
    observer = Observer(method=method)  # type: ignore[arg-type]
    last = estimates[60]
    for index in range(61, 120):
        last = observer.estimate(last, tracks[index], inputs[index], ROBOT, vortex())
    assert math.dist(last.flow_um_s, estimates[-1].flow_um_s) < 60.0
    assert np.linalg.eigvalsh(last.covariance).min() > 0


def test_the_estimate_turns_and_shifts_with_the_world() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    _, estimates, tracks, inputs = swim(Observer(), 3.0, 8.0)
    last = None
    for seen, done in zip(tracks, inputs, strict=True):
        there = replace(seen, position_um=turn @ seen.position_um + [700.0, -300.0])
        last = Observer().estimate(last, there, replace(done, turns=turn @ done.turns), ROBOT)
    assert last is not None
    np.testing.assert_allclose(last.flow_um_s, turn @ estimates[-1].flow_um_s, atol=1e-6)


@pytest.mark.parametrize("method", ["kalman", "kalman_map", "luenberger"])
def test_a_clock_that_stands_still_and_a_position_that_is_no_number_do_no_harm(method: str) -> None:
    observer = Observer(method=method)  # type: ignore[arg-type]
    _, estimates, tracks, inputs = swim(observer, 2.0, 2.0, field=vortex())
    still = replace(inputs[-1], turns=np.zeros(2))
    last = observer.estimate(estimates[-1], tracks[-1], still, ROBOT, vortex())
    assert math.dist(last.flow_um_s, estimates[-1].flow_um_s) < 20.0
    with as_read():
        nowhere = track(61, np.full(2, np.nan), seen=False)
    last = observer.estimate(last, nowhere, applied(61, np.zeros(2)), ROBOT, vortex())
    assert np.isfinite(last.flow_um_s).all() and np.isfinite(last.position_um).all()
    assert Sampler().collect(None, last, last, ROBOT) is None


def test_where_the_robot_was_lost_for_seconds_the_flow_is_soon_found_again() -> None:
    observer = Observer(kalman=Kalman(position_noise_um=2.0))
    truth, estimates, tracks, inputs = swim(observer, 2.0, 20.0)
    last = estimates[299]
    for index in range(300, 420):
        seen = tracks[index] if index >= 390 else replace(tracks[index], seen=False)
        last = observer.estimate(last, seen, inputs[index], ROBOT)
        assert math.hypot(*last.flow_um_s) < 600.0
    assert math.dist(last.flow_um_s, truth[419]) < 30.0


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


@pytest.mark.parametrize("method", ["kalman", "kalman_map", "luenberger"])
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
    assert len(rows.position_um) > 25
    ways = np.linalg.norm(np.diff(rows.position_um, axis=0), axis=1)
    assert ways.min() >= sampler.spacing_radii * ROBOT.radius_um * 0.999
    assert rows.radius_um == ROBOT.radius_um, "the flow carries it as a sphere of this size"
    assert Sampler(method="trimmed").treat(rows).radius_um == ROBOT.radius_um
    true = 0.2 * across(rows.position_um)
    pulls = (rows.flow_um_s - true) / rows.std_um_s[:, None]
    assert np.sqrt(np.mean(np.square(pulls[5:]))) < 1.5


def test_an_observation_counts_the_memory_of_its_filter_twice_in_its_variance_and_once_in_its_time() -> None:
    memory_s, variance, flow = 0.25, 900.0, np.array([40.0, 30.0])
    covariance = variance * np.eye(4)
    covariance[[0, 1, 2, 3], [2, 3, 0, 1]] = 800.0
    covariance[[0, 1], [0, 1]] = memory_s * 800.0
    sampler, rows, before = Sampler(rolling_share=0.0, floor_um_s=1.0, settled_share=1.0), None, None
    for second in (0.0, 1.0, 2.0):  # carried by the flow: it does not roll by itself
        here = flow * second
        estimate = Estimate(round(second * 1e9), here, flow, covariance, 2.0, here, True)
        rows, before = sampler.collect(rows, before, estimate, replace(ROBOT, radius_um=10.0)), estimate
    assert rows is not None and rows.time_s is not None
    # The first has no one before it; the second is 1 s = 4 memories younger, so half of its noise is its own.
    np.testing.assert_allclose(rows.std_um_s**2, [variance, variance * (1.0 + 2.0 * memory_s)])
    np.testing.assert_allclose(rows.time_s, [1.0 - memory_s, 2.0 - memory_s])


def test_an_observation_of_a_lagging_filter_is_placed_where_the_robot_was() -> None:
    # Flow across the way, growing along it: v = (0, g x). A filter that takes it for constant, with the steady gains
    # K_x and K_v, follows a ramp K_x / K_v late, so what it states belongs to x - c K_x / K_v. The ramp lasts.
    growth, pace = 0.5, 200.0  # 1/s, um/s
    kalman = Kalman(position_noise_um=5.0, flow_noise_um2_s3=4000.0, drift_um2_s=0.0)
    before, rows = None, None
    for index in range(180):
        here = np.array([pace * index / RATE_HZ, 0.0])
        # Held on a straight line against the flow at the middle of the step.
        against = growth * (here[0] - 0.5 * pace / RATE_HZ) / RATE_HZ
        moved = np.array([pace / RATE_HZ, -against]) if index else np.zeros(2)
        estimate = kalman.estimate(before, track(index, here), applied(index, moved), ROBOT)
        rows, before = Sampler().collect(rows, before, estimate, ROBOT), estimate
    assert rows is not None and before is not None
    late = slice(len(rows.position_um) // 2, None)
    missed = rows.flow_um_s[late, 1] - growth * rows.position_um[late, 0]
    lag_um_s = growth * pace * float(before.covariance[0, 0] / before.covariance[0, 2])
    assert lag_um_s > 10.0, "without a correction much would be missed"
    assert np.abs(missed).max() < 0.1 * lag_um_s


def test_a_flow_that_no_robot_could_be_held_in_is_not_believed_for_longer_than_a_frame():
    track = Track(0, True, np.array([500.0, 400.0]), 0.9, 0, 5.0, np.zeros(4))
    applied = Applied(0, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))
    first = Kalman().estimate(None, track, applied, ROBOT)
    run_away = replace(first, flow_um_s=np.array([1e40, -1e40]), covariance=1e80 * np.eye(len(first.covariance)))
    later = replace(track, stamp_ns=33_000_000)
    after = Kalman().estimate(run_away, later, replace(applied, stamp_ns=33_000_000), ROBOT)
    assert np.hypot(*after.flow_um_s) < ROBOT.max_speed_um_s
    assert np.linalg.norm(after.position_um - track.position_um) < 5.0


def test_the_luenberger_observer_is_the_papers_filter_and_goes_on_by_its_flow_where_the_robot_is_not_seen() -> None:
    """vhat' = L (x' - xhat') for a robot that swims and drifts steadily: vhat = v (1 - exp(-L t)) at any rate."""
    observer, flow, own = Luenberger(2.0), np.array([80.0, -30.0]), np.array([15.0, 40.0])
    estimate, at = None, np.array([500.0, 400.0])
    for index in range(21):
        estimate = observer.estimate(estimate, track(index, at), applied(index, own / RATE_HZ), ROBOT)
        at = at + (flow + own) / RATE_HZ
    assert estimate is not None
    np.testing.assert_allclose(estimate.flow_um_s, flow * (1.0 - math.exp(-2.0 * 20 / RATE_HZ)))
    blind = observer.estimate(estimate, track(21, at + 100.0, seen=False), applied(21, own / RATE_HZ), ROBOT)
    np.testing.assert_allclose(blind.flow_um_s, estimate.flow_um_s)
    np.testing.assert_allclose(blind.position_um - estimate.position_um, (own + estimate.flow_um_s) / RATE_HZ)


@pytest.mark.parametrize(
    "gain_per_s", [4.0, pytest.param(20.0, marks=pytest.mark.slow("many flights, with another gain"))]
)
def test_the_luenberger_observer_states_the_variance_that_the_noise_of_the_positions_gives_its_flow(
    gain_per_s: float,
) -> None:
    observer, rng = Luenberger(gain_per_s, position_noise_um=3.0), np.random.default_rng(0)
    previous, flows = None, []
    for index in range(6_000):
        stamp = round(index * 1e9 / RATE_HZ)
        track = Track(stamp, True, rng.normal(0.0, 3.0, 2), 0.9, 0, 5.0, np.zeros(4))
        still = Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))
        previous = observer.estimate(previous, track, still, ROBOT)
        flows.append(previous.flow_um_s)
    assert previous is not None
    assert previous.covariance[2, 2] == pytest.approx(np.var(flows[1000:]), rel=0.1)


def test_where_the_robot_is_out_of_sight_the_gradient_of_the_flow_is_not_followed_and_the_belief_widens() -> None:
    last, places = None, 10.0 * np.arange(60)[:, None] * np.array([1.0, 0.0])
    for index, place in enumerate(places):  # a flow that grows along the way
        last = Kalman().estimate(last, track(index, place * (1.0 + index / 60.0)), applied(index, np.zeros(2)), ROBOT)
    assert last is not None and abs(last.slopes_per_s[0]) > 0.1
    flows, widths = [], []
    for index in range(60, 70):
        unseen = track(index, places[-1], seen=False)
        last = Kalman().estimate(last, unseen, applied(index, np.zeros(2)), ROBOT)
        flows.append(last.flow_um_s)
        widths.append(np.sqrt(last.flow_variance))
    np.testing.assert_allclose(flows[1:], np.tile(flows[0], (9, 1)))  # of the first frame it was seen before
    assert (np.diff(widths) > 0.0).all()


def test_the_own_motion_of_an_estimate_is_that_of_the_um_per_revolution_that_it_states() -> None:
    observer, turned = Observer("kalman", kalman=Kalman(estimate_gain=True)), np.array([0.3, -0.4])
    last = observer.estimate(None, track(0, np.zeros(2)), applied(0, np.zeros(2)), ROBOT)
    known = replace(last, um_per_rev=1.3 * ROBOT.um_per_rev, rolled_um_s=np.zeros(0))
    driven = replace(applied(1, turned), turns=turned)
    after = observer.estimate(known, track(1, 1.3 * ROBOT.um_per_rev * turned), driven, ROBOT)
    assert after.um_per_rev == pytest.approx(1.3 * ROBOT.um_per_rev, rel=0.05)
    np.testing.assert_allclose(after.rolled_um_s, after.um_per_rev * turned / after.since_s(known))


def test_the_error_of_an_observation_grows_with_the_own_motion_alone_and_an_unlikely_position_makes_none() -> None:
    covariance = np.diag([4.0, 4.0, 9.0, 9.0])  # without memory

    def seen(index: int, place: list[float], flow: list[float], nis: float = 2.0) -> Estimate:
        position = np.array(place)
        return Estimate(round(index * 1e9 / RATE_HZ), position, np.array(flow), covariance, nis, position, True)

    sampler = Sampler(rolling_share=0.05, floor_um_s=0.001)
    for over_ground, own in (([100.0, 0.0], 0.0), ([100.0, 240.0], 240.0), ([0.0, 0.0], 100.0)):
        places = np.array([[0.0, 0.0], np.array(over_ground) / RATE_HZ])
        before, now = (seen(n, place.tolist(), [100.0, 0.0]) for n, place in enumerate(places))
        found = sampler.collect(None, before, now, ROBOT)
        assert found is not None and found.std_um_s.tolist() == pytest.approx([math.hypot(3.0, 0.05 * own)])
        assert sampler.collect(None, before, replace(now, nis=25.1), ROBOT) is None


@pytest.mark.parametrize("capacity", [1, 3])
def test_of_more_observations_than_are_kept_the_latest_stay(capacity: int) -> None:
    sampler, rows, before = Sampler(capacity=capacity), None, None
    for index in range(6):
        place = np.array([100.0 * index, 0.0])
        now = Estimate(index * 10**9, place, np.array([1.0, 0.0]), np.eye(4), 2.0, place, True)
        rows, before = sampler.collect(rows, before, now, ROBOT), now
    assert rows is not None and np.diff(rows.position_um[:, 0]).tolist() == [100.0] * (capacity - 1)
    assert rows.time_s is not None and 4.0 < rows.time_s[-1] <= 5.0
