"""The lid-driven cavity: largest and mean deviation from the figures of Ghia, Ghia and Shin.

U. Ghia, K. N. Ghia, C. T. Shin, High-Re solutions for incompressible flow using the Navier-Stokes equations and a
multigrid method, J. Comput. Phys. 48 (1982) 387-411, tables I (u on x = 0.5) and II (v on y = 0.5).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from flowrec.chip.chip import Chip
from flowrec.flow.newton_solver import assembled
from flowrec.units import UM_PER_M

# fmt: off
# Between the walls, whose values are known.
_Y = (
    0.9766, 0.9688, 0.9609, 0.9531, 0.8516, 0.7344, 0.6172, 0.5, 0.4531, 0.2813, 0.1719, 0.1016, 0.0703,
    0.0625, 0.0547
)
_X = (
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
        "u_largest": float(np.abs(u_off).max()),
        "u_rms": float(np.sqrt((u_off**2).mean())),
        "v_largest": float(np.abs(v_off).max()),
        "v_rms": float(np.sqrt((v_off**2).mean())),
        "u_at_quarters": [float(u) for u in u_line(np.array([0.25, 0.5, 0.75]))],
    }


def _solve(cells: int, reynolds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocities u (cells, cells + 1) and v (cells + 1, cells) of faces over that of the lid, which is the top row."""
    box = Chip("cavity", np.ones((cells, cells), bool), UM_PER_M / cells, (), 1.0, 1.0, walls="pixel")
    equations = assembled(box, 1)
    push = equations.momentum.sliding @ np.array([0.0, 0.0, 1.0, 0.0])
    moving = np.append(equations.steady(np.zeros(0), reynolds / cells, 100, 1e-9, push), 0.0)
    return moving[equations.grid.u.number], moving[equations.grid.v.number]
