from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import FlowError
from flowrec.physics import Chip, FlowSolver, Opening, bifurcation, clear_cache
from flowrec.physics.flow import newton_solver as systems


def relative(a, b):
    return np.sqrt(((a - b) ** 2).sum() / (b**2).sum())


@pytest.mark.parametrize("width", [1, 2, 6])
@pytest.mark.parametrize("walls", ["pixel", "smooth"])
def test_poiseuille_flow_is_exact_however_narrow_the_channel(straight, walls, width):
    speed = 100.0
    chip = straight(width, speed=speed, walls=walls)
    s = (np.arange(width) + 0.5) / width
    profile = speed * 6.0 * s * (1.0 - s)
    slope = -12e-3 * (speed * 1e-6) / (width * 10e-6) ** 2  # Pa/m
    for k in (1, 2, 4):
        field = FlowSolver(k).solve(chip)
        assert field.velocity_um_s[2:-2, 12, 0] == pytest.approx(profile, rel=1e-4)
        assert np.abs(field.velocity_um_s[2:-2, 12, 1]).max() < 1e-4 * speed
        assert (field.pressure_pa[2, 15] - field.pressure_pa[2, 9]) / 60e-6 == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("walls", ["pixel", "smooth"])
@pytest.mark.parametrize("k", [1, 2])
def test_every_cell_and_the_whole_chip_conserve_mass(crossing, walls, k):
    chip = replace(crossing, walls=walls, density_kg_m3=5e4)
    equations = systems.system(chip, k)
    drive = chip.boundary_values * np.array([1.0, 1.0, 0.01, 0.01])
    moving = equations.steady(drive, 1e-3, 40, 1e-10)
    padded = np.append(moving, 0.0)
    u, v = padded[equations.grid.u.number], padded[equations.grid.v.number]
    assert np.abs(np.diff(u, axis=1) + np.diff(v, axis=0)).max() < 1e-12 * np.abs(moving).max()
    fluxes = np.array([opening.inward * moving[opening.faces].sum() for opening in equations.grid.openings])
    assert fluxes[:2] == pytest.approx(drive[:2] * 12 * k, rel=1e-12)
    assert abs(fluxes.sum()) < 1e-10 * np.abs(fluxes).max()
    assert (fluxes[2:] < 0.0).all()


def test_stokes_flow_is_the_sum_of_its_modes(crossing):
    solver = FlowSolver(convection=False)
    values = np.array([70.0, -20.0, 0.01, 0.03])
    chip = crossing.with_boundary(values, viscosity_mpa_s=3.0)
    other = crossing.with_boundary([1.0, 2.0, 3.0, 4.0], viscosity_mpa_s=3.0)
    expansion = solver.sensitivities(other)
    field = solver.solve(chip)
    summed = np.tensordot(values, expansion.modes[:4], 1)
    assert relative(summed, field.velocity_um_s[chip.mask].astype(float)) < 1e-6
    offset = np.append(values - other.boundary_values, 0.0)
    pressure = expansion.pressure(offset, expansion.start())
    assert relative(pressure, field.pressure_pa[chip.mask].astype(float)) < 1e-6


def test_the_modes_are_the_derivatives_of_the_solution(crossing):
    # Re about 10: convection matters.
    values = np.array([60000.0, 20000.0, 0.0, 5.0])
    chip = crossing.with_boundary(values)
    solver = FlowSolver(tolerance=1e-12)
    expansion = solver.sensitivities(chip)
    still = expansion.start()
    assert relative(expansion.base, FlowSolver(convection=False).solve(chip).velocity_um_s[chip.mask]) > 0.02

    def slopes(changed, step):
        """Central differences of velocity and pressure on the fluid pixels."""
        more, less = (solver.solve(changed(sign * step)) for sign in (1, -1))
        return [
            (getattr(more, name)[chip.mask].astype(float) - getattr(less, name)[chip.mask]) / (2 * step)
            for name in ("velocity_um_s", "pressure_pa")
        ]

    for index, step in enumerate([600.0, 200.0, 0.5, 0.5]):
        unit = np.eye(5)[index]
        velocity, pressure = slopes(lambda change, unit=unit: chip.with_boundary(values + change * unit[:4]), step)
        assert relative(expansion.modes[index], velocity) < 2e-3
        more, less = (expansion.pressure(sign * step * unit, still) for sign in (1, -1))
        assert relative((more - less) / (2 * step), pressure) < 2e-3
    # At fixed outlet pressures a thicker fluid lowers p / mu, and the pressure is proportional to mu.
    velocity, pressure = slopes(lambda change: chip.with_boundary(values, float(np.exp(change))), 0.02)
    direction = np.array([0.0, 0.0, -values[2], -values[3], 1.0])
    assert relative(np.tensordot(direction, expansion.modes, 1), velocity) < 5e-3
    more, less = (np.exp(sign * 0.02) * expansion.pressure(sign * 0.02 * direction, still) for sign in (1, -1))
    assert relative((more - less) / 0.04, pressure) < 5e-3


