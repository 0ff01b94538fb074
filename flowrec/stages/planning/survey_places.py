"""Candidate places of a survey: the middle of the channels, away from the openings."""

from __future__ import annotations

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up

from flowrec.physics import Chip, distance_px
from flowrec.stages.planning.cost_rasters import Mask, Raster
from flowrec.stages.planning.free_space import FreeSpace


def central_pixels(clearance: Raster) -> Mask:
    """(h, w) pixels near the middle of a channel: within two pixels none has more than one pixel more clearance."""
    return np.asarray(clearance >= scipy.ndimage.maximum_filter(clearance, 5) - 1.0)


def far_from_openings(chip: Chip, least_px: float) -> Mask:
    """(h, w) pixels at least so far from every opening."""
    y, x = np.indices(chip.mask.shape)
    far = np.ones(chip.mask.shape, np.bool_)
    for opening in chip.openings:
        far &= distance_px(opening, x, y, chip.mask.shape) >= least_px
    return far


def middle_weight(space: FreeSpace, pull: float) -> Raster:
    """(h, w) factor on the cost of a pixel: `1 + pull` next to a wall, least in the middle of the channel."""
    return np.asarray(1.0 + pull * (space.need / np.maximum(space.clearance, space.need)) ** 2)
