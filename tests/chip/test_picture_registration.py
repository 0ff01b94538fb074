"""One picture tells how the chip lies in it; pictures by another renderer than the simulated microscope."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.chip import ChipSettings, load_chip
from flowrec.chip.picture_registration import register
from flowrec.chip.registration import Calibration
from flowrec.errors import ChipError
from tests.chip.looks import LOOKS, picture

VESSELS = load_chip(ChipSettings("vessels", seed=3))
SIZE_PX = (480, 384)
ABOUT = (13.2, 13.9)  # um per pixel


def seen(look, angle_deg, mirror=False, shift_um=(0.0, 0.0), um_per_px=13.4, chip=VESSELS):
    centre_um = np.array(chip.size_um) / 2 - 10.0 + shift_um
    truth = Calibration.centred(um_per_px, centre_um, SIZE_PX, angle_deg, mirror)
    return truth, picture(chip.mask, chip.um_per_px, truth, SIZE_PX, LOOKS[look], np.random.default_rng(4))


@pytest.mark.parametrize(
    ("look", "angle_deg", "mirror", "um_per_px"),
    [
        ("uneven", 90.0, True, 13.4),
        ("dye", -131.0, True, 13.8),
        ("relief", 55.0, False, 13.4),
    ],
)
def test_the_pose_is_found_whatever_the_walls_look_like(look, angle_deg, mirror, um_per_px):
    truth, image = seen(look, angle_deg, mirror, (300.0, -200.0), um_per_px)
    (fit,) = register(image, VESSELS, ABOUT, (mirror,) if look == "relief" else (False, True))
    found = fit.calibration
    assert abs((found.angle_deg - angle_deg + 180.0) % 360.0 - 180.0) < 0.05
    assert abs(found.um_per_px / um_per_px - 1.0) < 1e-3
    middle = (np.array(SIZE_PX) - 1) / 2
    off_um = found.to_um(middle) - truth.to_um(middle)
    assert np.hypot(*off_um) < 3.0
    assert fit.found > 0.9
    assert np.all(np.abs(off_um) < 6.0 * fit.std[:2] + 1.0)  # standard errors do not promise too much


def test_a_pose_that_one_reading_of_the_picture_finds_and_the_other_does_not_is_refused():
    """Broad lines, bright on one side of the channels: grey levels alone agree best 117 um beside the truth."""
    truth = Calibration.centred(13.4, np.array(VESSELS.size_um) / 2 + (290.0, -210.0), SIZE_PX, 37.0)
    broad = replace(LOOKS["relief"], line_um=60.0)
    image = picture(VESSELS.mask, VESSELS.um_per_px, truth, SIZE_PX, broad, np.random.default_rng(4))
    with pytest.raises(ChipError, match="in different places|does not show"):
        register(image, VESSELS, ABOUT, (False,))


def test_a_symmetric_chip_has_two_poses_and_none_is_chosen():
    chip = load_chip(ChipSettings("bifurcation"))
    _, image = seen("dark lines", 10.0, chip=chip)
    fits = register(image, chip, ABOUT)
    assert sorted(fit.calibration.mirror for fit in fits) == [False, True]
    assert abs(fits[0].explained - fits[1].explained) < 0.01


def test_a_straight_channel_does_not_tell_where_along_it_the_image_is():
    chip = load_chip(ChipSettings("straight"))
    _, image = seen("dark lines", 5.0, chip=chip)
    with pytest.raises(ChipError, match="do not determine the shift along x"):
        register(image, chip, ABOUT, (False,))


def test_other_pictures_are_refused():
    _, image = seen("dark lines", 5.0, chip=load_chip(ChipSettings("vessels", seed=5)))
    noise = np.random.default_rng(0).integers(0, 255, SIZE_PX[::-1]).astype(np.uint8)
    for other in (image, noise):
        with pytest.raises(ChipError, match="does not show the chip vessels-3"):
            register(other, VESSELS, ABOUT, (False,))
    with pytest.raises(ChipError, match="is blank"):
        register(np.full(SIZE_PX[::-1], 200, np.uint8), VESSELS, ABOUT)
