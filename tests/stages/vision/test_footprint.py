"""What a tracker does not read can not matter: the basis of images that are cut to a window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.stages.vision.disc_fit import block_means, initial_edge_px
from flowrec.stages.vision.masked_ncc import _weighted_blocks, masked_ncc, template
from tests.stages.vision.test_tracker import CHIP, ROBOT, TRACKER, Scene

WIDTHS = (160, 640, 1280, 2448)


class Watched:
    """An image that remembers how far out it was read."""

    def __init__(self, height: int, width: int) -> None:
        self.shape = (height, width)
        self.read = [1 << 30, 1 << 30, -1, -1]

    def __getitem__(self, place: tuple[int, int]) -> int:
        y, x = place
        self.read = [min(self.read[0], x), min(self.read[1], y), max(self.read[2], x + 1), max(self.read[3], y + 1)]
        return 0


@pytest.mark.parametrize("width_px", WIDTHS)
def test_no_pixel_is_read_beyond_the_footprint_and_some_are_at_its_end(
    width_px: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flowrec.stages.vision.masked_ncc._weighted_blocks", _weighted_blocks.py_func)
    scene = Scene(width_px)
    footprint = TRACKER.footprint(CHIP, scene.calibration, ROBOT, (round(0.8 * width_px), width_px))
    nominal = ROBOT.radius_um / scene.um_per_px
    step, largest = max(1, int(nominal / 2.5)), 1.35 * nominal
    open_water = np.full((400, 400), 1e3, np.float32)
    farthest = 0
    for right, bottom in ((201, 201), (202 + step, 201 + step)):
        box = (200, 200, right, bottom)
        seen = Watched(400, 400)
        masked_ncc(seen, open_water, box, step, 1.0, 0.7 * nominal, template(nominal, step))
        middle = 0.5 * (step - 1)
        for x in (200 + middle, 200 + middle + step * ((right - 200 + step - 1) // step - 1)):
            for y in (200 + middle, 200 + middle + step * ((bottom - 200 + step - 1) // step - 1)):
                reach = 1.25 * largest + 3.5 * initial_edge_px(largest)
                block_means.py_func(seen, open_water, 1.0, x, y, reach, max(1, int(nominal / 6.0)))
        out = (box[0] - seen.read[0], box[1] - seen.read[1], seen.read[2] - box[2], seen.read[3] - box[3])
        assert max(out) <= footprint.pad_px
        farthest = max(farthest, *out)
    assert farthest >= footprint.pad_px - 2


@pytest.mark.parametrize("width_px", [320, 640])
def test_another_world_outside_of_the_footprint_changes_nothing_of_a_track(width_px: int) -> None:
    scene, rng = Scene(width_px), np.random.default_rng(5)
    footprint = TRACKER.footprint(CHIP, scene.calibration, ROBOT, (round(0.8 * width_px), width_px))
    found = scene.track(None, scene.frame(scene.places(1, ROBOT.radius_um + 5.0)[0]))
    assert tuple(found.roi_px) == footprint.everywhere_px
    near = 0
    for place in scene.places(25, ROBOT.radius_um + 5.0):
        before = scene.track(None, scene.frame(place))
        frame = scene.frame(place + rng.uniform(-40.0, 40.0, 2), 1, debris=80)
        lost = replace(before, seen=False, lost_frames=int(rng.integers(1, 10)))
        for previous in (before, lost):
            track = scene.track(previous, frame)
            x0, y0, x1, y1 = (int(v) for v in track.roi_px)
            pad = footprint.pad_px
            kept = slice(max(y0 - pad, 0), y1 + pad), slice(max(x0 - pad, 0), x1 + pad)
            for outside in (np.zeros_like(frame.image), rng.integers(0, 256, frame.image.shape).astype(np.uint8)):
                outside[kept] = frame.image[kept]
                assert scene.track(previous, replace(frame, image=outside)).same_as(track)
                near += track.seen
    assert near > 50
