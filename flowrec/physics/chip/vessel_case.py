"""Vessel cases (*.npz): a mask of a real vessel with the flow that is assumed in it.

Such a file also holds the truth that an experiment is judged by. Only what an experimenter would know is read here:
mask, px, op_side, op_a, op_b, op_type and the keys that end in _assumed.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from flowrec.core import ChipError, Observations, refuse_irregular
from flowrec.physics.chip.chip import Chip, Opening, Side
from flowrec.physics.chip.openings import check_chip

# Noise levels and shares of the skeleton that cases hold, by the names in their keys.
NOISES = {"00": 0.0, "02": 0.02, "05": 0.05, "10": 0.1}
SHARES = {"05": 0.05, "10": 0.1, "20": 0.2}
KEYS = ("mask", "px", "rho_assumed", "mu_assumed", "op_side", "op_a", "op_b", "op_type", "op_u_assumed", "op_p_assumed")
_HALVES, _MEANS = ("vx_c", "vy_c"), ("vx", "vy")
_LIMIT_BYTES = 256 << 20  # of the arrays that are read at a time; those of a case have some 10 MB
# Row 0 is their south (y grows with the row), and our top (y points down): the same array, no flip.
_SIDES: dict[str, Side] = {"W": "left", "E": "right", "S": "top", "N": "bottom"}


def read_vessel_case(path: Path) -> Chip:
    """The chip of a vessel case, with pixel walls, on which its reference is defined. SI to um, mPa s."""
    known = _read(path, KEYS)
    mask = np.ascontiguousarray(known["mask"], np.bool_)
    if mask.ndim != 2:
        raise ChipError(f"{path}: mask has {mask.ndim} dimensions; it must be an image (h, w)")
    mask.flags.writeable = False
    openings = []
    for side, first, last, kind, speed, pressure in zip(*(known[key] for key in KEYS[4:]), strict=True):
        if str(side) not in _SIDES or str(kind) not in ("inlet", "outlet"):
            raise ChipError(f"{path}: opening {side} {kind}; sides are W, E, S, N, types inlet and outlet")
        if kind == "inlet":
            openings.append(Opening(_SIDES[str(side)], int(first), int(last), "inlet", float(speed) * 1e6))
        else:
            openings.append(Opening(_SIDES[str(side)], int(first), int(last), "outlet", float(pressure)))
    chip = Chip(
        path.stem,
        mask,
        float(known["px"]) * 1e6,
        tuple(openings),
        float(known["mu_assumed"]) * 1e3,
        float(known["rho_assumed"]),
        None,
        "pixel",
    )
    check_chip(chip, str(path))
    return chip


def read_observations(path: Path, noise: str, share: str) -> Observations:
    """Observations of a robot on its path through a vessel case: `noise` is a key of NOISES, `share` one of SHARES.

    The standard deviation is that of one component.
    """
    known = _read(path, ("px", "route_ij", f"obs_idx_{share}", f"route_v_n{noise}", "route_v_sigma"))
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
    known = _read(path, ("mu", "rho", "op_u_true", "op_p_true"))
    values = [
        float(speed) * 1e6 if opening.kind == "inlet" else float(pressure)
        for opening, speed, pressure in zip(believed.openings, known["op_u_true"], known["op_p_true"], strict=True)
    ]
    return believed.with_boundary(values, float(known["mu"]) * 1e3, float(known["rho"]))


def read_true_velocity(path: Path) -> NDArray[np.float64]:
    """The true velocity (h, w, 2) in um/s at the pixel centres, for scoring alone."""
    return (_at_centres(path) if _holds_means(path) else _velocity(path, _MEANS)) * 1e6


def _at_centres(path: Path) -> NDArray[np.float64]:
    """Values at the pixel centres where vx, vy are means over a pixel, and vx_c, vy_c over half of its width.

    A mean over a square of width h is the value in its middle plus h^2 / 24 lap v: the two means give both terms.
    """
    half = _velocity(path, _HALVES)
    return half + (half - _velocity(path, _MEANS)) / 3.0


def _velocity(path: Path, keys: tuple[str, str]) -> NDArray[np.float64]:
    known = _read(path, keys)
    return np.stack([known[key] for key in keys], axis=-1).astype(np.float64)


def _holds_means(path: Path) -> bool:
    """True if vx, vy are means over pixels, as where means over their middle are given beside them."""
    try:
        with np.load(path, allow_pickle=False) as case:
            return set(_HALVES) <= set(case.files)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return False  # told by whoever reads what is needed


def _refuse_large(case: zipfile.ZipFile, keys: tuple[str, ...]) -> None:
    """Raise ValueError where arrays would take much more memory than a case needs: before any is unpacked."""
    members = [case.getinfo(f"{key}.npy") for key in keys]
    nbytes = sum(member.file_size for member in members)
    if nbytes > _LIMIT_BYTES:
        raise ValueError(f"arrays of {nbytes} bytes, more than {_LIMIT_BYTES}")
    for member in members:
        with case.open(member) as file:
            read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(
                npy.read_magic(file)
            )
            if read_header is None:
                raise ValueError(f"{member.filename} is of a version that is not known")
            shape, _, dtype = read_header(file)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise ValueError(f"{member.filename} announces an array of shape {shape} in {member.file_size} bytes")


def _read(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Some arrays of a case, and no others."""
    refuse_irregular(path, ChipError)
    try:
        with np.load(path, allow_pickle=False) as case:
            missing = [key for key in keys if key not in case.files]
            if missing:
                raise ChipError(f"{path}: no {', '.join(missing)}; a vessel case has {', '.join(keys)}")
            _refuse_large(case.zip, keys)
            return {key: case[key] for key in keys}
    except FileNotFoundError as error:
        raise ChipError(f"{path}: no such vessel case; give the path of an .npz file") from error
    except (OSError, ValueError, EOFError, AttributeError, KeyError, zlib.error, zipfile.BadZipFile) as error:
        raise ChipError(f"{path}: not a readable .npz vessel case ({error})") from error
