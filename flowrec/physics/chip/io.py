"""Chips from settings and files. A chip is two files: a PNG mask and, beside it, a TOML of the same stem.

    um_per_px = 20.0          # required; everything below may be left out
    viscosity_mpa_s = 1.0     # 1.0
    density_kg_m3 = 1000.0    # 1000
    depth_um = 100.0          # left out: two-dimensional
    walls = "smooth"          # "smooth": a smooth contour through the pixels; "pixel": their edges; "grey": see below
    fluid = "bright"          # "bright": fluid is >= 128; "dark": fluid is < 128
    name = "y_junction"       # the stem of the file
    inlet_speed_um_s = 200.0  # of inlets that are found, not listed

    [viscosity]               # left out: Newtonian; see fluid.py
    law = "power_law"
    exponent = 0.7

    [[opening]]               # left out: found automatically, see openings.py
    side = "left"             # left, right, top, bottom
    first = 100               # first and last pixel of fluid on that side, from 0, both inclusive
    last = 119
    kind = "inlet"            # inlet (speed_um_s: mean inward) or outlet (pressure_pa, 0)
    speed_um_s = 200.0

With walls "grey" a wall lies where the grey level between pixel centres is 128, and 50 levels are a pixel.

Fluid that no opening reaches does not flow: such pockets are filled on loading.

A vessel case (*.npz) is a mask of a real vessel with the flow that is assumed in it. Such a file also holds
observations and the truth that an experiment is judged by, which bench/vessel_truth.py reads. Only what an experimenter
would know makes a chip: mask, px, op_side, op_a, op_b, op_type and the keys that end in _assumed.
"""

from __future__ import annotations

import difflib
import json
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast, get_args

import cv2
import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.lib import format as npy
from numpy.typing import NDArray

from flowrec.core import Bools, ChipError, hints, parse_toml, refuse_irregular
from flowrec.physics.chip.chip import WATER_KG_M3, WATER_MPA_S, Chip, ChipSettings, Kind, Opening, Side, Walls, levels
from flowrec.physics.chip.fluid import (
    BLOOD_KG_M3,
    BLOOD_MPA_S,
    LAWS,
    ViscosityLaw,
    ViscositySettings,
    law_of,
    law_settings,
    with_settings,
)
from flowrec.physics.chip.mask_image import FLUID, greys_of_png
from flowrec.physics.chip.openings import (
    CHIP_NUMBERS,
    DEFAULT_INLET_UM_S,
    border,
    check_chip,
    find_openings,
    guess_inlets,
    name_inlets,
    set_inlet_speed,
)
from flowrec.physics.chip.synthetic import bifurcation, straight, vessels

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


_POCKET_PX = 1.0  # level of what is filled
BUILT_IN: Mapping[str, Callable[[ChipSettings], Chip]] = {
    "bifurcation": lambda _: bifurcation(),
    "straight": lambda _: straight(),
    "vessels": lambda settings: vessels(settings.seed),
}
_NUMBERS = {  # by key, the value where the TOML has none
    "um_per_px": None,
    "viscosity_mpa_s": WATER_MPA_S,
    "density_kg_m3": WATER_KG_M3,
    "depth_um": None,
    "inlet_speed_um_s": DEFAULT_INLET_UM_S,
}
_MOVIES = (".mp4", ".tif", ".tiff", ".btf")  # that flowrec made of a session hold its chip
CHIP_KEYS = (*_NUMBERS, "walls", "fluid", "name", "viscosity", "opening")
_OF_BLOOD = {"viscosity_mpa_s": BLOOD_MPA_S, "density_kg_m3": BLOOD_KG_M3}  # where nothing else is stated
_OPENING_KEYS = ("side", "first", "last", "kind", "speed_um_s", "pressure_pa")


