"""A track and a log of its coils: clocks, um per revolution and heading are found, and the stated errors hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowrec.core import UsageError
from flowrec.measure import MotionFit
from flowrec.measure.calibrate_motion import _camera_delay, _means, _propose_settings, heading_settings
from flowrec.measure.motion_fit import _stretches, fit_motion
from flowrec.measure.motion_regression import Place, TrackRegression
from flowrec.measure.motion_search import SearchRange, search
from flowrec.stages import SKIPPED, NoiseModel

ANYWHERE = SearchRange(least_rate=0.7, largest_rate=1.0 / 0.7)
NEAR = SearchRange(-0.5, 0.5)
K = 25.0


@dataclass
class Log:
    """Commands that hold until the next."""

    times_s: np.ndarray
    rates_hz: np.ndarray  # (n, 2)

    @property
    def span_s(self) -> tuple[float, float]:
        return float(self.times_s[0]), float(self.times_s[-1])

    def turns(self, at: np.ndarray) -> np.ndarray:
        total = np.concatenate([np.zeros((1, 2)), np.cumsum(self.rates_hz[:-1] * np.diff(self.times_s)[:, None], 0)])
        row = np.clip(np.searchsorted(self.times_s, at, "right") - 1, 0, None)
        return total[row] + self.rates_hz[row] * np.maximum(at - self.times_s[row], 0.0)[:, None]

    def late(self, by_s: float) -> Log:
        return Log(self.times_s + by_s, self.rates_hz)


def commands(seed: int, duration_s: float, hold_s: float = 0.8, fastest_hz: float = 20.0) -> Log:
    """Random headings and frequencies, with holds of the field at zero."""
    rng = np.random.default_rng([seed, 7])
    times = np.concatenate([[0.0], np.cumsum(rng.gamma(3.0, hold_s / 3.0, int(3 * duration_s / hold_s) + 5))])
    times = times[times < duration_s]
    heading, frequency = rng.uniform(-math.pi, math.pi, len(times)), rng.uniform(0.3, 1.0, len(times)) * fastest_hz
    frequency[rng.random(len(times)) < 0.15] = 0.0
    return Log(times, frequency[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]))


def shear(at: np.ndarray, _time_s: float) -> np.ndarray:
    return np.array([150.0 + 0.3 * at[1], 0.1 * at[0]])


def vortex(at: np.ndarray, _time_s: float) -> np.ndarray:
    return np.array([-0.6 * at[1] + 120.0, 0.6 * at[0]]) / (1.0 + (at @ at) / 4e5)


def pulsating(_at: np.ndarray, time_s: float) -> np.ndarray:
    return np.array([200.0, 60.0]) * (1.0 + 0.3 * math.sin(2.0 * math.pi * 0.9 * time_s))


def still(_at: np.ndarray, _time_s: float) -> np.ndarray:
    return np.zeros(2)


FLOWS = (still, shear, vortex, pulsating)


def track(
    log: Log,
    seed: int,
    duration_s: float,
    flow=shear,
    latency_s: float = 0.04,
    rate_hz: float = 30.0,
    k: float = K,
    noise_um: float = 0.3,
    wander: float = 0.03,
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and positions of a robot whose speed and heading wander for about a second at a time."""
    rng, step_s = np.random.default_rng([seed, 1]), 1.0 / 240.0
    times = np.arange(0.0, duration_s, step_s)
    turns = log.turns(times - latency_s)
    decay = math.exp(-step_s)
    kicks, state, deviation = rng.standard_normal(len(times)) + 1j * rng.standard_normal(len(times)), 0j, []
    for kick in kicks:
        state = decay * state + math.sqrt(1.0 - decay**2) * kick
        deviation.append(1.0 + wander * state)
    rolled = np.concatenate([[0j], k * (np.diff(turns, axis=0) @ [1.0, 1j]) * np.array(deviation[1:])])
    at, way = np.zeros(2), np.zeros((len(times), 2))
    for n, step in enumerate(rolled):
        at = at + [step.real, step.imag] + step_s * flow(at, times[n]) + 0.03 * rng.standard_normal(2)
        way[n] = at
    stamps = np.arange(0.0, duration_s - 0.05, 1.0 / rate_hz)
    seen = np.column_stack([np.interp(stamps, times, way[:, axis]) for axis in (0, 1)])
    return stamps, seen + noise_um * rng.standard_normal(seen.shape)


