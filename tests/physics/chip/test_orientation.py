"""The eight orientations, and what a picture says about them."""

import numpy as np
import pytest

from flowrec.measure import orientation_by_image
from flowrec.physics import AS_STATED, ORIENTATIONS, Calibration, ChipSettings, load_chip, nearest
from flowrec.rigs.simulated.microscope import Microscope
from flowrec.stages import ResolvedCamera, SimulatedImage

SIZE_PX = (320, 256)
MIDDLE_PX = (159.5, 127.5)


def pictured(chip, true):
    camera = ResolvedCamera(width_px=SIZE_PX[0], height_px=SIZE_PX[1], rate_hz=30.0, um_per_px=true.um_per_px)
    microscope = Microscope(chip.mask, chip.um_per_px, true, camera, SimulatedImage(), 1, "disc", (0.0, 0.0))
    return microscope.image(())


def stated(chip, angle_deg=0.0, mirror=False):
    um_per_px = chip.size_um[1] / SIZE_PX[1]
    return Calibration.centre_on(um_per_px, np.array(chip.size_um) / 2, SIZE_PX, angle_deg, mirror)


@pytest.fixture(scope="module")
def junction():
    return load_chip(ChipSettings(path="sessions/chips/y_junction.png"))


@pytest.fixture(scope="module")
def symmetric():
    return load_chip(ChipSettings(name="bifurcation"))


@pytest.mark.parametrize(("angle_deg", "mirror"), [(0.0, False), (30.0, True)])
@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=lambda each: each.name)
def test_the_settings_of_an_orientation_state_what_the_image_shows(orientation, angle_deg, mirror):
    before = Calibration(2.0, (0.0, 0.0), angle_deg, mirror)
    after = orientation.about(before, MIDDLE_PX)
    np.testing.assert_allclose(after.to_um(MIDDLE_PX), before.to_um(MIDDLE_PX), atol=1e-9)
    arrow_um = np.array((3.0, 1.0))
    np.testing.assert_allclose(
        after.vectors_to_px(arrow_um), orientation.matrix @ before.vectors_to_px(arrow_um), atol=1e-9
    )
    assert nearest(0.7 * orientation.matrix) == orientation


def test_mirrored_left_to_right_reverses_x_alone():
    one = next(each for each in ORIENTATIONS if each.name == "mirrored left to right")
    np.testing.assert_allclose(one.matrix @ (3.0, 1.0), (-3.0, 1.0), atol=1e-12)
    right = next(each for each in ORIENTATIONS if each.name == "turned by 90 degrees to the right")
    np.testing.assert_allclose(right.matrix @ (1.0, 0.0), (0.0, 1.0), atol=1e-12)  # y is down


@pytest.mark.parametrize(
    "orientation",
    [AS_STATED, pytest.param(ORIENTATIONS[1], marks=pytest.mark.slow("another orientation")), ORIENTATIONS[6]],
    ids=lambda each: each.name,
)
def test_a_picture_in_another_orientation_is_contradicted_with_the_settings_that_make_it_right(junction, orientation):
    said = orientation_by_image(
        pictured(junction, orientation.about(stated(junction), MIDDLE_PX)), junction, stated(junction)
    )
    if orientation == AS_STATED:
        assert said.decided and not said.contradiction
        return
    assert not said.decided and orientation.name in said.contradiction
    seen = orientation.seen_by(stated(junction))
    assert f"camera.mirror = {str(seen.mirror).lower()}, camera.angle_deg = {seen.angle_deg:g}" in said.contradiction


def test_a_chip_that_looks_the_same_mirrored_is_undecided_by_its_image(symmetric):
    for orientation in (AS_STATED, next(each for each in ORIENTATIONS if each.name == "mirrored left to right")):
        said = orientation_by_image(
            pictured(symmetric, orientation.about(stated(symmetric), MIDDLE_PX)), symmetric, stated(symmetric)
        )
        assert not said.contradiction and not said.decided
        assert "mirrored left to right" in said.text


@pytest.mark.parametrize(
    ("growth", "refused"), [(0.7, True), (0.9, False), pytest.param(1.1, False, marks=pytest.mark.slow("another size"))]
)
def test_a_scale_off_by_more_than_a_fifth_is_contradicted(symmetric, growth, refused):
    true = AS_STATED.about(stated(symmetric), MIDDLE_PX, growth)
    said = orientation_by_image(pictured(symmetric, true), symmetric, stated(symmetric))
    assert bool(said.contradiction) == refused
    if refused:
        value = float(said.contradiction.partition("camera.um_per_px = ")[2])
        assert value == pytest.approx(true.um_per_px, rel=0.02)


def test_a_picture_without_walls_decides_nothing(junction):
    noise = np.random.default_rng(1).normal(120.0, 12.0, SIZE_PX[::-1]).astype(np.uint8)
    for picture in (noise, np.full(SIZE_PX[::-1], 90, np.uint8)):
        said = orientation_by_image(picture, junction, stated(junction))
        assert not said.decided and not said.contradiction and not said.alike
