"""Tracks of tracers on images that another renderer draws: Gaussian spots on an even background, with shot noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from flowrec.core import Frame, Observations, Tick, Track
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages import RunStatistics
from flowrec.stages.vision.tracers import _GATE, TracerTracker, assign

UM = 10.0  # per pixel, of the camera and of the mask
RATE_HZ = 30.0
MASK = np.zeros((128, 160), bool)
MASK[20:108] = True
CHIP = Chip("open", MASK, UM, (), 1.0, 1000.0)
ROBOT = Robot(radius_um=60.0, um_per_rev=60.0, step_out_hz=20.0, max_speed_um_s=600.0)
CALIBRATION = Calibration(UM)
TRACKER = TracerTracker(radius_um=15.0)


def frame(places_px: np.ndarray, index: int, darkness: float = 70.0, seed: int = 0) -> Frame:
    """An image of dark spots at (n, 2)."""
    y, x = np.mgrid[: MASK.shape[0], : MASK.shape[1]]
    light = np.full(MASK.shape, 170.0)
    for column, row in places_px:
        light -= darkness * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2.0 * 1.3**2))
    noisy = light + 2.0 * np.random.default_rng([seed, index]).standard_normal(MASK.shape)
    return Frame(round(index * 1e9 / RATE_HZ), index, np.clip(noisy, 0, 255).astype(np.uint8))


def followed(ways: np.ndarray, track: Track | None = None) -> list:
    """The tracers after each image of spots on their ways (frames, n, 2) in px; NaN: not there."""
    found, last = [], None
    for index, places in enumerate(ways):
        image = frame(places[np.isfinite(places).all(axis=1)], index)
        last = TRACKER.follow(last, track, image, CHIP, CALIBRATION, ROBOT)
        found.append(last)
    return found


def straight(start: np.ndarray, velocity: np.ndarray, frames: int) -> np.ndarray:
    return start + np.arange(frames)[:, None, None] * velocity


def test_bodies_keep_their_numbers_through_crossings_and_are_placed_within_their_bars() -> None:
    start = np.array([[20.0, 40.0], [20.0, 80.0], [140.0, 61.0], [80.0, 30.0]])
    velocity = np.array([[2.0, 0.7], [2.0, -0.7], [-2.0, 0.0], [0.0, 1.0]])
    ways = straight(start, velocity, 50)
    found = followed(ways)
    first = {int(n): int(np.hypot(*(found[3].position_um / UM - ways[3][n])[:, :].T).argmin()) for n in range(4)}
    names = {n: found[3].id[row] for n, row in first.items()}
    end = found[-1]
    for n, name in names.items():
        row = int(np.flatnonzero(end.id == name)[0])
        assert np.hypot(*(end.position_um[row] / UM - ways[-1][n])) < 0.3
        off = (end.velocity_um_s[row] - velocity[n] * UM * RATE_HZ) / end.velocity_std_um_s[row]
        assert np.abs(off).max() < 4.0
    for k, each in enumerate(found[5:10], 5):
        places = dict(zip(each.id, each.position_um, strict=True))
        assert max(np.abs(places[name] / UM - ways[k][n]).max() for n, name in names.items()) < 0.3


def test_small_bodies_that_walk_at_random_keep_their_numbers() -> None:
    um_per_px, radius_um = 0.35, 0.5
    walk_px = np.sqrt(2.0 * 0.437 / RATE_HZ) / um_per_px  # of a sphere of 1 um in water at 25 degrees
    rng = np.random.default_rng(3)
    start = np.stack(np.meshgrid(np.arange(15.0, 150.0, 20.0), np.arange(35.0, 95.0, 20.0)), -1).reshape(-1, 2)
    ways = start + np.cumsum(rng.normal(0.0, walk_px, (60, len(start), 2)), axis=0)
    chip, slow = replace(CHIP, um_per_px=um_per_px), replace(ROBOT, radius_um=2.0, max_speed_um_s=10.0)
    last = None
    for index, places in enumerate(ways):
        seen = frame(places, index)
        last = TracerTracker(radius_um=radius_um).follow(last, None, seen, chip, Calibration(um_per_px), slow)
    assert last is not None and last.next_id == len(start) == len(last.id)


def test_a_body_that_comes_in_at_the_edge_has_entered_and_one_that_was_there_has_not() -> None:
    ways = straight(
        np.array([[80.0, 60.0], [-20.0, 50.0], [100.0, 80.0]]), np.array([[0.5, 0.0], [3.0, 0.0], [0, 0]]), 24
    )
    ways[:12, 2] = np.nan  # appears in the middle
    end = followed(ways)[-1]
    entered = {tuple(np.rint(p / UM / 10).astype(int)): e for p, e in zip(end.position_um, end.entered, strict=True)}
    assert entered == {(9, 6): 0.0, (5, 5): 1.0, (10, 8): 0.0}


def test_a_body_that_leaves_is_dropped_and_one_that_is_hidden_for_a_moment_is_kept() -> None:
    ways = straight(np.array([[140.0, 60.0], [60.0, 60.0]]), np.array([[3.0, 0.0], [1.0, 0.0]]), 20)
    ways[8:12, 1] = np.nan
    found = followed(ways)
    assert found[6].count == 2 and found[10].lost_frames.max() == 3.0
    end = found[-1]
    assert end.count == 1 and end.id.tolist() == [found[6].id[np.argmin(found[6].position_um[:, 0])]]
    assert end.age_frames.tolist() == [16.0] and end.next_id == 2


def test_the_time_over_which_images_miss_a_body_counts_from_the_beginning_of_its_stretch() -> None:
    ways = straight(np.array([[20.0, 60.0]]), np.array([[1.0, 0.0]]), 24)  # stretches of six images, from the third on
    ways[10:12] = np.nan
    missed = [round(each.missed_s[0] * RATE_HZ) for each in followed(ways)]
    assert missed == [*[0] * 10, 1, 2, 2, 2, *[0] * 10]


def test_nothing_of_the_robot_is_a_tracer() -> None:
    place = np.array([80.0, 60.0])
    seen = Track(0, True, place * UM, 1.0, 0, 6.0, np.zeros(4))
    ring = place + 8.0 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    ways = np.stack([np.vstack([ring, [[30.0, 40.0]]])] * 3)
    assert followed(ways, seen)[-1].count == 1
    assert followed(ways, replace(seen, radius_px=3.0))[-1].count == 1, "it is no smaller than it is stated"
    assert followed(ways, replace(seen, seen=False))[-1].count == 4


def test_the_faint_ring_of_a_body_is_no_body() -> None:
    image = frame(np.array([[50.0, 60.0]]), 0)
    faint = np.array([[57.0, 60.0], [120.0, 60.0]])
    drawn = np.minimum(image.image, frame(faint, 0, darkness=22.0).image)
    found = TRACKER.follow(None, None, replace(image, image=drawn), CHIP, CALIBRATION, ROBOT)
    assert np.rint(found.position_um[:, 0] / UM).tolist() == [50.0, 120.0], "it is one where it is alone"


def test_the_edge_of_a_wall_that_the_mask_does_not_have_is_no_body_and_a_body_beside_it_is_one() -> None:
    light = frame(np.array([[80.0, 60.0], [40.0, 48.0]]), 0).image.astype(float)
    edge = 34.0 + 0.06 * np.arange(MASK.shape[1])  # a line two pixels wide, along which noise makes maxima
    light -= 60.0 * np.exp(-((np.arange(MASK.shape[0])[:, None] - edge) ** 2) / 2.0)
    shown = Frame(0, 0, np.clip(light, 0, 255).astype(np.uint8))
    found = TRACKER.follow(None, None, shown, CHIP, CALIBRATION, ROBOT)
    assert np.hypot(*(found.position_um / UM - [[40.0, 48.0], [80.0, 60.0]]).T).max() < 0.5
    as_before = replace(TRACKER, most_elongated=0.0).follow(None, None, shown, CHIP, CALIBRATION, ROBOT)
    assert as_before.count > 10


def test_groups_are_assigned_as_all_bodies_at_once_would_be() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        expected, spots = rng.uniform(0, 100, (30, 2)), rng.uniform(0, 100, (25, 2))
        variance = rng.uniform(2.0, 20.0, 30)
        cost = ((expected[:, None] - spots) ** 2).sum(axis=2) / variance[:, None]
        inside = cost < _GATE
        cost += 2.0 * np.log(variance / variance.max())[:, None] - _GATE
        padded = np.hstack([np.where(inside, cost, 1.0), np.zeros((30, 30))])
        rows, columns = assign(expected, variance, spots)
        assert len(set(rows)) == len(rows) and len(set(columns)) == len(columns)
        best = padded[linear_sum_assignment(padded)].sum()
        single = (inside.sum(axis=1)[rows] == 1) & (inside.sum(axis=0)[columns] == 1)
        assert cost[rows, columns].sum() <= best + 1e-9 + np.maximum(cost[rows, columns][single], 0.0).sum()


@pytest.mark.parametrize("count", [0, 1])
def test_an_image_without_bodies_has_no_tracks(count: int) -> None:
    assert followed(np.full((2, count, 2), np.nan))[-1].count == 0


def test_a_run_tells_how_many_tracers_it_followed_and_that_it_found_none() -> None:
    for count, told in ((2, "2.0 an image, 3 flow observations"), (0, "none was followed")):
        statistics = RunStatistics()
        assert statistics.others == {}, "a run without tracers has no such line"
        ways = np.array([[40.0, 60.0], [90.0, 60.0]])[:count] + np.zeros((12, 1, 1))
        seen = followed(ways)
        flow = Observations(0, np.zeros((3, 2)), np.zeros((3, 2)), np.ones(3))
        for each in seen[3:]:
            statistics.write(Tick(each.stamp_ns, tracers=each, tracer_flow=flow if count else None))
        statistics.write(Tick(seen[-1].stamp_ns + 1, tracers=seen[-1], tracer_flow=flow if count else None))
        assert told in str(statistics.others["tracers"])


def test_a_tracer_that_an_image_does_not_show_is_not_counted_in_it() -> None:
    ways = np.array([[40.0, 60.0], [90.0, 60.0]]) + np.zeros((12, 1, 1))
    ways[9:, 1] = np.nan
    statistics = RunStatistics()
    for each in followed(ways)[2:]:  # both are kept in all, and the last three of ten show one
        assert each.count == 2
        statistics.write(Tick(each.stamp_ns, tracers=each))
    assert "1.7 an image, 0 flow observations" in str(statistics.others["tracers"])
