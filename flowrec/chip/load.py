"""From settings to a chip."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path

from flowrec.chip.builtin import bifurcation, straight
from flowrec.chip.chip import Chip
from flowrec.chip.io import check_chip, read_png_chip, without_pockets
from flowrec.chip.openings import name_inlets, set_inlet_speed
from flowrec.chip.settings import ChipSettings
from flowrec.chip.vessel_case import read_vessel_case
from flowrec.chip.vessels import vessels
from flowrec.errors import ChipError

BUILT_IN = ("bifurcation", "straight", "vessels")


def load_chip(settings: ChipSettings) -> Chip:
    """The chip that the settings name, with what they say differently about it.

    Raises ChipError, in one line, where no flow can be computed on it.
    """
    where = settings.path or settings.name
    chip = _from_path(Path(settings.path), settings) if settings.path else _built_in(settings)
    openings = chip.openings
    if settings.inlets:
        openings = name_inlets(openings, settings.inlets, where)
    if settings.inlet_speed_um_s is not None:
        openings = set_inlet_speed(openings, settings.inlet_speed_um_s)
    depth_um = chip.depth_um if settings.depth_um is None else (settings.depth_um or None)
    chip = replace(
        chip,
        openings=openings,
        um_per_px=chip.um_per_px if settings.um_per_px is None else settings.um_per_px,
        walls=settings.walls or chip.walls,
        depth_um=depth_um,
        viscosity_mpa_s=chip.viscosity_mpa_s if settings.viscosity_mpa_s is None else settings.viscosity_mpa_s,
        density_kg_m3=chip.density_kg_m3 if settings.density_kg_m3 is None else settings.density_kg_m3,
    )
    check_chip(chip, where)
    return without_pockets(chip)


def _built_in(settings: ChipSettings) -> Chip:
    if settings.name == "vessels":
        return vessels(settings.seed)
    if settings.name == "bifurcation":
        return bifurcation()
    if settings.name == "straight":
        return straight()
    near = difflib.get_close_matches(settings.name, BUILT_IN, 1, 0.0)[0]
    raise ChipError(
        f"no built-in chip {settings.name!r}, did you mean {near!r}? A chip of your own is given by chip.path"
    )


def _from_path(path: Path, settings: ChipSettings) -> Chip:
    kind = path.suffix.lower()
    if kind in (".png", ".toml"):
        return read_png_chip(path, settings.um_per_px)
    if kind == ".npz":
        return read_vessel_case(path)
    raise ChipError(
        f"{path}: a chip is a .png with a .toml beside it, or a vessel case .npz; convert it to one of these"
    )
