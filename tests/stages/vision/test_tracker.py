"""The tracker against images whose truth is known: the simulated microscope, on the built-in chip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flowrec.core import Frame, Track
from flowrec.physics import Calibration, ChipSettings, Robot, clearance_um, load_chip
from flowrec.rigs.simulated.microscope import DrawnRobot, Microscope, Particles
from flowrec.stages import ResolvedCamera, SimulatedImage, Tracker

CHIP = load_chip(ChipSettings())
WALLS = clearance_um(CHIP.mask, CHIP.um_per_px)
ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0)
TRACKER = Tracker()
NO_DEBRIS = Particles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


class Scene:
    """A camera of a given width over the chip, with debris strewn at random."""

    def __init__(self, width_px: int, seed: int = 0) -> None:
        height_px = round(width_px * 0.8)
        self.um_per_px = 6400.0 / width_px
        corner = (3190.0 - self.um_per_px * (width_px - 1) / 2, 2550.0 - self.um_per_px * (height_px - 1) / 2)
        self.calibration = Calibration(self.um_per_px, corner)
        camera = ResolvedCamera(width_px=width_px, height_px=height_px, um_per_px=self.um_per_px, rate_hz=30.0)
        self.microscope = Microscope(CHIP.mask, CHIP.um_per_px, self.calibration, camera, SimulatedImage(), seed)
        self.rng = np.random.default_rng(seed)

    def places(self, count: int, least_um: float, most_um: float = 1e9) -> NDArray[np.float64]:
        rows, columns = np.nonzero((least_um <= WALLS) & (most_um > WALLS))
        picked = self.rng.integers(0, len(rows), count)
        return np.column_stack((columns[picked], rows[picked])) * CHIP.um_per_px + self.rng.uniform(-9, 9, (count, 2))

    def frame(self, robot_um: NDArray[np.float64] | None, index: int = 0, debris: int = 24) -> Frame:
        radii = self.rng.uniform(0.3, 0.7, debris) * ROBOT.radius_um
        robots = [] if robot_um is None else [DrawnRobot(robot_um, ROBOT.radius_um)]
        image = self.microscope.image(robots, Particles(self.places(debris, 20.0), radii, np.full(debris, 0.3)))
        return Frame(index * 33_000_000, index, image)

    def track(self, previous: Track | None, frame: Frame) -> Track:
        return TRACKER.track(previous, frame, CHIP, self.calibration, ROBOT)


@pytest.mark.parametrize(("width_px", "limit_px"), [(320, 0.2), (640, 0.1), (1280, 0.1), (2448, 0.15)])
def test_the_robot_is_found_anywhere_among_debris_and_located_to_a_tenth_of_a_pixel(
    width_px: int, limit_px: float
) -> None:
    scene = Scene(width_px)
    errors = []
    for place in scene.places(25, ROBOT.radius_um + 5.0):
        found = scene.track(None, scene.frame(place))
        assert found.seen
        moved = place + scene.rng.uniform(-8.0, 8.0, 2)
        errors.append(scene.track(found, scene.frame(moved, 1)).position_um - moved)
    assert np.sqrt(np.mean(np.square(errors))) / scene.um_per_px < limit_px


def test_beside_a_wall_the_robot_is_located_to_a_third_of_a_pixel() -> None:
    scene = Scene(640)
    errors = []
    for place in scene.places(40, ROBOT.radius_um + 1.0, ROBOT.radius_um + 12.0):
        found = scene.track(None, scene.frame(place))
        assert found.seen
        errors.append(found.position_um - place)
    assert np.sqrt(np.mean(np.square(errors))) / scene.um_per_px < 0.3


def test_debris_alone_is_not_taken_for_the_robot() -> None:
    scene = Scene(640)
    seen = [scene.track(None, scene.frame(None, n)).seen for n in range(10)]
    assert not any(seen)


def test_a_robot_out_of_sight_keeps_its_place_and_is_found_again_nearby_and_far_away() -> None:
    scene = Scene(640)
    start, far = np.array([500.0, 2780.0]), np.array([5900.0, 2780.0])
    track = scene.track(None, scene.frame(start))
    for index in range(1, 4):
        track = scene.track(track, scene.frame(None, index))
        assert not track.seen
        assert track.lost_frames == index
    np.testing.assert_allclose(track.position_um, start, atol=5.0)
    near = scene.track(track, scene.frame(start + 60.0, 5))
    assert near.seen
    assert near.lost_frames == 0
    for index in range(6, 20):
        track = scene.track(track, scene.frame(None, index))
    again = scene.track(track, scene.frame(far, 21))
    assert again.seen
    np.testing.assert_allclose(again.position_um, far, atol=5.0)


def test_a_disc_that_is_followed_though_its_size_is_off_is_not_taken_for_a_robot_that_was_out_of_sight() -> None:
    scene, tracker = Scene(640), Tracker(acquire_score=0.85)
    place = np.array([500.0, 2780.0])
    followed = scene.track(None, scene.frame(place, debris=0))
    larger = scene.microscope.image([DrawnRobot(place, 1.2 * ROBOT.radius_um)], NO_DEBRIS)
    lost = replace(followed, seen=False, lost_frames=1)
    seen = [
        tracker.track(each, Frame(33_000_000, 1, larger), CHIP, scene.calibration, ROBOT) for each in (followed, lost)
    ]
    assert [each.seen for each in seen] == [True, False] and 0.55 < seen[0].score < 0.85


def test_once_locked_only_a_region_is_searched() -> None:
    scene = Scene(640)
    place = np.array([500.0, 2780.0])
    track = scene.track(scene.track(None, scene.frame(place)), scene.frame(place, 1))
    x0, y0, x1, y1 = track.roi_px
    assert (x1 - x0) * (y1 - y0) < 0.01 * 640 * 512


def test_the_same_message_and_frame_give_the_same_track() -> None:
    scene = Scene(640)
    place = np.array([500.0, 2780.0])
    first = scene.track(None, scene.frame(place))
    frame = scene.frame(place + 5.0, 1)
    assert scene.track(first, frame).same_as(Tracker().track(first, frame, CHIP, scene.calibration, ROBOT))