@pytest.mark.parametrize("k", [1, pytest.param(2, marks=pytest.mark.slow("four times the cells"))])
def test_the_same_friction_in_every_pixel_is_that_of_a_depth(k):
    chip = bifurcation()
    everywhere = replace(chip, friction_per_um2=np.full(chip.mask.shape, 12.0 / 150.0**2))
    solver = FlowSolver(k=k)
    by_depth, by_pixel = solver.solve(replace(chip, depth_um=150.0)), solver.solve(everywhere)
    assert by_pixel.velocity_um_s == pytest.approx(by_depth.velocity_um_s, abs=1e-3)
    assert solver.solve(chip).velocity_um_s != pytest.approx(by_depth.velocity_um_s, abs=1.0)  # nothing is left behind


def test_friction_in_one_branch_sends_the_flow_through_the_other():
    chip = bifurcation()
    friction = np.zeros(chip.mask.shape)
    friction[140:, 130:190] = 1.0  # in the lower branch: as good as solid
    below = FlowSolver().solve(replace(chip, friction_per_um2=friction)).velocity_um_s[140:, 160, 0]
    assert abs(below).max() < 5.0


def test_depth_friction_gives_the_profile_of_a_shallow_channel(straight):
    width, speed, depth = 16, 100.0, 40.0
    field = FlowSolver(4).solve(straight(width, 32, speed, depth_um=depth))
    y = (np.arange(width) - (width - 1) / 2) * 10.0
    rate, half = np.sqrt(12.0) / depth, width * 5.0
    profile = 1.0 - np.cosh(rate * y) / np.cosh(rate * half)
    profile *= speed / (1.0 - np.tanh(rate * half) / (rate * half))
    assert relative(field.velocity_um_s[2:-2, 16, 0], profile) < 0.01
    # Far from the sides Hele-Shaw: dp/dx = -12 mu v / H^2.
    slope = (field.pressure_pa[9, 20] - field.pressure_pa[9, 12]) / 80e-6
    assert slope == pytest.approx(-12e-3 * field.velocity_um_s[9, 16, 0] * 1e-6 / (depth * 1e-6) ** 2, rel=0.01)


def test_convection_leaves_a_developed_channel_flow_alone(straight):
    chip = straight(8, speed=1e5)
    with_it, without = FlowSolver().solve(chip), FlowSolver(convection=False).solve(chip)
    # The inlet's parabola is not quite the discrete one, hence not zero.
    assert relative(with_it.velocity_um_s, without.velocity_um_s) < 0.01


def test_a_mirrored_chip_has_the_mirrored_flow_and_convection_tells_forth_from_back(straight):
    mask = np.zeros((24, 36), bool)
    mask[8:16] = True
    mask[2:22, 14:] = True  # a sudden expansion
    openings = (Opening("left", 8, 15, "inlet", 8e4), Opening("right", 2, 21, "outlet", 0.0))
    forth = Chip("step", mask, 10.0, openings, 1.0, 1e3, walls="pixel")
    upside = replace(forth, mask=mask[::-1])
    upside = replace(
        upside, openings=(replace(forth.openings[0]), replace(forth.openings[1]))
    )  # the rows 8..15 and 2..21 of 24 mirror onto themselves
    field, mirrored = FlowSolver().solve(forth), FlowSolver().solve(upside)
    assert relative(mirrored.velocity_um_s[::-1] * [1, -1], field.velocity_um_s) < 1e-6
    # Inertia carries the jet on: the middle is faster than in Stokes flow, and the corners turn back.
    stokes = FlowSolver(convection=False).solve(forth)
    assert field.velocity_um_s[12, 22, 0] > 1.1 * stokes.velocity_um_s[12, 22, 0]
    assert field.velocity_um_s[3, 16:22, 0].min() < 0.0


def test_a_smooth_wall_has_the_resistance_of_the_oblique_channel_it_was_drawn_from():
    width, angle, length = 8.0, np.radians(30.0), 80
    rows, columns = np.mgrid[: int(length * np.tan(angle)) + 24, :length].astype(float)
    rows, columns = rows - rows.mean() + 0.27, columns - columns.mean() + 0.13
    mask = np.abs(rows * np.cos(angle) - columns * np.sin(angle)) < width / 2
    left, right = np.flatnonzero(mask[:, 0]), np.flatnonzero(mask[:, -1])
    openings = (
        Opening("left", int(left[0]), int(left[-1]), "inlet", 100.0 * width / len(left)),
        Opening("right", int(right[0]), int(right[-1]), "outlet", 0.0),
    )
    along = columns * np.cos(angle) + rows * np.sin(angle)
    core = mask & (np.abs(rows * np.cos(angle) - columns * np.sin(angle)) < 1.0) & (np.abs(along) < 20.0)

    def resistance(walls, k):
        chip = Chip("oblique", mask, 10.0, openings, 1.0, 1000.0, walls=walls)
        pressure = FlowSolver(k).solve(chip).pressure_pa
        return -np.polyfit(along[core] * 10e-6, pressure[core], 1)[0] * (width * 10e-6) ** 2 / (12e-3 * 100e-6)

    assert resistance("smooth", 1) == pytest.approx(1.0, abs=0.01)
    assert resistance("smooth", 2) == pytest.approx(1.0, abs=0.01)
    assert resistance("pixel", 2) > 1.15


