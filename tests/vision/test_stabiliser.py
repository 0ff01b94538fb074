"""The shift of an image against the walls of the chip: none where it rests or can not be seen."""

from __future__ import annotations

import numpy as np
import pytest

from flowrec.chip.chip import Chip
from flowrec.messages import Shift
from flowrec.vision import Stabiliser, Tracker, carried
from tests.vision.shaky import CALIBRATION, ROBOT, chip, frame, image

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
        known = track if track is None or before is None else carried(track, shift.shift_px - before.shift_px)
        track, appearance = tracker.follow(
            known, appearance, seen, on, CALIBRATION, ROBOT, tuple(shift.shift_px.tolist())
        )
        assert track.seen
        off.append(np.hypot(*(CALIBRATION.to_px(track.position_um) - at)))
    assert max(off) < 0.35
