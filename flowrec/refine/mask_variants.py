"""Other walls than the mask says: all a pixel further out or in, or the whole mask a pixel off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from flowrec.chip.chip import Chip, Opening
from flowrec.chip.openings import border, run_around

Mask = NDArray[np.bool_]


def other_walls(chip: Chip) -> Iterator[tuple[str, Chip]]:
    """What was done to the mask, in words, and the chip with its openings where they are then.

    An opening that vanishes or meets another leaves its variant out.
    """
    mask = chip.mask
    edge = np.pad(mask, 1, mode="edge")
    variants = (
        ("its channels are drawn a pixel too wide on each side", binary_erosion(mask, border_value=1), (0, 0)),
        ("its channels are drawn a pixel too narrow on each side", binary_dilation(mask), (0, 0)),
        ("it lies a pixel too far left", edge[1:-1, :-2], (1, 0)),
        ("it lies a pixel too far right", edge[1:-1, 2:], (-1, 0)),
        ("it lies a pixel too high", edge[:-2, 1:-1], (0, 1)),
        ("it lies a pixel too low", edge[2:, 1:-1], (0, -1)),
    )
    for words, other, (right, down) in variants:
        openings = []
        for opening in chip.openings:
            along = down if opening.side in ("left", "right") else right
            line = border(other, opening.side)
            span = run_around(line, (opening.first + opening.last) // 2 + along)
            if span is None:
                break
            openings.append(replace(opening, first=span[0], last=span[1]))
        if len(openings) == len(chip.openings) and not _meet(openings):
            yield words, replace(chip, mask=np.ascontiguousarray(other), openings=tuple(openings))


def _meet(openings: list[Opening]) -> bool:
    return len({(opening.side, opening.first) for opening in openings}) < len(openings)
