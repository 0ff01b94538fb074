"""The shift of an image against the walls of the chip: none where it rests or can not be seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import flowrec
from flowrec.core import Shift, Track
from flowrec.physics import Chip
from flowrec.stages import Tracker, load_config
from flowrec.stages.sight import Sight, look
from flowrec.stages.vision import Stabiliser, move_neighbours
from flowrec.stages.vision.walls import Walls
from tests.short_missions import SMALL
from tests.stages.vision.shaky import CALIBRATION, ROBOT, chip, frame, image

ON = Stabiliser(on=True)
SHAKE = [(2.0 * np.sin(0.63 * n + 0.4), 1.4 * np.cos(0.63 * n)) for n in range(12)]


def shifts(pictures: list[np.ndarray], on: Chip, bits: int = 8) -> list[Shift]:
    shift = background = None
    found = []
    for number, picture in enumerate(pictures):
        shift, background = ON.register(shift, background, None, frame(number, picture, bits), on, CALIBRATION, ROBOT)
        found.append(shift)
    return found


@pytest.mark.parametrize("bits", [8, 16])
def test_a_shake_is_measured_while_the_robot_passes_and_the_light_drifts(bits: int) -> None:
    on = chip()
    pictures = [
        image(on, [(30.0 + 6.0 * n, 80.0), (135.0, 5.0 + 8.0 * n)], shake, gain=1.0 - 0.03 * n, bits=bits, seed=n)
        for n, shake in enumerate(SHAKE)
    ]
    found = shifts(pictures, on, bits)
    off = np.array([each.shift_px for each in found]) - (np.array(SHAKE) - SHAKE[0])
    assert np.abs(off).max() < 0.12
    assert all(each.found for each in found)


def test_a_still_image_has_no_shift_at_all_whatever_moves_in_the_channel() -> None:
    on = chip()
    pictures = [image(on, [(30.0 + 6.0 * n, 93.0), (90.0 + 5.0 * n, 66.0)], seed=n) for n in range(20)]
    assert {tuple(each.shift_px.tolist()) for each in shifts(pictures, on)} == {(0.0, 0.0)}


def test_a_shift_is_measured_across_a_straight_channel_and_never_along_it() -> None:
    on = chip(bend=False)
    found = shifts([image(on, [(100.0, 80.0)], shake, seed=n) for n, shake in enumerate(SHAKE)], on)
    off = np.array([each.shift_px for each in found]) - (np.array(SHAKE) - SHAKE[0])
    assert np.abs(off[:, 1]).max() < 0.3  # the walls lie along the pixels, so all of them err together
    assert not any(each.shift_px[0] for each in found)


def test_without_a_wall_in_the_image_nothing_is_invented_from_what_drifts() -> None:
    on = chip()
    pictures = [image(None, [(20.0 * k + 2.0 * n, 72.0 + 2.0 * k) for k in range(9)], seed=n) for n in range(6)]
    assert {tuple(each.shift_px.tolist()) for each in shifts(pictures, on)} == {(0.0, 0.0)}


def test_an_image_that_shows_something_else_keeps_the_shift_before_and_says_so() -> None:
    on = chip()
    pictures = [image(on, [(60.0, 80.0)], (2.0 * (n > 0), 0.0), seed=n) for n in range(3)]
    pictures.insert(2, np.random.default_rng(9).integers(0, 255, pictures[0].shape).astype(np.uint8))
    found = shifts(pictures, on)
    assert [each.found for each in found] == [True, True, False, True]
    assert np.allclose([each.shift_px[0] for each in found], [0.0, 2.0, 2.0, 2.0], atol=0.12)


def test_the_pixels_around_the_robot_are_not_used_where_the_shaken_image_shows_it() -> None:
    on, swift = chip(), np.array([9.0, 6.0])
    robot = replace(ROBOT, radius_um=64.0)  # 16 px: it hides a large part of the walls that the image shows
    at_px = np.array([135.0, 60.0])
    track = Track(0, True, CALIBRATION.to_um(at_px), 0.9, 0, 5.0, np.zeros(4))
    _, background = ON.register(None, None, track, frame(0, image(on, [], seed=1)), on, CALIBRATION, robot)
    shaken = image(on, [], tuple(swift), seed=2)
    row, column = np.mgrid[: shaken.shape[0], : shaken.shape[1]]
    hidden = np.hypot(column - (at_px + swift)[0], row - (at_px + swift)[1]) < 32.0
    shaken[hidden] = np.random.default_rng(3).integers(0, 255, np.count_nonzero(hidden))
    # The image before was shifted as much, more than a second ago: how alike this one is, is stated anew.
    before = Shift(0, swift, found=True, alike=0.5)
    shift, _ = ON.register(before, background, track, frame(40, shaken), on, CALIBRATION, robot)
    assert shift is not None and np.abs(shift.shift_px - swift).max() < 0.2
    assert shift.found and shift.alike > 0.8


def test_the_box_of_the_fluid_moves_with_the_image_along_each_axis_by_its_own_shift() -> None:
    walls = Walls(np.zeros((100, 300), np.float32), (20, 10, 290, 90))
    assert walls.for_shift((5.0, -3.0)).box == (25, 7, 295, 87)
    assert walls.for_shift((40.0, 20.0)).box == (60, 30, 300, 100)  # as far as the image goes


def test_the_distance_to_the_walls_moves_with_the_image_along_each_axis_by_its_own_shift() -> None:
    row, column = np.mgrid[:40, :60].astype(np.float32)
    walls = Walls(column + np.float32(100.0) * row, (0, 0, 60, 40))
    moved = walls.for_shift((5.0, -3.0)).distance_px
    np.testing.assert_allclose(moved[10:30, 10:50], walls.distance_px[13:33, 5:45], atol=1e-3)


def test_a_shift_beyond_what_the_stage_can_make_is_not_believed() -> None:
    on = chip()
    still, near, far = (image(on, [], shift, seed=n) for n, shift in enumerate([(0.0, 0.0), (3.0, 0.0), (6.0, 0.0)]))
    for reach_px, there in ((4.0, False), (8.0, True)):
        stage = replace(ON, reach_px=reach_px)
        shift = background = None
        for number, picture in enumerate((still, near, far)):
            shift, background = stage.register(shift, background, None, frame(number, picture), on, CALIBRATION, ROBOT)
        assert shift is not None and shift.found is there
        assert shift.shift_px[0] == pytest.approx(6.0 if there else 3.0, abs=0.2)


def test_the_track_on_a_shaking_stage_is_that_of_the_chip() -> None:
    on, tracker = chip(), Tracker(polarity="auto", click_px=(40.0, 80.0))
    track = appearance = shift = background = None
    off = []
    for n, shake in enumerate(SHAKE):
        at = (40.0 + 1.5 * n, 80.0)
        relative = np.array(shake) - SHAKE[0]
        # A second body beside it: its place in the image before is one of the neighbours, which are kept in pixels.
        seen = frame(n, image(on, [at, (at[0], 92.0)], tuple(relative), seed=n))
        before = shift
        shift, background = ON.register(shift, background, track, seen, on, CALIBRATION, ROBOT)
        known = track if track is None or before is None else move_neighbours(track, shift.shift_px - before.shift_px)
        track, appearance = tracker.follow(
            known, appearance, seen, on, CALIBRATION, ROBOT, tuple(shift.shift_px.tolist())
        )
        assert track.seen
        off.append(np.hypot(*(CALIBRATION.to_px(track.position_um) - at)))
    assert max(off) < 0.35


@pytest.mark.slow("flies a mission on a shaking stage")
def test_a_simulated_mission_on_a_shaking_stage_has_the_track_of_one_that_rests(tmp_path: Path) -> None:
    shakes = [*SMALL, "simulated.shake_um=40", "simulated.shake_hz=2", "mission.phases=['survey']", "duration_s=2"]
    sway_px = {}
    for on in ("true", "false"):
        out = tmp_path / f"{on}.mcap"
        flowrec.record(load_config(None, [*shakes, f"stabilise.on={on}"]), out)
        session = flowrec.open(out)
        off_um = [
            tick.track.position_um - tick.truth.position_um
            for tick in session.ticks(with_frames=False)
            if tick.track is not None and tick.track.seen and tick.truth is not None
        ]
        sway_px[on] = float(np.std(off_um, axis=0).max()) / session.config.camera.um_per_px
    # The first image is the reference, so all lie off by as much as that one: only the sway is taken out.
    assert sway_px["true"] < 0.1 < 1.0 < sway_px["false"]
    assert flowrec.replay(tmp_path / "true.mcap", verify=True).same


def test_the_neighbours_of_the_image_before_are_moved_by_what_the_image_moved_since():
    before, now = (Shift(n, np.array(px), found=True, alike=1.0) for n, px in enumerate(([5.0, -2.0], [6.5, -1.0])))
    neighbours = np.array([100.0, 50.0, 8.0, 30.0, 40.0, 9.0])
    track = Track(0, True, np.zeros(2), 0.9, 0, 5.0, np.zeros(4), neighbours_px=neighbours)
    given = []
    scene = SimpleNamespace(
        stabiliser=SimpleNamespace(register=lambda *_: (now, None)),
        tracker=SimpleNamespace(count=1, tracers=False, follow=lambda *all_: given.extend(all_) or (track, None)),
        **dict.fromkeys(("chip", "calibration", "robot", "mission")),
    )
    look(scene, Sight(track=track, shift=before), None)
    assert given[0].neighbours_px.tolist() == [101.5, 51.0, 8.0, 31.5, 41.0, 9.0]
    assert tuple(given[-1]) == (6.5, -1.0)
