"""One picture tells how the chip lies in it; pictures by another renderer than the simulated microscope."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flowrec.core import ChipError
from flowrec.measure import orientation_by_image, wall_fit
from flowrec.measure.picture_registration import fit_nearby, other_scale, overlay, register
from flowrec.measure.wall_fit import Fitter
from flowrec.measure.wall_search import Pose, WallMap
from flowrec.physics import Calibration, ChipSettings, load_chip, median_width_um
from tests.physics.chip.looks import LOOKS, picture

VESSELS = load_chip(ChipSettings("vessels", seed=3))
SIZE_PX = (480, 384)
ABOUT = (13.2, 13.9)  # um per pixel
LOOK = pytest.mark.slow("registers a picture that differs in its looks and pose only")


def seen(look, angle_deg, mirror=False, shift_um=(0.0, 0.0), um_per_px=13.4, chip=VESSELS):
    centre_um = np.array(chip.size_um) / 2 - 10.0 + shift_um
    truth = Calibration.centre_on(um_per_px, centre_um, SIZE_PX, angle_deg, mirror)
    return truth, picture(chip.mask, chip.um_per_px, truth, SIZE_PX, LOOKS[look], np.random.default_rng(4))


@pytest.mark.parametrize(
    ("look", "angle_deg", "mirror", "um_per_px"),
    [
        ("dye", -131.0, True, 13.8),
        pytest.param("uneven", 90.0, True, 13.4, marks=LOOK),
        pytest.param("relief", 55.0, False, 13.4, marks=LOOK),
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


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (-0.05, True),
        *(pytest.param(share, told, marks=LOOK) for share, told in ((0.01, False), (0.05, True), (0.0, False))),
    ],
)
def test_a_scale_that_the_walls_contradict_is_told_and_measured_and_a_right_one_is_not(share, told):
    truth, image = seen("dark lines", 12.0)
    middle_px = (np.array(SIZE_PX) - 1) / 2
    stated = Calibration.centre_on(
        13.4 * (1.0 + share), truth.to_um(middle_px) + np.array([20.0, -15.0]), SIZE_PX, 12.2
    )
    fit = fit_nearby(image, VESSELS, stated)
    um_per_px = other_scale(fit, stated)
    assert (um_per_px is not None) == told
    if told:
        assert um_per_px == pytest.approx(13.4, rel=2e-3)
    assert other_scale(fit._replace(std=np.full(4, 0.1)), stated) is None  # where the picture does not determine it


@pytest.fixture
def searched(monkeypatch):
    """A search that finds one given pose only: of what is judged after it, one fit instead of a dozen."""

    def finds(pose):
        found = SimpleNamespace(candidates=lambda *_: [Pose(pose, 1.0)])
        monkeypatch.setattr("flowrec.measure.picture_registration.WallSearch", lambda *_: found)

    return finds


@pytest.mark.slow("searches two pictures for every angle")
def test_walls_that_grey_levels_and_local_contrast_put_in_different_places_are_refused(searched):
    """Broad lines, bright on one side of the channels: grey levels alone agree best 117 um beside the truth."""
    truth, _ = seen("relief", 37.0, shift_um=(300.0, -200.0))
    broad = replace(LOOKS["relief"], line_um=60.0)
    image = picture(VESSELS.mask, VESSELS.um_per_px, truth, SIZE_PX, broad, np.random.default_rng(4))
    fit = fitted(image, truth)
    assert fit.found > 0.7  # part of the walls alone does not tell
    assert np.hypot(*fit.apart[:2]) > 50.0
    assert (fit.std >= fit.apart).all()
    searched(truth)
    with pytest.raises(ChipError, match="vessels-3"):
        register(image, VESSELS, ABOUT, (False,))


@pytest.mark.slow("registers a picture several times")
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


@pytest.mark.slow("searches a picture for every angle")
def test_a_symmetric_chip_has_two_poses_and_none_is_chosen():
    chip = load_chip(ChipSettings("bifurcation"))
    _, image = seen("dark lines", 10.0, chip=chip)
    fits = register(image, chip, ABOUT)
    assert sorted(fit.calibration.mirror for fit in fits) == [False, True]
    assert abs(fits[0].explained - fits[1].explained) < 0.01


@pytest.mark.slow("searches a picture along a channel")
def test_a_straight_channel_does_not_tell_where_along_it_the_image_is(monkeypatch):
    monkeypatch.setattr("flowrec.measure.picture_registration._CANDIDATES", 2)  # of a dozen that are all alike
    chip = load_chip(ChipSettings("straight"))
    _, image = seen("dark lines", 5.0, chip=chip)
    with pytest.raises(ChipError, match="along x"):
        register(image, chip, ABOUT, (False,))


@pytest.mark.slow("registers pictures of other things")
def test_other_pictures_are_refused(monkeypatch):
    monkeypatch.setattr("flowrec.measure.picture_registration._FIRST", 1)  # the first candidate tells as much as three
    _, image = seen("dark lines", 5.0, chip=load_chip(ChipSettings("vessels", seed=5)))
    noise = np.random.default_rng(0).integers(0, 255, SIZE_PX[::-1]).astype(np.uint8)
    for other in (image, noise):
        with pytest.raises(ChipError, match="vessels-3"):
            register(other, VESSELS, ABOUT, (False,))
    with pytest.raises(ChipError, match="is blank"):
        register(np.full(SIZE_PX[::-1], 200, np.uint8), VESSELS, ABOUT)


def test_a_field_without_a_channel_has_no_walls_to_compare_though_the_image_is_dark_at_its_border():
    mask = np.ones((96, 128), bool)
    mask[[0, -1]] = False
    image = np.full(mask.shape, 180, np.uint8)
    image[[0, 1, -2, -1]] = 60
    chip = replace(VESSELS, mask=mask, openings=(), um_per_px=2.0)
    assert fit_nearby(image, chip, Calibration(2.0, (0.0, 0.0), 0.0)) is None
    assert orientation_by_image(image, chip, Calibration(2.0, (0.0, 0.0), 0.0)).alike == ()
