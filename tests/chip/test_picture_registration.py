"""One picture tells how the chip lies in it; pictures by another renderer than the simulated microscope."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from flowrec.chip import ChipSettings, load_chip, wall_fit
from flowrec.chip.clearance import median_width_um
from flowrec.chip.picture_registration import overlay, register
from flowrec.chip.registration import Calibration
from flowrec.chip.wall_fit import Fitter, WallMap
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


def fitted(image, start, chip=VESSELS):
    reach_um = max(0.6 * median_width_um(chip), 6.0 * 13.4)
    return Fitter(image.astype(np.float32), WallMap(chip.mask, chip.um_per_px), reach_um, 13.4).fit(start)


def test_walls_that_grey_levels_and_local_contrast_put_in_different_places_are_refused():
    """Broad lines, bright on one side of the channels: grey levels alone agree best 117 um beside the truth."""
    truth, _ = seen("relief", 37.0, shift_um=(300.0, -200.0))
    broad = replace(LOOKS["relief"], line_um=60.0)
    image = picture(VESSELS.mask, VESSELS.um_per_px, truth, SIZE_PX, broad, np.random.default_rng(4))
    fit = fitted(image, truth)
    assert fit.found > 0.7  # part of the walls alone does not tell
    assert np.hypot(*fit.apart[:2]) > 50.0
    assert (fit.std >= fit.apart).all()
    with pytest.raises(ChipError, match="put vessels-3 in different places"):
        register(image, VESSELS, ABOUT, (False,))


def test_the_residual_is_how_far_the_walls_are_from_the_mask():
    truth, image = seen("dark lines", 0.0)
    assert 0.0 < fitted(image, truth).residual_um < 2.0
    wider = replace(VESSELS, mask=cv2.resize(VESSELS.mask.astype(np.uint8), None, fx=1.02, fy=1.0) > 0)
    assert 4.0 < fitted(image, truth, wider).residual_um < 40.0


def test_where_the_walls_are_found_does_not_depend_on_the_size_at_which_the_picture_is_fitted(monkeypatch):
    truth, image = seen("dark lines", 20.0)
    monkeypatch.setattr(wall_fit, "_LONGEST_PX", 200)
    off_um = fitted(image, truth).calibration.to_um((239.5, 191.5)) - truth.to_um((239.5, 191.5))
    assert np.hypot(*off_um) < 2.0


def test_the_overlay_is_drawn_on_the_walls():
    calibration = Calibration(13.4, (-400.0, 5200.0), 37.0, True)
    drawn = overlay(np.full(SIZE_PX[::-1], 90, np.uint8), VESSELS, calibration).astype(int)
    rows, columns = np.nonzero(drawn[..., 2] - drawn[..., 0] > 120)
    distance, _, inside = WallMap(VESSELS.mask, VESSELS.um_per_px).at(calibration.to_um(np.stack((columns, rows), -1)))
    assert len(rows) > 500
    assert inside.mean() > 0.95
    assert np.percentile(np.abs(distance[inside]), 95) < 30.0


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
