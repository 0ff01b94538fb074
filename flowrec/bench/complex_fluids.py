"""Flows of fluids whose viscosity depends on the shear rate, beside fine quadratures; the time that they take."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.optimize import brentq

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, Floats
from flowrec.physics import (
    CarreauYasuda,
    Chip,
    FlowSolver,
    Opening,
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
_UM_PER_PX, _SPEED_UM_S, _MARGIN_PX = 10.0, 100.0, 2
_ACROSS, _RATES = 4_001, 20_001  # of the quadrature


def channel_profile(law: ViscosityLaw, half_m: float, mean_m_s: float, from_middle_m: Floats) -> tuple[Floats, float]:
    """Speeds (m/s) of the developed flow in a plane channel, and its wall stress over the viscosity of the chip.

    The stress grows linearly from the middle, and the shear rate is the inverse of the flow curve.
    """
    rates = np.concatenate([[0.0], np.logspace(-8, 8, _RATES - 1)])
    stresses = rates * law.relative(rates**2)[0]
    places = np.linspace(0.0, half_m, _ACROSS)

    def speeds(wall: float) -> Floats:
        fall = cumulative_simpson(np.interp(wall * places / half_m, stresses, rates), x=places, initial=0.0)
        return np.asarray(fall[-1] - fall)

    def excess(wall: float) -> float:
        return float(np.trapezoid(speeds(wall), places)) / half_m - mean_m_s

    wall = float(brentq(excess, 1e-9, 1e6, rtol=1e-12))
    return np.interp(np.abs(from_middle_m), places, speeds(wall)), wall


def law_channel_case(name: str, width_px: int, k: int) -> dict[str, Any]:
    """Errors of the profile (relative L2 norm at pixel centres) and of the pressure gradient, along the pixels."""
    length = 5 * width_px
    mask = np.zeros((width_px + 2 * _MARGIN_PX, length), bool)
    mask[_MARGIN_PX:-_MARGIN_PX] = True
    ends = (_MARGIN_PX, _MARGIN_PX + width_px - 1)
    openings = (Opening("left", *ends, "inlet", _SPEED_UM_S), Opening("right", *ends, "outlet", 0.0))
    chip = Chip("channel", mask, _UM_PER_PX, openings, 1.0, 1000.0, walls="pixel", law=LAWS[name])
    field = FlowSolver(k).solve(chip)
    px = _UM_PER_PX * M_PER_UM
    across = np.asarray((np.arange(width_px) - 0.5 * (width_px - 1)) * px, np.float64)
    half = 0.5 * width_px * px
    exact, wall = channel_profile(LAWS[name], half, _SPEED_UM_S * M_PER_UM, across)
    # Downstream, where the profile of the inlet is forgotten.
    at = length - width_px
    found = field.velocity_um_s[_MARGIN_PX:-_MARGIN_PX, at, 0] * M_PER_UM
    fall = (field.pressure_pa[:, at - 3] - field.pressure_pa[:, at + 3])[_MARGIN_PX:-_MARGIN_PX].mean() / (6.0 * px)
    return {
        "law": name,
        "width_px": width_px,
        "k": k,
        "profile_error_percent": 100.0 * float(np.linalg.norm(found - exact) / np.linalg.norm(exact)),
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
    angle, length = np.radians(angle_deg), 80
    rows = int(length * np.tan(angle)) + 24
    # Not symmetric to the pixels.
    middle_x, middle_y = 0.5 * (length - 1) - 0.13, 0.5 * (rows - 1) - 0.27

    def across(x: Floats, y: Floats) -> Floats:
        return np.asarray((y - middle_y) * np.cos(angle) - (x - middle_x) * np.sin(angle))

    y, x = np.mgrid[:rows, :length].astype(float)
    mask = np.abs(across(x, y)) < 0.5 * width_px
    left, right = np.flatnonzero(mask[:, 0]), np.flatnonzero(mask[:, -1])
    openings = (
        Opening("left", int(left[0]), int(left[-1]), "inlet", _SPEED_UM_S * width_px / len(left)),
        Opening("right", int(right[0]), int(right[-1]), "outlet", 0.0),
    )
    chip = Chip("oblique", mask, _UM_PER_PX, openings, 1.0, 1000.0, law=law)
    walls = from_distance(lambda x, y: 0.5 * width_px - np.abs(across(x, y)), mask.shape, k)
    equations = generalised_equations(chip, law, k, walls)
    flux = equations.steady(Scales.of(chip, k, False).drive, 0.0, 100, 1e-9)
    along = (x - middle_x) * np.cos(angle) + (y - middle_y) * np.sin(angle)
    core = np.abs(along)[mask] < 15.0
    px = _UM_PER_PX * M_PER_UM
    speed, _ = channel_profile(law, 0.5 * width_px * px, _SPEED_UM_S * M_PER_UM, across(x, y)[mask][core] * px)
    exact = speed[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return 100.0 * float(np.linalg.norm(equations.velocity(flux)[core] - exact) / np.linalg.norm(exact))


def bend_drop(law: ViscosityLaw, inner_m: float, outer_m: float, flow_m2_s: float) -> float:
    """Fall of the pressure per radian over the chip's viscosity, of the flow along circles between two walls.

    The balance along a circle, d(r^2 tau) / dr = -K r, has tau = -K / 2 + C / r^2, and tau = f(gamma) gamma with
    gamma = r d(u / r) / dr. C makes the wall speeds zero, K the flow rate per depth `flow_m2_s`.
    """
    rates = np.concatenate([[0.0], np.logspace(-8, 8, _RATES - 1)])
    stresses = rates * law.relative(rates**2)[0]
    radius = np.linspace(inner_m, outer_m, _ACROSS)

    def turning(drop: float, constant: float) -> Floats:
        tau = -0.5 * drop + constant / radius**2
        rate = np.sign(tau) * np.interp(np.abs(tau), stresses, rates)
        return np.asarray(cumulative_simpson(rate / radius, x=radius, initial=0.0))

    def flow(drop: float) -> float:
        ends = 0.5 * drop * inner_m**2, 0.5 * drop * outer_m**2
        constant = brentq(lambda c: turning(drop, c)[-1], *ends, rtol=1e-13)
        return float(np.trapezoid(turning(drop, constant) * radius, radius))

    return float(brentq(lambda drop: flow(drop) - flow_m2_s, 1e-9, 1e6, rtol=1e-10))


def law_bend_case(name: str, k: int) -> dict[str, Any]:
    """Error of the resistance of a quarter of a ring whose walls are exact circles."""
    inner, outer, law = 12.3, 20.3, LAWS[name]

    def distance(x: Floats, y: Floats) -> Floats:
        radius = np.hypot(x + 0.5, y + 0.5)
        return np.asarray(np.minimum(radius - inner, outer - radius))

    y, x = np.mgrid[:26, :26].astype(float)
    mask = distance(x, y) > 0.0
    end = np.flatnonzero(mask[:, 0])
    ends = int(end[0]), int(end[-1])
    openings = (Opening("left", *ends, "inlet", _SPEED_UM_S), Opening("top", *ends, "outlet", 0.0))
    chip = Chip("bend", mask, _UM_PER_PX, openings, 1.0, 1000.0, law=law)
    equations = generalised_equations(chip, law, k, from_distance(distance, mask.shape, k))
    scales = Scales.of(chip, k, False)
    flux = equations.steady(scales.drive, 0.0, 100, 1e-9)
    load = equations.residual(flux, scales.drive, 0.0)
    pressure = equations.grid.pressure(equations.pressure(load)) * scales.pressure
    turn, radius = np.arctan2(y + 0.5, x + 0.5), np.hypot(x + 0.5, y + 0.5)
    core = (np.abs(radius - 0.5 * (inner + outer)) < 1.5) & (np.abs(turn - np.pi / 4) < 0.2)
    slope = float(np.polyfit(turn[core], pressure[core], 1)[0])
    px = _UM_PER_PX * M_PER_UM
    exact = bend_drop(law, inner * px, outer * px, _SPEED_UM_S * M_PER_UM * len(end) * px)
    return {"law": name, "k": k, "resistance_error_percent": 100.0 * (slope / (PA_S_PER_MPA_S * exact) - 1.0)}


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
