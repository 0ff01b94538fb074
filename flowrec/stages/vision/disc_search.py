"""Search for the robot as a dark disc: candidates by correlation with a template, then a fit to each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats32, Image, nearest_pixel
from flowrec.stages.vision.disc_fit import fit_disc, fit_radius, initial_edge_px
from flowrec.stages.vision.masked_ncc import masked_ncc, template
from flowrec.stages.vision.walls import Box, Walls

_SMALLEST, _LARGEST = 0.75, 1.35  # least and greatest tracked radius relative to the robot's own
_RADIUS_WEIGHT = 0.05  # of the newest radius in the tracked one: focus drifts, single frames are unreliable
_COARSE_RADIUS_PX = 2.5  # of the robot in the reduced image in which candidates are found
_FINE_RADIUS_PX = 6.0  # of the robot in the image that the disc is fitted to, unless it is smaller in the camera's
_LEAST_CORRELATION = 0.35  # of a candidate
_SIZE_PX = 0.5  # uncertainty of any disc's radius because of blur
_SURE = 0.92  # a score that needs no comparison
_DISTANCE_PENALTY = 0.1  # at the end of the search range
_NOISE_LEVELS = 2.0  # of a normalised image: the default of least_contrast is three times its noise


@dataclass(frozen=True, slots=True)
class Disc:
    """A fitted disc, in camera pixels and grey levels."""

    x: float
    y: float
    radius_px: float
    darkness: float
    likeness: float
    score: float  # likeness times agreement of size


@dataclass(frozen=True, slots=True)
class DiscSearch:
    """Area of the search for discs, and the least similarity to the robot. Lengths in camera pixels."""

    box: Box  # of possible centres
    centre: tuple[float, float]
    range_px: float  # from the centre; inf: everywhere
    nominal_px: float
    expected_px: float
    margin_px: float
    least_score: float
    least_likeness: float
    least_contrast: float  # grey levels
    size_tolerance: float  # one sigma of ln(measured radius / expected radius)
    candidates: int  # largest number of fitted discs
    slack_px: float = 0.0  # the walls may be off by this much


def best_disc(image: Image | Floats32, walls: Walls, search: DiscSearch) -> Disc | None:
    """The best disc within the search range."""
    near = math.isfinite(search.range_px)
    best, best_rank = None, 0.0
    for found in discs(image, walls, search):
        rank = found.score * found.darkness
        if near:
            moved2 = (found.x - search.centre[0]) ** 2 + (found.y - search.centre[1]) ** 2
            rank = found.score - _DISTANCE_PENALTY * moved2 / search.range_px**2
        if rank > best_rank:
            best, best_rank = found, rank
        if near and found.score > _SURE:
            break
    return best


def discs(image: Image | Floats32, walls: Walls, search: DiscSearch) -> Iterator[Disc]:
    """The discs within the search range that are like a robot, the most similar ones to its template first."""
    x0, y0, x1, y1 = search.box
    if x1 <= x0 or y1 <= y0:
        return
    nominal = search.nominal_px
    step = coarse_step(nominal)
    clearance = 0.7 * nominal - search.slack_px
    match = masked_ncc(image, walls.distance_px, search.box, step, search.margin_px, clearance, template(nominal, step))
    rows, columns = match.shape
    offset = 0.5 * (step - 1)
    if math.isfinite(search.range_px):
        dx = x0 + offset - search.centre[0] + step * np.arange(columns, dtype=np.float32)
        dy = y0 + offset - search.centre[1] + step * np.arange(rows, dtype=np.float32)
        distance2 = ((dx * dx)[None] + (dy * dy)[:, None]) / np.float32(search.range_px**2)
        match = np.where(distance2 <= 1.0, match - np.float32(_DISTANCE_PENALTY) * distance2, np.float32(-1.0))
    suppressed = max(1, round(nominal / step))  # around a candidate
    for _ in range(search.candidates):
        row, column = divmod(int(match.argmax()), columns)
        if match[row, column] < _LEAST_CORRELATION:
            break
        top, left = max(row - suppressed, 0), max(column - suppressed, 0)
        match[top : row + suppressed + 1, left : column + suppressed + 1] = -1.0
        found = _measure(image, walls, x0 + offset + step * column, y0 + offset + step * row, search)
        if found is not None and found.score >= search.least_score and found.likeness >= search.least_likeness:
            yield found


def _measure(image: Image | Floats32, walls: Walls, x: float, y: float, search: DiscSearch) -> Disc | None:
    """Fit a disc near a candidate; None if the result can not be the robot."""
    expected = search.expected_px
    step = max(1, int(search.nominal_px / _FINE_RADIUS_PX))
    fx, fy, radius_px, darkness, likeness = fit_disc(
        image, walls.distance_px, search.margin_px, x, y, expected, initial_edge_px(expected), step
    )
    if darkness < search.least_contrast or math.hypot(fx - x, fy - y) > max(1.2 * expected, 2.0):
        return None
    if walls.distance_px[nearest_pixel(fx, fy, image.shape)] < 0.6 * search.nominal_px - search.slack_px:
        return None
    size = math.log(radius_px / expected) / math.hypot(search.size_tolerance, _SIZE_PX / expected)
    return Disc(fx, fy, radius_px, darkness, likeness, likeness * math.exp(-0.5 * size * size))


def best_disc_normalised(
    image: Image | Floats32, walls: Walls, search: DiscSearch, noise: float, slack_px: float
) -> Disc | None:
    """The best disc in an image scaled so that the noise of a pixel is 2 grey levels.

    The contrast is then relative to the noise, and the depth of the image does not matter. The walls may be off by
    `slack_px`. The darkness of the result is the difference to the background in grey levels of the image.
    """
    x0, y0, x1, y1 = search.box
    pad = disc_pad_px(search.nominal_px)
    left, top = max(x0 - pad, 0), max(y0 - pad, 0)
    part = image[top : y1 + pad, left : x1 + pad].astype(np.float32)
    if not part.size:
        return None
    gain = _NOISE_LEVELS / noise
    level = np.median(part[:: max(1, len(part) // 64)])
    part = np.float32(128.0) + np.float32(gain) * (part - level)
    distance = np.ascontiguousarray(walls.distance_px[top : y1 + pad, left : x1 + pad])
    shifted = replace(
        search,
        box=(x0 - left, y0 - top, x1 - left, y1 - top),
        centre=(search.centre[0] - left, search.centre[1] - top),
        margin_px=search.margin_px - slack_px,
        slack_px=slack_px,
    )
    found = best_disc(part, Walls(distance, shifted.box), shifted)
    if found is None:
        return None
    return replace(found, x=found.x + left, y=found.y + top, darkness=found.darkness / gain)


def disc_pad_px(nominal: float) -> int:
    """Margin around a searched box that the search for a disc of a radius reads, in px."""
    coarse = coarse_step(nominal)
    # Blocks of the reduced image that a template on the outermost block of the region covers; the last of them may
    # exceed the region by all but a pixel.
    correlated = coarse * (len(template(nominal, coarse)) // 2 + 1) - 1
    # A disc is fitted around the middle of a block, to blocks that begin on whole pixels.
    largest = _LARGEST * nominal
    fitted = 0.5 * (coarse - 1) + fit_radius(largest, initial_edge_px(largest)) + 1.0
    return max(correlated, math.ceil(fitted))


def tracked_radius_px(before_px: float, found: Disc, nominal_px: float) -> float:
    """The radius of a robot by all discs so far, of which the newest is `found`."""
    radius_px = before_px + _RADIUS_WEIGHT * (found.radius_px - before_px)
    return min(max(radius_px, _SMALLEST * nominal_px), _LARGEST * nominal_px)


def coarse_step(nominal_px: float) -> int:
    """Camera pixels per block of the image in which candidates are found."""
    return max(1, int(nominal_px / _COARSE_RADIUS_PX))
