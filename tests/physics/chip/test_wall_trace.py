"""One picture tells where a chip lies and where its walls are; pictures by another renderer than the microscope's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from flowrec.measure.wall_contours import WallContours
from flowrec.measure.wall_trace import as_pictured, trace_walls
from flowrec.physics import Calibration, ChipSettings, load_chip, with_wall_offset
from flowrec.physics.flow.level_set import from_mask
from flowrec.rigs.simulated.true_walls import true_walls
from flowrec.stages import load_config, registration_of, resolve
from tests.physics.chip.looks import LOOKS, picture

SIZE_PX = (640, 512)
BIFURCATION, STRAIGHT = (load_chip(ChipSettings(name)) for name in ("bifurcation", "straight"))
VESSELS = load_chip(ChipSettings("vessels", seed=3))
LOOK = pytest.mark.slow("traces a picture that differs in its looks only")


def levels(mask):
    """Signed distance of the pixel centres to the walls, in px."""
    return from_mask(mask, 2, "smooth").level[2::4, 2::4]


class Scene:
    """A chip whose walls are up to `error_px` off, with a blocked branch, in an image that is not as stated."""

    def __init__(
        self, chip, look, error_px, um_per_px=1.006, shift_um=(12.0, -9.0), angle_deg=0.25, mirror=False, finer=1
    ):
        rng, size_px = np.random.default_rng(7), (finer * SIZE_PX[0], finer * SIZE_PX[1])
        blocked = 0.35 if error_px else 0.0
        self.chip, self.true = chip, true_walls(chip, error_px, blocked, np.zeros((0, 2)), rng)[0]
        self.first_um = 0.5 * (self.true.um_per_px - chip.um_per_px)
        size_um = np.array(chip.size_um)
        scale_um, middle_um = 1.02 * float(max(size_um / size_px)), 0.5 * (size_um - chip.um_per_px)
        self.stated = Calibration.centre_on(scale_um, middle_um, size_px, 0.0, mirror)
        self.camera = Calibration.centre_on(um_per_px * scale_um, middle_um + shift_um, size_px, angle_deg, mirror)
        x_um, y_um = self.camera.origin_um
        of_true = replace(self.camera, origin_um=(x_um - self.first_um, y_um - self.first_um))
        self.image = picture(
            self.true.mask, self.true.um_per_px, of_true, size_px, LOOKS[look], np.random.default_rng(4)
        )

    def off_um(self, calibration):
        """Root mean square error of a registration over the channels."""
        places = np.argwhere(self.chip.mask)[::37, ::-1] * self.chip.um_per_px
        return float(np.sqrt(((calibration.to_um(self.camera.to_px(places)) - places) ** 2).sum(axis=1).mean()))

    def wall_errors_px(self, level_px, calibration):
        """Errors of the levels of pixels beside the true walls, where the camera sees them."""
        h, w = self.chip.mask.shape
        rows, columns = np.nonzero(np.abs(level_px) < 0.7)
        away = np.minimum.reduce([rows, columns, h - 1 - rows, w - 1 - columns]) > 3
        px = self.chip.um_per_px
        at_um = self.camera.to_um(calibration.to_px(np.stack((columns, rows), axis=-1) * px))
        at = (at_um - self.first_um) / self.true.um_per_px
        fine = levels(self.true.mask) * self.true.um_per_px / px
        true = map_coordinates(fine, at[:, ::-1].T, order=1, mode="nearest")
        near = away & (np.abs(true) < 0.6)
        return level_px[rows, columns][near] - true[near]


@pytest.mark.parametrize(
    ("chip", "look", "most_px"),
    [
        (BIFURCATION, "dirty", 0.25),
        pytest.param(BIFURCATION, "relief", 0.3, marks=LOOK),
        *(
            pytest.param(chip, look, 0.35, marks=LOOK)
            for chip in (BIFURCATION, VESSELS)
            for look in ("dark lines", "thin bright lines", "phase edges", "dye", "ink", "uneven", "noisy", "relief")
            if (chip, look) != (BIFURCATION, "relief")
        ),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_walls_that_are_off_the_mask_and_the_pose_are_found_whatever_walls_look_like(chip, look, most_px):
    scene = Scene(chip, look, 0.8)
    found = trace_walls(scene.image, chip, scene.stated)
    assert scene.off_um(scene.stated) > 14.0
    assert scene.off_um(found.calibration) < 4.0
    drawn = np.std(scene.wall_errors_px(levels(chip.mask), scene.stated))
    assert np.std(scene.wall_errors_px(found.level_px, found.calibration)) < min(most_px, 0.75 * drawn)


@pytest.mark.parametrize("offset_px", [-1.0, 1.0])
def test_a_mask_that_is_too_narrow_or_too_wide_everywhere_is_corrected(offset_px):
    scene = Scene(BIFURCATION, "ink", 0.0, um_per_px=1.0, shift_um=(0.0, 0.0), angle_deg=0.0)
    drawn = replace(with_wall_offset(BIFURCATION, offset_px), drawn=None, wall_offset_px=0.0)
    found = trace_walls(scene.image, drawn, scene.stated)
    beside = np.abs(levels(BIFURCATION.mask)) < 0.6
    beside[:4] = beside[-4:] = beside[:, :4] = beside[:, -4:] = False
    right, wrong = levels(BIFURCATION.mask), levels(drawn.mask)
    assert abs((wrong - right)[beside].mean()) > 0.6
    assert abs((found.level_px - right)[beside].mean()) < 0.15


@pytest.mark.parametrize("out_px", [-2.0, 1.0, 2.0])
def test_walls_that_move_change_no_pixel_that_they_do_not_reach(out_px):
    """Where channels meet at an acute angle, two walls that move apart from the fluid cross."""
    contours = WallContours.of(VESSELS)
    drawn, moved = (contours.levels(np.where(contours.inside, by, 0.0)) for by in (0.0, out_px))
    beyond = np.abs(drawn) > abs(out_px) + 1.0
    assert np.count_nonzero(beyond & VESSELS.mask) > 1_000
    np.testing.assert_array_equal(moved[beyond] > 0.0, VESSELS.mask[beyond])
    beside = np.abs(drawn) < 1.0
    assert abs(np.median((moved - drawn)[beside]) - out_px) < 0.05


def test_where_a_closed_wall_begins_changes_no_pixel():
    contours = WallContours.of(VESSELS)
    order = np.arange(len(contours.points))
    assert any(closed for _, closed in contours.walls)
    for which, closed in contours.walls:
        if closed:
            order[which] = np.roll(order[which], (which.stop - which.start) // 2)
    turned = contours._replace(**{name: getattr(contours, name)[order] for name in ("points", "inward", "inside")})
    for out_px in (-2.0, 2.0):
        once, again = (each.levels(np.where(each.inside, out_px, 0.0)) for each in (contours, turned))
        clear = np.abs(once) > 0.1
        np.testing.assert_array_equal(once[clear] > 0.0, again[clear] > 0.0)


def test_the_pose_in_a_mirror_image_is_found():
    scene = Scene(BIFURCATION, "dark lines", 0.0, mirror=True)
    assert scene.off_um(trace_walls(scene.image, BIFURCATION, scene.stated).calibration) < 1.5


def test_a_camera_of_six_times_the_resolution_of_the_mask_finds_the_pose_too():
    scene = Scene(BIFURCATION, "dark lines", 0.0, finer=3)
    assert scene.off_um(scene.stated) > 14.0
    assert scene.off_um(trace_walls(scene.image, BIFURCATION, scene.stated).calibration) < 1.5


def test_a_scale_that_is_three_percent_off_is_found():
    scene = Scene(BIFURCATION, "dark lines", 0.0, um_per_px=0.97)
    assert scene.off_um(trace_walls(scene.image, BIFURCATION, scene.stated).calibration) < 1.5


def test_along_a_straight_channel_the_chip_stays_where_it_is_stated():
    scene = Scene(STRAIGHT, "dark lines", 0.0, um_per_px=1.0, shift_um=(90.0, 9.0), angle_deg=0.0)
    found = trace_walls(scene.image, STRAIGHT, scene.stated).calibration
    middle = 0.5 * (np.array(SIZE_PX) - 1.0)
    along_um, across_um = found.to_um(middle) - scene.stated.to_um(middle)
    assert abs(along_um) < 1.0
    assert across_um == pytest.approx(9.0, abs=1.0)
    assert found.um_per_px == pytest.approx(scene.stated.um_per_px, rel=2e-3)


def drawn_chip(folder, curves, width_px):
    """A chip of channels along curves (n, 2) in px of a mask of 240 x 160."""
    mask = np.zeros((160, 240), np.uint8)
    for curve, width in zip(curves, width_px, strict=True):
        cv2.polylines(mask, [np.rint(16.0 * np.asarray(curve)).astype(np.int32)], False, 255, width, shift=4)
    cv2.imwrite(str(folder / "drawn.png"), mask)
    return load_chip(ChipSettings(path=str(folder / "drawn.png"), um_per_px=20.0))


def test_the_scale_of_straight_channels_from_one_junction_stays_as_stated(tmp_path):
    """Their walls lie alike in every scale; their widths alone tell it, and those of a mask are not exact."""
    ends = ((-10.0, 20.0), (-10.0, 140.0), (250.0, 90.0))
    chip = drawn_chip(tmp_path, [[(120.0, 80.0), end] for end in ends], (15, 10, 18))
    scene = Scene(chip, "dark lines", 0.8)
    found = trace_walls(scene.image, chip, scene.stated)
    assert found.walls_differ
    assert found.calibration.um_per_px == pytest.approx(scene.stated.um_per_px)
    assert scene.off_um(found.calibration) < scene.off_um(scene.stated)


@pytest.mark.parametrize(
    ("waves", "width_px"), [(3, 6), pytest.param(3, 4, marks=LOOK), pytest.param(5, 8, marks=LOOK)]
)
def test_light_from_one_side_does_not_move_a_meander_by_half_its_channel(tmp_path, waves, width_px):
    """Of relief, walls that face each other look alike half a channel aside of where they are."""
    x = np.linspace(-5.0, 245.0, 400)
    chip = drawn_chip(tmp_path, [np.column_stack((x, 80.0 + 66.0 * np.sin(2.0 * np.pi * waves * x / 240)))], [width_px])
    for error_px in (0.0, 0.8):
        scene = Scene(chip, "relief", error_px)
        found = trace_walls(scene.image, chip, scene.stated)
        assert found is None or scene.off_um(found.calibration) < 0.5 * scene.off_um(scene.stated)


def another_picture(shown):
    """A picture that does not show the bifurcation where it is stated."""
    noise = np.random.default_rng(0).normal(0.0, 1.0, SIZE_PX[::-1])
    if shown == "noise":
        return 128.0 + 20.0 * noise
    if shown == "blurred noise":
        smooth = map_coordinates(noise[::8, ::8], np.indices(SIZE_PX[::-1]) / 8.0, order=3, mode="nearest")
        return 128.0 + 40.0 * smooth
    if shown == "light from the left":
        return np.tile(np.linspace(60.0, 200.0, SIZE_PX[0]), (SIZE_PX[1], 1))
    if shown == "another chip":
        return Scene(VESSELS, "dark lines", 0.0).image
    right = Scene(BIFURCATION, "dark lines", 0.0).image
    hidden = np.where(np.arange(SIZE_PX[0]) < SIZE_PX[0] // 2, 128.0 + 8.0 * noise, right)
    return right[::-1] if shown == "upside down" else hidden


@pytest.mark.parametrize(
    "shown",
    [
        "half hidden",
        *(
            pytest.param(each, marks=LOOK)
            for each in ("another chip", "noise", "blurred noise", "light from the left", "upside down")
        ),
    ],
)
def test_a_picture_that_does_not_show_the_chip_changes_nothing(shown):
    config = resolve(load_config(None, []), BIFURCATION)
    image = another_picture(shown).clip(0.0, 255.0).astype(np.uint8)
    kept, chip, said = as_pictured(config, BIFURCATION, image)
    assert kept is config
    assert chip is BIFURCATION
    assert "does not show the walls" in said


def test_a_right_mask_stays_as_it_is_in_a_picture_out_of_focus_and_in_a_clear_one():
    config = resolve(load_config(None, []), BIFURCATION)
    camera = registration_of(config.camera, BIFURCATION)
    for look in ("out of focus", "noisy", "dark lines"):
        image = picture(BIFURCATION.mask, BIFURCATION.um_per_px, camera, SIZE_PX, LOOKS[look], np.random.default_rng(4))
        assert as_pictured(config, BIFURCATION, image)[1] is BIFURCATION


def test_a_goal_in_a_wall_of_the_picture_keeps_the_mask():
    scene = Scene(BIFURCATION, "dark lines", 0.8)
    config = resolve(load_config(None, []), BIFURCATION)
    x, y = np.argwhere((levels(BIFURCATION.mask) > 0.0) & (levels(scene.true.mask)[::2, ::2] < -0.5))[0][::-1]
    place = (float(x) * BIFURCATION.um_per_px, float(y) * BIFURCATION.um_per_px)
    blocked = replace(config, mission=replace(config.mission, goal=place))
    _, chip, said = as_pictured(blocked, BIFURCATION, scene.image)
    assert chip is BIFURCATION
    assert "goal" in said
