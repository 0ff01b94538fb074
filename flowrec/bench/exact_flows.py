"""Flows with an exact solution: a channel along the pixels, a channel at an angle to them, and a bend."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, Floats
from flowrec.physics import Chip, FlowSolver, Opening, Walls, from_distance, newton_equations, sample

_UM_PER_PX, _SPEED_UM_S, _MARGIN_PX = 10.0, 100.0, 2
_SAMPLES = 65  # across a channel


def straight_case(width_px: int, k: int) -> dict[str, Any]:
    """Errors of the profile (relative L2 norm at pixel centres, and sampled between them) and of 12 mu Q / w^3."""
    length = 3 * width_px + 8
    mask = np.zeros((width_px + 2 * _MARGIN_PX, length), bool)
    mask[_MARGIN_PX:-_MARGIN_PX] = True
    ends = (_MARGIN_PX, _MARGIN_PX + width_px - 1)
    openings = (Opening("left", *ends, "inlet", _SPEED_UM_S), Opening("right", *ends, "outlet", 0.0))
    field = FlowSolver(k).solve(Chip("straight", mask, _UM_PER_PX, openings, 1.0, 1000.0, walls="pixel"))
    middle = length // 2
    profile = field.velocity_um_s[_MARGIN_PX:-_MARGIN_PX, middle, 0]
    exact = _parabola((np.arange(width_px) + 0.5) / width_px)
    across = np.linspace(0.0, 1.0, _SAMPLES)
    places = np.stack([np.full(_SAMPLES, middle + 0.3), _MARGIN_PX - 0.5 + width_px * across], axis=1)
    sampled = sample(field, places * _UM_PER_PX)[:, 0]
    row = mask.shape[0] // 2
    fall = float(field.pressure_pa[row, middle - 3] - field.pressure_pa[row, middle + 3]) / (6e-6 * _UM_PER_PX)
    return {
        "width_px": width_px,
        "k": k,
        "profile_error_percent": _relative_percent(profile, exact),
        "sampled_error_percent": _relative_percent(sampled, _parabola(across)),
        "resistance_error_percent": 100.0 * (fall / _slope_pa_m(width_px) - 1.0),
    }


def oblique_case(width_px: int, k: int, walls: Walls, angles_deg: tuple[float, ...]) -> dict[str, Any]:
    """Largest and mean absolute error of the resistance over angles between channel and pixels.

    `undecided` is half the range of the resistances of all channels with the same mask, which determines the position
    of a straight wall of slope p / q only to 1 / (2 sqrt(p^2 + q^2)) pixels.
    """
    found = [_oblique(float(width_px), angle, k, walls) for angle in angles_deg]
    errors, undecided = [abs(error) for error, _ in found], [share for _, share in found]
    return {
        "width_px": width_px,
        "k": k,
        "walls": walls,
        "largest_resistance_error_percent": 100.0 * max(errors),
        "mean_resistance_error_percent": 100.0 * float(np.mean(errors)),
        "largest_undecided_percent": 100.0 * max(undecided),
        "mean_undecided_percent": 100.0 * float(np.mean(undecided)),
    }


def bend_case(k: int) -> dict[str, Any]:
    """Error of the resistance of a quarter of a ring whose walls are exact circles, not a mask.

    Stokes flow along circles: u = G / (2 mu) (r ln r + B r + C / r) for a pressure that grows by G per radian, with B
    and C such that u = 0 on both walls.
    """
    inner, outer = 12.3, 20.3

    def distance(x: Floats, y: Floats) -> Floats:
        radius = np.hypot(x + 0.5, y + 0.5)
        return np.asarray(np.minimum(radius - inner, outer - radius))

    y, x = np.mgrid[:26, :26].astype(float)
    mask = distance(x, y) > 0.0
    end = np.flatnonzero(mask[:, 0])
    first, last = int(end[0]), int(end[-1])
    openings = (Opening("left", first, last, "inlet", _SPEED_UM_S), Opening("top", first, last, "outlet", 0.0))
    chip = Chip("bend", mask, _UM_PER_PX, openings, 1.0, 1000.0)
    equations = newton_equations(chip, k, from_distance(distance, mask.shape, k))
    h, mu = _UM_PER_PX * M_PER_UM / k, chip.viscosity_mpa_s * PA_S_PER_MPA_S
    drive = np.array([_SPEED_UM_S * M_PER_UM, 0.0])
    load = equations.residual(equations.linear(drive[:, None])[:, 0], drive, 0.0)
    pressure = equations.grid.pressure(equations.pressure(load[:, None])[:, 0]) * mu / h
    turn, radius = np.arctan2(y + 0.5, x + 0.5), np.hypot(x + 0.5, y + 0.5)
    core = (np.abs(radius - (inner + outer) / 2) < 1.5) & (np.abs(turn - np.pi / 4) < 0.2)
    b, c = np.linalg.solve([[inner, 1 / inner], [outer, 1 / outer]], [-inner * np.log(inner), -outer * np.log(outer)])
    r = np.linspace(inner, outer, 20001)
    flux = -float(np.trapezoid(0.5 * (r * np.log(r) + b * r + c / r), r))
    exact = drive[0] * len(end) * mu / (flux * _UM_PER_PX * M_PER_UM)
    slope = float(np.polyfit(turn[core], pressure[core], 1)[0])
    return {"width_px": outer - inner, "k": k, "resistance_error_percent": 100.0 * (slope / exact - 1.0)}


def _parabola(across: Floats) -> Floats:
    """Plane Poiseuille flow at fractions of the width from one wall."""
    return 6.0 * _SPEED_UM_S * across * (1.0 - across)


def _relative_percent(found: NDArray[np.floating], exact: Floats) -> float:
    return 100.0 * float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def _slope_pa_m(width_px: float) -> float:
    """Pressure gradient of the plane channel at 1 mPa s."""
    return 12e-3 * _SPEED_UM_S * 1e-6 / (width_px * _UM_PER_PX * 1e-6) ** 2


def _oblique(width: float, angle_deg: float, k: int, walls: Walls) -> tuple[float, float]:
    """Relative error of the resistance of a channel across the mask, and how far the mask leaves it undetermined."""
    angle, length = np.radians(angle_deg), 80
    rows, columns = np.mgrid[: int(length * np.tan(angle)) + 24, :length].astype(float)
    # Not symmetric to the pixels, as in a real image.
    rows, columns = rows - rows.mean() + 0.27, columns - columns.mean() + 0.13
    across = rows * np.cos(angle) - columns * np.sin(angle)
    along = columns * np.cos(angle) + rows * np.sin(angle)
    mask = np.abs(across) < width / 2
    left, right = np.flatnonzero(mask[:, 0]), np.flatnonzero(mask[:, -1])
    openings = (
        Opening("left", int(left[0]), int(left[-1]), "inlet", _SPEED_UM_S * width / len(left)),
        Opening("right", int(right[0]), int(right[-1]), "outlet", 0.0),
    )
    chip = Chip("oblique", mask, _UM_PER_PX, openings, 1.0, 1000.0, walls=walls)
    pressure = FlowSolver(k).solve(chip).pressure_pa
    core = mask & (np.abs(across) < 1.0) & (np.abs(along) < 20.0)
    fall = -float(np.polyfit(along[core] * _UM_PER_PX * 1e-6, pressure[core], 1)[0])
    inside, outside = across[mask], across[~mask]
    narrowest = inside.max() - inside.min()
    widest = outside[outside > inside.max()].min() - outside[outside < inside.min()].max()
    # The resistance is proportional to the inverse third power of the width.
    return fall / _slope_pa_m(width) - 1.0, 1.5 * float(widest - narrowest) / width
