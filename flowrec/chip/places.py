"""Named places on a chip: a point just inside an opening, where a robot is released or sent to."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from flowrec.chip.chip import Chip, Opening
from flowrec.chip.clearance import clearance_um
from flowrec.errors import ChipError


def named_opening(chip: Chip, name: str) -> Opening:
    """The opening called `inlet` or `outlet` (the widest of its kind), or `inlet:1` (counted in the chip's order)."""
    kind, _, number = name.partition(":")
    found = [opening for opening in chip.openings if opening.kind == kind]
    if not found or (number and (not number.isdigit() or int(number) >= len(found))):
        have = sorted({opening.kind for opening in chip.openings})
        counts = ", ".join(f"{kind}:0 to :{sum(o.kind == kind for o in chip.openings) - 1}" for kind in have)
        raise ChipError(f"place {name!r} is not on chip {chip.name!r}; it has {counts}, or give a point as x,y in um")
    return found[int(number)] if number else max(found, key=lambda opening: opening.width_px)


def opening_point_um(chip: Chip, name: str, depth_um: float) -> tuple[float, float]:
    """The point (x, y) in um in the middle of the channel, `depth_um` along it from the named opening."""
    opening = named_opening(chip, name)
    side = np.zeros_like(chip.mask)
    run = slice(opening.first, opening.last + 1)
    {"left": side[:, 0], "right": side[:, -1], "top": side[0], "bottom": side[-1]}[opening.side][run] = True
    reached, front = side & chip.mask, side & chip.mask
    for _ in range(max(1, round(depth_um / chip.um_per_px))):
        grown = binary_dilation(reached) & chip.mask
        if not (grown & ~reached).any():
            break
        front, reached = grown & ~reached, grown
    to_wall = clearance_um(chip.mask, chip.um_per_px)
    row, column = np.unravel_index(np.argmax(np.where(front, to_wall, -np.inf)), chip.mask.shape)
    return float(column * chip.um_per_px), float(row * chip.um_per_px)


def distance_um(chip: Chip, opening: Opening, point_um: ArrayLike) -> float:
    """From a point (2,) um to the nearest place of an opening on the border of the chip."""
    x, y = np.asarray(point_um, np.float64) / chip.um_per_px
    height, width = chip.mask.shape
    if opening.side in ("left", "right"):
        nearest = (-0.5 if opening.side == "left" else width - 0.5, min(max(y, opening.first), opening.last))
    else:
        nearest = (min(max(x, opening.first), opening.last), -0.5 if opening.side == "top" else height - 0.5)
    return float(np.hypot(x - nearest[0], y - nearest[1])) * chip.um_per_px
