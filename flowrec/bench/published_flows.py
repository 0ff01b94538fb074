"""Published flows: the lid-driven cavity, and the cylinder in a channel at Re 20, drawn as a mask.

U. Ghia, K. N. Ghia, C. T. Shin, High-Re solutions for incompressible flow using the Navier-Stokes equations and a
multigrid method, J. Comput. Phys. 48 (1982) 387-411, tables I (u on x = 0.5) and II (v on y = 0.5).

M. Schaefer, S. Turek et al., Benchmark computations of laminar flow around a cylinder, NNFM 52 (1996) 547-566, case
2D-1; the digits are those of FeatFlow (www.featflow.de). Channel 2.2 m x 0.41 m, cylinder of 0.1 m at (0.2, 0.2) m.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, UM_PER_M, Bools, Floats
from flowrec.physics import Chip, Opening, Walls, newton_equations, system

# fmt: off
# Between the walls, whose values are known.
_Y = (
    0.9766, 0.9688, 0.9609, 0.9531, 0.8516, 0.7344, 0.6172, 0.5, 0.4531, 0.2813, 0.1719, 0.1016, 0.0703,
    0.0625, 0.0547
)
_X = (  # places of the table's rows, over the side of the cavity
    0.9688, 0.9609, 0.9531, 0.9453, 0.9063, 0.8594, 0.8047, 0.5, 0.2344, 0.2266, 0.1563, 0.0938, 0.0781,
    0.0703, 0.0625
)
_U = {
    100: (
        0.84123, 0.78871, 0.73722, 0.68717, 0.23151, 0.00332, -0.13641, -0.20581, -0.2109, -0.15662, -0.1015,
        -0.06434, -0.04775, -0.04192, -0.03717
    ),
    400: (
        0.75837, 0.68439, 0.61756, 0.55892, 0.29093, 0.16256, 0.02135, -0.11477, -0.17119, -0.32726, -0.24299,
        -0.14612, -0.10338, -0.09266, -0.08186
    ),
    1000: (
        0.65928, 0.57492, 0.51117, 0.46604, 0.33304, 0.18719, 0.05702, -0.0608, -0.10648, -0.27805, -0.38289,
        -0.2973, -0.2222, -0.20196, -0.18109
    ),
}
_V = {
    100: (
        -0.05906, -0.07391, -0.08864, -0.10313, -0.16914, -0.22445, -0.24533, 0.05454, 0.17527, 0.17507,
        0.16077, 0.12317, 0.1089, 0.10091, 0.09233
    ),
    400: (
        -0.12146, -0.15663, -0.19254, -0.22847, -0.23827, -0.44993, -0.38598, 0.05186, 0.30174, 0.30203,
        0.28124, 0.22965, 0.2092, 0.19713, 0.1836
    ),
    1000: (
        -0.21388, -0.27669, -0.33714, -0.39188, -0.5155, -0.42665, -0.31966, 0.02526, 0.32235, 0.33075,
        0.37095, 0.32627, 0.30353, 0.29012, 0.27485
    ),
}
# fmt: on
_MISPRINT = (400, 0.9063)  # v = -0.23827 there lies on no smooth curve

REFERENCE = {"drag": 5.57953523384, "lift": 0.010618948146, "pressure_difference_pa": 0.11752016697}
LENGTH_M, HEIGHT_M, DIAMETER_M, MIDDLE_M, MEAN_M_S = 2.2, 0.41, 0.1, 0.2, 0.2
MARGIN_PX = 3
_BOX_M = (0.1, 0.3, 0.1, 0.3)  # left, right, low, high of the control volume


def cavity_case(cells: int, reynolds: int) -> dict[str, Any]:
    """Deviation from the table on cells x cells, in units of the lid's speed."""
    u, v = _solve(cells, reynolds)
    middle = (np.arange(cells) + 0.5) / cells
    y = np.concatenate(([0.0], middle, [1.0]))
    # Rows count downwards, the table's y upwards.
    u_line = CubicSpline(y, np.concatenate(([0.0], u[::-1, cells // 2], [1.0])))
    v_line = CubicSpline(y, np.concatenate(([0.0], -v[cells // 2], [0.0])))
    u_off = u_line(np.array(_Y)) - _U[reynolds]
    sound = np.array([(reynolds, x) != _MISPRINT for x in _X])
    v_off = (v_line(np.array(_X)) - _V[reynolds])[sound]
    return {
        "reynolds": reynolds,
        "cells": cells,
        **{f"{name}_largest": float(np.abs(off).max()) for name, off in (("u", u_off), ("v", v_off))},
        **{f"{name}_rms": float(np.sqrt((off**2).mean())) for name, off in (("u", u_off), ("v", v_off))},
        "u_at_quarters": [float(u) for u in u_line(np.array([0.25, 0.5, 0.75]))],
    }


def _solve(cells: int, reynolds: float) -> tuple[Floats, Floats]:
    """Velocities u (cells, cells + 1) and v (cells + 1, cells) of faces over that of the lid, which is the top row."""
    box = Chip("cavity", np.ones((cells, cells), bool), UM_PER_M / cells, (), 1.0, 1.0, walls="pixel")
    equations = newton_equations(box, 1)
    push = equations.momentum.sliding @ np.array([0.0, 0.0, 1.0, 0.0])
    moving = np.append(equations.steady(np.zeros(0), reynolds / cells, 100, 1e-9, push), 0.0)
    return moving[equations.grid.u.number], moving[equations.grid.v.number]


def cylinder_case(px_per_diameter: int, k: int, walls: Walls) -> dict[str, Any]:
    """Coefficients and their errors; a diameter has a multiple of 10 pixels, so that walls are between pixels."""
    chip, px = _chip(px_per_diameter, walls)
    h, mu, rho = px / k, chip.viscosity_mpa_s * PA_S_PER_MPA_S, chip.density_kg_m3
    equations = system(chip, k)
    drive = np.array([MEAN_M_S, 0.0])
    inertia = rho * h / mu
    moving = equations.steady(drive, inertia, 60, 1e-9)
    load = equations.residual(moving, drive, inertia)
    grid = equations.grid
    p = np.append(equations.pressure(load[:, None])[:, 0] * mu / h, 0.0)[grid.number_p]
    padded = np.append(moving, 0.0)
    u, v = padded[grid.u.number], padded[grid.v.number]  # fluxes, which are velocities where no wall cuts the faces
    bottom = (grid.fluid.shape[0] / k - MARGIN_PX) * k  # row of the lower wall
    left, right = (round(x / h) for x in _BOX_M[:2])
    top, low = (round(bottom - y / h) for y in (_BOX_M[3], _BOX_M[2]))
    force = _force(u, v, p, (left, right, top, low), h, mu, rho)
    scale = 2.0 / (rho * MEAN_M_S**2 * DIAMETER_M)
    line = bottom - MIDDLE_M / h - 0.5  # row of the axis, in cells
    front = _at_wall(p, grid.fluid, line, (MIDDLE_M - DIAMETER_M / 2) / h, -1)
    back = _at_wall(p, grid.fluid, line, (MIDDLE_M + DIAMETER_M / 2) / h, 1)
    found = {"drag": scale * force[0], "lift": -scale * force[1], "pressure_difference_pa": front - back}
    return {
        "px_per_diameter": px_per_diameter,
        "k": k,
        "walls": walls,
        "unknowns": equations.stream.curl.shape[1],
        **found,
        **{f"{key}_error_percent": 100.0 * (found[key] / exact - 1.0) for key, exact in REFERENCE.items()},
    }


def _chip(px_per_diameter: int, walls: Walls) -> tuple[Chip, float]:
    px = DIAMETER_M / px_per_diameter
    height, length = round(HEIGHT_M / px), round(LENGTH_M / px)
    mask = np.zeros((height + 2 * MARGIN_PX, length), bool)
    mask[MARGIN_PX:-MARGIN_PX] = True
    rows, columns = np.mgrid[: mask.shape[0], :length] + 0.5
    y = (mask.shape[0] - MARGIN_PX - rows) * px
    mask[np.hypot(columns * px - MIDDLE_M, y - MIDDLE_M) < DIAMETER_M / 2] = False
    ends = (MARGIN_PX, MARGIN_PX + height - 1)
    openings = (Opening("left", *ends, "inlet", MEAN_M_S * UM_PER_M), Opening("right", *ends, "outlet", 0.0))
    return Chip("cylinder", mask, px / M_PER_UM, openings, 1.0, 1.0, walls=walls), px


def _force(
    u: Floats, v: Floats, p: Floats, box: tuple[int, int, int, int], h: float, mu: float, rho: float
) -> tuple[float, float]:
    """Force per depth (N/m) along columns and rows on the body in the box, by the balance of momentum.

    F = -oint (rho w (w . n) + p n - mu (grad w + grad w') n) ds over the box, whose sides are faces of cells.
    """
    left, right, top, low = box
    along = down = 0.0
    for normal, tangential in _sides(u, v, p, (left, right), (top, low), h, mu, rho):
        along, down = along - normal, down - tangential
    # The other two sides are these of the transposed field.
    for normal, tangential in _sides(v.T, u.T, p.T, (top, low), (left, right), h, mu, rho):
        along, down = along - tangential, down - normal
    return along, down


def _sides(
    u: Floats, v: Floats, p: Floats, ends: tuple[int, int], span: tuple[int, int], h: float, mu: float, rho: float
) -> Iterator[tuple[float, float]]:
    """Momentum through the two sides of the box that are normal to u: its components along u and along v."""
    top, low = span
    rows = slice(top, low)
    for i, outward in zip(ends, (-1.0, 1.0), strict=True):
        w = u[rows, i]
        cross = 0.25 * (v[top:low, i - 1] + v[top:low, i] + v[top + 1 : low + 1, i - 1] + v[top + 1 : low + 1, i])
        pressure = 0.5 * (p[rows, i - 1] + p[rows, i])
        stretch = (u[rows, i + 1] - u[rows, i - 1]) / (2 * h)
        step = v[top:low, i] - v[top:low, i - 1] + v[top + 1 : low + 1, i] - v[top + 1 : low + 1, i - 1]
        shear = (u[top + 1 : low + 1, i] - u[top - 1 : low - 1, i]) / (2 * h) + 0.5 * step / h
        normal = outward * h * float((rho * w * w + pressure - 2 * mu * stretch).sum())
        yield normal, outward * h * float((rho * w * cross - mu * shear).sum())


def _at_wall(p: Floats, fluid: Bools, row: float, wall: float, step: int) -> float:
    """Pressure at the wall (in cells along the row), extrapolated from the first three cells away from it."""
    upper = int(np.floor(row))
    share = row - upper
    first = int(np.ceil(wall)) if step > 0 else int(np.floor(wall)) - 1
    columns = first + step * np.arange(6)
    columns = columns[fluid[upper, columns] & fluid[upper + 1, columns]][1:4]
    values = (1 - share) * p[upper, columns] + share * p[upper + 1, columns]
    return float(np.polyval(np.polyfit(columns + 0.5 - wall, values, 2), 0.0))
