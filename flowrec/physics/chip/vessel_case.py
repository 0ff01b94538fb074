"""Vessel cases (*.npz): a mask of a real vessel with the flow that is assumed in it.

Such a file also holds observations and the truth that an experiment is judged by, which bench/vessel_truth.py reads.
Only what an experimenter would know makes a chip: mask, px, op_side, op_a, op_b, op_type and the keys that end in
_assumed.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from flowrec.core import ChipError, refuse_irregular
from flowrec.physics.chip.chip import Chip, Kind, Opening, Side
from flowrec.physics.chip.openings import check_chip

KEYS = ("mask", "px", "rho_assumed", "mu_assumed", "op_side", "op_a", "op_b", "op_type", "op_u_assumed", "op_p_assumed")
_LIMIT_BYTES = 256 << 20  # of the arrays that are read at a time; those of a case have some 10 MB
# Row 0 is their south (y grows with the row), and our top (y points down): the same array, no flip.
_SIDES: dict[str, Side] = {"W": "left", "E": "right", "S": "top", "N": "bottom"}


def read_vessel_case(path: Path) -> Chip:
    """The chip of a vessel case, with pixel walls, on which its reference is defined. SI to um, mPa s."""
    known = read_case(path, KEYS)
    mask = np.ascontiguousarray(known["mask"], np.bool_)
    if mask.ndim != 2:
        raise ChipError(f"{path}: mask has {mask.ndim} dimensions; it must be an image (h, w)")
    mask.flags.writeable = False
    openings = []
    for side, first, last, kind, speed, pressure in zip(*(known[key] for key in KEYS[4:]), strict=True):
        if str(side) not in _SIDES or str(kind) not in ("inlet", "outlet"):
            raise ChipError(f"{path}: opening {side} {kind}; sides are W, E, S, N, types inlet and outlet")
        value = float(speed) * 1e6 if kind == "inlet" else float(pressure)
        openings.append(Opening(_SIDES[str(side)], int(first), int(last), cast(Kind, str(kind)), value))
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


def read_case(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[Any]]:
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
