"""Camera pixels to chip coordinates and back, for a camera that is turned, mirrored and shifted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowrec.physics import Calibration

ANY = st.builds(
    Calibration,
    st.floats(0.05, 50.0),
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
    st.floats(-360.0, 360.0),
    st.booleans(),
)
POINTS = st.lists(st.tuples(st.floats(-5e3, 5e3), st.floats(-5e3, 5e3)), min_size=1, max_size=4).map(np.array)


@given(ANY, POINTS)
def test_to_px_is_the_inverse_of_to_um(calibration, points):
    np.testing.assert_allclose(calibration.to_px(calibration.to_um(points)), points, atol=1e-6)


@given(ANY, POINTS)
def test_the_matrix_and_the_scale_say_the_same_as_to_um(calibration, points):
    there = calibration.to_um(points)
    np.testing.assert_allclose(np.column_stack((points, np.ones(len(points)))) @ calibration.matrix.T, there, atol=1e-6)
    lengths = np.hypot(*np.diff(there, axis=0).T), np.hypot(*np.diff(points, axis=0).T)
    np.testing.assert_allclose(lengths[0], calibration.um_per_px * lengths[1], rtol=1e-9, atol=1e-6)
    moves = calibration.vectors_to_px(there - there[0])
    np.testing.assert_allclose(moves, points - points[0], atol=1e-6)
    assert np.sign(np.linalg.det(calibration.matrix[:, :2])) == (-1 if calibration.mirror else 1)


@given(ANY)
def test_a_centred_image_has_the_given_point_in_its_middle(calibration):
    turned = Calibration.centre_on(
        calibration.um_per_px, (300.0, -20.0), (641, 400), calibration.angle_deg, calibration.mirror
    )
    np.testing.assert_allclose(turned.to_um((320.0, 199.5)), (300.0, -20.0), atol=1e-6)


@pytest.mark.parametrize(
    ("angle_deg", "mirror", "right", "down"),
    [
        (0.0, False, (1, 0), (0, 1)),
        (90.0, False, (0, -1), (1, 0)),
        (-90.0, False, (0, 1), (-1, 0)),
        (180.0, False, (-1, 0), (0, -1)),
        (0.0, True, (1, 0), (0, -1)),
        (90.0, True, (0, 1), (1, 0)),
    ],
)
def test_right_angles_are_exact(angle_deg, mirror, right, down):
    """`right`, `down`: where one pixel to the right and one down lie on the chip."""
    calibration = Calibration(2.0, (0.0, 0.0), angle_deg, mirror)
    assert calibration.to_um([(1.0, 0.0), (0.0, 1.0)]).tolist() == [[2.0 * v for v in right], [2.0 * v for v in down]]


def test_an_upright_camera_has_the_bits_that_it_had_before_cameras_turned():
    points = np.random.default_rng(0).uniform(-1e3, 1e3, (50, 2))
    calibration = Calibration.centre_on(10.3, (3190.1, 2550.7), (640, 511))
    corner = np.array([3190.1 - 10.3 * 639 / 2, 2550.7 - 10.3 * 510 / 2])
    assert np.array_equal(calibration.to_um(points), points * 10.3 + corner)
    assert np.array_equal(calibration.to_px(points), (points - corner) / 10.3)
