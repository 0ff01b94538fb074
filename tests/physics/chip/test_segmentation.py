"""The channel in a picture; pictures by another renderer than the simulated microscope."""

import numpy as np
import pytest

from flowrec.core import ChipError
from flowrec.measure.segmentation import chip_mask, iou, segment
from flowrec.physics import Calibration, ChipSettings, find_openings, load_chip
from tests.physics.chip.looks import LOOKS, picture

VESSELS = load_chip(ChipSettings("vessels", seed=3))
SIZE_PX = (320, 256)  # pixel on pixel of the chip


def seen(look):
    camera = Calibration.centre_on(20.0, np.array(VESSELS.size_um) / 2 - 10.0, SIZE_PX, 0.0, False)
    return picture(VESSELS.mask, 20.0, camera, SIZE_PX, LOOKS[look], np.random.default_rng(4))


@pytest.mark.parametrize(
    ("look", "shown"),
    [
        ("dark lines", "dark"),
        pytest.param("ink", "step", marks=pytest.mark.slow("segments a picture of another look")),
        pytest.param("thin bright lines", "bright", marks=pytest.mark.slow("segments a picture of another look")),
    ],
)
def test_channel_and_openings_are_found_whether_walls_or_fluid_show(look, shown):
    found = segment(seen(look))
    mask, um_per_px = chip_mask(found, 20.0)
    assert (found.shown, mask.shape, um_per_px) == (shown, VESSELS.mask.shape, 20.0)
    assert iou(mask, VESSELS.mask) > 0.93
    openings = find_openings(mask)
    assert [o.side for o in openings] == [o.side for o in VESSELS.openings]
    for o, wanted in zip(openings, VESSELS.openings, strict=True):
        assert abs(o.first - wanted.first) <= 1 and abs(o.last - wanted.last) <= 1


@pytest.mark.slow("segments a picture twice more")
def test_a_point_says_which_side_of_the_walls_is_the_channel():
    image = seen("dark lines")
    row, column = np.argwhere(VESSELS.mask)[500]
    inside = segment(image, "dark", [(column, row)]).outline.mask()
    assert iou(inside, VESSELS.mask) > 0.93
    for seeds_px in ([(3.0, 3.0), (column, row)], [(400.0, 3.0)]):  # on both sides of a wall; outside of the picture
        with pytest.raises(ChipError):
            segment(image, "dark", seeds_px)


@pytest.mark.slow("segments pictures of other things")
def test_pictures_without_a_channel_are_refused():
    noise = np.random.default_rng(0).normal(120, 20, SIZE_PX[::-1]).clip(0, 255).astype(np.uint8)
    for image, why in ((noise, "no channel is seen"), (np.full(SIZE_PX[::-1], 200, np.uint8), "is blank")):
        with pytest.raises(ChipError, match=why):
            segment(image)


@pytest.mark.slow("segments a picture of a thin wall")
def test_a_wall_that_may_close_a_branch_makes_the_picture_unsure():
    """Dirt across a channel closes it at one threshold and not at another: a flow there would be a guess."""
    image = seen("noisy")
    with pytest.raises(ChipError):
        segment(image)
