"""A chip whose walls lie elsewhere than its mask shows: all by a fraction of a pixel, or each as it was measured.

A threshold that is too high or too low moves all walls of a segmented mask by the same distance. The walls of such a
chip are those of its mask, moved by that distance (level_set.py); its pixels are those whose centres lie between them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Bools, Floats32, FlowError
from flowrec.physics.chip.chip import Chip, Opening, greys_of, levels
from flowrec.physics.chip.io import without_pockets
from flowrec.physics.chip.openings import border, run_around
from flowrec.physics.flow.level_set import CLEARANCE_PX, from_mask


def with_wall_offset(chip: Chip, offset_px: float) -> Chip:
    """The chip with all walls moved outwards from where it has them, at the same flow rates through its inlets.

    Raises FlowError if an opening closes, or two meet.
    """
    if offset_px == 0.0:
        return chip
    total_px = chip.wall_offset_px + offset_px
    drawn = chip.mask if chip.drawn is None else chip.drawn
    level = from_mask(drawn, 2, chip.walls, total_px, chip.level_px).level
    mask = np.ascontiguousarray(level[2::4, 2::4] >= 0.5 * CLEARANCE_PX)
    openings = _in_other_walls(chip, mask, f"walls moved by {total_px:g} px")
    return replace(chip, mask=mask, drawn=drawn, wall_offset_px=total_px, openings=openings)


def with_levels(chip: Chip, level_px: Floats32) -> Chip:
    """The chip with walls on the zero line of levels (h, w), at the same flow rates through its inlets.

    Levels are rounded to steps of 1 / GREYS_PER_PX, as its file has them. Raises FlowError if an opening closes, or two
    meet.
    """
    level_px = levels(greys_of(level_px))
    mask = np.ascontiguousarray(level_px >= 0.0)
    mask.flags.writeable = False
    openings = _in_other_walls(chip, mask, "walls as they were measured")
    return without_pockets(replace(chip, mask=mask, walls="grey", level_px=level_px, openings=openings))


def _in_other_walls(chip: Chip, mask: Bools, why: str) -> tuple[Opening, ...]:
    """The openings of a chip in another mask (h, w), at the same flow rates through its inlets."""
    runs = [run_around(border(mask, o.side), (o.first + o.last) // 2) for o in chip.openings]
    if None in runs or len({(o.side, run) for o, run in zip(chip.openings, runs, strict=True)}) < len(runs):
        raise FlowError(f"chip '{chip.name}' with {why}: an opening closes or meets another")
    openings = []
    for opening, run in zip(chip.openings, runs, strict=True):
        assert run is not None
        other = replace(opening, first=run[0], last=run[1])
        wider = opening.width_px / other.width_px if opening.kind == "inlet" else 1.0
        openings.append(replace(other, value=opening.value * wider))
    return tuple(openings)
