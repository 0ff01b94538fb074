"""Frame to Shift: how far does the image lie from where the registration of the chip holds?

A shaking stage or camera moves the whole image, and the robot with it. The solid of the chip does not move on the chip,
so its image tells by how much. The first image gives the reference (Background): the pixels in and beside the solid
where the grey level changes most. Every later image is registered to it by least squares on these pixels (Lucas and
Kanade 1981), with a gain and an offset of the light and with Tukey's weights, because dirt and the robot pass some:

    min sum_k w_k [I(p_k + d) - a R(p_k) - b]^2   over d, a, b.

A shift is measured only along directions in which the reference has structure: not along a straight channel, and not at
all where the image shows no walls. There it stays 0, and the Background says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import (
    NS_PER_S,
    STD_PER_MAD,
    TUKEY,
    Background,
    Bools,
    Floats,
    Frame,
    Image,
    Ints,
    Range,
    Shift,
    Track,
)
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages.vision.learning import pixel_noise
from flowrec.stages.vision.walls import walls_in_view

_Pixel = Annotated[float, Range(-1e3, 1e3)]
_TILE_PX, _PER_TILE = 32, 8  # so that the pixels are spread over the image
_BORDER_PX = 4  # pixels nearer to the border would leave the image with most shifts
_LEAST_GRADIENT = 4.5  # of a pixel that is used, in standard deviations: one in 25,000 has it by noise alone
# Variance of a gradient by Scharr's operator (cv2.Scharr / 32) for a pixel's noise of variance 1.
_GRADIENT_NOISE = 236.0 / 1024.0
_LEAST_PIXELS = 60  # with fewer no shift is measured
_LEAST_STRUCTURE = 4.0  # mean squared gradient along a direction, in units of that of noise alone
_WALL_PX = 2.0  # half the width of the image of a wall: farther in the fluid there are bodies that move
_ITERATIONS = 8  # at most, of the reweighted fit
_CONVERGED_PX = 0.002
_AGREES, _AGREES_PX = 3.0, 0.5  # standard deviations of the noise, and px of shift, by which a pixel that agrees is off
_LEAST_ALIKE = 0.5  # share of the pixels that agree with the reference
_LESS_ALIKE = 0.1  # than the image before: the whole range is searched
_STILL = 3.0  # standard errors by which an image that moves has to move farther before its shift is another one
# An image that rests stays where it is until it moves by more than this. A lossy codec (MJPEG, quality 4) moves the
# walls of a still movie by 0.23 px while its quality settles, drifting dirt by 0.05 px. What stays for so long rests.
_RESTING_PX, _RESTS_AFTER_NS = 0.3, NS_PER_S
_SEARCHED = 400  # pixels that are compared in that search
_STEPS_PER_PX = 64  # a shift is a multiple of this part: rounding of the machine does not change it
_ROBOT_RADII = 2.0  # around its last place pixels are not used


@dataclass(frozen=True, slots=True)
class Stabiliser:
    """Measures the shift of each image of a shaking stage; its memory is the previous Shift, and the Background."""

    # compensate for a stage that shakes; None: on for a movie and a camera of a lab, off in a simulation, and in a
    # session that does not state it
    on: bool | None = None
    # shift of the first image (columns, rows), which is the reference of the others; flowrec import measures it
    first_px: tuple[_Pixel, _Pixel] = (0.0, 0.0)
    reach_px: Annotated[float, Range(1.0, 100.0)] = 12.0  # largest shift from the first image

    def register(
        self,
        previous: Shift | None,
        background: Background | None,
        track: Track | None,
        frame: Frame,
        chip: Chip,
        calibration: Calibration,
        robot: Robot,
    ) -> tuple[Shift | None, Background | None]:
        """The shift of this image, and the reference; (None, None) where it is off.

        An image that is not like the reference has the shift of the one before. `track` is that of the image before.
        """
        if not self.on:
            return None, None
        if background is None:
            background = _background(frame, chip, calibration)
            return Shift(frame.stamp_ns, np.array(self.first_px), found=True, alike=1.0, rests=True), background
        assert previous is not None, "a shift is measured with the reference"
        directions = _directions(background)
        if not directions.shape[1]:
            return previous, background
        first = np.array(self.first_px)
        pixels = background.pixels
        if track is not None and track.score > 0.0:
            at_px = calibration.to_px(track.position_um) + (previous.shift_px - first)
            away = np.hypot(*(pixels[:, :2] - at_px).T) > _ROBOT_RADII * robot.radius_um / calibration.um_per_px
            pixels = pixels[away] if np.count_nonzero(away) >= _LEAST_PIXELS else pixels
        found = _fit(frame.image, pixels, background.noise, previous.shift_px - first, directions)
        if found.alike < previous.alike - _LESS_ALIKE:
            start_px = _search_shift(frame.image, pixels, self.reach_px, directions)
            other = _fit(frame.image, pixels, background.noise, start_px, directions)
            found = other if other.alike > found.alike else found
        if found.alike < _LEAST_ALIKE or float(np.abs(found.shift_px).max()) > self.reach_px:
            return replace(previous, stamp_ns=frame.stamp_ns, found=False), background
        shift_px = np.rint((first + found.shift_px) * _STEPS_PER_PX) / _STEPS_PER_PX
        moved_px = float(np.abs(shift_px - previous.shift_px).max())
        least_px = _RESTING_PX if previous.rests else 1.5 / _STEPS_PER_PX
        if moved_px > max(least_px, _STILL * found.std_px):
            return Shift(frame.stamp_ns, shift_px, found=True, alike=found.alike), background
        rests = previous.rests or frame.stamp_ns - previous.stamp_ns >= _RESTS_AFTER_NS
        if previous.found and previous.rests == rests and previous.alike < 1.0:  # 1: the first, which is the reference
            return previous, background
        return Shift(frame.stamp_ns, previous.shift_px, found=True, alike=found.alike, rests=rests), background


def _background(frame: Frame, chip: Chip, calibration: Calibration) -> Background:
    """The reference: pixels with their grey levels and gradients, as many from each part of the image."""
    import cv2  # not at start-up

    image = frame.image
    height, width = image.shape
    grey, noise = image.astype(np.float32), pixel_noise(image)
    across, down = (cv2.Scharr(grey, cv2.CV_32F, *axis) / np.float32(32.0) for axis in ((1, 0), (0, 1)))
    steep = np.hypot(across, down)
    distance_px = walls_in_view(chip, calibration, (height, width)).distance_px
    steep[(distance_px > _WALL_PX) | (steep < _LEAST_GRADIENT * noise * math.sqrt(_GRADIENT_NOISE))] = 0.0
    inner = np.zeros(image.shape, bool)
    inner[_BORDER_PX : height - _BORDER_PX, _BORDER_PX : width - _BORDER_PX] = True
    steep[~inner] = 0.0
    chosen: list[tuple[int, int]] = []
    for top in range(0, height, _TILE_PX):
        for left in range(0, width, _TILE_PX):
            tile = steep[top : top + _TILE_PX, left : left + _TILE_PX]
            for place in np.argsort(-tile, axis=None, kind="stable")[:_PER_TILE].tolist():
                row, column = divmod(place, tile.shape[1])
                if tile[row, column] > 0.0:
                    chosen.append((top + row, left + column))
    rows, columns = np.array(chosen, np.intp).reshape(-1, 2).T
    values = (columns, rows, grey[rows, columns], across[rows, columns], down[rows, columns])
    background = Background(frame.stamp_ns, np.column_stack(values).astype(np.float64), noise)
    return background if _directions(background).shape[1] else Background(frame.stamp_ns, np.zeros((0, 5)), noise)


def _directions(background: Background) -> Floats:
    """(2, m) the directions in which a shift can be measured: m = 0, 1 (across a straight channel) or 2."""
    if len(background.pixels) < _LEAST_PIXELS:
        return np.zeros((2, 0))
    gradients = background.pixels[:, 3:]
    structure, axes = np.linalg.eigh(gradients.T @ gradients / len(gradients))
    return axes[:, structure > _LEAST_STRUCTURE * _GRADIENT_NOISE * background.noise**2]


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """An image against a reference."""

    shift_px: Floats  # (2,)
    std_px: float  # its standard error along the direction that is known least
    alike: float  # share of the pixels, by their gradients, that agree there


def _fit(image: Image, pixels: Floats, noise: float, start_px: Floats, directions: Floats) -> _Fit:
    """The shift of an image from a reference, from a first guess (2,) on."""
    known, slopes = pixels[:, 2], pixels[:, 3:] @ directions
    design = np.column_stack([slopes, known, np.ones(len(known))])
    count = slopes.shape[1]
    shift_px, alike, gain, std_px = start_px, 0.0, 1.0, math.inf
    for _ in range(_ITERATIONS):
        seen, inside = _levels(image, pixels[:, :2] + shift_px)
        residual = seen - gain * known
        residual -= np.median(residual[inside]) if inside.any() else 0.0
        scale = STD_PER_MAD * float(np.median(np.abs(residual[inside]))) if inside.any() else 0.0
        weights = np.clip(1.0 - (residual / max(TUKEY * scale, 1e-6)) ** 2, 0.0, None) ** 2 * inside
        weighted = design * weights[:, None]
        normal = design.T @ weighted
        solution = np.linalg.lstsq(normal, weighted.T @ seen, rcond=1e-12)[0]
        # I(p + d) = a R + b + slopes . u: the slopes that are left say how far the image lies beyond the shift so far.
        gain = float(solution[count])
        if gain <= 0.0:
            break
        step = -solution[:count] / gain
        shift_px = shift_px + directions @ np.clip(step, -2.0, 2.0)
        pulls, curvature = weighted[:, :count] * (seen - design @ solution)[:, None], normal[:count, :count] * gain
        if np.abs(step).max() < _CONVERGED_PX:
            break
    seen, inside = _levels(image, pixels[:, :2] + shift_px)
    if np.count_nonzero(inside) >= _LEAST_PIXELS and gain > 0.0:
        residual = seen - gain * known
        residual = np.abs(residual - np.median(residual[inside]))
        steep = np.hypot(*pixels[:, 3:].T) * inside  # what is hardly steep agrees at every shift
        agrees = residual < gain * (_AGREES * noise + _AGREES_PX * steep)
        alike = float(steep[agrees].sum() / steep.sum())
        std_px = _standard_error(pulls, _tiles_of(pixels), curvature)
    return _Fit(shift_px, std_px, alike)


def _tiles_of(pixels: Floats) -> Ints:
    """The number of the tile (n,) in which each pixel lies, counted without gaps."""
    tile = (pixels[:, 1] // _TILE_PX) * 1e4 + pixels[:, 0] // _TILE_PX
    return np.unique(tile, return_inverse=True)[1]


def _standard_error(pulls: Floats, tiles: Ints, curvature: Floats) -> float:
    """Standard error of a shift (m,) in its least certain direction, from the pull of each tile.

    H^-1 (sum_t u_t u_t^T) H^-1 with the sum u_t of the pulls (n, m) of a tile (Liang and Zeger 1986): the pixels of a
    tile err together, where a codec makes blocks or a stain lies, so they are no independent measurements.
    """
    each = np.column_stack([np.bincount(tiles, pull) for pull in pulls.T])
    if np.linalg.eigvalsh(curvature)[0] <= 0.0:
        return math.inf
    inverse = np.linalg.inv(curvature)
    return math.sqrt(float(np.linalg.eigvalsh(inverse @ (each.T @ each) @ inverse)[-1]))


def _search_shift(image: Image, pixels: Floats, reach_px: float, directions: Floats) -> Floats:
    """The shift (2,) in whole pixels with the highest correlation, within a reach."""
    some = pixels[:: max(1, len(pixels) // _SEARCHED)]
    reach = int(reach_px)
    steps = np.arange(-reach, reach + 1)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2).astype(np.float64)
    if directions.shape[1] == 1:
        grid = steps[:, None] * directions[:, 0]
    best, best_alike = np.zeros(2), -1.0
    for shift_px in grid:
        seen, inside = _levels(image, some[:, :2] + shift_px)
        alike = _correlation(seen[inside], some[inside, 2]) if np.count_nonzero(inside) > _LEAST_PIXELS // 2 else -1.0
        if alike > best_alike:
            best, best_alike = shift_px, alike
    return best


def _levels(image: Image, places_px: Floats) -> tuple[Floats, Bools]:
    """Grey levels (n,) between pixels, by bilinear interpolation, and which places (n, 2) lie in the image."""
    height, width = image.shape
    x, y = places_px.T
    inside = (x >= 0.0) & (x <= width - 1.0) & (y >= 0.0) & (y <= height - 1.0)
    column = np.clip(np.floor(x).astype(np.intp), 0, width - 2)
    row = np.clip(np.floor(y).astype(np.intp), 0, height - 2)
    a, b = x - column, y - row
    flat, first = image.ravel(), row * width + column
    upper = (1.0 - a) * flat[first] + a * flat[first + 1]
    lower = (1.0 - a) * flat[first + width] + a * flat[first + width + 1]
    return np.asarray((1.0 - b) * upper + b * lower), inside


def _correlation(one: Floats, other: Floats) -> float:
    one, other = one - one.mean(), other - other.mean()
    size = math.sqrt(float(one @ one) * float(other @ other))
    return float(one @ other) / size if size > 0.0 else 0.0
