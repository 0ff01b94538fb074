"""Flow of fluids whose viscosity depends on the shear rate, beside exact profiles and the Newtonian solver."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson
from scipy.optimize import brentq

from flowrec.core import FlowError
from flowrec.physics import CarreauYasuda, ChipSettings, FlowSolver, PowerLaw, blood, clear_cache, load_chip
from flowrec.physics.chip.fluid import TabulatedLaw
from flowrec.physics.flow import generalised

THIN = PowerLaw(0.5, 1.0, 1e-3)


def profile(law, across, half_m, mean_m_s):
    """Fully developed profile (m/s) at fractions of the width, and the wall stress over viscosity, by fine quadrature.

    The stress grows linearly from the middle, so the shear rate there is the inverse of the flow curve.
    """
    curve = np.concatenate([[0.0], np.logspace(-8, 8, 20_001)])
    stress = curve * law.relative(curve**2)[0]
    y = np.linspace(0.0, half_m, 4_001)  # from the middle to the wall

    def speeds(wall):
        rate = np.interp(wall * y / half_m, stress, curve)
        fall = cumulative_simpson(rate, x=y, initial=0.0)
        return fall[-1] - fall

    wall = brentq(lambda wall: speeds(wall).mean() - mean_m_s, 1e-6, 1e4, rtol=1e-10)
    wall = brentq(lambda w: np.trapezoid(speeds(w), y) / half_m - mean_m_s, 0.5 * wall, 2.0 * wall, rtol=1e-12)
    return np.interp(np.abs(2.0 * across - 1.0) * half_m, y, speeds(wall)), wall


@pytest.mark.parametrize("law", [THIN, PowerLaw(1.5), blood()], ids=["thinning", "thickening", "blood"])
def test_the_profile_and_pressure_of_a_channel_of_12_pixels_are_those_of_the_law(straight, law):
    chip = replace(straight(width=12, length=60, viscosity_mpa_s=3.0), law=law)
    field = FlowSolver().solve(chip)
    exact, wall = profile(law, (np.arange(12) + 0.5) / 12.0, 60e-6, 100e-6)
    found = field.velocity_um_s[2:14, 50, 0] * 1e-6
    assert np.linalg.norm(found - exact) < 5e-3 * np.linalg.norm(exact)
    falls = (field.pressure_pa[2:14, 48] - field.pressure_pa[2:14, 54]) / 60e-6
    np.testing.assert_allclose(falls.mean(), 3e-3 * wall / 60e-6, rtol=4e-3)


def test_the_quadrature_has_the_exact_power_law_profile():
    across = np.array([0.05, 0.2, 0.45])
    found, wall = profile(PowerLaw(0.5, 1.0, 1e-9), across, 60e-6, 1e-4)
    np.testing.assert_allclose(found, 4.0 / 3.0 * 1e-4 * (1.0 - np.abs(2.0 * across - 1.0) ** 3), rtol=1e-5)
    np.testing.assert_allclose(wall, (4.0 * 1e-4 / 60e-6) ** 0.5, rtol=1e-5)


@pytest.mark.parametrize("walls", ["smooth", "pixel"])
def test_laws_of_constant_viscosity_have_the_newtonian_flow_on_cut_walls_too(walls):
    chip = replace(load_chip(ChipSettings()), walls=walls, depth_um=80.0)
    newtonian = FlowSolver().solve(chip)
    for law in (PowerLaw(1.0), TabulatedLaw((1.0, 10.0), (1.0, 1.0))):
        found = FlowSolver().solve(replace(chip, law=law))
        scale = np.abs(newtonian.velocity_um_s).max()
        assert np.abs(found.velocity_um_s - newtonian.velocity_um_s).max() < 1e-6 * scale
        assert np.abs(found.pressure_pa - newtonian.pressure_pa).max() < 1e-5 * np.ptp(newtonian.pressure_pa)


def test_an_oblique_thinning_flow_converges_with_the_square_of_the_cell(oblique_error):
    errors = [oblique_error(12.0, 30.0, k, THIN) for k in (1, 2)]
    assert errors[0] < 0.8e-2
    assert errors[1] < 0.3 * errors[0]


def test_a_law_of_twice_the_viscosity_has_the_flow_of_twice_the_viscosity(crossing):
    law, rates = CarreauYasuda(0.4, 0.3), np.logspace(-6, 6, 400)
    doubled = TabulatedLaw(tuple(rates), tuple(2.0 * law.relative(rates**2)[0]))
    field = FlowSolver().solve(replace(crossing.with_boundary(crossing.boundary_values, 2.0), law=law))
    other = FlowSolver().solve(replace(crossing, law=doubled))
    np.testing.assert_allclose(other.velocity_um_s, field.velocity_um_s, atol=2e-5 * np.abs(field.velocity_um_s).max())


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(PowerLaw(0.6), marks=pytest.mark.slow("solves the flow for each unknown, of another law")),
        CarreauYasuda(0.4, 0.05, 0.1, 1.5),
    ],
    ids=["power law", "carreau"],
)
def test_the_sensitivities_are_the_derivatives_of_the_flow(crossing, law, monkeypatch):
    monkeypatch.setattr(generalised, "ENOUGH", 1e-12)  # differences of flows need exact flows
    chip = replace(crossing, law=law, depth_um=60.0, density_kg_m3=3e5)
    solver = FlowSolver(tolerance=1e-11)
    found = solver.sensitivities(chip, friction=True, shapes=True, law=True)
    openings, unknowns = len(chip.openings), len(law.unknowns)
    assert found.law_unknowns == law.unknowns
    assert len(found.modes) == openings + 2 + 4 + unknowns

    def derivative(change, step):
        ends = [solver.sensitivities(change(sign * step)).base for sign in (1.0, -1.0)]
        return (ends[0] - ends[1]) / (2.0 * step)

    def with_value(index):
        return lambda step: chip.with_boundary(chip.boundary_values + step * np.eye(openings)[index])

    changes = {index: (with_value(index), 1e-5 if index > 1 else 0.5) for index in range(openings)}
    changes[openings] = (lambda step: replace(chip, density_kg_m3=chip.density_kg_m3 * np.exp(-step)), 1e-2)
    changes[openings + 1] = (lambda step: replace(chip, depth_um=chip.depth_um * np.exp(-0.5 * step)), 1e-3)
    for number in range(unknowns):
        offset = np.eye(unknowns)[number]
        place = len(found.modes) - unknowns + number
        changes[place] = (lambda step, offset=offset: replace(chip, law=law.with_offset(step * offset)), 1e-3)
    for place, (change, step) in changes.items():
        expected = derivative(change, step)
        np.testing.assert_allclose(found.modes[place], expected, atol=2e-4 * np.abs(expected).max(), err_msg=str(place))


def test_the_linear_prediction_and_its_remainder_lead_to_the_flow_of_other_values(crossing):
    law = PowerLaw(0.6)
    chip = replace(crossing, law=law, depth_um=60.0)
    solver = FlowSolver()
    expansion = solver.sensitivities(chip, friction=True, law=True)
    offset = np.array([30.0, -10.0, 0.0, 0.02, 0.1, 0.2, -0.1])
    remainder = expansion.start()
    for _ in range(25):
        remainder = expansion.approach(offset, remainder)
    flux = expansion.flux + expansion.flux_modes @ offset + remainder.flux
    other = replace(chip.with_boundary(chip.boundary_values + offset[:4], density_kg_m3=1000.0 * np.exp(-0.1)))
    other = replace(other, depth_um=60.0 * np.exp(-0.1), law=law.with_offset(offset[-1:]))
    exact = solver.sensitivities(other).base
    assert np.abs(expansion.base + np.tensordot(offset, expansion.modes, axes=1) - exact).max() > 1.0  # um/s
    np.testing.assert_allclose(expansion.pixels(flux), exact, atol=1e-4 * np.abs(exact).max())


def test_a_shallow_power_law_layer_has_the_resistance_of_the_fluid_between_plates(straight):
    law, depth_m = PowerLaw(0.5, 1.0, 1e-3), 8e-6
    chip = replace(straight(width=24, length=60, density_kg_m3=1.0), law=law, depth_um=1e6 * depth_m)
    pressure = FlowSolver().solve(chip).pressure_pa
    slope = (pressure[14, 40] - pressure[14, 50]) / 100e-6
    middle = FlowSolver().solve(chip).velocity_um_s[14, 45, 0] * 1e-6
    # K ((2 n + 1) / n)^n V^n (2 / H)^(n + 1)
    np.testing.assert_allclose(slope, 1e-3 * 4.0**0.5 * middle**0.5 * (2.0 / depth_m) ** 1.5, rtol=5e-3)


def test_a_thinning_flow_with_inertia_does_not_depend_on_how_it_is_found(crossing, monkeypatch):
    chip = replace(crossing, law=PowerLaw(0.6), density_kg_m3=3e6)
    field = FlowSolver(max_iterations=200).solve(chip)
    slow = FlowSolver(convection=False).solve(chip)
    scale = np.abs(field.velocity_um_s).max()
    assert np.abs(field.velocity_um_s - slow.velocity_um_s).max() > 0.05 * scale  # inertia matters
    clear_cache()
    monkeypatch.setattr(generalised, "KEEPING", 0.0)
    monkeypatch.setattr(generalised, "NEGLIGIBLE", 0.0)
    other = FlowSolver(max_iterations=200).solve(chip)
    np.testing.assert_allclose(other.velocity_um_s, field.velocity_um_s, atol=1e-5 * scale)


def test_a_law_that_can_not_be_followed_is_an_error_for_people(crossing):
    with pytest.raises(FlowError, match="converge"):
        FlowSolver(max_iterations=2).solve(replace(crossing, law=PowerLaw(0.3)))


def test_the_field_states_the_law(straight):
    assert FlowSolver().solve(replace(straight(), law=THIN)).viscosity_law == (
        "power_law exponent=0.5 rate_1_s=1.0 plateau_1_s=0.001"
    )
    assert FlowSolver().solve(straight()).viscosity_law == ""
