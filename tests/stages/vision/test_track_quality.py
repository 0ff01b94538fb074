"""A track is doubted for jumps, the border, rivals and changed looks; a good one for nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Appearance, Extra, Shift, Tick, Track
from flowrec.stages import TrackQuality
from tests.stages.vision.shaky import CALIBRATION, HEIGHT, ROBOT, UM_PER_PX, WIDTH


def tracks(count: int = 60, step_px: float = 1.5) -> list[Track]:
    """A robot that starts, turns and rests, with a noise of 0.05 px."""
    rng = np.random.default_rng(3)
    angle = np.where(np.arange(count) < count // 2, 0.0, 2.5)
    speed = np.where((np.arange(count) > 5) & (np.arange(count) < count - 8), step_px, 0.0)
    steps = speed[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    places = np.array([60.0, 70.0]) + np.cumsum(steps, axis=0) + rng.normal(0.0, 0.05, (count, 2))
    return [
        Track(round(n * 1e9 / 30.0), True, UM_PER_PX * place, 0.9, 0, 5.0, np.zeros(4), spread_px=0.3, energy=50.0)
        for n, place in enumerate(places)
    ]


def doubts(given: list[Track], looks: list[Appearance] | None = None) -> list[str]:
    quality = TrackQuality(CALIBRATION, (HEIGHT, WIDTH), ROBOT)
    for n, track in enumerate(given):
        quality.take(track, looks[n] if looks else None, None)
        quality.take(track, None, None)  # a tick that brings no other track
    return quality.doubts()


@pytest.mark.parametrize("step_px", [0.0, 0.2, 1.5, 8.0])
def test_a_track_of_one_robot_is_not_doubted_however_fast_it_starts_and_turns(step_px: float) -> None:
    assert doubts(tracks(34, step_px)) == []


def test_a_track_that_is_lost_and_found_where_the_robot_can_have_gone_is_not_doubted() -> None:
    given = tracks()
    lost = [replace(track, seen=False) if 12 <= n < 16 else track for n, track in enumerate(given)]
    assert doubts(lost) == []


def test_a_jump_to_another_body_is_doubted_and_its_time_told() -> None:
    given = tracks()
    moved = [
        replace(t, position_um=t.position_um + (UM_PER_PX * 25.0 if n >= 30 else 0.0)) for n, t in enumerate(given)
    ]
    (doubt,) = doubts(moved)
    assert "jumps once farther than the robot goes (at 1.00 s)" in doubt


def test_a_jump_of_another_robot_is_told_with_its_number_and_its_border_is_not() -> None:
    quality = TrackQuality(CALIBRATION, (HEIGHT, WIDTH), ROBOT)
    for n, first in enumerate(tracks()):
        at_um = UM_PER_PX * np.array([WIDTH - 2.0 if n < 30 else WIDTH - 60.0, 70.0])
        other = replace(first, position_um=at_um + first.position_um - tracks()[0].position_um)
        quality.write(
            Tick(first.stamp_ns, track=first, extra=Extra({"/robot/1/track": first, "/robot/2/track": other}))
        )
    (doubt,) = quality.doubts()
    assert doubt.startswith("robot 2: the track jumps once farther than the robot goes (at 1.00 s)")


def test_jumps_on_half_of_the_images_do_not_pass_as_the_speed_of_the_robot() -> None:
    rng = np.random.default_rng(1)
    hops = np.where(rng.random(60) < 0.4, rng.uniform(30.0, 120.0, 60), 0.0)  # to another one of many bodies
    given = [
        replace(t, position_um=UM_PER_PX * (np.array([20.0 + hop, 70.0]) + rng.normal(0.0, 0.1, 2)))
        for t, hop in zip(tracks(), hops, strict=True)
    ]
    assert any("jumps" in each for each in doubts(given))


def test_a_robot_that_the_border_cuts_is_doubted() -> None:
    given = [replace(t, position_um=UM_PER_PX * np.array([WIDTH - 2.0, 70.0])) for t in tracks()[:10]] + tracks()[10:12]
    assert any("cut by the border of the image on 10 of 12 images" in each for each in doubts(given))


@pytest.mark.parametrize(("away_px", "energy", "rivals"), [(3.0, 45.0, True), (12.0, 45.0, False), (3.0, 5.0, False)])
def test_a_body_as_bright_is_a_rival_where_the_robot_may_be_itself(away_px: float, energy: float, rivals: bool) -> None:
    given = tracks()
    beside = [
        replace(t, neighbours_px=np.array([*(t.position_um / UM_PER_PX + (0.0, away_px)), energy])) if n == 20 else t
        for n, t in enumerate(given)
    ]
    assert [("on 1 of 60 images" in each, "exchanged" in each) for each in doubts(beside)] == [(True, True)] * rivals


def test_an_image_that_becomes_much_stronger_is_doubted() -> None:
    given = [replace(t, energy=50.0 * 8.0 ** (n / 59.0)) for n, t in enumerate(tracks())]
    (doubt,) = doubts(given)
    assert "5.8 times as strong as at the beginning" in doubt


def test_an_image_that_becomes_much_weaker_is_doubted_with_what_is_left_of_it() -> None:
    (doubt,) = doubts([replace(t, energy=50.0 if n < 40 else 10.0) for n, t in enumerate(tracks())])
    assert "is 20 % as strong as at the beginning" in doubt


def test_a_round_body_that_turns_into_a_ring_is_doubted_and_one_that_stays_is_not() -> None:
    axis = np.arange(-8, 9)
    distance = np.hypot(axis[None], axis[:, None])
    disc, ring = (np.exp(-0.5 * ((distance - at) / 1.5) ** 2).astype(np.float32) for at in (0.0, 5.0))
    for recent, count in ((disc, 0), (ring, 1)):
        views = np.stack([disc, recent])
        look = Appearance(0, "dark", 1.0, 1.0, 5.0, np.zeros(2), views)
        found = doubts(tracks(), [look] * 60)
        assert [("no longer looks" in each) for each in found] == [True] * count


@pytest.mark.parametrize(("moved_px", "cut"), [((0.0, 0.0), True), ((40.0, 0.0), False), ((0.0, 40.0), True)])
def test_the_border_is_that_of_the_image_which_may_lie_elsewhere_than_the_chip(moved_px, cut) -> None:
    quality = TrackQuality(CALIBRATION, (HEIGHT, WIDTH), ROBOT)
    for track in tracks(step_px=0.0):
        beside = replace(track, position_um=track.position_um - UM_PER_PX * np.array([60.0, 0.0]))
        quality.take(beside, None, Shift(track.stamp_ns, np.array(moved_px), found=True, alike=1.0))
    assert bool(quality.doubts()) == cut
