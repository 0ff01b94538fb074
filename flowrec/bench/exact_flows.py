"""Flows with an exact solution: a channel along the pixels, a channel at an angle to them, and a bend."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, Floats
from flowrec.physics import Chip, FlowSolver, Opening, ViscosityLaw, Walls, from_distance, newton_equations, sample

UM_PER_PX, SPEED_UM_S, MARGIN_PX = 10.0, 100.0, 2
INNER_PX, OUTER_PX = 12.3, 20.3  # radii of the walls of the bend
_SAMPLES = 65  # across a channel


def straight_channel(width_px: int, length_px: int, law: ViscosityLaw | None = None) -> Chip:
    """A channel along the pixels."""
    mask = np.zeros((width_px + 2 * MARGIN_PX, length_px), bool)
    mask[MARGIN_PX:-MARGIN_PX] = True
    ends = (MARGIN_PX, MARGIN_PX + width_px - 1)
    openings = (Opening("left", *ends, "inlet", SPEED_UM_S), Opening("right", *ends, "outlet", 0.0))
    return Chip("straight", mask, UM_PER_PX, openings, 1.0, 1000.0, walls="pixel", law=law)


def oblique_channel(
    width_px: float, angle_deg: float, walls: Walls = "smooth", law: ViscosityLaw | None = None
) -> tuple[Chip, Callable[[Floats, Floats], tuple[Floats, Floats]]]:
    """A channel at an angle to the pixels, and its coordinates (across, along) in px of places (x, y) in px."""
    angle, length = np.radians(angle_deg), 80
    rows = int(length * np.tan(angle)) + 24

    def to_channel(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        # Not symmetric to the pixels, as in a real image.
        x, y = x - 0.5 * (length - 1) + 0.13, y - 0.5 * (rows - 1) + 0.27
        return y * np.cos(angle) - x * np.sin(angle), x * np.cos(angle) + y * np.sin(angle)

    y, x = np.mgrid[:rows, :length].astype(float)
    mask = np.abs(to_channel(x, y)[0]) < width_px / 2
    left, right = np.flatnonzero(mask[:, 0]), np.flatnonzero(mask[:, -1])
    openings = (
        Opening("left", int(left[0]), int(left[-1]), "inlet", SPEED_UM_S * width_px / len(left)),
        Opening("right", int(right[0]), int(right[-1]), "outlet", 0.0),
    )
    return Chip("oblique", mask, UM_PER_PX, openings, 1.0, 1000.0, walls=walls, law=law), to_channel


def bend(law: ViscosityLaw | None = None) -> Chip:
    """A quarter of a ring, whose walls are the circles of `bend_distance`."""
    y, x = np.mgrid[:26, :26].astype(float)
    mask = bend_distance(x, y) > 0.0
    end = np.flatnonzero(mask[:, 0])
    ends = int(end[0]), int(end[-1])
    openings = (Opening("left", *ends, "inlet", SPEED_UM_S), Opening("top", *ends, "outlet", 0.0))
    return Chip("bend", mask, UM_PER_PX, openings, 1.0, 1000.0, law=law)


def bend_distance(x: Floats, y: Floats) -> Floats:
    """Distance to the walls of the bend in px, negative in solid."""
    radius = np.hypot(x + 0.5, y + 0.5)
    return np.minimum(radius - INNER_PX, OUTER_PX - radius)


def bend_slope(pressure_pa: Floats) -> float:
    """Growth of the pressure (26, 26) per radian in the middle of the bend."""
    y, x = np.mgrid[:26, :26].astype(float)
    turn, radius = np.arctan2(y + 0.5, x + 0.5), np.hypot(x + 0.5, y + 0.5)
    core = (np.abs(radius - 0.5 * (INNER_PX + OUTER_PX)) < 1.5) & (np.abs(turn - np.pi / 4) < 0.2)
    return float(np.polyfit(turn[core], pressure_pa[core], 1)[0])


def straight_case(width_px: int, k: int) -> dict[str, Any]:
    """Errors of the profile (relative L2 norm at pixel centres, and sampled between them) and of 12 mu Q / w^3."""
    length = 3 * width_px + 8
    field = FlowSolver(k).solve(straight_channel(width_px, length))
    middle = length // 2
    profile = field.velocity_um_s[MARGIN_PX:-MARGIN_PX, middle, 0]
    exact = _parabola((np.arange(width_px) + 0.5) / width_px)
    across = np.linspace(0.0, 1.0, _SAMPLES)
    places = np.stack([np.full(_SAMPLES, middle + 0.3), MARGIN_PX - 0.5 + width_px * across], axis=1)
    sampled = sample(field, places * UM_PER_PX)[:, 0]
    row = len(field.pressure_pa) // 2
    fall = float(field.pressure_pa[row, middle - 3] - field.pressure_pa[row, middle + 3]) / (6e-6 * UM_PER_PX)
    return {
        "width_px": width_px,
        "k": k,
        "profile_error_percent": relative_percent(profile, exact),
        "sampled_error_percent": relative_percent(sampled, _parabola(across)),
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
    chip, inner, outer = bend(), INNER_PX, OUTER_PX
    equations = newton_equations(chip, k, from_distance(bend_distance, chip.mask.shape, k))
    h, mu = UM_PER_PX * M_PER_UM / k, chip.viscosity_mpa_s * PA_S_PER_MPA_S
    drive = np.array([SPEED_UM_S * M_PER_UM, 0.0])
    load = equations.residual(equations.linear(drive[:, None])[:, 0], drive, 0.0)
    pressure = equations.grid.pressure(equations.pressure(load[:, None])[:, 0]) * mu / h
    b, c = np.linalg.solve([[inner, 1 / inner], [outer, 1 / outer]], [-inner * np.log(inner), -outer * np.log(outer)])
    r = np.linspace(inner, outer, 20001)
    flux = -float(np.trapezoid(0.5 * (r * np.log(r) + b * r + c / r), r))
    exact = drive[0] * chip.openings[0].width_px * mu / (flux * UM_PER_PX * M_PER_UM)
    error_percent = 100.0 * (bend_slope(pressure) / exact - 1.0)
    return {"width_px": outer - inner, "k": k, "resistance_error_percent": error_percent}


def _parabola(across: Floats) -> Floats:
    """Plane Poiseuille flow at fractions of the width from one wall."""
    return 6.0 * SPEED_UM_S * across * (1.0 - across)


def relative_percent(found: NDArray[np.floating], exact: Floats) -> float:
    """L2 norm of the error over that of the exact values."""
    return 100.0 * float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def _slope_pa_m(width_px: float) -> float:
    """Pressure gradient of the plane channel at 1 mPa s."""
    return 12e-3 * SPEED_UM_S * 1e-6 / (width_px * UM_PER_PX * 1e-6) ** 2


def _oblique(width: float, angle_deg: float, k: int, walls: Walls) -> tuple[float, float]:
    """Relative error of the resistance of a channel across the mask, and how far the mask leaves it undetermined."""
    chip, to_channel = oblique_channel(width, angle_deg, walls)
    mask = chip.mask
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(float)
    across, along = to_channel(columns, rows)
    pressure = FlowSolver(k).solve(chip).pressure_pa
    core = mask & (np.abs(across) < 1.0) & (np.abs(along) < 20.0)
    fall = -float(np.polyfit(along[core] * UM_PER_PX * 1e-6, pressure[core], 1)[0])
    inside, outside = across[mask], across[~mask]
    narrowest = inside.max() - inside.min()
    widest = outside[outside > inside.max()].min() - outside[outside < inside.min()].max()
    # The resistance is proportional to the inverse third power of the width.
    return fall / _slope_pa_m(width) - 1.0, 1.5 * float(widest - narrowest) / width
