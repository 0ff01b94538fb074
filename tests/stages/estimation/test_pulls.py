"""Observations of tracks whose truth is known: their errors have the spread that they state, at their place and time.

The pull of an observation is its error over its stated standard deviation. Each track is a robot that is driven about
in a flow; what the tracker measures of it has noise of a known size. The pull of the weighted mean of a run shows
whether neighbours count the same noise twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flowrec.core import Applied, Estimate, Observations, Track, seconds
from flowrec.physics import Robot
from flowrec.stages import Kalman, memory_s, observe, smooth
from flowrec.stages.estimation import Sampler

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, um_per_rev=25.0)
DT, PACE_UM_S = 1.0 / 30.0, 300.0
SETTLED_S = 1.5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Swim:
    """One track, its truth and what an observer makes of it."""

    tracks: list[Track]
    applied: list[Applied]
    place_um: Floats  # (n, 2) true
    flow_um_s: Floats  # (n, 2) true, there and then
    amplitudes: Floats | None  # of a flow that is steady: see `_waves`
    waves: Floats | None

    def flow_at(self, places: Floats) -> Floats:
        """(n, 2) of the steady flow."""
        assert self.amplitudes is not None and self.waves is not None
        return _waves(places, self.amplitudes, self.waves)

    def estimates(self, kalman: Kalman) -> list[Estimate]:
        found: list[Estimate] = []
        for track, applied in zip(self.tracks, self.applied, strict=True):
            found.append(kalman.estimate(found[-1] if found else None, track, applied, ROBOT))
        return found


def _swim(
    moved: Floats,
    place: Floats,
    flow: Floats,
    noise_um: float,
    rng: np.random.Generator,
    amplitudes: Floats | None = None,
    waves: Floats | None = None,
) -> Swim:
    stamps = [round(index * DT * 1e9) for index in range(len(place))]
    measured = place + noise_um * rng.standard_normal(place.shape)
    tracks = [Track(stamp, True, at, 0.9, 0, 5.0, np.zeros(4)) for stamp, at in zip(stamps, measured, strict=True)]
    applied = [
        Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), step / ROBOT.um_per_rev)
        for stamp, step in zip(stamps, moved, strict=True)
    ]
    return Swim(tracks, applied, place, flow, amplitudes, waves)


def wandering(seed: int, seconds: float = 6.0, noise_um: float = 4.0, q: float = 2000.0) -> Swim:
    """A flow that wanders in time alone, as a Wiener process of q um2/s3; the way is its exact integral."""
    rng, count = np.random.default_rng(seed), round(seconds / DT)
    flow = np.array([80.0, -40.0]) + np.cumsum(math.sqrt(q * DT) * rng.standard_normal((count, 2)), axis=0)
    angle = np.cumsum(0.2 * rng.standard_normal(count))
    moved = PACE_UM_S * DT * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    moved[0] = 0.0
    # Between two frames the process is a bridge, whose mean has the variance q dt / 12.
    bridge = math.sqrt(q * DT / 12.0) * rng.standard_normal((count, 2))
    carried = DT * (0.5 * (flow + np.concatenate([flow[:1], flow[:-1]])) + bridge)
    carried[0] = 0.0
    return _swim(moved, np.cumsum(moved + carried, axis=0), flow, noise_um, rng)


def _waves(places: Floats, amplitudes: Floats, waves: Floats) -> Floats:
    """(n, 2) a mean flow, the first of the amplitudes, and waves along k (m, 2) with a phase: free of divergence."""
    k, phase = waves[:, :2], waves[:, 2]
    across = np.stack([k[:, 1], -k[:, 0]], axis=1)
    return np.asarray(amplitudes[:2] + amplitudes[2] * np.cos(places @ k.T + phase) @ across)


def driven(seed: int, seconds: float = 6.0, noise_um: float = 1.0, length_um: float = 400.0, rms_um_s: float = 120.0):
    """A steady flow of random waves over some channel widths; the robot turns at random and diffuses a little."""
    rng, count, fine = np.random.default_rng(seed), round(seconds / DT), 4
    waves = np.column_stack([rng.standard_normal((12, 2)) / length_um, rng.uniform(0.0, 2.0 * math.pi, 12)])
    size = rms_um_s / math.sqrt(0.5 * float((waves[:, :2] ** 2).sum()))
    amplitudes = np.array([*(rms_um_s * rng.standard_normal(2)), size])
    angle = np.cumsum(0.8 * math.sqrt(DT) * rng.standard_normal(count))
    own = PACE_UM_S * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    own[0] = 0.0
    place = np.zeros((count, 2))
    for index in range(1, count):
        at = place[index - 1]
        for _ in range(fine):
            half = at + 0.5 * DT / fine * (_waves(at[None], amplitudes, waves)[0] + own[index])
            at = at + DT / fine * (_waves(half[None], amplitudes, waves)[0] + own[index])
        place[index] = at + math.sqrt(4.0 * DT) * rng.standard_normal(2)
    return _swim(DT * own, place, _waves(place, amplitudes, waves), noise_um, rng, amplitudes, waves)


MATCHED = Kalman(position_noise_um=4.0, flow_noise_um2_s3=2000.0, drift_um2_s=0.0)  # what `wandering` is


def collected(estimates: list[Estimate]) -> Observations:
    """What the sampler makes of a run once the filter has settled."""
    rows = before = None
    for estimate in estimates:
        rows, before = Sampler().collect(rows, before, estimate, ROBOT), estimate
    assert rows is not None and rows.time_s is not None
    return rows.only(rows.time_s > SETTLED_S)


def rms(values: Sequence[Floats]) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate([np.atleast_2d(one) for one in values])))))


@pytest.fixture(scope="module")
def wanderers() -> list[Swim]:
    return [wandering(seed) for seed in range(30)]


@pytest.fixture(scope="module")
def surveys() -> list[tuple[Swim, list[Estimate], Observations]]:
    swims = [driven(seed) for seed in range(30)]
    estimates = [swim.estimates(Kalman()) for swim in swims]
    return [(swim, found, collected(found)) for swim, found in zip(swims, estimates, strict=True)]


def test_the_filter_states_the_error_of_its_flow_where_its_model_is_right(wanderers: list[Swim]) -> None:
    pulls = []
    for swim in wanderers:
        for estimate, true in list(zip(swim.estimates(MATCHED), swim.flow_um_s, strict=True))[45:]:
            pulls.append((estimate.flow_um_s - true) / np.sqrt(np.diag(estimate.covariance)[2:]))
    # 30 runs of some 20 memories of the filter: 3 %.
    assert 0.9 < rms(pulls) < 1.1


@pytest.mark.slow("many flights of the observer")
def test_observations_of_the_smoother_state_their_errors_and_neighbours_have_errors_of_their_own(
    wanderers: list[Swim],
) -> None:
    pulls = []
    for swim in wanderers:
        # At no distance but that in time, so that this decides.
        rows = observe(smooth(swim.tracks, swim.applied, MATCHED, ROBOT), ROBOT, spacing_radii=0.0)
        assert rows.time_s is not None
        inside = rows.only((rows.time_s > 0.5) & (rows.time_s < 5.5))
        at = np.round(inside.time_s / DT).astype(int)
        pulls.append((inside.flow_um_s - swim.flow_um_s[at]) / inside.std_um_s[:, None])
    assert 0.9 < rms(pulls) < 1.1
    assert np.mean([(pull[1:] * pull[:-1]).mean() for pull in pulls]) < 0.08  # 0.04 is the error of this mean


@pytest.mark.slow("many flights of the observer")
def test_a_run_of_observations_states_the_error_of_its_mean_and_each_of_them_twice_its_own(
    surveys: list[tuple[Swim, list[Estimate], Observations]],
) -> None:
    each, together = [], []
    for swim, _, rows in surveys:
        error, weight = rows.flow_um_s - swim.flow_at(rows.position_um), 1.0 / rows.std_um_s[:, None] ** 2
        each.append(error / rows.std_um_s[:, None])
        together.append((weight * error).sum(axis=0) / np.sqrt(weight.sum()))
    # 60 components of means: 9 %. Measured: 0.93 and 0.54, since neighbours share what they are computed from.
    assert 0.8 < rms(together) < 1.1
    assert 0.45 < rms(each) < 0.65


@pytest.mark.slow("many flights of the observer")
def test_an_observation_lies_nearer_to_where_its_flow_was_than_the_robot_does_or_the_whole_memory_ago(
    surveys: list[tuple[Swim, list[Estimate], Observations]],
) -> None:
    placed, at_once, too_far = [], [], []
    for swim, estimates, rows in surveys:
        found = {seconds(one.stamp_ns): index for index, one in enumerate(estimates)}
        for place, flow, time_s in zip(rows.position_um, rows.flow_um_s, rows.time_s, strict=True):
            # The time of an observation is that of its estimate less the memory.
            index = min(
                (k for t, k in found.items() if t > time_s),
                key=lambda k: abs(seconds(estimates[k].stamp_ns) - memory_s(estimates[k].covariance) - time_s),
            )
            now, before = estimates[index], estimates[index - 1]
            back = memory_s(now.covariance) * (now.position_um - before.position_um) / DT
            for errors, where in ((placed, place), (at_once, now.position_um), (too_far, now.position_um - back)):
                errors.append(flow - swim.flow_at(where[None])[0])
    assert rms(placed) < 0.97 * min(rms(at_once), rms(too_far))


def test_the_time_of_an_observation_is_when_the_flow_was_what_it_says() -> None:
    # A flow that grows steadily in time, everywhere alike: a filter that takes it for constant is late by its memory.
    growth_um_s2, kalman = 60.0, Kalman(position_noise_um=5.0, flow_noise_um2_s3=4000.0, drift_um2_s=0.0)
    times = DT * np.arange(240)
    place = np.stack([PACE_UM_S * times + 0.5 * growth_um_s2 * times**2, 0.0 * times], axis=1)
    moved = np.tile([PACE_UM_S * DT, 0.0], (240, 1))
    flow = np.stack([growth_um_s2 * times, 0.0 * times], axis=1)
    swim = _swim(moved, place, flow, 0.0, np.random.default_rng(0))
    estimates = swim.estimates(kalman)
    rows = collected(estimates)
    late = growth_um_s2 * memory_s(estimates[-1].covariance)
    assert late > 5.0, "without the correction much would be missed"
    assert np.abs(rows.flow_um_s[:, 0] - growth_um_s2 * rows.time_s).max() < 0.15 * late


@pytest.mark.parametrize("deviations", [7.0, 12.0])
def test_one_wrong_position_does_not_throw_the_estimate(wanderers: list[Swim], deviations: float) -> None:
    swim = wanderers[0]
    estimates = swim.estimates(MATCHED)
    last, track, applied = estimates[-2], swim.tracks[-1], swim.applied[-1]
    state, covariance, *_ = MATCHED.predict(last, track, applied, ROBOT)
    sigma_um = math.sqrt(covariance[0, 0] + 4.0**2)
    wrong = replace(track, position_um=state[:2] + np.array([deviations * sigma_um, 0.0]))
    after = MATCHED.estimate(last, wrong, applied, ROBOT)
    assert after.nis == pytest.approx(deviations**2, rel=1e-6)
    assert math.dist(after.position_um, state[:2]) < 0.05 * sigma_um
    assert math.dist(after.flow_um_s, state[2:4]) < 0.05 * math.sqrt(covariance[2, 2])


def test_innovations_that_are_white_leave_the_noise_of_the_filter_as_it_is_stated() -> None:
    swim, kalman = driven(0, seconds=2.0), Kalman()
    last, track, applied = swim.estimates(kalman)[-2], swim.tracks[-1], swim.applied[-1]

    def spread(before: Estimate, agility: float = 1.0) -> float:
        """Variance of the flow after a step: linear in the factor on the noise."""
        return float(replace(kalman, agility=agility).predict(before, track, applied, ROBOT)[1][2, 2])

    unsurprised = replace(last, surprise=np.zeros(0))
    one, two = spread(unsurprised), spread(unsurprised, 2.0)
    # The exponential mean of white innovations of unit variance, over `watch_radii` at full speed.
    rng, weight = np.random.default_rng(0), DT * ROBOT.max_speed_um_s / (kalman.watch_radii * ROBOT.radius_um)
    surprise, factors = np.zeros(2), []
    for _ in range(6000):
        surprise = surprise + weight * (rng.standard_normal(2) - surprise)
        factors.append(1.0 + (spread(replace(last, surprise=surprise)) - one) / (two - one))
    # The factor is the power 3/2 of the mean square, which is exponentially distributed around 1, and at least 0.2.
    least = 0.2 ** (2.0 / 3.0)
    assert np.mean(np.array(factors) ** (2.0 / 3.0)) == pytest.approx(least + math.exp(-least), rel=0.1)
