from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import FlowField
from flowrec.physics import MapRaster, on_chip, raster_velocity, sample, sample_as_seen


@pytest.fixture
def bilinear():
    """v = (1 + 2 x - 3 y + x y / 8, 5 - x) in pixels, exact in float32."""
    rows, columns = np.mgrid[:12, :17].astype(float)
    velocity = np.stack([1 + 2 * columns - 3 * rows + columns * rows / 8, 5 - columns], axis=-1)
    return FlowField(0, 0, "test", 4.0, velocity, np.zeros((12, 17)), None, np.zeros(0), 1.0, 1000.0, "")


def test_sampling_is_exact_on_bilinear_fields(bilinear):
    points = np.random.default_rng(1).uniform([0, 0], [16, 11], (5, 40, 2))
    x, y = points[..., 0], points[..., 1]
    expected = np.stack([1 + 2 * x - 3 * y + x * y / 8, 5 - x], axis=-1)
    assert sample(bilinear, points * 4.0) == pytest.approx(expected, abs=1e-12)


def test_one_point_and_many_give_the_same_bits(bilinear):
    points = np.random.default_rng(2).uniform(-8.0, 76.0, (300, 2))
    many = sample(bilinear, points)
    assert all(np.array_equal(sample(bilinear, point), value) for point, value in zip(points, many, strict=True))


def test_the_border_holds_for_half_a_pixel_and_there_is_nothing_beyond(bilinear):
    assert sample(bilinear, [-2.0, -2.0]) == pytest.approx([1.0, 5.0])
    assert sample(bilinear, [66.0, 46.0]) == pytest.approx(sample(bilinear, [64.0, 44.0]))
    for outside in ([-2.1, 3.0], [3.0, 46.1], [np.nan, 3.0]):
        assert not sample(bilinear, outside).any() and not sample(bilinear, [outside]).any()


def test_a_flow_as_the_image_shows_it_moves_a_point_of_the_image_as_the_flow_moves_its_place_on_the_chip(bilinear):
    registration = np.array([[1.02, -0.05, 3.1], [0.06, 0.97, -1.2]])  # offset, scale and turn
    field, seen = replace(bilinear, registration=registration), np.array([[15.0, 12.0], [26.0, 20.0]])
    moved = on_chip(registration, seen + 1e-3 * sample_as_seen(field, seen)) - on_chip(registration, seen)
    assert moved / 1e-3 == pytest.approx(sample(bilinear, on_chip(registration, seen)), rel=1e-6)
    assert np.array_equal(sample_as_seen(bilinear, seen), sample(bilinear, seen)), "without a registration"
    assert sample_as_seen(field, seen[0]) == pytest.approx(sample_as_seen(field, seen)[0])


def test_the_kernel_of_the_control_loop_gives_the_flow_as_the_image_shows_it(bilinear):
    field = replace(bilinear, registration=np.array([[0.97, 0.11, 3.0], [-0.06, 1.05, -2.0]]))
    points = field.um_per_px * np.array([[2.3, 1.7], [1.1, 2.6], [3.2, 2.2]])
    found = [raster_velocity(*MapRaster.of(field), *point) for point in points.tolist()]
    np.testing.assert_allclose(found, sample_as_seen(field, points), rtol=1e-12)
    assert np.abs(found).max() > 0.0
