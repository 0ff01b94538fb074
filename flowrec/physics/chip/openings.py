"""Openings: the runs of fluid on the border of a mask, and which of them are taken for inlets.

Default: the widest opening on the left is the inlet; where the left has none, the widest of all (of equal ones the
first, in the order left, right, top, bottom and along the side). All others are outlets at 0 Pa. Runs shorter than
three pixels are channels that only touch the border and stay closed, as does the shorter of two runs that meet in a
corner pixel: both are one hole in the border, and an opening lies on one side. A border pixel of fluid without an
opening is a wall.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import Bools, ChipError, Floats
from flowrec.physics.chip.chip import Chip, Kind, Opening, Side

SIDES: tuple[Side, ...] = ("left", "right", "top", "bottom")
CHIP_NUMBERS = ("um_per_px", "viscosity_mpa_s", "density_kg_m3", "depth_um")  # of a chip; the depth may be None
MIN_SIDE_PX, MIN_OPENING_PX = 8, 3
DEFAULT_INLET_UM_S = 200.0  # mean speed at an inlet that no file states


def border(image: NDArray[Any], side: Side) -> NDArray[Any]:
    """View of one side of an image (h, w): from the top for left and right, from the left for top and bottom."""
    return {"left": image[:, 0], "right": image[:, -1], "top": image[0], "bottom": image[-1]}[side]


def fluid_runs(line: Bools) -> list[tuple[int, int]]:
    """First and last pixel of each run of fluid along a side."""
    steps = np.diff(np.concatenate(([0], line.astype(np.int8), [0])))
    return list(zip(np.flatnonzero(steps == 1).tolist(), (np.flatnonzero(steps == -1) - 1).tolist(), strict=True))


def run_around(line: Bools, middle: int) -> tuple[int, int] | None:
    """First and last pixel of the run of fluid around a pixel of a side; None if that is solid."""
    return next(((first, last) for first, last in fluid_runs(line) if first <= middle <= last), None)


def _end_pixels(opening: Opening, shape: tuple[int, ...]) -> set[tuple[int, int]]:
    """(row, column) of the first and the last pixel of an opening of a mask of `shape`."""
    far = {"left": 0, "top": 0, "right": shape[1] - 1, "bottom": shape[0] - 1}[opening.side]
    ends = (opening.first, opening.last)
    return {(end, far) if opening.side in ("left", "right") else (far, end) for end in ends}


def find_openings(mask: Bools) -> tuple[Opening, ...]:
    """Every opening of a mask, all as outlets at 0 Pa."""
    found = [
        Opening(side, first, last, "outlet", 0.0)
        for side in SIDES
        for first, last in fluid_runs(border(mask, side))
        if last - first + 1 >= MIN_OPENING_PX
    ]
    closed: set[Opening] = set()
    for a, b in itertools.combinations(found, 2):
        if _end_pixels(a, mask.shape) & _end_pixels(b, mask.shape):
            closed.add(min(b, a, key=lambda opening: opening.width_px))
    return tuple(opening for opening in found if opening not in closed)


def guess_inlets(openings: tuple[Opening, ...], speed_um_s: float = DEFAULT_INLET_UM_S) -> tuple[Opening, ...]:
    """The openings with the inlet of the default rule, at a mean inward speed; () of none."""
    left = [opening for opening in openings if opening.side == "left"]
    inlet = max(left or openings, key=lambda opening: opening.width_px, default=None)
    return tuple(replace(o, kind="inlet", value=speed_um_s) if o is inlet else o for o in openings)


def opening_names(openings: Iterable[Opening]) -> tuple[str, ...]:
    """`side:number` of each opening, counted along its side in the order of the pixels."""
    openings = tuple(openings)
    return tuple(
        f"{o.side}:{sum(other.side == o.side and other.first < o.first for other in openings)}" for o in openings
    )


def name_inlets(openings: tuple[Opening, ...], inlets: Iterable[str], where: str) -> tuple[Opening, ...]:
    """Make the named openings inlets and all others outlets at 0 Pa; an inlet keeps the speed it had.

    Raises ChipError for a name that fits no opening.
    """
    names = opening_names(openings)
    chosen: set[str] = set()
    for wanted in inlets:
        fitting = {name for name in names if wanted in (name, name.split(":")[0])}
        if not fitting:
            raise ChipError(f"{where}: no opening {wanted!r}; it has {', '.join(names)}")
        chosen |= fitting
    kinds: list[Kind] = ["inlet" if name in chosen else "outlet" for name in names]
    return tuple(
        o if o.kind == kind else replace(o, kind=kind, value=DEFAULT_INLET_UM_S if kind == "inlet" else 0.0)
        for o, kind in zip(openings, kinds, strict=True)
    )


def named_opening(chip: Chip, name: str) -> Opening:
    """The opening called `inlet` or `outlet` (the widest of its kind), or `inlet:1` (counted in the chip's order).

    Raises ChipError for any other name.
    """
    kind, _, number = name.partition(":")
    found = [opening for opening in chip.openings if opening.kind == kind]
    if not found or (number and (not number.isdigit() or int(number) >= len(found))):
        kinds = [opening.kind for opening in chip.openings]
        most = {kind: kinds.count(kind) - 1 for kind in sorted(set(kinds))}
        there = ", ".join(f"{kind}:0 to {kind}:{last}" if last else kind for kind, last in most.items())
        raise ChipError(f"place {name!r} is not on chip {chip.name!r}; it has {there}, or give a point as x,y in um")
    return found[int(number)] if number else max(found, key=lambda opening: opening.width_px)


def check_chip(chip: Chip, where: str) -> None:
    """Raise ChipError unless a flow can be computed on the chip."""
    height, width = chip.mask.shape
    if height < MIN_SIDE_PX or width < MIN_SIDE_PX:
        raise ChipError(
            f"{where}: the mask is {width} x {height} pixels; at least {MIN_SIDE_PX} x {MIN_SIDE_PX} needed"
        )
    if not chip.mask.any():
        raise ChipError(f'{where}: no fluid in the mask; is it the other way round? (fluid = "dark" in its TOML)')
    if chip.mask.all():
        raise ChipError(
            f'{where}: no wall in the mask; is it the other way round? (fluid = "dark" in its TOML) A field without '
            "walls, such as a dish, needs two far ones: make the first and the last row of pixels black"
        )
    for key in CHIP_NUMBERS:
        value = getattr(chip, key)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ChipError(f"{where}: {key} = {value:g}; it must be more than zero")
    check_openings(chip.mask, chip.openings, where)


def check_openings(mask: Bools, openings: tuple[Opening, ...], where: str) -> None:
    """Raise ChipError unless the openings lie on fluid, apart from each other, with an inlet and an outlet."""
    for opening in openings:
        what = f"opening {opening.side} {opening.first}-{opening.last}"
        line = border(mask, opening.side)
        if not 0 <= opening.first <= opening.last < len(line):
            raise ChipError(f"{where}: {what} is not within 0-{len(line) - 1}; pixels count from 0, first to last")
        if not line[opening.first : opening.last + 1].all():
            runs = ", ".join(f"{a}-{b}" for a, b in fluid_runs(line)) or "none"
            raise ChipError(f"{where}: {what} lies on a wall; the fluid on that side is at {runs}")
        if not np.isfinite(opening.value):
            raise ChipError(f"{where}: {what} has no finite speed or pressure; give speed_um_s or pressure_pa")
    for a, b in itertools.combinations(openings, 2):
        if a.side == b.side and a.first <= b.last and b.first <= a.last:
            raise ChipError(f"{where}: two openings on the {a.side} overlap at {b.first}-{b.last}; remove one")
    kinds = {opening.kind for opening in openings}
    if not openings:
        raise ChipError(
            f"{where}: no opening; let the fluid reach the border of the mask with at least {MIN_OPENING_PX} pixels"
        )
    if "inlet" not in kinds:
        raise ChipError(f'{where}: no inlet; name one, for example chip.inlets = ["{opening_names(openings)[0]}"]')
    if "outlet" not in kinds:
        raise ChipError(f"{where}: no outlet; the fluid must be able to leave through at least one opening")


def set_inlet_speed(openings: tuple[Opening, ...], speed_um_s: float) -> tuple[Opening, ...]:
    """Give the fastest inlet this mean speed in um/s; the others keep their ratio to it."""
    fastest = max((abs(o.value) for o in openings if o.kind == "inlet"), default=0.0)
    return tuple(
        replace(o, value=o.value * speed_um_s / fastest if fastest > 0 else speed_um_s) if o.kind == "inlet" else o
        for o in openings
    )


def distance_px(opening: Opening, x: ArrayLike, y: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """From points x, y (...) in px to the nearest place of an opening on the border of a mask of `shape` (h, w)."""
    h, w = shape[:2]
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if opening.side in ("left", "right"):
        away, along = x - (-0.5 if opening.side == "left" else w - 0.5), y
    else:
        away, along = y - (-0.5 if opening.side == "top" else h - 0.5), x
    return np.asarray(np.hypot(away, along - np.clip(along, opening.first, opening.last)))


def distance_um(chip: Chip, opening: Opening, point_um: ArrayLike) -> float:
    """From a point (2,) um to the nearest place of an opening on the border of the chip."""
    x, y = np.asarray(point_um, np.float64) / chip.um_per_px
    return float(distance_px(opening, x, y, chip.mask.shape)) * chip.um_per_px
