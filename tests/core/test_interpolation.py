"""Interpolation against SciPy, and every form against every other, bit by bit."""

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from flowrec.core import bilinear, bilinear_known, cell_at, cells_at, corner_weights, nearest_pixel, nearest_pixels

RNG = np.random.default_rng(3)
RASTER = RNG.normal(size=(7, 11))  # not square: a transposed index shows
POINTS = RNG.uniform(-2.0, [12.0, 8.0], (400, 2))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_every_form_agrees_with_scipy_where_the_border_value_holds_beyond_the_border(kind):
    raster = RASTER.astype(kind)
    expected = map_coordinates(raster.astype(float), POINTS.T[::-1], order=1, mode="nearest")
    np.testing.assert_allclose(cells_at(POINTS, raster.shape).interpolate(raster), expected, atol=1e-12)
    for (x, y), value in zip(POINTS, expected, strict=True):
        j, i, *weights = corner_weights(x, y, *raster.shape)
        assert bilinear(raster, x, y) == pytest.approx(value, abs=1e-12)
        assert raster[j : j + 2, i : i + 2].ravel().astype(float) @ weights == pytest.approx(value, abs=1e-12)


def test_one_point_many_points_and_the_kernel_give_the_same_bits():
    cells = cells_at(POINTS, RASTER.shape)
    values = cells.interpolate(RASTER)
    for k, (x, y) in enumerate(POINTS):
        assert bilinear(RASTER, x, y) == values[k]
        each = (cells.row, cells.column, cells.below, cells.right, cells.a, cells.b)
        assert cell_at(x, y, RASTER.shape) == tuple(of[k] for of in each)
        assert corner_weights(x, y, *RASTER.shape)[2:] == tuple(cells.weights[k])


def test_channels_are_interpolated_one_by_one():
    both = np.stack([RASTER, 2.0 * RASTER], axis=-1)
    cells = cells_at(POINTS.reshape(4, 100, 2), both.shape)
    np.testing.assert_array_equal(cells.interpolate(both)[..., 0], cells.interpolate(RASTER))
    assert cells.interpolate(both).shape == (4, 100, 2)


def test_rows_columns_and_weights_are_the_same_interpolation_as_a_linear_operator():
    cells = cells_at(POINTS, RASTER.shape)
    np.testing.assert_allclose((RASTER[cells.rows, cells.columns] * cells.weights).sum(-1), cells.interpolate(RASTER))
    np.testing.assert_allclose(cells.weights.sum(-1), 1.0)


def test_a_point_is_inside_up_to_half_a_pixel_beyond_the_border_and_nowhere_if_it_is_not_finite():
    at = [[-0.5, 6.5], [10.5, -0.5], [-0.51, 3.0], [3.0, 6.51], [math.nan, 3.0], [3.0, math.inf], [-math.inf, 3.0]]
    cells = cells_at(np.array(at), RASTER.shape)
    assert cells.inside.tolist() == [True, True, False, False, False, False, False]
    assert cells.interpolate(RASTER)[:2].tolist() == [RASTER[6, 0], RASTER[0, 10]]


@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (1, 1)])
def test_a_raster_of_one_row_or_column_has_values_along_the_other(shape):
    raster = np.arange(5.0)[: max(shape)].reshape(shape)
    along = np.array([0.25, 2.5, 9.0])
    at = np.stack([along, along], -1)
    np.testing.assert_allclose(cells_at(at, shape).interpolate(raster), np.clip(along, 0.0, max(shape) - 1.0))
    assert cell_at(2.5, 2.5, shape)[:4] == tuple(
        int(of[1])
        for of in (
            cells_at(at, shape).row,
            cells_at(at, shape).column,
            cells_at(at, shape).below,
            cells_at(at, shape).right,
        )
    )


@pytest.mark.parametrize("missing", [math.inf, math.nan])
def test_pixels_without_a_value_do_not_count_and_a_point_needs_a_quarter_of_the_weight(missing):
    raster = RASTER.copy()
    raster[RNG.random(raster.shape) < 0.4] = missing
    cells = cells_at(POINTS, raster.shape)
    values = cells.interpolate_known(raster)
    within = (POINTS >= 0.0).all(1) & (POINTS <= [10.0, 6.0]).all(1)
    finite = np.isfinite(raster[cells.rows, cells.columns])
    weights = cells.weights * finite
    known = cells.inside & (weights.sum(1) >= 0.25)
    mean = (weights * np.where(finite, raster[cells.rows, cells.columns], 0.0)).sum(1) / weights.sum(1).clip(0.25)
    np.testing.assert_allclose(values[known], mean[known])
    assert np.isinf(values[~known]).all() and 0.1 < known.mean() < 0.9
    for (x, y), value, inner in zip(POINTS, values, within, strict=True):
        assert bilinear_known(raster, x, y) == (value if inner else math.inf)


def test_the_nearest_pixel_is_within_the_image_and_a_half_goes_to_the_even_number():
    rows, columns = nearest_pixels(POINTS, RASTER.shape)
    for (x, y), row, column in zip(POINTS, rows, columns, strict=True):
        assert nearest_pixel(x, y, RASTER.shape) == (row, column)
        assert 0 <= row < 7 and 0 <= column < 11
        assert abs(row - min(max(y, 0.0), 6.0)) <= 0.5 and abs(column - min(max(x, 0.0), 10.0)) <= 0.5
    assert nearest_pixel(2.5, 3.5, RASTER.shape) == (4, 2)
