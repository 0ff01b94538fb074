"""Contents of a vessel case (*.npz) beside its chip: observations of a robot, and the truth that it is judged by."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from flowrec.core import Floats, Observations
from flowrec.physics import Chip, read_case

# Noise levels and shares of the skeleton that cases hold, by the names in their keys.
NOISES = {"00": 0.0, "02": 0.02, "05": 0.05, "10": 0.1}
SHARES = {"05": 0.05, "10": 0.1, "20": 0.2}
Noise = Annotated[Literal["00", "02", "05", "10"], typer.Option(help="Noise of the observations in %.")]
ObservedShare = Annotated[Literal["05", "10", "20"], typer.Option(help="Observed part of the skeleton in %.")]
_HALVES, _MEANS = ("vx_c", "vy_c"), ("vx", "vy")


def read_observations(path: Path, noise: str, share: str) -> Observations:
    """Observations of a robot on its path through a vessel case: `noise` is a key of NOISES, `share` one of SHARES.

    The standard deviation is that of one component.
    """
    known = read_case(path, ("px", "route_ij", f"obs_idx_{share}", f"route_v_n{noise}", "route_v_sigma"))
    measured = known[f"route_v_n{noise}"]
    if _holds_means(path):
        # A robot measures at a point: the means that the noise was added to are replaced by the values there.
        measured = measured + (_at_centres(path) - _velocity(path, _MEANS))[*known["route_ij"].T]
    seen = known[f"obs_idx_{share}"].astype(np.intp)
    sigma_um_s = float(known["route_v_sigma"][list(NOISES).index(noise)]) * 1e6
    return Observations(
        0,
        known["route_ij"][seen][:, ::-1] * float(known["px"]) * 1e6,
        measured[seen] * 1e6,
        np.full(len(seen), sigma_um_s),
    )


def read_true_chip(path: Path, believed: Chip) -> Chip:
    """The chip with the true parameters, for measuring the solver alone."""
    known = read_case(path, ("mu", "rho", "op_u_true", "op_p_true"))
    values = [
        float(speed) * 1e6 if opening.kind == "inlet" else float(pressure)
        for opening, speed, pressure in zip(believed.openings, known["op_u_true"], known["op_p_true"], strict=True)
    ]
    return believed.with_boundary(values, float(known["mu"]) * 1e3, float(known["rho"]))


def read_true_velocity(path: Path) -> Floats:
    """The true velocity (h, w, 2) in um/s at the pixel centres, for scoring alone."""
    return (_at_centres(path) if _holds_means(path) else _velocity(path, _MEANS)) * 1e6


def read_true_pressure(path: Path) -> Floats | None:
    """The true pressure (h, w) in Pa, for scoring alone; None where the case does not have it."""
    with np.load(path, allow_pickle=False) as case:
        return np.asarray(case["p"], np.float64) if "p" in case.files else None


def _at_centres(path: Path) -> Floats:
    """Values at the pixel centres where vx, vy are means over a pixel, and vx_c, vy_c over half of its width.

    A mean over a square of width h is the value in its middle plus h^2 / 24 lap v: the two means give both terms.
    """
    half = _velocity(path, _HALVES)
    return half + (half - _velocity(path, _MEANS)) / 3.0


def _velocity(path: Path, keys: tuple[str, str]) -> Floats:
    known = read_case(path, keys)
    return np.stack([known[key] for key in keys], axis=-1).astype(np.float64)


def _holds_means(path: Path) -> bool:
    """True if vx, vy are means over pixels, as where means over their middle are given beside them."""
    try:
        with np.load(path, allow_pickle=False) as case:
            return set(_HALVES) <= set(case.files)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return False  # told by whoever reads what is needed
