"""True walls that are not the mask's: a mask of half the pixel size, pushed about in patches, with a blocked branch.

The solver makes its smooth outline of this mask as of any other, so the true flow has another grid and another wall.
Openings stay as they are: near the border the walls are those of the chip's mask. The mask of a chip so large that its
true flow would take minutes keeps its pixel size, and only whole pixels of it are pushed about.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Floats32, FlowField, RigError
from flowrec.physics import Chip, clearance_um, median_width_um, sample
from flowrec.rigs.simulated.microscope import blotches, outline_px

_REFINED, _LARGEST_PX = 2, 40_000  # cells of the true mask per pixel side; fluid pixels of a larger chip are not cut
_PATCH_WIDTHS = 1.0  # correlation length of the error of the walls, in median channel widths
_BORDER_PX = 6.0  # from here to twice as far from the border the error grows to its full size
_CORE = 0.6  # of the way from the middle of a channel to its wall that no error reaches, and so between channels
_SPECK_PX = 30  # a smaller piece is none, if it was part of a larger one
_FROM_BORDER_WIDTHS = 1.5  # no branch is blocked nearer than this to the border
_CLEAR_WIDTHS = 2.0  # nor to the start
_WIDTHS = (0.6, 1.3)  # times the median, of a place to be blocked: wider ones are junctions
_FARTHEST_PX = 1.1  # largest level of a pixel centre, as the solver states it
_BLOCK_LENGTH = 0.6  # half length of the obstacle along the channel, in widths


def true_walls(
    chip: Chip, wall_error_px: float, blocked_share: float, clear_um: Floats, rng: np.random.Generator
) -> tuple[Chip, str]:
    """The chip with a mask (c h, c w) of its true walls, c = 2 or for large chips 1, and what was drawn, in words.

    Parameters
    ----------
    wall_error_px : largest shift of a wall, in pixels of the chip; its patches are about as long as a channel is wide.
    blocked_share : fraction of a channel's width that an obstacle fills, at one place.
    clear_um : (n, 2) places in um from which the obstacle keeps away.

    Raises RigError if the mask has no place for the obstacle.
    """
    cut = _REFINED if np.count_nonzero(chip.mask) <= _LARGEST_PX else 1
    outline = cv2.resize(outline_px(chip.mask), None, fx=cut, fy=cut, interpolation=cv2.INTER_CUBIC)
    height, width = outline.shape
    coarse, words = cut_up(chip.mask, cut), []
    y, x = np.mgrid[:height, :width]
    inwards_px = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y)) / cut
    channel = median_width_um(chip) / chip.um_per_px * cut
    if wall_error_px > 0.0:
        shift = wall_error_px * np.tanh(blotches(rng, height, width, _PATCH_WIDTHS * channel))
        outline = outline + shift * np.clip(inwards_px / _BORDER_PX - 1.0, 0.0, 1.0)
        words.append(f"walls up to {wall_error_px:g} px off")
    fluid = ((outline > 0.0) | _core(coarse)) & ~_core(~coarse)
    fluid = np.where(inwards_px < 1.0, coarse, _without_specks(fluid, coarse))  # openings keep their pixels
    true = replace(
        chip,
        um_per_px=chip.um_per_px / cut,
        openings=tuple(replace(o, first=cut * o.first, last=cut * o.last + cut - 1) for o in chip.openings),
        walls="smooth",
    )
    if blocked_share > 0.0:
        block, place = _obstacle(
            replace(true, mask=fluid), origin_um(true, chip), blocked_share, channel, clear_um, rng
        )
        fluid = fluid & ~block
        words.append(f"{100 * blocked_share:.0f} % of a branch blocked at {place[0]:.0f}, {place[1]:.0f} um")
    return replace(true, mask=np.ascontiguousarray(fluid)), ", ".join(words)


def _ridge(inside: Bools) -> tuple[Bools, Floats]:
    """The pixels in the middle between walls, and the distance (h, w) of every pixel to the nearest wall, in pixels.

    In the middle the distance has no slope, as in median_width_um.
    """
    distance = clearance_um(inside, 1.0).astype(np.float64)
    return inside & (np.hypot(*np.gradient(distance)) <= 0.55), distance


def _core(inside: Bools) -> Bools:
    """The pixels within _CORE of the way from the middle of a channel to its wall."""
    ridge, distance = _ridge(inside)
    if not ridge.any():
        return np.zeros_like(inside)
    away, (rows, columns) = scipy.ndimage.distance_transform_edt(~ridge, return_indices=True)
    return away <= _CORE * distance[rows, columns]


def _without_specks(fluid: Bools, before: Bools) -> Bools:
    """Remove pieces of a few pixels that were part of larger ones before, such as a corner that is cut off.

    A piece of a wall becomes fluid, a piece of fluid a wall; a post that was small before stays.
    """
    corners = np.ones((3, 3))
    fluid = fluid | _specks(~fluid, ~before, corners)
    return fluid & ~_specks(fluid, before, None)


def _specks(inside: Bools, before: Bools, neighbours: Floats | None) -> Bools:
    """The pixels of small pieces of `inside` whose pixels were in a piece of `before` of more than twice their size."""
    pieces, count = scipy.ndimage.label(inside, neighbours)
    whole, _ = scipy.ndimage.label(before, neighbours)
    sizes, wholes = np.bincount(pieces.ravel(), minlength=count + 1), np.bincount(whole.ravel())
    wholes[0] = 0
    was = scipy.ndimage.maximum(wholes[whole], pieces, np.arange(1, count + 1))
    small = np.concatenate(([False], (sizes[1:] < _SPECK_PX) & (2 * sizes[1:] < was)))
    return small[pieces]


def _obstacle(
    true: Chip, origin: float, share: float, channel: float, clear_um: Floats, rng: np.random.Generator
) -> tuple[Bools, tuple[float, float]]:
    """The pixels of half an ellipse on one wall of a branch, and the place in um; `channel` is a width in pixels."""
    fluid = true.mask
    ridge, distance = _ridge(fluid)
    rows, columns = np.nonzero(ridge)
    radii = distance[rows, columns]
    height, width = fluid.shape
    inwards = np.minimum(np.minimum(columns, width - columns), np.minimum(rows, height - rows))
    places_um = origin + np.stack((columns, rows), -1) * true.um_per_px
    away = np.min(np.hypot(*(places_um[:, None] - clear_um[None]).T), axis=0) if len(clear_um) else np.inf
    fits = (
        (2.0 * radii > _WIDTHS[0] * channel)
        & (2.0 * radii < _WIDTHS[1] * channel)
        & (inwards > _FROM_BORDER_WIDTHS * channel)
        & (away > _CLEAR_WIDTHS * channel * true.um_per_px)
    )
    if not fits.any():
        raise RigError(f"chip '{true.name}' has no branch to block; set simulated.blocked_share = 0")
    chosen = int(rng.choice(np.flatnonzero(fits)))
    row, column, radius = rows[chosen], columns[chosen], float(radii[chosen])
    # The channel runs along the middle pixels around the place.
    near = np.hypot(rows - row, columns - column) <= 2.0 * radius
    along = np.linalg.svd(np.stack((columns[near] - column, rows[near] - row), -1).astype(np.float64))[2][0]
    side = 1.0 if rng.random() < 0.5 else -1.0
    y, x = np.indices(fluid.shape)
    down = (x - column) * along[0] + (y - row) * along[1]
    across = side * ((y - row) * along[0] - (x - column) * along[1])
    length = _BLOCK_LENGTH * 2.0 * radius
    bulge = 2.0 * radius * share * np.sqrt(np.clip(1.0 - (down / length) ** 2, 0.0, 1.0))
    block = (np.abs(down) < length) & (across > radius - bulge) & (across < 2.0 * radius)
    place = places_um[chosen]
    return block, (float(place[0]), float(place[1]))


def cut_up(mask: Bools, cut: int) -> Bools:
    """A mask with each pixel cut into cut x cut."""
    return np.repeat(np.repeat(mask, cut, axis=0), cut, axis=1)


def origin_um(true: Chip, chip: Chip) -> float:
    """Position of the centre of the first pixel of the true mask, on either axis of the chip frame."""
    return 0.5 * (true.um_per_px - chip.um_per_px)


def on_pixels(field: FlowField, true: Chip, chip: Chip) -> FlowField:
    """A field of the true mask as values at the centres of the chip's pixels, with its walls there."""
    rows, columns = np.indices(chip.mask.shape)
    centres_um = np.stack((columns, rows), -1) * chip.um_per_px - origin_um(true, chip)
    wall_px = at_centres(outline_px(true.mask), chip) * (true.um_per_px / chip.um_per_px)
    velocity = np.where((wall_px > 0.0)[..., None], sample(field, centres_um), 0.0)
    return replace(
        field,
        um_per_px=chip.um_per_px,
        velocity_um_s=np.ascontiguousarray(velocity, np.float32),
        pressure_pa=np.where(wall_px > 0.0, at_centres(field.pressure_pa, chip), 0.0).astype(np.float32),
        wall_px=np.clip(wall_px, -_FARTHEST_PX, _FARTHEST_PX).astype(np.float32),
    )


def at_centres(raster: NDArray[Any], chip: Chip) -> Floats32:
    """A raster of the true mask at the centres of the chip's pixels (h, w): the mean of those within each."""
    height, width = chip.mask.shape
    cut = raster.shape[0] // height
    return np.asarray(raster.reshape(height, cut, width, cut).mean((1, 3)), np.float32)
