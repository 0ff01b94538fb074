"""Registration of a chip in one picture: search, sub-pixel fit, and a verdict.

Nothing is chosen silently: poses that explain the picture equally well are all returned (a chip may be symmetric), and
a picture that does not show the chip, or not enough of it, is refused.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import ChipError
from flowrec.measure.wall_fit import Fitter, WallFit, WallMap
from flowrec.measure.wall_search import WallSearch
from flowrec.physics import AS_STATED, Calibration, Chip, median_width_um

_CANDIDATES = 12
_LEAST_SCORE = 0.55  # of a candidate, relative to the best one
_FIRST, _HOPELESS = 3, 0.5  # if of so many candidates none finds this part of the walls, the others are not tried
_REACH_WIDTHS, _REACH_PX = 0.6, 6.0  # from the walls: in median channel widths, but at least so many camera pixels
LEAST_FOUND = 0.7  # part of the walls
_EQUAL_FOUND, _EQUAL_EXPLAINED = 0.1, 0.85  # less found by this, and explained at least by this factor: equally good
_SAME_PX = 2.0  # two poses that differ by less are one
_MOST_SHIFT_PX, _MOST_ANGLE_DEG, _MOST_SCALE = 0.5, 0.1, 0.003  # standard errors above which a picture is refused
_OTHER_SCALE, _SIGNIFICANT = 0.02, 3.0  # relative difference, and standard errors, from which a scale is another one
# Scales that are tried about an assumed one: a step moves the image's border by 2 of 480 px.
_GROWTHS = (1.0, *np.geomspace(1.0 / 1.2, 1.2, 48).tolist())
_NEAR_SCALE = 0.012  # relative difference from the assumed scale up to which the fit finds its way
LEAST_PX, LEAST_CONTRAST = 32, 4.0  # shorter side and range of grey levels of a picture


def register(
    picture: NDArray[np.uint8 | np.uint16],
    chip: Chip,
    um_per_px: tuple[float, float],
    mirrors: tuple[bool, ...] = (False, True),
) -> tuple[WallFit, ...]:
    """The poses of a chip that explain a picture (h, w) equally well, best first; usually one.

    `um_per_px` is the range that is searched, `mirrors` says whether mirror images are.

    Raises
    ------
    ChipError : one line: the picture does not show this chip, or does not determine how it lies.
    """
    grey = np.asarray(picture, np.float32)
    if min(grey.shape) < LEAST_PX:
        least = f"{LEAST_PX} x {LEAST_PX}"
        raise ChipError(f"the picture has {grey.shape[1]} x {grey.shape[0]} pixels; take one of at least {least}")
    if float(np.ptp(grey)) < LEAST_CONTRAST:
        raise ChipError("the picture is blank; is the lamp on and the chip in view?")
    walls = WallMap(chip.mask, chip.um_per_px)
    poses = WallSearch(grey, chip.mask, chip.um_per_px, walls.clearance_um).candidates(um_per_px, mirrors, _CANDIDATES)
    fitter = fitter_of(grey, chip, math.sqrt(um_per_px[0] * um_per_px[1]), walls)
    fits: list[WallFit] = []
    for pose in poses:
        hopeless = len(fits) == _FIRST and max(fit.found for fit in fits) < _HOPELESS
        if hopeless or pose.score < _LEAST_SCORE * poses[0].score:
            break
        fits.append(fitter.fit(pose.calibration))
    # Of fits that end at one pose, one in which both readings do goes before one in which a reading went astray.
    fits.sort(key=lambda fit: bool(_loose(fit).any()))
    distinct: list[WallFit] = []
    for fit in fits:
        if all(_apart_px(fit.calibration, other.calibration, walls) > _SAME_PX for other in distinct):
            distinct.append(fit)
    distinct.sort(key=lambda fit: -fit.found * fit.explained)
    if not distinct or distinct[0].found < LEAST_FOUND:
        found = 100.0 * distinct[0].found if distinct else 0.0
        raise ChipError(
            f"the picture does not show the chip {chip.name}: at best {found:.0f} % of its walls agree, "
            f"{100 * LEAST_FOUND:.0f} % are needed; is it this chip, in focus, and is um_per_px about right?"
        )
    best = distinct[0]
    equal = [
        fit
        for fit in distinct
        if fit.found >= best.found - _EQUAL_FOUND and fit.explained >= _EQUAL_EXPLAINED * best.explained
    ]
    _refuse_undetermined(best, chip)
    return tuple(equal)


def fit_nearby(picture: NDArray[np.uint8 | np.uint16], chip: Chip, assumed: Calibration) -> WallFit | None:
    """The pose in a picture (h, w) near an assumed one, whose scale may be off by a fifth.

    None if the picture does not show the walls nearby.
    """
    grey = np.asarray(picture, np.float32)
    if min(grey.shape) < LEAST_PX or float(np.ptp(grey)) < LEAST_CONTRAST:
        return None
    walls = WallMap(chip.mask, chip.um_per_px)
    search = WallSearch(grey, chip.mask, chip.um_per_px, walls.clearance_um)
    middle_px = (np.array(grey.shape[::-1]) - 1) / 2
    grown = [AS_STATED.about(assumed, middle_px, growth) for growth in _GROWTHS]
    likely = max(grown, key=search.agreement)
    near = abs(math.log(likely.um_per_px / assumed.um_per_px)) < _NEAR_SCALE
    starts = [assumed] if near else [assumed, likely]
    fits = [fitter_of(grey, chip, start.um_per_px, walls).fit(start) for start in starts]
    best = max(fits, key=lambda fit: fit.found * fit.explained)
    return best if best.found >= LEAST_FOUND else None


def moved_px(fit: WallFit, chip: Chip, assumed: Calibration) -> float | None:
    """Root mean square distance, in pixels, of the walls in a picture from the walls of a calibration.

    None if the picture does not tell, because it does not show enough of them.
    """
    return None if _loose(fit).any() else _apart_px(fit.calibration, assumed, WallMap(chip.mask, chip.um_per_px))


def other_scale(fit: WallFit, assumed: Calibration) -> float | None:
    """The um per pixel of a fit, where they contradict the assumed ones by more than 2 % and three standard errors."""
    apart, std = abs(math.log(fit.calibration.um_per_px / assumed.um_per_px)), float(fit.std[3])
    contradicts = std < _MOST_SCALE and apart > max(_OTHER_SCALE, _SIGNIFICANT * std)
    return fit.calibration.um_per_px if contradicts else None


def fitter_of(grey: NDArray[np.float32], chip: Chip, um_per_px: float, walls: WallMap) -> Fitter:
    """Fits poses of a chip to a picture (h, w) of about this scale."""
    return Fitter(grey, walls, max(_REACH_WIDTHS * median_width_um(chip), _REACH_PX * um_per_px), um_per_px)


def _apart_px(one: Calibration, other: Calibration, walls: WallMap) -> float:
    """Root mean square distance of the walls of two poses in the image."""
    off = one.to_px(walls.points_um) - other.to_px(walls.points_um)
    return float(np.sqrt(np.mean(np.sum(off * off, -1))))


def _loose(fit: WallFit) -> NDArray[np.bool_]:
    """(4,) which of shift along x and y, angle and scale the picture does not determine."""
    shift_um = _MOST_SHIFT_PX * fit.calibration.um_per_px
    return ~(fit.std < (shift_um, shift_um, _MOST_ANGLE_DEG, _MOST_SCALE))


def _refuse_undetermined(fit: WallFit, chip: Chip) -> None:
    names = ("the shift along x ({:.3g} um)", "the shift along y ({:.3g} um)", "the angle ({:.2g} degrees)")
    shown = [name.format(value) for name, value in zip(names, fit.std.tolist(), strict=False)]
    shown.append(f"the scale ({100 * fit.std[3]:.2g} %)")
    loose = [text for text, bad in zip(shown, _loose(fit).tolist(), strict=True) if bad]
    if not loose:
        return
    if not _loose(replace(fit, std=fit.apart)).any():
        raise ChipError(
            f"the walls of {chip.name} in the picture do not determine {' and '.join(loose)}; show more of the chip, "
            "with walls of several directions"
        )
    raise ChipError(
        f"grey levels and local contrast of the picture put {chip.name} in different places: they disagree on "
        f"{' and '.join(loose)}; is it this chip, in focus, and is the light even from all sides?"
    )


def overlay(picture: NDArray[np.uint8 | np.uint16], chip: Chip, calibration: Calibration) -> NDArray[np.uint8]:
    """The picture (h, w, 3), blue first, with the outline of the chip as it was found, in orange."""
    grey = picture.astype(np.float32)
    low, high = np.percentile(grey, (0.5, 99.5))
    shown = np.clip(255.0 * (grey - low) / max(float(high - low), 1.0), 0, 255).astype(np.uint8)
    drawn = np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), np.uint8)
    contours, _ = cv2.findContours(chip.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    wide = max(1, round(max(grey.shape) / 800))
    for contour in contours:
        at = calibration.to_px(contour[:, 0] * chip.um_per_px)
        cv2.polylines(drawn, [np.rint(16 * at).astype(np.int32)], True, (0, 140, 255), wide, cv2.LINE_AA, 4)
    return drawn