def fit(stamps: np.ndarray, positions: np.ndarray, log: Log, within: SearchRange = ANYWHERE) -> MotionFit:
    return fit_motion(stamps, positions, log.turns, log.span_s, within)


@pytest.mark.parametrize(("flow", "late_s"), [(still, 0.033), (shear, 0.1), (vortex, 0.5), (pulsating, 1.7e9)])
def test_a_late_log_is_found_to_3_ms_in_any_flow(flow, late_s: float) -> None:
    log = commands(3, 15.0)
    found = fit(*track(log, 3, 15.0, flow), log.late(late_s))
    assert not found.refusal and found.rate == 1.0
    assert found.offset_s == pytest.approx(late_s - 0.04, rel=0.0, abs=3e-3)
    assert found.um_per_rev == pytest.approx(K, abs=3.0 * found.um_per_rev_std)
    assert found.um_per_rev_std > 0.05 * K, "the flow along the way is not known, and changes with the robot's motion"
    assert abs(found.heading_offset_rad) < 3.0 * found.heading_offset_std_rad and not found.mirrored


@pytest.mark.parametrize("rate", [25.0 / 30.0, 1.003])
def test_the_rate_of_the_movies_clock_is_found_to_a_thousandth(rate: float) -> None:
    log = commands(4, 24.0)
    stamps, positions = track(log, 4, 14.0)
    found = fit(stamps / rate + 2.0, positions, log)
    assert not found.refusal and found.rate == pytest.approx(rate, rel=1e-3)
    middle_s = float(stamps.mean())
    assert found.offset_s + found.rate * (middle_s / rate + 2.0) == pytest.approx(middle_s - 0.04, abs=3e-3)
    # A log of commands is late by 0.03 revolutions of 20 Hz at most, at both ends of the movie by another part of them.
    assert found.rate_std > 2.0 * (0.03 / 20.0) / (14.0 / rate)


