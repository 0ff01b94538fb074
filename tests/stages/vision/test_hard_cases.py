"""Hard cases: images of a hard-edged, supersampled, blurred disc, which shares no formula with the fit."""

import cv2
import numpy as np
import pytest

from flowrec.core import Frame
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages import Tracker

WIDTH, HEIGHT, TOP, UM = 320, 256, 50, 10.0


def paint(image, x, y, radius, dark, rim, blur=1.0, fine=6):
    width = max(1.0, 0.25 * radius)
    half = int(np.ceil(radius + width + 4 * blur)) + 2
    cx, cy, n = round(x), round(y), 2 * half + 1
    axis = (np.arange(n * fine) + 0.5) / fine - 0.5 - half
    rho = np.hypot(axis[None] - (x - cx), axis[:, None] - (y - cy))
    disc = np.where(rho < radius, -dark, np.where(rho < radius + width, rim, 0.0))
    disc = cv2.GaussianBlur(disc, (0, 0), blur * fine).reshape(n, fine, n, fine).mean(axis=(1, 3))
    image[cy - half : cy + half + 1, cx - half : cx + half + 1] += disc


def channel():
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    image = 150 + 25 * x - 15 * y - 20 * (x**2 + y**2)
    rows = np.arange(HEIGHT)[:, None]
    for edge, side in ((TOP - 0.5, 1), (HEIGHT - TOP - 0.5, -1)):
        depth = side * (rows - edge)
        image = image - 60 * ((depth > -2.5) & (depth < 0)) + 28 * ((depth >= 0) & (depth < 1.5))
    return cv2.GaussianBlur(image, (0, 0), 0.9)


def world(radius):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[TOP : HEIGHT - TOP] = True
    robot = Robot(radius_um=radius * UM, max_speed_um_s=600.0, step_out_hz=40.0)
    return Chip("channel", mask, UM, (), 1.0, 1000.0), Calibration(UM), robot


def film(radius, count, contrast=60.0, near=None, debris=0, gone=(), seed=1):
    """(Frame, true centre in px) while the robot wanders."""
    rng, base = np.random.default_rng(seed), channel()
    point = np.array([WIDTH / 2, HEIGHT / 2])
    for k in range(count):
        point = point + rng.uniform(-0.7, 0.7, 2) * radius
        low = np.array([6 * radius, TOP + 1.6 * radius + 3])
        point = np.clip(point, low, np.array([WIDTH, HEIGHT]) - low)
        if near is not None:
            point[1] = TOP - 0.5 + radius + near * rng.uniform()
        image = base.copy()
        for _ in range(debris):
            angle = rng.uniform(0, 2 * np.pi)
            away = rng.uniform(1.4, 4) * radius * np.array([np.cos(angle), np.sin(angle)])
            paint(image, *(point + away), radius * rng.uniform(0.3, 0.7), contrast * rng.uniform(0.3, 0.9), 9.0)
        if k not in gone:
            paint(image, *point, radius, contrast, 0.4 * contrast)
        noisy = np.clip(image + 4.0 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)
        yield Frame(k * 33_333_333, k, noisy), point


def run(radius, count, **how):
    last, tracks, misses, place = None, [], [], world(radius)
    for frame, truth in film(radius, count, **how):
        last = Tracker().track(last, frame, *place)
        tracks.append(last)
        misses.append(last.position_um / UM - truth)
    return tracks, np.array(misses)


@pytest.mark.parametrize("radius", [3.0, 5.0, 12.0])
def test_a_wall_beside_the_robot_does_not_pull_it(radius):
    tracks, misses = run(radius, 60, near=2.0)
    # A robot of 3 px may take a second frame to be found at first (in the open too); then it is held.
    assert all(track.seen for track in tracks[1:])
    misses = misses[1:]
    assert np.sqrt(np.mean(misses**2, axis=0)).max() < 0.15
    assert abs(misses[:, 1].mean()) < 0.05


def test_a_pale_robot_is_not_lost():
    tracks, misses = run(5.0, 60, contrast=15.0)
    assert all(track.seen for track in tracks)
    assert np.sqrt(np.mean(misses**2)) < 0.25


def test_a_crowd_of_debris_does_not_lead_it_astray():
    tracks, misses = run(5.0, 80, debris=6)
    assert all(track.seen for track in tracks)
    assert np.abs(misses).max() < 1.0


def test_a_lost_robot_keeps_its_place_and_is_found_again():
    tracks, misses = run(5.0, 60, gone=range(20, 40))
    assert [track.lost_frames for track in tracks[20:40]] == list(range(1, 21))
    assert all(np.array_equal(track.position_um, tracks[19].position_um) for track in tracks[20:40])
    assert all(track.seen for track in tracks[40:])
    assert np.abs(misses[40:]).max() < 0.3


def test_resuming_from_any_message_continues_bit_for_bit():
    frames = [frame for frame, _ in film(5.0, 40, debris=2, gone=range(10, 25))]
    stage, place = Tracker(), world(5.0)

    def follow(last, some):
        return [last := stage.track(last, frame, *place) for frame in some]

    whole = follow(None, frames)
    for start in (1, 12, 22, 30):
        assert all(a.same_as(b) for a, b in zip(follow(whole[start - 1], frames[start:]), whole[start:], strict=True))


def test_debris_is_rarely_taken_for_a_robot_that_has_gone():
    tracks, _ = run(5.0, 60, debris=3, gone=range(20, 60))
    assert sum(track.seen for track in tracks[20:]) <= 4


def test_a_small_robot_is_acquired_at_once():
    for frame, truth in film(3.0, 20, debris=3, seed=12):
        found = Tracker().track(None, frame, *world(3.0))
        assert found.seen and np.abs(found.position_um / UM - truth).max() < 1.0
