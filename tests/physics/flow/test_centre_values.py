"""A field holds values at pixel centres, and `sample` the flow between them: judged by exact solutions."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import FlowField, Observations
from flowrec.physics import Chip, FlowSolver, Opening, fluid_image, from_distance, pixel_weights, sample
from flowrec.physics.flow import newton_solver as systems
from flowrec.stages import Refiner

SPEED = 100.0
UM_PER_PX = 10.0


def with_known_walls(chip, k, distance):
    """Stokes flow of a chip whose walls are those of a formula."""
    equations = systems.newton_equations(chip, k, from_distance(distance, chip.mask.shape, k))
    flux = equations.linear(chip.boundary_values[:, None] * 1e-6)[:, 0]
    velocity, still = fluid_image(chip.mask, equations.velocity(flux) * 1e6), np.zeros(chip.mask.shape)
    walls = equations.grid.wall_px
    return FlowField(0, 0, "fvm", UM_PER_PX, velocity, still, None, chip.boundary_values, 1.0, 1e3, "", walls)


def relative(found, exact):
    return np.sqrt(((found - exact) ** 2).sum() / (exact**2).sum())


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("width", [1, 2, 3, 4, 5, 6, 8, 12])
@pytest.mark.parametrize("walls", ["pixel", "smooth"])
def test_a_sampled_channel_has_the_parabola_from_wall_to_wall(straight, walls, width, k):
    field = FlowSolver(k).solve(straight(width, 36, SPEED, walls=walls))
    s = np.linspace(0.0, 1.0, 41)
    for x in (17.0, 17.5, 18.3):
        places = np.stack([np.full_like(s, x), 1.5 + width * s], axis=1)
        velocity = sample(field, places * UM_PER_PX)
        assert np.abs(velocity - np.stack([6.0 * SPEED * s * (1.0 - s), 0.0 * s], axis=1)).max() < 1e-3 * SPEED


@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize(("width", "off_axis"), [(3.0, 0.04), (5.0, 0.02), (8.0, 0.01)])
@pytest.mark.parametrize("degrees", [7.0, 20.0, 31.0, 45.0])
def test_a_sampled_channel_has_its_parabola_at_any_angle_to_the_pixels(width, off_axis, degrees, k):
    angle, length = np.radians(degrees), 56
    tall = int(length * np.tan(angle) + width / np.cos(angle)) + 8
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-np.sin(angle), np.cos(angle)])
    centre = np.array([0.5 * length - 0.63, 0.5 * tall - 0.77])

    def distance(x, y):
        return 0.5 * width - np.abs((x - centre[0]) * across[0] + (y - centre[1]) * across[1])

    y, x = np.mgrid[:tall, :length].astype(float)
    mask = distance(x, y) > 0.0
    ends = [np.flatnonzero(mask[:, column]) for column in (0, -1)]
    openings = tuple(
        Opening(side, int(end[0]), int(end[-1]), kind, value)
        for side, end, kind, value in zip(
            ("left", "right"), ends, ("inlet", "outlet"), (SPEED * width / len(ends[0]), 0.0), strict=True
        )
    )
    field = with_known_walls(Chip("oblique", mask, UM_PER_PX, openings, 1.0, 1000.0), k, distance)
    rng = np.random.default_rng(1)
    on = rng.uniform(-length / 6, length / 6, (400, 1))
    off = rng.uniform(-0.5, 0.5, (400, 1))
    axis = sample(field, (centre + on * along) * UM_PER_PX)
    assert axis @ along == pytest.approx(1.5 * SPEED, rel=5e-3)
    exact = 1.5 * SPEED * (1.0 - 4.0 * off**2) * along
    assert relative(sample(field, (centre + on * along + width * off * across) * UM_PER_PX), exact) < off_axis


@pytest.mark.parametrize("k", [1, 2])
def test_a_sampled_ring_has_the_profile_between_its_circles(k):
    # Stokes flow along circles: u = G / (2 mu) (r ln r + B r + C / r), zero on both, in the last quarter of a ring.
    inner, outer = 8.3, 13.3

    def distance(x, y):
        radius = np.hypot(x + 0.5, y + 0.5)
        return np.minimum(radius - inner, outer - radius)

    y, x = np.mgrid[:19, :19].astype(float)
    mask = distance(x, y) > 0.0
    end = np.flatnonzero(mask[:, 0])
    first, last = int(end[0]), int(end[-1])
    openings = (Opening("left", first, last, "inlet", SPEED), Opening("top", first, last, "outlet", 0.0))
    field = with_known_walls(Chip("ring", mask, UM_PER_PX, openings, 1.0, 1000.0), k, distance)
    b, c = np.linalg.solve([[inner, 1 / inner], [outer, 1 / outer]], [-inner * np.log(inner), -outer * np.log(outer)])
    fine = np.linspace(inner, outer, 4001)
    profile = fine * np.log(fine) + b * fine + c / fine
    scale = SPEED * len(end) / np.trapezoid(profile, fine)
    for turn in np.radians([35.0, 45.0, 52.0]):
        r = np.linspace(inner, outer, 61)
        places = r[:, None] * [np.cos(turn), np.sin(turn)] - 0.5
        exact = np.interp(r, fine, profile * scale)[:, None] * [np.sin(turn), -np.cos(turn)]
        assert relative(sample(field, places * UM_PER_PX), exact) < (0.03 if k == 1 else 0.015)


WIDE = pytest.mark.slow("solves the flow in channels whose width differs little from the others")


@pytest.mark.parametrize("width", [3, 5, *(pytest.param(each, marks=WIDE) for each in (4, 6, 8, 12))])
def test_exact_observations_at_points_put_the_inlet_right(straight, width):
    chip = straight(width, 36, SPEED)
    s = np.array([0.5, 0.5, 0.5, 0.35, 0.7])
    points = np.stack([[10.0, 14.5, 18.2, 21.0, 25.7], 1.5 + width * s], axis=1) * UM_PER_PX
    flow = np.stack([6.0 * SPEED * s * (1.0 - s), 0.0 * s], axis=1)
    observations = Observations(0, points, flow, np.full(len(s), 0.01))
    assumed = chip.with_boundary([0.8 * SPEED, 0.0])
    solver = FlowSolver(2)
    refined = Refiner().refine(solver.solve(assumed), observations, assumed, solver)
    # Some of it is taken for an error along the channel, whatever the width.
    assert refined.boundary_values[0] == pytest.approx(SPEED, rel=5e-3)


def test_nothing_moves_in_solid_and_a_field_without_walls_is_bilinear(crossing):
    field = FlowSolver(2).solve(replace(crossing, walls="smooth"))
    places = np.random.default_rng(4).uniform(-1.0, 49.0, (4000, 2))
    rows, columns = (np.clip(np.rint(places[:, axis]).astype(int), 0, size - 1) for axis, size in ((1, 40), (0, 48)))
    velocity = sample(field, places * UM_PER_PX)
    deep = field.wall_px[rows, columns] < -0.65
    assert deep.sum() > 500 and not velocity[deep].any()
    # The first release recorded no walls: what its loop computed from such a field is computed again to the last bit.
    centres = np.stack(np.meshgrid(np.arange(48.0), np.arange(40.0)), axis=-1)[crossing.mask]
    for known in (field, replace(field, wall_px=None)):
        assert np.array_equal(sample(known, centres * UM_PER_PX).astype(np.float32), known.velocity_um_s[crossing.mask])
    between = 0.5 * (field.velocity_um_s[20, 12] + field.velocity_um_s[20, 13])
    assert sample(replace(field, wall_px=None), [125.0, 200.0]) == pytest.approx(between, rel=1e-6)


def test_the_weights_of_a_place_give_what_is_sampled_and_the_first_is_of_the_nearest_pixel(crossing):
    field = FlowSolver().solve(replace(crossing, walls="smooth"))
    places = np.random.default_rng(5).uniform([-0.4, -0.4], [47.4, 39.4], (2000, 2))
    pixels, weights = pixel_weights(field.wall_px, places)
    summed = (field.velocity_um_s.reshape(-1, 2)[pixels] * weights[..., None]).sum(axis=1)
    np.testing.assert_allclose(summed, sample(field, places * UM_PER_PX), atol=1e-9 * SPEED)
    nearest = np.rint(places).astype(int)
    assert (pixels[:, 0] == nearest[:, 1] * 48 + nearest[:, 0]).all()
    assert not weights[field.wall_px.ravel()[pixels] <= 0.0].any()
