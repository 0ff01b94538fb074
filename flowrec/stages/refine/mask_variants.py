"""Masks that differ from a chip's by a pixel, for observations that contradict the chip's walls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up

from flowrec.physics import Chip, border, run_around


def mask_variants(chip: Chip) -> Iterator[tuple[str, Chip]]:
    """Possible errors of the mask, in words, each with the chip of the corrected mask and adapted openings.

    A mask that lies beside its place is an error of the registration (causes.py). A variant in which an opening
    vanishes or meets another is left out.
    """
    mask = chip.mask
    variants = (
        ("its channels are drawn a pixel too wide on each side", scipy.ndimage.binary_erosion(mask, border_value=1)),
        ("its channels are drawn a pixel too narrow on each side", scipy.ndimage.binary_dilation(mask)),
    )
    for words, other in variants:
        runs = [run_around(border(other, o.side), (o.first + o.last) // 2) for o in chip.openings]
        openings = tuple(
            replace(o, first=run[0], last=run[1]) for o, run in zip(chip.openings, runs, strict=True) if run
        )
        if len({(o.side, o.first) for o in openings}) == len(runs):
            yield words, replace(chip, mask=np.ascontiguousarray(other), openings=openings)