def test_solid_and_ponds_stand_still(crossing):
    field = FlowSolver(2).solve(crossing)
    assert not field.velocity_um_s[~crossing.mask].any() and not field.pressure_pa[~crossing.mask].any()
    assert not field.velocity_um_s[3:8, 4:9].any()


@pytest.mark.parametrize("k", [1, 2])
def test_a_fluid_that_nothing_drives_stands_still_as_the_equations_say(crossing, k):
    still = FlowSolver(k).solve(crossing.with_boundary([0.0, 0.0, 0.0, 0.0]))
    assert not still.velocity_um_s.any() and not still.pressure_pa.any() and still.note == "residual below 1e-9"
    barely = FlowSolver(k).solve(crossing.with_boundary([1e-9, 0.0, 0.0, 0.0]))
    assert 0.0 < np.abs(barely.velocity_um_s).max() < 1e-8
    assert np.array_equal(still.wall_px, barely.wall_px)
    moved = FlowSolver(k).solve(crossing.with_boundary([0.0, 0.0, 3.0, 0.0]))  # a pressure alone
    assert np.abs(moved.velocity_um_s).max() > 1.0


def test_the_same_chip_gives_the_same_bytes_with_or_without_the_cache(crossing):
    chip = crossing.with_boundary([6000.0, 2000.0, 0.0, 0.0])
    first = FlowSolver().solve(chip)
    FlowSolver().sensitivities(chip.with_boundary([1.0, 2.0, 3.0, 4.0], viscosity_mpa_s=9.0))
    assert FlowSolver().solve(chip).same_as(first)
    clear_cache()
    assert FlowSolver().solve(chip).same_as(first)


def test_what_can_not_be_solved_is_an_error_of_one_line(crossing, straight):
    with pytest.raises(FlowError, match="max_iterations"):
        FlowSolver(max_iterations=3).solve(crossing.with_boundary([5e7, 5e7, 0.0, 0.0]))
    channel = straight()
    inlet, outlet = channel.openings
    for solver, openings in (
        (FlowSolver(), (inlet,)),
        (FlowSolver(k=3), (inlet, outlet)),
        (FlowSolver(), (Opening("left", 0, 9, "inlet", 1.0), outlet)),  # partly in a wall
    ):
        with pytest.raises(FlowError):
            solver.solve(replace(channel, openings=openings))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viscosity_mpa_s": 0.0}, "viscosity_mpa_s = 0; it must be more than zero"),
        ({"viscosity_mpa_s": -1.0}, "viscosity_mpa_s = -1"),
        ({"viscosity_mpa_s": np.nan}, "viscosity_mpa_s = nan"),
        ({"density_kg_m3": np.nan}, "density_kg_m3 = nan"),
        ({"um_per_px": 0.0}, "um_per_px = 0"),
        ({"depth_um": -5.0}, "depth_um = -5"),
        ({"openings": (Opening("left", 2, 9, "inlet", np.inf), Opening("right", 2, 9, "outlet", 0.0))}, "value inf"),
        ({"openings": (Opening("left", 2, 6, "inlet", 1.0), Opening("left", 5, 9, "outlet", 0.0))}, "overlaps"),
        ({"openings": (Opening("left", 9, 2, "inlet", 1.0), Opening("right", 2, 9, "outlet", 0.0))}, "not one run"),
    ],
)
def test_impossible_numbers_and_openings_are_refused_in_one_line(straight, change, message):
    with pytest.raises(FlowError, match=message) as refused:
        FlowSolver().solve(replace(straight(), **change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("kinds", [("inlet", "outlet", "outlet"), ("inlet", "inlet", "outlet"), ("outlet",) * 3])
def test_openings_that_meet_in_a_corner_conserve_mass_and_so_do_channels_without_walls(k, kinds):
    spans = (("left", 0, 5), ("top", 0, 6), ("right", 0, 11))
    values = [100.0 if kind == "inlet" else 0.1 * index for index, kind in enumerate(kinds)]
    openings = tuple(Opening(*span, kind, value) for span, kind, value in zip(spans, kinds, values, strict=True))
    chip = Chip("corner", np.ones((12, 20), bool), 10.0, openings, 1.0, 1000.0, walls="pixel")
    field = FlowSolver(k).solve(chip)
    assert np.isfinite(field.velocity_um_s).all() and np.isfinite(field.pressure_pa).all()
    equations = systems.system(chip, k)
    moving = equations.linear(chip.boundary_values[:, None])[:, 0]
    fluxes = [opening.inward * moving[opening.faces].sum() for opening in equations.grid.openings]
    assert abs(sum(fluxes)) < 1e-9 * np.abs(fluxes).max()
    assert all(flux > 0 for flux, kind in zip(fluxes, kinds, strict=True) if kind == "inlet")


def test_a_channel_of_one_pixel_carries_what_flows_in(straight):
    field = FlowSolver(2).solve(straight(1))
    assert field.velocity_um_s[2, 3:-3, 0] == pytest.approx(150.0, rel=1e-6)  # on the axis