def load_chip(settings: ChipSettings, mask: Bools | None = None) -> Chip:
    """The chip that the settings name, or with that mask (h, w), with the values that they give instead of its own.

    Raises ChipError, in one line, if no flow can be computed on it.
    """
    where = "mask" if mask is not None else settings.path or settings.name
    if mask is not None:
        written, png = cv2.imencode(".png", np.where(mask, 255, 0).astype(np.uint8)) if mask.size else (False, mask)
        if not written:
            raise ChipError(f"{where}: no image can have {mask.shape} pixels")
        chip = chip_from_files(png.tobytes(), "", where, settings.um_per_px)
    elif settings.path:
        chip = _read_chip(Path(settings.path), settings.um_per_px)
    elif settings.name in BUILT_IN:
        chip = BUILT_IN[settings.name](settings)
    else:
        near = difflib.get_close_matches(settings.name, BUILT_IN, 1, 0.0)[0]
        raise ChipError(
            f"no built-in chip {settings.name!r}, did you mean {near!r}? A chip of your own is given by chip.path"
        )
    given = {key: value for key in (*CHIP_NUMBERS, "walls") if (value := getattr(settings, key)) is not None}
    law = with_settings(chip.law, settings.viscosity, where)
    of_blood = _OF_BLOOD if settings.viscosity.law == "blood" else {}
    chip = replace(chip, law=law, **(of_blood | given))
    if settings.depth_um == 0.0:
        chip = replace(chip, depth_um=None)
    if settings.inlets:
        chip = replace(chip, openings=name_inlets(chip.openings, settings.inlets, where))
    if settings.inlet_speed_um_s is not None:
        chip = replace(chip, openings=set_inlet_speed(chip.openings, settings.inlet_speed_um_s))
    check_chip(chip, where)
    return without_pockets(chip)


def chip_files(chip: Chip) -> tuple[bytes, str]:
    """PNG and TOML of a chip, from which `chip_from_files` makes exactly the same one."""
    written, png = cv2.imencode(".png", chip.greys)
    if not written:
        raise ChipError(f"{chip.name}: the mask can not be written as PNG; is it {chip.mask.shape} pixels?")
    numbers = {key: getattr(chip, key) for key in CHIP_NUMBERS}
    lines = [f"name = {json.dumps(chip.name, ensure_ascii=False)}"]
    lines += [f"{key} = {float(value)!r}" for key, value in numbers.items() if value is not None]
    lines += [f'walls = "{chip.walls}"', 'fluid = "bright"']
    law = law_settings(chip.law)
    if law:
        lines += ["", "[viscosity]", *(f"{key} = {json.dumps(value)}" for key, value in law.items())]
    for o in chip.openings:
        value = "speed_um_s" if o.kind == "inlet" else "pressure_pa"
        lines += ["", "[[opening]]", f'side = "{o.side}"', f"first = {int(o.first)}", f"last = {int(o.last)}"]
        lines += [f'kind = "{o.kind}"', f"{value} = {float(o.value)!r}"]
    return png.tobytes(), "\n".join(lines) + "\n"


def chip_from_files(png_bytes: bytes, toml_text: str, where: str = "chip", um_per_px: float | None = None) -> Chip:
    """The chip in a PNG and a TOML text; `where` names it in errors, `um_per_px` overrides that of the TOML.

    Raises ChipError, in one line, for whatever no flow can be computed on.
    """
    try:
        table = parse_toml(toml_text)
    except (ValueError, RecursionError) as error:  # besides bad TOML, numbers and nesting beyond all measure
        beside = f"{where.removesuffix('.png')}.toml" if where.endswith(".png") else where
        raise ChipError(f"{beside}: not valid TOML ({error}); mend that line") from error
    _refuse_unknown(table, CHIP_KEYS, where)
    law, of_law = _law(table.get("viscosity", {}), where)
    number: dict[str, Any] = {key: _number(table, key, where, value) for key, value in (_NUMBERS | of_law).items()}
    if um_per_px is not None:
        number["um_per_px"] = um_per_px
    if number["um_per_px"] is None:
        raise ChipError(f"{where}: no um_per_px; set chip.um_per_px or put it into a TOML of the same name")
    walls = cast(Walls, _choice(table, "walls", get_args(Walls), where) or "smooth")
    fluid = _choice(table, "fluid", ("bright", "dark"), where) or "bright"
    greys = greys_of_png(png_bytes, fluid, where, between=walls == "grey")
    mask = np.asarray(greys >= FLUID)
    mask.flags.writeable = False
    if "opening" in table:
        openings = _openings_of(table["opening"], where)
    else:
        openings = guess_inlets(find_openings(mask), number["inlet_speed_um_s"])
    name = table.get("name", Path(where).stem)
    if not isinstance(name, str):
        raise ChipError(f"{where}: name = {name!r} is no text; put it in quotes")
    chip = Chip(
        name,
        mask,
        number["um_per_px"],
        openings,
        number["viscosity_mpa_s"],
        number["density_kg_m3"],
        number["depth_um"],
        walls,
        law=law,
        level_px=levels(greys) if walls == "grey" else None,
    )
    check_chip(chip, where)
    return chip


