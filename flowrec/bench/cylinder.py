"""The cylinder in a channel at Re 20, drawn as a mask: drag, lift and pressure difference.

M. Schaefer, S. Turek et al., Benchmark computations of laminar flow around a cylinder, NNFM 52 (1996) 547-566, case
2D-1; the digits are those of FeatFlow (www.featflow.de). Channel 2.2 m x 0.41 m, cylinder of 0.1 m at (0.2, 0.2) m.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip, Opening, Walls
from flowrec.flow.newton_solver import system
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S, UM_PER_M

REFERENCE = {"drag": 5.57953523384, "lift": 0.010618948146, "pressure_difference_pa": 0.11752016697}
LENGTH_M, HEIGHT_M, DIAMETER_M, MIDDLE_M, MEAN_M_S = 2.2, 0.41, 0.1, 0.2, 0.2
MARGIN_PX = 3
_BOX_M = (0.1, 0.3, 0.1, 0.3)  # left, right, low, high of the control volume

Array = NDArray[np.float64]


def cylinder_case(px_per_diameter: int, k: int, walls: Walls) -> dict[str, Any]:
    """Coefficients on a mask of so many pixels a diameter (a multiple of 10: walls lie between pixels)."""
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
    u: Array, v: Array, p: Array, box: tuple[int, int, int, int], h: float, mu: float, rho: float
) -> tuple[float, float]:
    """Force per depth (N/m) along columns and rows on what stands in the box, by the balance of momentum.

    F = -oint (rho w (w . n) + p n - mu (grad w + grad w') n) ds over the box, whose sides lie on faces of cells.
    """
    left, right, top, low = box
    along, down = 0.0, 0.0
    rows, columns = slice(top, low), slice(left, right)
    for i, outward in ((left, -1.0), (right, 1.0)):
        w = u[rows, i]
        cross = 0.25 * (v[top:low, i - 1] + v[top:low, i] + v[top + 1 : low + 1, i - 1] + v[top + 1 : low + 1, i])
        pressure = 0.5 * (p[rows, i - 1] + p[rows, i])
        stretch = (u[rows, i + 1] - u[rows, i - 1]) / (2 * h)
        shear = (u[top + 1 : low + 1, i] - u[top - 1 : low - 1, i]) / (2 * h)
        shear = (
            shear
            + 0.5 * (v[top:low, i] - v[top:low, i - 1] + v[top + 1 : low + 1, i] - v[top + 1 : low + 1, i - 1]) / h
        )
        along -= outward * h * float((rho * w * w + pressure - 2 * mu * stretch).sum())
        down -= outward * h * float((rho * w * cross - mu * shear).sum())
    for j, outward in ((top, -1.0), (low, 1.0)):
        w = v[j, columns]
        cross = 0.25 * (
            u[j - 1, left:right] + u[j, left:right] + u[j - 1, left + 1 : right + 1] + u[j, left + 1 : right + 1]
        )
        pressure = 0.5 * (p[j - 1, columns] + p[j, columns])
        stretch = (v[j + 1, columns] - v[j - 1, columns]) / (2 * h)
        shear = (v[j, left + 1 : right + 1] - v[j, left - 1 : right - 1]) / (2 * h)
        shear = (
            shear
            + 0.5
            * (u[j, left:right] - u[j - 1, left:right] + u[j, left + 1 : right + 1] - u[j - 1, left + 1 : right + 1])
            / h
        )
        down -= outward * h * float((rho * w * w + pressure - 2 * mu * stretch).sum())
        along -= outward * h * float((rho * w * cross - mu * shear).sum())
    return along, down


def _at_wall(p: Array, fluid: NDArray[np.bool_], row: float, wall: float, step: int) -> float:
    """Pressure at the wall (in cells along the row), continued from the first three cells that are clear of it."""
    upper = int(np.floor(row))
    share = row - upper
    first = int(np.ceil(wall)) if step > 0 else int(np.floor(wall)) - 1
    columns = first + step * np.arange(6)
    columns = columns[fluid[upper, columns] & fluid[upper + 1, columns]][1:4]
    values = (1 - share) * p[upper, columns] + share * p[upper + 1, columns]
    return float(np.polyval(np.polyfit(columns + 0.5 - wall, values, 2), 0.0))
