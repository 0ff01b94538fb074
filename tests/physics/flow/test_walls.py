"""Walls between the grid lines: straight at any angle, curved, and of random masks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from flowrec.physics import (
    Chip,
    FlowSolver,
    Opening,
    find_openings,
    from_distance,
    guess_inlets,
    with_levels,
    with_wall_offset,
)
from flowrec.physics.flow import newton_solver as systems
from flowrec.physics.flow.contour_smoothing import contour_segments
from flowrec.physics.flow.grid import INLET
from flowrec.physics.flow.level_set import from_mask

SPEED = 100.0
UM_PER_PX = 10.0


class Oblique:
    """A straight channel turned by an angle, and the mask of the pixels whose centres lie in it."""

    def __init__(self, width, degrees, offset, length=70):
        self.width, self.angle, self.length = width, np.radians(degrees), length
        tall = int(length * np.tan(self.angle) + width / np.cos(self.angle)) + 8
        y, x = np.mgrid[:tall, :length].astype(float)
        self.centre = (x.mean() - offset[0], y.mean() - offset[1])
        mask = self.distance(x, y) > 0.0
        left, right = np.flatnonzero(mask[:, 0]), np.flatnonzero(mask[:, -1])
        openings = (
            Opening("left", int(left[0]), int(left[-1]), "inlet", SPEED * width / len(left)),
            Opening("right", int(right[0]), int(right[-1]), "outlet", 0.0),
        )
        self.chip = Chip("oblique", mask, UM_PER_PX, openings, 1.0, 1000.0)
        along, across = self.places(x, y)
        self.along, self.core = along, mask & (np.abs(across) < 1.0) & (np.abs(along) < length / 4)
        self.slices = [mask & (np.abs(along - s * length / 4) < 1.0) for s in (-1, 1)]

    def places(self, x, y):
        x, y = x - self.centre[0], y - self.centre[1]
        return x * np.cos(self.angle) + y * np.sin(self.angle), y * np.cos(self.angle) - x * np.sin(self.angle)

    def distance(self, x, y):
        return self.width / 2 - np.abs(self.places(x, y)[1])

    def errors(self, pressure):
        """Of the hydraulic resistance, from the slope in the core and from the drop between two sections."""
        per_slope = (self.width * UM_PER_PX * 1e-6) ** 2 / (12e-3 * SPEED * 1e-6) / (UM_PER_PX * 1e-6)
        first, last = self.slices
        drop = (pressure[last].mean() - pressure[first].mean()) / (self.along[last].mean() - self.along[first].mean())
        return -np.polyfit(self.along[self.core], pressure[self.core], 1)[0] * per_slope - 1.0, -drop * per_slope - 1.0


def solved(chip, k, drawn=None):
    """Stokes flow: the equations, the fluxes through faces and the pressure in Pa on pixels."""
    equations = systems.newton_equations(chip, k, drawn)
    drive = chip.boundary_values * 1e-6
    moving = equations.linear(drive[:, None])[:, 0]
    cells = equations.pressure(equations.residual(moving, drive, 0.0)[:, None])[:, 0]
    return equations, moving, equations.grid.pressure(cells) * 1e-3 / (chip.um_per_px * 1e-6 / k)


def divergence(equations, moving):
    padded = np.append(moving, 0.0)
    u, v = padded[equations.grid.u.number], padded[equations.grid.v.number]
    return np.abs(np.diff(u, axis=1) + np.diff(v, axis=0)).max() / np.abs(moving).max()


@pytest.mark.parametrize("width", [1.8, 4.0, 8.0])
@pytest.mark.parametrize("degrees", [0.0, 7.0, 20.0, 31.0, 45.0])
def test_a_plane_channel_at_any_angle_is_solved_without_error_when_its_walls_are_known(width, degrees):
    channel = Oblique(width, degrees, (0.13, 0.27))
    drawn = from_distance(channel.distance, channel.chip.mask.shape, 1)
    equations, moving, pressure = solved(channel.chip, 1, drawn)
    assert divergence(equations, moving) < 1e-13
    # What is left are faces open by less than a fiftieth.
    assert np.abs(channel.errors(pressure)).max() < 5e-4


@pytest.mark.parametrize("depth_px", [1.0, 3.0])
@pytest.mark.parametrize("degrees", [0.0, 7.0, 20.0, 31.0, 45.0])
def test_a_shallow_channel_at_any_angle_has_the_resistance_of_brinkmans_equation(degrees, depth_px):
    # mu u'' - 12 mu u / H^2 = dp/dx between walls at +-a, of mean speed U: with r = sqrt(12) / H
    # dp/dx = -mu r^2 U / (1 - tanh(r a) / (r a)), here over the slope -3 mu U / a^2 without friction.
    channel = Oblique(8.0, degrees, (0.13, 0.27))
    drawn = from_distance(channel.distance, channel.chip.mask.shape, 2)
    chip = replace(channel.chip, depth_um=depth_px * UM_PER_PX)
    _, _, pressure = solved(chip, 2, drawn)
    ra = np.sqrt(12.0) / depth_px * channel.width / 2
    exact = ra**2 / (1.0 - np.tanh(ra) / ra) / 3.0
    slope, drop = channel.errors(pressure)
    assert slope + 1.0 == pytest.approx(exact, rel=0.01)
    assert drop + 1.0 == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("degrees", [0.0, 7.0, 20.0, 31.0, 45.0])
def test_a_very_shallow_channel_flows_as_fast_in_cut_faces_as_in_its_middle(degrees):
    # Depth much below the width: v = -H^2 / (12 mu) grad p, the same everywhere but for H / sqrt(12) beside the walls,
    # here 0.07 px.
    channel = Oblique(8.0, degrees, (0.13, 0.27))
    drawn = from_distance(channel.distance, channel.chip.mask.shape, 1)
    equations, moving, _ = solved(replace(channel.chip, depth_um=0.25 * UM_PER_PX), 1, drawn)
    j, i = np.nonzero(equations.grid.u.number >= 0)
    faces = equations.grid.u.number[j, i]
    share = equations.grid.open_fraction[faces]
    core = np.abs(channel.places(i - 0.5, j)[0]) < channel.length / 8
    speed = moving[faces] / share / (SPEED * 1e-6 * np.cos(channel.angle))
    whole, cut = speed[core & (share == 1.0)], speed[core & (share < 1.0) & (share > 0.1)]
    assert len(cut) > 5
    assert whole.min() > 0.97 and whole.max() < 1.02
    # The mean over an open part that is narrow holds more of what the wall slows.
    assert cut.min() > 0.8 and cut.max() < 1.0


@pytest.mark.parametrize(("width", "mean", "largest"), [(8.0, 0.01, 0.03), (4.0, 0.02, 0.08)])
def test_a_mask_of_an_oblique_channel_has_its_resistance_at_every_angle(width, mean, largest):
    offsets = np.random.default_rng(3).uniform(0.0, 1.0, (14, 2))
    errors = []
    for degrees, offset in zip([0, 2, 5, 8, 10, 12, 15, 17, 22, 25, 28, 30, 37, 42], offsets, strict=True):
        channel = Oblique(width, degrees, offset)
        errors.append([channel.errors(solved(channel.chip, k)[2]) for k in (1, 2)])
    errors = np.abs(errors)
    assert errors.max() < largest
    assert (errors.mean(axis=0) < mean).all()


def test_a_bend_between_circles_converges_at_second_order():
    inner, outer = 12.3, 20.3

    def distance(x, y):
        radius = np.hypot(x + 0.5, y + 0.5)
        return np.minimum(radius - inner, outer - radius)

    y, x = np.mgrid[:26, :26].astype(float)
    mask = distance(x, y) > 0.0
    ends = [np.flatnonzero(mask[:, 0]), np.flatnonzero(mask[0])]
    openings = tuple(
        Opening(side, int(end[0]), int(end[-1]), kind, value)
        for side, end, kind, value in zip(("left", "top"), ends, ("inlet", "outlet"), (SPEED, 0.0), strict=True)
    )
    chip = Chip("bend", mask, UM_PER_PX, openings, 1.0, 1000.0)
    turn, radius = np.arctan2(y + 0.5, x + 0.5), np.hypot(x + 0.5, y + 0.5)
    core = (np.abs(radius - (inner + outer) / 2) < 1.5) & (np.abs(turn - np.pi / 4) < 0.2)
    slopes = [
        np.polyfit(turn[core], solved(chip, k, from_distance(distance, mask.shape, k))[2][core], 1)[0]
        for k in (1, 2, 4)
    ]
    # Stokes flow along circles: u = G / (2 mu) (r ln r + B r + C / r) for a pressure that grows by G per radian.
    b, c = np.linalg.solve([[inner, 1 / inner], [outer, 1 / outer]], [-inner * np.log(inner), -outer * np.log(outer)])
    r = np.linspace(inner, outer, 20001)
    flux = -np.trapezoid(0.5 * (r * np.log(r) + b * r + c / r), r)
    exact = SPEED * 1e-6 * len(ends[0]) * 1e-3 / (flux * UM_PER_PX * 1e-6)
    errors = np.array(slopes) / exact - 1.0
    assert abs(errors[0]) < 0.005
    assert abs(errors[2]) < 0.0006
    assert (slopes[0] - slopes[1]) / (slopes[1] - slopes[2]) == pytest.approx(4.0, abs=1.0)


def nasty(seed, size=36):
    """Blobs, necks of one pixel, corners that touch, ponds and islands, and openings all around."""
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.normal(size=(size, size)), rng.choice([0.5, 0.9, 1.6]))
    mask = field > np.quantile(field, 0.4)
    mask[:, 5] = mask[9] = True
    mask[20:24, 30:] = True
    return Chip(f"nasty {seed}", mask, UM_PER_PX, guess_inlets(find_openings(mask)), 1.0, 1000.0)


@pytest.mark.parametrize("walls", ["smooth", "pixel"])
@pytest.mark.parametrize("k", [1, 2])
def test_no_mask_makes_mass_vanish_or_the_flow_wild(walls, k):
    for seed in range(12):
        chip = replace(nasty(seed), walls=walls)
        equations, moving, pressure = solved(chip, k)
        grid = equations.grid
        assert np.isfinite(moving).all() and np.isfinite(pressure).all()
        assert divergence(equations, moving) < 1e-12
        fluxes = np.array([opening.inward * moving[opening.faces].sum() for opening in grid.openings])
        asked = [SPEED * 2e-6 * o.width_px * k for o in chip.openings if o.kind == "inlet"]
        assert [f for f, m in zip(fluxes, grid.openings, strict=True) if m.kind == "inlet"] == pytest.approx(asked)
        assert abs(fluxes.sum()) < 1e-10 * np.abs(fluxes).max()
        # Nowhere faster than all of the flux through a pixel, as a parabola.
        assert np.abs(moving / grid.open_fraction).max() < 3.0 * max(asked) / k
        # The pressure balances every face, so no loop is left open.
        drive = chip.boundary_values * 1e-6
        load = equations.residual(moving, drive, 0.0)
        free = np.setdiff1d(
            np.arange(grid.faces), np.concatenate([m.faces for m in grid.openings if m.kind == "inlet"])
        )
        rest = load - equations.momentum.gradient @ equations.pressure(load[:, None])[:, 0]
        assert np.abs(rest[free]).max() < 1e-8 * np.abs(load[free]).max()


def test_the_outline_keeps_the_sides_of_pixels_and_the_area_of_islands():
    rng = np.random.default_rng(8)
    for radius in (0.8, 1.3, 3.0, 8.0):
        for x0, y0 in rng.uniform(12.0, 13.0, (10, 2)):
            y, x = np.mgrid[:26, :26]
            island = np.hypot(x - x0, y - y0) < radius
            for mask, sign in ((island, 1.0), (~island, -1.0)):
                a, b = contour_segments(mask, 2)
                area = 0.5 * sign * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
                assert area == pytest.approx(island.sum(), rel=0.05)
    for seed in range(6):
        mask = nasty(seed).mask
        for k in (1, 2):
            level = from_mask(mask, k, "smooth").level
            assert np.array_equal(level[k :: 2 * k, k :: 2 * k] > 0.0, mask)


def test_walls_on_grid_lines_are_those_of_pixels():
    mask = np.zeros((12, 20), bool)
    mask[2:9] = True
    openings = (Opening("left", 2, 8, "inlet", SPEED), Opening("right", 2, 8, "outlet", 0.0))
    chip = Chip("straight", mask, UM_PER_PX, openings, 1.0, 1000.0)
    for k in (1, 2):
        smooth, pixel = (FlowSolver(k).solve(replace(chip, walls=walls)) for walls in ("smooth", "pixel"))
        assert np.abs(smooth.velocity_um_s - pixel.velocity_um_s).max() < 1e-3 * SPEED


def test_a_lid_drives_a_closed_box():
    n, reynolds = 32, 100.0
    box = Chip("box", np.ones((n, n), bool), 1e6 / n, (), 1.0, 1.0, walls="pixel")
    equations = systems.newton_equations(box, 1)
    push = equations.momentum.sliding @ [0.0, 0.0, 1.0, 0.0]
    moving = equations.steady(np.zeros(0), reynolds / n, 40, 1e-9, push=push)
    assert divergence(equations, moving) < 1e-13
    u = np.append(moving, 0.0)[equations.grid.u.number[:, n // 2]]
    # Ghia, Ghia and Shin (1982), table I, Re 100: -0.2109 at y = 0.4531; finer solutions have -0.2140.
    assert u.min() == pytest.approx(-0.2140, abs=0.006)
    assert np.isfinite(equations.pressure(equations.residual(moving, np.zeros(0), reynolds / n, push)[:, None])).all()
    assert (equations.grid.u.kind != INLET).all()


@pytest.mark.parametrize("width_px", [9.3, 10.0, 10.7])
def test_walls_at_grey_levels_lie_between_the_pixels_and_move_outwards_from_there(width_px):
    rows = np.abs(np.arange(20) - 9.5)
    level_px = np.repeat((0.5 * width_px - rows)[:, None], 60, axis=1).astype(np.float32)
    mask = level_px > 0.0
    openings = guess_inlets(find_openings(mask), SPEED * width_px / mask[:, 0].sum())
    chip = with_levels(Chip("straight", mask, UM_PER_PX, openings, 1.0, 1000.0), level_px)
    for moved, width in ((chip, width_px), (with_wall_offset(chip, 0.25), width_px + 0.5)):
        drop = np.diff(FlowSolver(k=2).solve(moved).pressure_pa[10, [20, 40]])[0]
        # The flow rate is the same in wider walls: 12 mu Q / w^3.
        expected = -12e-3 * SPEED * 1e-6 * width_px * 20.0 / (width**3 * UM_PER_PX * 1e-6)
        assert drop == pytest.approx(expected, rel=0.02)


def test_walls_that_are_moved_twice_lie_where_one_move_puts_them_and_each_place_has_a_flow_of_its_own():
    mask = np.zeros((16, 40), bool)
    mask[5:11] = True
    openings = Opening("left", 5, 10, "inlet", 100.0), Opening("right", 5, 10, "outlet", 0.0)
    drawn = Chip("channel", mask, 10.0, openings, 1.0, 1000.0)
    at_once, twice = with_wall_offset(drawn, 0.7), with_wall_offset(with_wall_offset(drawn, 0.3), 0.4)
    assert at_once.mask.sum() > mask.sum() and np.array_equal(at_once.mask, twice.mask)
    assert at_once.openings == twice.openings and at_once.wall_offset_px == pytest.approx(twice.wall_offset_px)
    # Between pixel centres the mask and its openings are the same, and the walls are not.
    peaks = [
        FlowSolver().solve(with_wall_offset(drawn, offset_px)).velocity_um_s.max() for offset_px in (0.0, 0.1, 0.2, 0.1)
    ]
    assert peaks[0] > peaks[1] > peaks[2] and peaks[1] == peaks[3]
