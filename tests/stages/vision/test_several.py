"""Several robots that cross, touch and hide each other, on images that another renderer draws: soft dark discs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Frame, Track, UsageError
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages import Tracker
from flowrec.stages.vision import Expected

UM, RADIUS_PX = 10.0, 6.0
MASK = np.zeros((120, 200), bool)
MASK[5:115] = True
CHIP = Chip("open", MASK, UM, (), 1.0, 1000.0)
ROBOT = Robot(radius_um=RADIUS_PX * UM, um_per_rev=60.0, step_out_hz=20.0, max_speed_um_s=600.0)
CALIBRATION = Calibration(UM)
FRAME_S = 1.0 / 30.0


def frame(places_px: np.ndarray, index: int, radii=None, darkness=None, debris=()) -> Frame:
    """An image of opaque discs at (n, 2), and of paler ones; NaN: not there."""
    y, x = np.mgrid[: MASK.shape[0], : MASK.shape[1]]
    light = np.full(MASK.shape, 170.0)
    radii = [RADIUS_PX] * len(places_px) if radii is None else radii
    darkness = [0.75] * len(places_px) if darkness is None else darkness
    for column, row in debris:
        light *= 1.0 - 0.3 / (1.0 + np.exp((np.hypot(x - column, y - row) - 0.5 * RADIUS_PX) / 0.5))
    for (column, row), radius, dark in zip(places_px, radii, darkness, strict=True):
        if np.isfinite(column):
            light *= 1.0 - dark / (1.0 + np.exp((np.hypot(x - column, y - row) - radius) / 0.4))
    noisy = light + 2.0 * np.random.default_rng([7, index]).standard_normal(MASK.shape)
    return Frame(round(index * FRAME_S * 1e9), index, np.clip(noisy, 0, 255).astype(np.uint8))


def followed(ways: np.ndarray, start: int = 0, std_px: float = 1.0, tracker: Tracker | None = None, **drawn) -> list:
    """The tracks after each image of robots on their ways (frames, n, 2) in px; expected where they last went."""
    tracker = tracker or Tracker(robots=ways.shape[1], polarity="auto")
    tracks: list[list[Track]] = []
    look, velocity = None, np.zeros(ways.shape[1:])
    for index, places in enumerate(ways):
        image = frame(places, index, **drawn)
        expected = []
        if len(tracks) > 1:
            for n, (now, then) in enumerate(zip(tracks[-1], tracks[-2], strict=True)):
                # As an observer: a mean velocity, with which it goes on; it knows less of the place without a sight.
                velocity[n] += 0.2 * (now.position_um - then.position_um - velocity[n])
        for now, step in zip(tracks[-1] if tracks else (), velocity, strict=False):
            expected.append(Expected(now.position_um + step, (std_px + 0.3 * now.lost_frames) * UM))
        found, look = tracker.follow_all(
            tracks[-1] if tracks else [],
            expected,
            look,
            image,
            CHIP,
            CALIBRATION,
            ROBOT,
            (0.0, 0.0),
            ways[0, start] * UM,
        )
        tracks.append(found)
    return tracks


def errors_px(tracks: list, ways: np.ndarray, order: list[int]) -> np.ndarray:
    """Distances (frames, n) of the tracks from the robots that they follow."""
    at = np.array([[track.position_um / UM for track in each] for each in tracks])
    return np.hypot(*(at - ways[:, order]).transpose(2, 0, 1))


def order_of(tracks: list, ways: np.ndarray) -> list[int]:
    """The robot that each track follows at first."""
    at = np.array([track.position_um / UM for track in tracks[0]])
    return [int(np.hypot(*(ways[0] - place).T).argmin()) for place in at]


def straight(start, velocity, frames: int) -> np.ndarray:
    return np.array(start, float) + np.arange(frames)[:, None, None] * np.array(velocity, float)


@pytest.mark.parametrize("offset_px", [0.0, 4.0, 9.0])
def test_robots_that_pass_over_each_other_keep_their_numbers(offset_px: float) -> None:
    ways = straight([[60, 50], [140, 50 + offset_px], [100, 95]], [[1.5, 0], [-1.5, 0], [0, -0.2]], 50)
    tracks = followed(ways)
    order = order_of(tracks, ways)
    assert order[0] == 0 and sorted(order) == [0, 1, 2]
    off = errors_px(tracks, ways, order)
    assert off[-1].max() < 0.5, "each track ends at the robot at which it began"
    assert off.max() < 4.0 and all(track.seen for track in tracks[-1])


def test_robots_of_different_look_keep_their_numbers_when_they_turn_back_while_one_hides_the_other() -> None:
    """They come together and part again the way they came: by motion alone they would be exchanged."""
    half = straight([[70, 60], [110, 60]], [[1, 0], [-1, 0]], 20)
    ways = np.concatenate((half, half[::-1]))
    tracks = followed(ways, radii=[RADIUS_PX, 0.8 * RADIUS_PX], darkness=[0.8, 0.55], std_px=2.0)
    assert errors_px(tracks, ways, order_of(tracks, ways))[-1].max() < 0.5


def test_a_robot_that_leaves_takes_over_neither_another_one_nor_debris() -> None:
    ways = straight([[40, 40], [150, 60], [120, 90]], [[0.5, 0], [2.0, 0], [0, 0]], 60)
    ways[20:, 1] = np.nan
    tracks = followed(ways, debris=[(60, 90), (90, 30), (170, 60)])
    order = order_of(tracks, ways)
    gone = order.index(1)
    assert not any(each[gone].seen for each in tracks[25:])
    off = errors_px(tracks, ways, order)
    assert np.delete(off, gone, axis=1).max() < 0.5


def test_a_robot_that_is_missed_for_a_second_is_found_again_elsewhere() -> None:
    ways = straight([[40, 40], [150, 60]], [[0.2, 0], [0, 0]], 80)
    ways[20:50, 1] = np.nan
    ways[50:, 1] = (120, 95)
    tracks = followed(ways)
    assert not tracks[40][1].seen
    assert errors_px(tracks, ways, order_of(tracks, ways))[-1].max() < 0.5


def found_at(tracker: Tracker, tracks: list, look, places, expected_px, std_px: float, index: int, **drawn) -> list:
    """The tracks after one more image."""
    expected = [Expected(np.array(place) * UM, std_px * UM) for place in expected_px]
    image = frame(np.array(places, float), index, **drawn)
    return tracker.follow_all(tracks, expected, look, image, CHIP, CALIBRATION, ROBOT, (0.0, 0.0), np.zeros(2))[0]


def test_the_robot_of_the_mission_is_looked_for_everywhere_in_each_image_and_others_in_every_tenth() -> None:
    tracker, places = Tracker(robots=2, polarity="auto"), np.array([[60.0, 60.0], [120.0, 60.0]])
    tracks, look = tracker.follow_all(
        [], [], None, frame(places, 0), CHIP, CALIBRATION, ROBOT, (0.0, 0.0), places[0] * UM
    )
    moved = places + np.array([0.0, 30.0])
    for lost, index, seen in ((0, 101, True), (1, 101, False), (1, 110, True)):
        before = [replace(track, stamp_ns=round((index - 1) * FRAME_S * 1e9)) for track in tracks]
        before[lost] = replace(before[lost], seen=False, lost_frames=60, seen_ns=0)
        at, expected = places.copy(), places.copy()
        at[lost] = moved[lost]
        found = found_at(tracker, before, look, at, expected, 0.5, index)
        assert [each.seen for each in found] == [True if n != lost else seen for n in (0, 1)]
        assert not seen or np.hypot(*(found[lost].position_um / UM - moved[lost])) < 0.5


def test_of_robots_that_may_be_anywhere_nearby_their_looks_tell_which_is_which() -> None:
    tracker, looks = Tracker(robots=2, polarity="auto"), {"radii": [RADIUS_PX, 0.8 * RADIUS_PX], "darkness": [0.8, 0.5]}
    places = np.array([[60.0, 60.0], [90.0, 60.0]])
    first = frame(places, 0, **looks)
    tracks, look = tracker.follow_all([], [], None, first, CHIP, CALIBRATION, ROBOT, (0.0, 0.0), places[0] * UM)
    moved = places[::-1] + np.array([[-10.0, 5.0], [10.0, 5.0]])  # each is nearer to where the other one was
    for each, place in zip(found_at(tracker, tracks, look, moved, places, 8.0, 1, **looks), moved, strict=True):
        assert each.seen and np.hypot(*(each.position_um / UM - place)) < 3.0


@pytest.mark.parametrize(("apart_px", "expected_px", "found_px"), [(6.0, 3.0, 6.0), (5.5, 2.5, 5.5), (2.0, 2.0, 2.0)])
def test_robots_that_hide_each_other_are_as_far_apart_as_expected_unless_the_image_contradicts_it(
    apart_px: float, expected_px: float, found_px: float
) -> None:
    """Fitted freely, two of 2 px are found 3.1 px apart; never fitted freely, two that part would stay together."""
    tracker, first = Tracker(robots=2, polarity="auto"), np.array([[60.0, 60.0], [90.0, 60.0]])
    image = frame(first, 0)
    tracks, look = tracker.follow_all([], [], None, image, CHIP, CALIBRATION, ROBOT, (0.0, 0.0), first[0] * UM)
    places, expected = (
        [(75.0 - 0.5 * px, y), (75.0 + 0.5 * px, y)] for px, y in ((apart_px, 60.0), (expected_px, 61.0))
    )
    one, other = (each.position_um / UM for each in found_at(tracker, tracks, look, places, expected, 1.0, 1))
    assert other - one == pytest.approx([found_px, 0.0], abs=0.2)
    assert 0.5 * (one + other) == pytest.approx([75.0, 60.0], abs=0.1)


def test_a_robot_that_is_looked_for_everywhere_does_not_take_a_disc_beside_one_that_was_seen_just_now() -> None:
    tracker, places = Tracker(robots=2, polarity="auto", reacquire_after=3), np.array([[60.0, 60.0], [140.0, 60.0]])
    first = frame(places, 0)
    tracks, look = tracker.follow_all([], [], None, first, CHIP, CALIBRATION, ROBOT, (0.0, 0.0), places[0] * UM)
    for index in range(1, 10):
        tracks = found_at(tracker, tracks, look, [places[0], (np.nan, np.nan)], places, 0.5, index)
    assert tracks[0].seen and tracks[1].lost_frames == 9
    # The first one moved farther than its observer can explain, on the image on which lost ones are looked for.
    tracks = found_at(tracker, tracks, look, [(68.0, 60.0), (np.nan, np.nan)], places, 0.5, 10)
    assert not tracks[1].seen


def test_the_first_robot_is_the_one_nearest_to_the_start_or_the_one_that_is_pointed_at() -> None:
    ways = straight([[40, 40], [150, 60], [90, 90]], [[0, 0]] * 3, 2)
    assert order_of(followed(ways, start=2), ways)[0] == 2
    pointed = Tracker(robots_px=((148.0, 61.0), (91.0, 88.0), (40.0, 40.0)), polarity="auto")
    assert pointed.count == 3
    assert order_of(followed(ways, tracker=pointed), ways) == [1, 2, 0]


def test_bright_robots_and_images_of_more_bits_are_followed_alike() -> None:
    ways = straight([[40, 40], [150, 60]], [[1.0, 0], [-1.0, 0]], 15)
    dark, tracks, look = Tracker(robots=2, polarity="auto"), [], None
    bright = Tracker(robots=2, polarity="bright")
    for tracker, made in ((dark, lambda image: image.astype(np.uint16) * 16), (bright, lambda image: 255 - image)):
        tracks, look = [], None
        for index, places in enumerate(ways):
            image = frame(places, index)
            changed = made(image.image)
            shown = Frame(image.stamp_ns, index, changed, 12 if changed.dtype == np.uint16 else 8)
            expected = [Expected(each.position_um, 20.0) for each in tracks]
            tracks, look = tracker.follow_all(
                tracks, expected, look, shown, CHIP, CALIBRATION, ROBOT, (0.0, 0.0), ways[0, 0] * UM
            )
        for track, place in zip(tracks, ways[-1], strict=True):
            assert track.seen and np.hypot(*(track.position_um / UM - place)) < 0.5


def test_settings_of_one_robot_are_refused_with_several() -> None:
    with pytest.raises(UsageError, match=r"tracker\.click_px is for one robot"):
        Tracker(robots=2, click_px=(3.0, 4.0)).refuse_unfit()
    Tracker(click_px=(3.0, 4.0)).refuse_unfit()
