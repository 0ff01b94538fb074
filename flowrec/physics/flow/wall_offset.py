"""A chip whose walls lie a fraction of a pixel inside or outside those that its mask shows.

A threshold that is too high or too low moves all walls of a segmented mask by the same distance. The walls of such a
chip are those of its mask, moved by that distance (level_set.py); its pixels are those whose centres lie between them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import FlowError
from flowrec.physics.chip.chip import Chip
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
    level = from_mask(drawn, 2, chip.walls, total_px).level
    mask = np.ascontiguousarray(level[2::4, 2::4] >= 0.5 * CLEARANCE_PX)
    runs = [run_around(border(mask, o.side), (o.first + o.last) // 2) for o in chip.openings]
    if None in runs or len({(o.side, run) for o, run in zip(chip.openings, runs, strict=True)}) < len(runs):
        raise FlowError(f"chip '{chip.name}' with walls moved by {total_px:g} px: an opening closes or meets another")
    openings = []
    for opening, run in zip(chip.openings, runs, strict=True):
        assert run is not None
        other = replace(opening, first=run[0], last=run[1])
        wider = opening.width_px / other.width_px if opening.kind == "inlet" else 1.0
        openings.append(replace(other, value=opening.value * wider))
    return replace(chip, mask=mask, drawn=drawn, wall_offset_px=total_px, openings=tuple(openings))
