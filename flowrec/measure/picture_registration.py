"""Registration of a chip in one picture: search, sub-pixel fit, and a verdict; and the comparison with a stated one.

Nothing is chosen silently: poses that explain the picture equally well are all returned (a chip may be symmetric), and
a picture that does not show the chip, or not enough of it, is refused.

The orientation (of eight) and the scale in which a picture shows its chip are compared with those of a registration:
the directions of the walls (wall_search.py) in all eight at once, which takes some hundredths of a second. Only another
orientation than the stated one is then fitted (wall_fit.py), and it contradicts only where that fit finds the walls and
the fit of the stated one does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from flowrec.core import ChipError, Floats, Image
from flowrec.measure.images import Colours, Mask, with_curves
from flowrec.measure.wall_fit import Fitter, WallFit
from flowrec.measure.wall_search import WallMap, WallSearch
from flowrec.physics import AS_STATED, ORIENTATIONS, Calibration, Chip, Orientation, camera_settings, median_width_um

_CANDIDATES = 12  # coarse poses that are fitted at most, the best first
_LEAST_SCORE = 0.55  # of a candidate, relative to the best one
_FIRST, _HOPELESS = 3, 0.5  # if of so many candidates none finds this part of the walls, the others are not tried
_REACH_WIDTHS, _REACH_PX = 0.6, 6.0  # from the walls: in median channel widths, but at least so many camera pixels
_LEAST_FOUND = 0.7  # part of the walls
_EQUAL_FOUND, _EQUAL_EXPLAINED = 0.1, 0.85  # less found by this, and explained at least by this factor: equally good
_SAME_PX = 2.0  # two poses that differ by less are one
_MOST_SHIFT_PX, _MOST_ANGLE_DEG, _MOST_SCALE = 0.5, 0.1, 0.003  # standard errors above which a picture is refused
_OTHER_SCALE = 0.02  # relative difference from which a scale is another one: over six of the largest standard errors
# Scales that are tried about an assumed one: a step moves the image's border by 2 of 480 px.
_NEAR_GROWTHS = (1.0, *np.geomspace(1.0 / 1.2, 1.2, 48).tolist())
_NEAR_SCALE = 0.012  # relative difference from the assumed scale up to which the fit finds its way
_LEAST_PX, _LEAST_CONTRAST = 32, 4.0  # shorter side and range of grey levels of a picture

# Agreement of directions is 1 to 1.8 in sharp pictures, 0.8 with noise of the size of the walls' contrast; 0.6 at most
# for a wrong orientation of the chips of the benchmarks, 0.1 as a rule.
_SHOWN = 0.4  # agreement from which a picture shows walls
_EQUAL = 0.85  # part of the best agreement from which an orientation is as good
_LESS_FOUND = 0.1  # part of the walls that the stated orientation finds less than one that contradicts it
_LEAST_SURE_DEG, _LEAST_SURE_SCALE = 2.0, 0.05  # standard errors of a fit above which it tells no angle or scale
_MOST_GROWTH = 1.2  # factor by which the scale may be off, to either side
# Scales that are tried, relative to the stated one: a step moves the image's border by 4 of 480 px.
_GROWTHS = tuple(np.geomspace(0.5, 2.0, 91).tolist())


class _ChipInPicture:
    """A picture (h, w) and the chip that it may show."""

    def __init__(self, picture: Image, chip: Chip) -> None:
        self.chip, self.grey = chip, np.asarray(picture, np.float32)
        self.middle_px = (np.array(self.grey.shape[::-1]) - 1) / 2
        self.walls = WallMap(chip.mask, chip.um_per_px)
        self.search = WallSearch(self.grey, self.walls)

    def fitter(self, um_per_px: float) -> Fitter:
        """Fits poses to the picture, which is of about this scale."""
        reach_um = max(_REACH_WIDTHS * median_width_um(self.chip), _REACH_PX * um_per_px)
        return Fitter(self.grey, self.walls, reach_um, um_per_px)


def _is_small(picture: Image) -> bool:
    return bool(min(picture.shape) < _LEAST_PX)


def _is_blank(picture: Image) -> bool:
    return float(np.ptp(picture)) < _LEAST_CONTRAST


def is_legible(picture: Image, chip: Chip) -> bool:
    """False where the picture is small or blank, or the chip, like an open field, has walls along its border only."""
    return not (_is_small(picture) or _is_blank(picture) or chip.is_open_field)


def register(
    picture: Image, chip: Chip, um_per_px: tuple[float, float], mirrors: tuple[bool, ...] = (False, True)
) -> tuple[WallFit, ...]:
    """The poses of a chip that explain a picture (h, w) equally well, best first; usually one.

    `um_per_px` is the range that is searched, `mirrors` says whether mirror images are. Raises ChipError: one line: the
    picture does not show this chip, or does not determine how it lies.
    """
    if _is_small(picture):
        least = f"{_LEAST_PX} x {_LEAST_PX}"
        raise ChipError(f"the picture has {picture.shape[1]} x {picture.shape[0]} pixels; take one of at least {least}")
    if _is_blank(picture):
        raise ChipError("the picture is blank; is the lamp on and the chip in view?")
    scene = _ChipInPicture(picture, chip)
    poses = scene.search.candidates(um_per_px, mirrors, _CANDIDATES)
    fitter = scene.fitter(math.sqrt(um_per_px[0] * um_per_px[1]))
    fits: list[WallFit] = []
    for pose in poses:
        hopeless = len(fits) == _FIRST and max(fit.found for fit in fits) < _HOPELESS
        if hopeless or pose.score < _LEAST_SCORE * poses[0].score:
            break
        fits.append(fitter.fit(pose.calibration))
    # Of fits that end at one pose, one in which both readings do goes before one in which a reading went astray.
    fits.sort(key=is_loose)
    distinct: list[WallFit] = []
    for fit in fits:
        if all(apart_px(fit.calibration, other.calibration, scene.walls.points_um) > _SAME_PX for other in distinct):
            distinct.append(fit)
    distinct.sort(key=lambda fit: -fit.found * fit.explained)
    if not distinct or distinct[0].found < _LEAST_FOUND:
        found = 100.0 * distinct[0].found if distinct else 0.0
        raise ChipError(
            f"the picture does not show the chip {chip.name}: at best {found:.0f} % of its walls agree, "
            f"{100 * _LEAST_FOUND:.0f} % are needed; is it this chip, in focus, and is um_per_px about right?"
        )
    best = distinct[0]
    _refuse_undetermined(best, chip)
    return tuple(
        fit
        for fit in distinct
        if fit.found >= best.found - _EQUAL_FOUND and fit.explained >= _EQUAL_EXPLAINED * best.explained
    )


def fit_nearby(picture: Image, chip: Chip, assumed: Calibration) -> WallFit | None:
    """The pose in a picture (h, w) near an assumed one, whose scale may be off by a fifth.

    None if the picture does not show the walls nearby.
    """
    if not is_legible(picture, chip):
        return None
    scene = _ChipInPicture(picture, chip)
    grown = [AS_STATED.about(assumed, scene.middle_px, growth) for growth in _NEAR_GROWTHS]
    likely = max(grown, key=scene.search.agreement)
    near = abs(math.log(likely.um_per_px / assumed.um_per_px)) < _NEAR_SCALE
    starts = [assumed] if near else [assumed, likely]
    fits = [scene.fitter(start.um_per_px).fit(start) for start in starts]
    best = max(fits, key=lambda fit: fit.found * fit.explained)
    return best if best.found >= _LEAST_FOUND else None


def moved_px(fit: WallFit, chip: Chip, assumed: Calibration) -> float | None:
    """Root mean square distance, in pixels, of the walls in a picture from the walls of a calibration.

    None if the picture does not tell, because it does not show enough of them.
    """
    walls = WallMap(chip.mask, chip.um_per_px)
    return None if is_loose(fit) else apart_px(fit.calibration, assumed, walls.points_um)


def other_scale(fit: WallFit, assumed: Calibration) -> float | None:
    """The um per pixel of a fit that the picture determines, where they differ from the assumed ones by over 2 %."""
    apart = abs(math.log(fit.calibration.um_per_px / assumed.um_per_px))
    contradicts = float(fit.std[3]) < _MOST_SCALE and apart > _OTHER_SCALE
    return fit.calibration.um_per_px if contradicts else None


def apart_px(one: Calibration, other: Calibration, points_um: Floats) -> float:
    """Root mean square distance of points (n, 2) on the walls of two poses in the image."""
    off = one.to_px(points_um) - other.to_px(points_um)
    return float(np.sqrt(np.mean(np.sum(off * off, -1))))


def is_loose(fit: WallFit) -> bool:
    """True where the picture does not determine shift, angle and scale of a fit."""
    return bool(_loose(fit).any())


def _loose(fit: WallFit) -> Mask:
    """(4,) which of shift along x and y, angle and scale the picture does not determine."""
    shift_um = _MOST_SHIFT_PX * fit.calibration.um_per_px
    return ~(fit.std < (shift_um, shift_um, _MOST_ANGLE_DEG, _MOST_SCALE))


def _refuse_undetermined(fit: WallFit, chip: Chip) -> None:
    x, y, angle, scale = fit.std.tolist()
    shown = (
        f"the shift along x ({x:.3g} um)",
        f"the shift along y ({y:.3g} um)",
        f"the angle ({angle:.2g} degrees)",
        f"the scale ({100 * scale:.2g} %)",
    )
    loose = " and ".join(text for text, bad in zip(shown, _loose(fit), strict=True) if bad)
    if not loose:
        return
    if not _loose(fit._replace(std=fit.apart)).any():
        raise ChipError(
            f"the walls of {chip.name} in the picture do not determine {loose}; show more of the chip, with walls of "
            "several directions"
        )
    raise ChipError(
        f"grey levels and local contrast of the picture put {chip.name} in different places: they disagree on {loose}; "
        "is it this chip, in focus, and is the light even from all sides?"
    )


def overlay(picture: Image, chip: Chip, calibration: Calibration) -> Colours:
    """The picture (h, w, 3), blue first, with the outline of the chip as it was found, in orange."""
    contours, _ = cv2.findContours(chip.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return with_curves(picture, (calibration.to_px(contour[:, 0] * chip.um_per_px) for contour in contours))[0]


class ImageVerdict(NamedTuple):
    """Result of the comparison of the axes with a picture."""

    contradiction: str  # one line with the settings to paste; '' if there is none
    # the orientations in the image that it shows equally well; () if it does not show enough of the walls
    alike: tuple[Orientation, ...]

    @property
    def decided(self) -> bool:
        """True if the stated orientation is the only one that the picture shows."""
        return self.alike == (AS_STATED,) and not self.contradiction

    @property
    def text(self) -> str:
        """The verdict in a sentence."""
        if self.contradiction:
            return self.contradiction
        if self.decided:
            return "the image shows the chip in the stated orientation"
        if not self.alike:
            return "the image does not tell the orientation of the chip: too few walls are where they should be"
        others = ", ".join(each.name for each in self.alike if each != AS_STATED)
        return f"the chip looks the same {others}: its image does not tell which it is"


def orientation_by_image(picture: Image, chip: Chip, stated: Calibration) -> ImageVerdict:
    """The verdict of a picture (h, w) on the stated registration."""
    if not is_legible(picture, chip):
        return ImageVerdict("", ())
    scene = _ChipInPicture(picture, chip)

    def pose(orientation: Orientation, growth: float) -> Calibration:
        return orientation.about(stated, scene.middle_px, growth)

    def score(orientations: Sequence[Orientation], growths: Sequence[float]) -> dict[tuple[Orientation, float], float]:
        tried = [(each, growth) for each in orientations for growth in growths]
        return {each: scene.search.agreement(pose(*each)) for each in tried}

    scores = score(ORIENTATIONS, (1.0,)) | score((AS_STATED,), _GROWTHS)
    if max(scores.values()) < _SHOWN:
        scores |= score(ORIENTATIONS, _GROWTHS)
    least = max(_EQUAL * max(scores.values()), _SHOWN)
    if scores[AS_STATED, 1.0] >= least:
        growth = 1.0
    else:
        _, growth = max(scores, key=lambda each: scores[each])
        scores |= score(ORIENTATIONS, (growth,))
    alike = tuple(each for each in ORIENTATIONS if scores[each, growth] >= least)
    if AS_STATED in alike and 1.0 / _MOST_GROWTH < growth < _MOST_GROWTH:
        return ImageVerdict("", alike)
    fitter = scene.fitter(stated.um_per_px * growth)
    fits = {each: fitter.fit(pose(each, growth)) for each in alike}
    # Where along a straight channel, a picture that shows the walls need not tell.
    shown = {each: fit for each, fit in fits.items() if fit.found >= _LEAST_FOUND and fit.std[2] < _LEAST_SURE_DEG}
    if not shown:
        return ImageVerdict("", ())
    best = max(shown.values(), key=lambda fit: fit.found)
    if scene.fitter(stated.um_per_px).fit(stated).found > best.found - _LESS_FOUND:
        return ImageVerdict("", ())
    ratio = best.calibration.um_per_px / stated.um_per_px if best.std[3] < _LEAST_SURE_SCALE else 1.0
    return ImageVerdict(_contradiction(tuple(shown), ratio, stated), tuple(shown))


def _contradiction(shown: tuple[Orientation, ...], ratio: float, stated: Calibration) -> str:
    """The line on a picture that shows a chip in other orientations or at another scale, with the settings of each."""
    found, sets = [], [""]
    if AS_STATED not in shown:
        found.append(" or ".join(each.name for each in shown))
        sets = [camera_settings(each.seen_by(stated)) for each in shown]
    if not 1.0 / _MOST_GROWTH < ratio < _MOST_GROWTH:
        um_per_px = ratio * stated.um_per_px
        found.append(f"at {um_per_px:.4g} um per pixel instead of {stated.um_per_px:.4g}")
        sets = [", ".join(filter(None, (each, f"camera.um_per_px = {um_per_px:.4g}"))) for each in sets]
    return f"the image shows the chip {', '.join(found)}: set {', or '.join(sets)}" if found else ""
