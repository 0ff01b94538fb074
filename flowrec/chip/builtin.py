"""Two chips that are always there: a straight channel and the paper's kind of bifurcation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.chip.chip import Chip
from flowrec.chip.draw import draw_channel, smooth_curve
from flowrec.chip.io import WATER_KG_M3, WATER_MPA_S
from flowrec.chip.openings import find_openings, guess_inlets, set_inlet_speed

_UM_PER_PX = 20.0


def straight() -> Chip:
    """5.12 mm of a channel 0.4 mm wide: Poiseuille flow, mean 200 um/s, so 300 um/s in the middle."""
    mask = np.zeros((64, 256), np.bool_)
    mask[22:42] = True
    return _chip("straight", mask, 200.0)


def bifurcation() -> Chip:
    """6.4 x 5.12 mm: the inlet on the left splits into a short fast and a long slow branch that meet again.

    In a plane channel the mean speed goes as width^2 / length at a given pressure drop. So the short lower branch
    (4.5 mm, 0.29 mm wide) is about two and a half times faster than the long upper one (5.6 mm, 0.20 mm wide, the
    narrowest). For a robot of radius 50 um and v_max = 600 um/s the middle of the short branch runs at three
    quarters of v_max: downstream the short branch saves 2.7 s of 9, upstream the long one saves 3 s of 19, and the
    robot can hold its place everywhere, also where the true inflow is a fifth faster.
    """
    middle = 2.7  # mm from the top: height of inlet and outlet
    left, right, bottom, top = 1.1, 5.3, 3.4, 1.2
    short = [(left, middle), (1.85, 3.085), (2.5, 3.365), (3.2, bottom), (3.9, 3.365), (4.55, 3.085), (right, middle)]
    long = [(left, middle), (1.4, 2.15), (2.1, 1.4), (3.2, top), (4.3, 1.4), (5.0, 2.15), (right, middle)]
    gap = np.full((256, 320), np.inf)
    for points, width_mm in (
        ([(-1.0, middle), (left, middle)], 0.5),
        ([(right, middle), (7.4, middle)], 0.5),
        (short, 0.29),
        (long, 0.2),
    ):
        draw_channel(gap, smooth_curve(_pixels(points)), width_mm * 1e3 / _UM_PER_PX)
    return _chip("bifurcation", gap <= 0, 220.0)


def _pixels(points_mm: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(points_mm, np.float64) * 1e3 / _UM_PER_PX


def _chip(name: str, mask: NDArray[np.bool_], inlet_speed_um_s: float) -> Chip:
    mask.flags.writeable = False
    openings = set_inlet_speed(guess_inlets(find_openings(mask)), inlet_speed_um_s)
    return Chip(name, mask, _UM_PER_PX, openings, WATER_MPA_S, WATER_KG_M3)
