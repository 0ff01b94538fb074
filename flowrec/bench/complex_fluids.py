"""Flows of fluids whose viscosity depends on the shear rate, beside fine quadratures; the time that they take."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.optimize import brentq

from flowrec.bench.exact_flows import (
    INNER_PX,
    MARGIN_PX,
    OUTER_PX,
    SPEED_UM_S,
    UM_PER_PX,
    bend,
    bend_distance,
    bend_slope,
    oblique_channel,
    relative_percent,
    straight_channel,
)
from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, Floats
from flowrec.physics import (
    CarreauYasuda,
    Chip,
    FlowSolver,
    PowerLaw,
    Scales,
    ViscosityLaw,
    blood,
    clear_cache,
    from_distance,
    generalised_equations,
)

LAWS: dict[str, ViscosityLaw] = {
    "power law 0.5": PowerLaw(0.5, plateau_1_s=1e-3),
    "power law 0.7": PowerLaw(0.7, plateau_1_s=1e-3),
    "power law 1.5": PowerLaw(1.5, plateau_1_s=1e-3),
    "carreau 0.3": CarreauYasuda(0.3, 0.2),
    "blood": blood(),
}
_ACROSS, _RATES = 4_001, 20_001  # of the quadrature


def channel_profile(law: ViscosityLaw, half_m: float, mean_m_s: float, from_middle_m: Floats) -> tuple[Floats, float]:
    """Speeds (m/s) of the developed flow in a plane channel, and its wall stress over the viscosity of the chip.

    The stress grows linearly from the middle, and the shear rate is the inverse of the flow curve.
    """
    rates, stresses = _flow_curve(law)
    places = np.linspace(0.0, half_m, _ACROSS)

    def speeds(wall: float) -> Floats:
        fall = cumulative_simpson(np.interp(wall * places / half_m, stresses, rates), x=places, initial=0.0)
        return fall[-1] - fall

    def excess(wall: float) -> float:
        return float(np.trapezoid(speeds(wall), places)) / half_m - mean_m_s

    wall = float(brentq(excess, 1e-9, 1e6, rtol=1e-12))
    return np.interp(np.abs(from_middle_m), places, speeds(wall)), wall


def _flow_curve(law: ViscosityLaw) -> tuple[Floats, Floats]:
    """Shear rates (n,) in 1/s, and the stresses over the viscosity of the chip."""
    rates = np.concatenate([[0.0], np.logspace(-8, 8, _RATES - 1)])
    return rates, rates * law.relative(rates**2)[0]


def law_channel_case(name: str, width_px: int, k: int) -> dict[str, Any]:
    """Errors of the profile (relative L2 norm at pixel centres) and of the pressure gradient, along the pixels."""
    length = 5 * width_px
    field = FlowSolver(k).solve(straight_channel(width_px, length, LAWS[name]))
    px = UM_PER_PX * M_PER_UM
    across = np.asarray((np.arange(width_px) - 0.5 * (width_px - 1)) * px, np.float64)
    half = 0.5 * width_px * px
    exact, wall = channel_profile(LAWS[name], half, SPEED_UM_S * M_PER_UM, across)
    # Downstream, where the profile of the inlet is forgotten.
    at = length - width_px
    found = field.velocity_um_s[MARGIN_PX:-MARGIN_PX, at, 0] * M_PER_UM
    fall = (field.pressure_pa[:, at - 3] - field.pressure_pa[:, at + 3])[MARGIN_PX:-MARGIN_PX].mean() / (6.0 * px)
    return {
        "law": name,
        "width_px": width_px,
        "k": k,
        "profile_error_percent": relative_percent(found, exact),
        "resistance_error_percent": 100.0 * (float(fall) * half / (PA_S_PER_MPA_S * wall) - 1.0),
    }


def law_oblique_case(name: str, width_px: float, k: int, angles_deg: tuple[float, ...]) -> dict[str, Any]:
    """Largest and mean error of the profile over angles between channel and pixels; the walls are exact lines."""
    errors = [_oblique(LAWS[name], width_px, angle, k) for angle in angles_deg]
    return {
        "law": name,
        "width_px": width_px,
        "k": k,
        "largest_profile_error_percent": max(errors),
        "mean_profile_error_percent": float(np.mean(errors)),
    }


def _oblique(law: ViscosityLaw, width_px: float, angle_deg: float, k: int) -> float:
    """Relative error of the velocity in the middle of the channel, percent."""
    chip, to_channel = oblique_channel(width_px, angle_deg, law=law)
    mask, angle = chip.mask, np.radians(angle_deg)
    walls = from_distance(lambda x, y: 0.5 * width_px - np.abs(to_channel(x, y)[0]), mask.shape, k)
    equations = generalised_equations(chip, law, k, walls)
    flux = equations.steady(Scales.of(chip, k, False).drive, 0.0, 100, 1e-9)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(float)
    across, along = to_channel(x, y)
    core = np.abs(along)[mask] < 15.0
    px = UM_PER_PX * M_PER_UM
    speed, _ = channel_profile(law, 0.5 * width_px * px, SPEED_UM_S * M_PER_UM, across[mask][core] * px)
    exact = speed[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return relative_percent(equations.velocity(flux)[core], exact)


def bend_drop(law: ViscosityLaw, inner_m: float, outer_m: float, flow_m2_s: float) -> float:
    """Fall of the pressure per radian over the chip's viscosity, of the flow along circles between two walls.

    The balance along a circle, d(r^2 tau) / dr = -K r, has tau = -K / 2 + C / r^2, and tau = f(gamma) gamma with
    gamma = r d(u / r) / dr. C makes the wall speeds zero, K the flow rate per depth `flow_m2_s`.
    """
    rates, stresses = _flow_curve(law)
    radius = np.linspace(inner_m, outer_m, _ACROSS)

    def turning(drop: float, constant: float) -> Floats:
        tau = -0.5 * drop + constant / radius**2
        rate = np.sign(tau) * np.interp(np.abs(tau), stresses, rates)
        return cumulative_simpson(rate / radius, x=radius, initial=0.0)

    def flow(drop: float) -> float:
        ends = 0.5 * drop * inner_m**2, 0.5 * drop * outer_m**2
        constant = brentq(lambda c: turning(drop, c)[-1], *ends, rtol=1e-13)
        return float(np.trapezoid(turning(drop, constant) * radius, radius))

    return float(brentq(lambda drop: flow(drop) - flow_m2_s, 1e-9, 1e6, rtol=1e-10))


def law_bend_case(name: str, k: int) -> dict[str, Any]:
    """Error of the resistance of a quarter of a ring whose walls are exact circles."""
    law = LAWS[name]
    chip = bend(law)
    equations = generalised_equations(chip, law, k, from_distance(bend_distance, chip.mask.shape, k))
    scales = Scales.of(chip, k, False)
    flux = equations.steady(scales.drive, 0.0, 100, 1e-9)
    load = equations.residual(flux, scales.drive, 0.0)
    pressure = equations.grid.pressure(equations.pressure(load)) * scales.pressure
    px = UM_PER_PX * M_PER_UM
    exact = bend_drop(law, INNER_PX * px, OUTER_PX * px, SPEED_UM_S * M_PER_UM * chip.openings[0].width_px * px)
    error_percent = 100.0 * (bend_slope(pressure) / (PA_S_PER_MPA_S * exact) - 1.0)
    return {"law": name, "k": k, "resistance_error_percent": error_percent}


def law_speed_case(pattern: str, chip: Chip, k: int, repeats: int) -> list[dict[str, Any]]:
    """CPU seconds of a solve without anything in the cache, for a Newtonian fluid and for laws; least of `repeats`."""

    def seconds(law: ViscosityLaw | None) -> float:
        taken = []
        for _ in range(repeats):
            clear_cache()
            began = time.process_time()
            FlowSolver(k).solve(replace(chip, law=law))
            taken.append(time.process_time() - began)
        return min(taken)

    newtonian = seconds(None)
    rows = []
    for name, law in LAWS.items():
        taken = seconds(law)
        rows.append(
            {
                "pattern": pattern,
                "law": name,
                "k": k,
                "cpu_s": taken,
                "newtonian_cpu_s": newtonian,
                "over_newtonian": taken / newtonian,
            }
        )
    return rows