def without_pockets(chip: Chip) -> Chip:
    """The chip with all fluid filled that no opening reaches through the sides of pixels; its mask is read-only."""
    labels, _ = scipy.ndimage.label(chip.mask)
    mask = np.isin(labels, [border(labels, opening.side)[opening.first] for opening in chip.openings])
    mask.flags.writeable = False
    if chip.level_px is None:
        return replace(chip, mask=mask)
    level_px = np.where(chip.mask & ~mask, -_POCKET_PX, chip.level_px).astype(np.float32)
    return replace(chip, mask=mask, level_px=level_px)


def _read_chip(path: Path, um_per_px: float | None) -> Chip:
    """The chip of a vessel case, or of a PNG and, if there is one, the TOML of the same stem; either path will do."""
    kind = path.suffix.lower()
    if kind == ".npz":
        return read_vessel_case(path)
    if kind in _MOVIES:
        from flowrec.movies import open_movie  # with packages of an extra

        with open_movie(path) as movie:
            notes = movie.facts.notes  # None if another program made it
        if notes is not None:
            return chip_from_files(*notes.chip_files(), str(path), um_per_px)
    if kind not in (".png", ".toml"):
        raise ChipError(
            f"{path}: a chip is a .png with a .toml beside it, or a vessel case .npz; convert it to one of these"
        )
    png, toml = path if kind == ".png" else path.with_suffix(".png"), path.with_suffix(".toml")
    for each in (png, toml):
        refuse_irregular(each, ChipError)
    try:
        data = png.read_bytes()
        text = toml.read_text(encoding="utf-8") if toml.exists() or path == toml else ""
    except FileNotFoundError as error:
        raise ChipError(
            f"{error.filename}: no such file; a chip is a PNG with a TOML of the same stem beside it"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ChipError(f"{path}: can not be read ({error}); is it a chip?") from error
    return chip_from_files(data, text, str(path), um_per_px)


def _refuse_unknown(table: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.0)[0]
            raise ChipError(f"{where}: unknown key {key}; did you mean {near}?")


def _number(table: Mapping[str, Any], key: str, where: str, default: float | None) -> float | None:
    value = table.get(key, default)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ChipError(f"{where}: {key} = {value!r}; it must be a number")
    return float(value)


def _law(table: Any, where: str) -> tuple[ViscosityLaw | None, dict[str, float]]:
    """The law in the table [viscosity], and the numbers of its fluid."""
    if not isinstance(table, dict):
        raise ChipError(f'{where}: viscosity = {table!r}; write [viscosity] above law = "power_law"')
    known = hints(ViscositySettings)
    _refuse_unknown(table, tuple(known), where)
    for key, value in table.items():
        text = key in ("law", "function")
        parts = value if key in ("rates_1_s", "ratios") and isinstance(value, list) else [value]
        if not all(isinstance(part, str if text else (int, float)) and not isinstance(part, bool) for part in parts):
            raise ChipError(f"{where}: viscosity.{key} = {value!r} is no {'text' if text else 'number'}")
    _choice(table, "law", tuple(LAWS), where)
    values: dict[str, Any] = {
        key: tuple(map(float, value)) if isinstance(value, list) else value for key, value in table.items()
    }
    settings = ViscositySettings(**values)
    return law_of(settings, where), _OF_BLOOD if settings.law == "blood" else {}


def _choice(table: Mapping[str, Any], key: str, choices: tuple[str, ...], where: str) -> str | None:
    value = table.get(key)
    if value is not None and value not in choices:
        raise ChipError(f"{where}: {key} = {value!r}; it must be one of {', '.join(choices)}")
    return value


def _openings_of(tables: Any, where: str) -> tuple[Opening, ...]:
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ChipError(f"{where}: openings are tables; write [[opening]] above each")
    openings = []
    for number, table in enumerate(tables, 1):
        here = f"{where}: opening {number}"
        _refuse_unknown(table, _OPENING_KEYS, here)
        side = _choice(table, "side", get_args(Side), here)
        kind = _choice(table, "kind", get_args(Kind), here)
        ends = [table.get("first"), table.get("last")]
        if side is None or kind is None or any(type(end) is not int for end in ends):
            raise ChipError(
                f'{here}: side, first, last (whole pixels) and kind are wanted, as in side = "left", first = 91, '
                'last = 109, kind = "inlet", speed_um_s = 180.0'
            )
        key, other = ("speed_um_s", "pressure_pa") if kind == "inlet" else ("pressure_pa", "speed_um_s")
        if other in table:
            raise ChipError(f"{here}: an {kind} has no {other}; give {key}")
        value = _number(table, key, here, None if kind == "inlet" else 0.0)
        if value is None:
            raise ChipError(f"{here}: an inlet needs speed_um_s, its mean inward speed")
        openings.append(Opening(cast(Side, side), ends[0], ends[1], cast(Kind, kind), value))
    return tuple(openings)
