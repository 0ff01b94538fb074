"""Distance to the walls, and points with enough of it: the place of an opening, the place of a robot."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.typing import ArrayLike

from flowrec.core import Bools, ChipError, Floats, Floats32
from flowrec.physics.chip.chip import Chip
from flowrec.physics.chip.openings import border, named_opening

_KEPT = 8  # masks of which the distances are kept: an assimilation asks for those of one mask a hundred times
_PAD_PX = 16  # by which a channel goes on straight beyond the border


def clearance_um(mask: Bools, um_per_px: float) -> Floats32:
    """Signed distance (h, w) in um from each pixel centre to the nearest wall, negative in solid.

    The wall lies half way between the centres of a fluid and a solid pixel: exact for walls along the pixels, up to
    a fifth of a pixel too near for oblique ones. A channel cut by the border goes on straight beyond it.
    """
    if mask.all():
        return np.full(mask.shape, np.inf, np.float32)
    return np.ascontiguousarray(_signed_px(mask.shape, mask.tobytes()) * um_per_px, np.float32)


@functools.lru_cache(maxsize=_KEPT)
def _signed_px(shape: tuple[int, int], data: bytes) -> Floats:
    """(h, w) the same in px, of the mask whose bytes are these."""
    padded = np.pad(np.frombuffer(data, np.bool_).reshape(shape), _PAD_PX, mode="edge")
    signed = np.where(padded, _distance(padded) - 0.5, 0.5 - _distance(~padded))
    return signed[_PAD_PX:-_PAD_PX, _PAD_PX:-_PAD_PX]


def _distance(inside: Bools) -> Floats:
    """Distance (h, w) in px of each pixel to the nearest one outside; 0 there.

    OpenCV takes a tenth of SciPy's time, in single precision. Squared distances are whole numbers, so rounding them
    restores the exact ones.
    """
    rough = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.sqrt(np.rint(rough * rough))


def median_width_um(chip: Chip) -> float:
    """The width of the channels that is exceeded along half of their length, um.

    On the centreline the distance to the wall has no slope. A centreline that runs between two pixel centres, at a
    distance s from one of them, shows there as the slope s (px) and as half the width less s.
    """
    distance = clearance_um(chip.mask, chip.um_per_px).astype(np.float64) / chip.um_per_px
    slope = np.hypot(*np.gradient(distance))
    half_widths_um = ((distance + slope) * chip.um_per_px)[chip.mask & (slope <= 0.55)]
    half_widths_um = half_widths_um[np.isfinite(half_widths_um)]
    return 2.0 * float(np.median(half_widths_um)) if len(half_widths_um) else chip.um_per_px


def opening_point_um(chip: Chip, name: str, depth_um: float) -> tuple[float, float]:
    """The point (x, y) in um in the middle of the channel, `depth_um` along it from the named opening."""
    opening = named_opening(chip, name)
    side = np.zeros_like(chip.mask)
    border(side, opening.side)[opening.first : opening.last + 1] = True
    steps = max(1, round(depth_um / chip.um_per_px))
    rows, columns = (slice(max(at.min() - steps, 0), at.max() + steps + 1) for at in np.nonzero(side))
    mask = chip.mask[rows, columns]  # what so many steps can reach
    front = reached = side[rows, columns] & mask
    for _ in range(steps):
        grown = scipy.ndimage.binary_dilation(reached) & mask
        if not (grown & ~reached).any():
            break
        front, reached = grown & ~reached, grown
    to_wall = clearance_um(chip.mask, chip.um_per_px)[rows, columns]
    row, column = np.unravel_index(np.argmax(np.where(front, to_wall, -np.inf)), mask.shape)
    return float((columns.start + column) * chip.um_per_px), float((rows.start + row) * chip.um_per_px)


def nearest_fluid(chip: Chip, point_um: ArrayLike, clearance: float = 0.0) -> Floats | None:
    """The pixel centre (2,) um nearest to a point with at least this clearance in um; None if there is none."""
    rows, columns = np.nonzero(chip.mask & (clearance_um(chip.mask, chip.um_per_px) >= clearance))
    if not len(rows):
        return None
    centres = np.stack((columns, rows), -1) * chip.um_per_px
    nearest = centres[np.argmin(np.sum((centres - np.asarray(point_um, np.float64)) ** 2, -1))]
    return np.asarray(nearest, np.float64)


def check_point(chip: Chip, point_um: ArrayLike, what: str, clearance: float = 0.0) -> None:
    """Raise ChipError unless a point (2,) in um lies in the fluid with this clearance in um; `what` names it."""
    x, y = (float(value) for value in np.asarray(point_um, np.float64))
    column, row = round(x / chip.um_per_px), round(y / chip.um_per_px)
    height, width = chip.mask.shape
    if not (0 <= column < width and 0 <= row < height):
        problem = f"is outside the chip, which is {chip.size_um[0]:g} x {chip.size_um[1]:g} um"
    elif not chip.mask[row, column]:
        problem = "is in a wall"
        if max(abs(x), abs(y)) < 10.0:
            problem += " (it is read in um, not in mm)"
    elif clearance_um(chip.mask, chip.um_per_px)[row, column] < clearance:
        problem = f"is nearer to a wall than {clearance:g} um"
    else:
        return
    near = nearest_fluid(chip, (x, y), clearance)
    hint = "no point of this chip would do" if near is None else f"the nearest that would do is {near[0]:g},{near[1]:g}"
    raise ChipError(f"{chip.name}: {what} {x:g},{y:g} um {problem}; {hint}")