@pytest.mark.slow("fits a movie to a long log")
def test_a_movie_from_the_middle_of_a_long_log_on_another_clock() -> None:
    log = commands(5, 400.0)
    stamps, positions = track(log, 5, 220.0, still)
    part = stamps > 150.0
    found = fit(stamps[part] - 150.0, positions[part], log, SearchRange(least_rate=0.99, largest_rate=1.01))
    assert not found.refusal and found.offset_s == pytest.approx(150.0 - 0.04, abs=3e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_axes_of_the_headings_are_found(mirrored: bool) -> None:
    log = commands(6, 15.0)
    stamps, positions = track(log, 6, 15.0, still)
    turn = math.radians(70.0)
    seen = positions * [1.0, -1.0] if mirrored else positions
    seen = seen @ [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
    found = fit(stamps, seen, log)
    assert not found.refusal and found.mirrored == mirrored
    assert found.heading_offset_rad == pytest.approx(turn, abs=3.0 * found.heading_offset_std_rad)


def test_one_wrong_position_in_thirty_does_not_hide_the_log() -> None:
    log, rng = commands(8, 12.0), np.random.default_rng(8)
    stamps, positions = track(log, 8, 12.0)
    wrong, away = np.arange(10, len(stamps) - 10, 30), rng.uniform(-math.pi, math.pi, len(stamps))
    positions[wrong] += 150.0 * np.column_stack([np.cos(away), np.sin(away)])[wrong]
    found = fit(stamps, positions, log)
    assert not found.refusal and found.left_out >= len(wrong) - 1
    assert found.offset_s == pytest.approx(-0.04, abs=3e-3)


@pytest.mark.slow("fits a movie with another particle")
def test_frames_without_the_robot_and_positions_of_another_particle_neither_hide_the_log_nor_move_the_offset() -> None:
    log = commands(8, 20.0)
    stamps, positions = track(log, 8, 20.0)
    rng = np.random.default_rng(8)
    wrong = positions.copy()
    away = rng.uniform(-math.pi, math.pi, 5)
    wrong[rng.choice(len(stamps), 5, replace=False)] += 400.0 * np.column_stack([np.cos(away), np.sin(away)])
    wrong[200:260] = positions[200] + [400.0, 150.0] + 5.0 * np.arange(60)[:, None]
    kept = rng.random(len(stamps)) > 0.2
    kept[400:430] = False
    found = fit(stamps[kept], wrong[kept], log)
    assert not found.refusal
    every = fit(stamps, wrong, log)
    assert not every.refusal and 60 <= every.left_out <= 66  # those on the other particle, and the single ones
    assert found.offset_s == pytest.approx(-0.04, abs=3e-3)
    assert found.um_per_rev == pytest.approx(K, abs=3.0 * found.um_per_rev_std)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_noise_alone_a_log_explains_little(seed: int) -> None:
    """A fraction of next to nothing says nothing, however large it is."""
    rng, log = np.random.default_rng(seed), commands(seed + 70, 24.0)
    stamps = np.arange(0.0, 8.0, 1.0 / 30.0)
    drifting = np.cumsum(rng.normal(0.0, 1.0, (len(stamps), 2)), axis=0)
    found = fit(stamps, drifting + rng.normal(0.0, 3.0, drifting.shape), log, SearchRange())
    assert found.explained < 0.4 and found.refusal


@pytest.mark.parametrize("other", ["another run", "backwards"])
def test_a_log_of_something_else_is_refused(other: str) -> None:
    log = commands(9, 20.0)
    stamps, positions = track(log, 9, 20.0)
    wrong = commands(10, 40.0) if other == "another run" else Log(log.times_s, -log.rates_hz[::-1])
    assert "the log explains " in fit(stamps, positions, wrong).refusal


def test_commands_that_repeat_themselves_are_refused_on_another_clock_and_found_on_the_same() -> None:
    times = np.arange(0.0, 60.0, 0.5)
    rates = 15.0 * np.tile([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], (len(times) // 4, 1))
    log = Log(times, rates)
    stamps, positions = track(log, 11, 40.0, still)
    part = stamps > 20.0
    assert "two places" in fit(stamps[part], positions[part], log).refusal
    assert fit(stamps[part], positions[part], log, NEAR).offset_s == pytest.approx(-0.04, abs=3e-3)


def test_without_changes_of_the_command_nothing_is_claimed() -> None:
    log = Log(np.array([0.0, 30.0]), np.array([[15.0, 0.0], [15.0, 0.0]]))
    assert fit(*track(log, 12, 20.0), log).refusal
    nothing = Log(log.times_s, np.zeros((2, 2)))
    with pytest.raises(UsageError, match="no turns"):
        fit(*track(log, 12, 20.0), nothing)
    with pytest.raises(UsageError, match="frames"):
        fit(np.arange(5.0), np.zeros((5, 2)), log)


@pytest.mark.parametrize("own_log", [False, True])
def test_images_that_are_stamped_late_by_other_times_are_placed_where_the_log_is_that_of_the_run(own_log: bool) -> None:
    """Each shows the robot as it was 40 to 60 ms before its stamp, as of a camera without a clock."""
    log = commands(5, 25.0)
    stamps, positions = track(log, 5, 24.0, latency_s=0.0)
    age_s = 0.04 + np.random.default_rng(5).uniform(0.0, 0.02, len(stamps))
    seen = np.column_stack([np.interp(stamps - age_s, stamps, positions[:, axis]) for axis in (0, 1)])
    found = fit_motion(stamps, seen, log.turns, log.span_s, NEAR, exact_log=True, own_log=own_log)
    assert 0.2 < found.explained < 0.65, "the jitter is what the log does not explain"
    assert ("explains" in found.refusal) is not own_log
    assert -found.offset_s == pytest.approx(0.05, abs=3.0 * found.offset_std_s) and found.offset_std_s < 0.01
    other = commands(6, 25.0)
    stranger = fit_motion(stamps, seen, other.turns, other.span_s, NEAR, exact_log=True, own_log=own_log)
    assert stranger.refusal, "a track that does not follow the commands is refused all the same"


@pytest.mark.slow("fits many movies")
def test_stated_errors_hold() -> None:
    """95 of 100 within 1.96 standard errors; and they are not far too large, and larger where less is to be seen."""
    deviations, errors = [], []
    for seed in range(16):
        log = commands(seed + 100, 9.0)
        stamps, positions = track(log, seed, 8.0, FLOWS[seed % 4], rate_hz=20.0, noise_um=1.0, wander=0.06)
        found = fit_motion(stamps, positions, log.turns, log.span_s, NEAR, exact_log=True)
        deviations.append((found.offset_s + 0.04, found.um_per_rev - K, found.heading_offset_rad))
        errors.append((found.offset_std_s, found.um_per_rev_std, found.heading_offset_std_rad))
    inside = (np.abs(deviations) < 1.96 * np.array(errors)).mean(axis=0)
    assert (inside >= 0.85).all(), inside
    ratio = np.sqrt(np.mean(np.square(deviations), axis=0)) / np.median(errors, axis=0)
    assert (ratio > 0.2).all(), ratio
    quiet = commands(100, 9.0, fastest_hz=3.0)
    poor = fit_motion(*track(quiet, 0, 8.0, noise_um=2.0), quiet.turns, quiet.span_s, NEAR, exact_log=True)
    assert poor.offset_std_s > 2.0 * np.median(np.array(errors)[:, 0])


def test_a_track_that_goes_to_other_things_for_long_is_skipped_for_a_quarter_of_its_frames_at_most() -> None:
    time_s = np.arange(800) / 30.0
    positions = np.column_stack([60.0 * time_s, np.zeros(800)]) + np.random.default_rng(0).normal(0.0, 0.3, (800, 2))
    excursions = {60: 80, 260: 76, 460: 84, 660: 82}  # a tenth of the frames each
    for first, frames in excursions.items():
        positions[first : first + frames] += [0.0, 500.0]
    flags = _stretches(time_s, positions)
    assert [int((flags[first - 5 : first + 100] == SKIPPED).sum()) for first in excursions] == [80, 76, 0, 0]


def test_the_errors_of_a_gain_are_those_of_many_tracks_of_a_robot_whose_speed_and_course_wander() -> None:
    off, stated = [], []
    time_s = np.arange(0.0, 8.0, 0.1)
    for seed in range(100):
        log, rng = commands(seed, 9.0, hold_s=0.4), np.random.default_rng(seed)
        wander = np.repeat(rng.normal(0.0, 0.05, (8, 2)) @ [1.0, 1j], 10)
        steps = np.diff(log.turns(time_s), axis=0) @ [1.0, 1j] * (1.0 + wander[:-1])
        way = np.concatenate([[0j], np.cumsum(K * steps)]) + rng.normal(0.0, 0.1, (80, 2)) @ [1.0, 1j]
        positions = np.column_stack([way.real, way.imag])
        noise = NoiseModel(0.01, 4.0, 3e3)
        seen = TrackRegression(time_s, positions, np.zeros(80, np.int8), noise, log.turns, (False, False))
        found = seen.fit(Place(0.0, 1.0, False))
        off.append((found.gain.real - K, found.gain.imag))
        stated.append(np.sqrt(np.diag(seen.covariance(found))[2:]))
    inside = (np.abs(off) < 1.96 * np.array(stated)).mean()
    assert 0.88 < inside < 0.99


def test_a_log_of_another_run_has_a_p_value_below_a_tenth_in_one_search_of_ten_however_many_rates_are_tried() -> None:
    noise = NoiseModel(0.1, 4.0, 3e4)
    chances = []
    for seed in range(24):
        log, other = commands(2 * seed, 12.0, hold_s=0.4), commands(2 * seed + 1, 12.0, hold_s=0.4)
        time_s = np.arange(2.0, 10.0, 0.1)
        positions = K * other.turns(time_s)
        seen = TrackRegression(time_s, positions, np.zeros(80, np.int8), noise, log.turns, (True, True))
        chances.append(search(seen, log.span_s, SearchRange(-2.0, 2.0, 0.7, 1.4))[1])
    assert np.mean(np.array(chances) < 0.1) < 0.25
    assert np.mean(np.array(chances) < 0.5) > 0.1


def test_of_commands_along_one_axis_the_search_leaves_open_whether_the_other_one_is_mirrored() -> None:
    rng = np.random.default_rng(0)
    log = Log(np.arange(0.0, 12.0, 0.4), np.column_stack([rng.choice([-15.0, 0.0, 15.0], 30), np.zeros(30)]))
    time_s = np.arange(2.0, 10.0, 0.1)
    noise = NoiseModel(0.1, 4.0, 3e4)
    seen = TrackRegression(time_s, K * log.turns(time_s), np.zeros(80, np.int8), noise, log.turns, (True, False))
    found = search(seen, log.span_s, SearchRange(-1.0, 1.0))[0]
    assert {each.mirrored for each in found if abs(each.offset_s) < 0.11} == {False, True}


@pytest.mark.parametrize("mirrored_before", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(("turned_deg", "before_deg"), [(40.0, 0.0), (40.0, 100.0), (-170.0, -60.0), (0.5, 30.0)])
def test_the_proposed_axes_of_the_headings_are_the_stated_ones_and_then_those_that_the_fit_found(
    turned_deg: float, before_deg: float, mirrored: bool, mirrored_before: bool
) -> None:
    given = dict.fromkeys(MotionFit._fields, 0.0) | {"mirrored": mirrored, "heading_offset_std_rad": 0.01}
    found = MotionFit(**given | {"heading_offset_rad": math.radians(turned_deg)})  # type: ignore[arg-type]
    sets = heading_settings(found, before_deg, mirrored_before)
    offset_deg = sets.get("movie.heading_offset_deg", before_deg)
    sense = -1.0 if sets.get("movie.heading_mirrored", mirrored_before) else 1.0
    for log_deg in (-120.0, 10.0, 75.0):
        stated_deg = before_deg + (-log_deg if mirrored_before else log_deg)
        true_deg = (turned_deg if turned_deg > 2.0 or turned_deg < -2.0 else 0.0) + stated_deg * (
            -1.0 if mirrored else 1.0
        )
        assert math.cos(math.radians(offset_deg + sense * log_deg - true_deg)) == pytest.approx(1.0, abs=1e-6)


def made_up(**values: float) -> MotionFit:
    """A fit of which a test reads some values."""
    given = dict.fromkeys(MotionFit._fields, 0.0) | {"mirrored": False, "refusal": "", "um_per_rev": K}
    return MotionFit(**given | values)  # type: ignore[arg-type]


def test_a_delay_that_is_found_is_added_to_the_stated_one(monkeypatch: pytest.MonkeyPatch) -> None:
    late = made_up(offset_s=-0.012, offset_std_s=0.001)
    monkeypatch.setitem(_camera_delay.__globals__, "_applied_turns", lambda *_: (None, (0.0, 1.0)))
    monkeypatch.setitem(_camera_delay.__globals__, "fit_motion", lambda *_, **__: late)
    robot, lab = SimpleNamespace(um_per_rev=K, delay_s=0.04), SimpleNamespace(camera_delay_s=0.03)
    movie = SimpleNamespace(clock_offset_s=1.5, heading_offset_deg=0.0, heading_mirrored=False)
    session: Any = SimpleNamespace(config=SimpleNamespace(robot=robot, lab=lab, movie=movie))
    assert _camera_delay(session, np.zeros(2), np.zeros((2, 2)), None) == pytest.approx((0.042, 0.001))
    sets, advice = _propose_settings(late, session, shared_clock=False, own_log=True)
    assert sets["movie.clock_offset_s"] == 1.488 and "the log is not aligned" in " ".join(advice)


def test_means_over_images_leave_out_those_of_which_one_lacks() -> None:
    stamps = np.delete(np.arange(13) * 40_000_000, 5)
    places = np.column_stack([np.arange(12.0), np.zeros(12)])
    means_ns, means_um, around_ns = _means(stamps, places, 4)
    assert means_ns.tolist() == [60_000_000, 420_000_000]
    assert means_um[:, 0].tolist() == [1.5, 9.5]
    np.testing.assert_allclose(around_ns, 40_000_000 * np.array([-1.5, -0.5, 0.5, 1.5]))
