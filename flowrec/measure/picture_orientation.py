"""Orientation (of eight) and scale in which a picture shows its chip, compared with those of a registration.

The directions of the walls (wall_search.py) are compared with the picture in all eight at once, which takes some
hundredths of a second. Only another orientation than the stated one is then fitted (wall_fit.py), and it contradicts
only where that fit finds the walls and the fit of the stated one does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.measure.picture_registration import LEAST_CONTRAST, LEAST_FOUND, LEAST_PX, fitter_of
from flowrec.measure.wall_fit import WallFit, WallMap
from flowrec.measure.wall_search import WallSearch
from flowrec.physics import AS_STATED, ORIENTATIONS, Calibration, Chip, Orientation, camera_settings

# Agreement of directions is 1 to 1.8 in sharp pictures, 0.8 with noise of the size of the walls' contrast; 0.6 at most
# for a wrong orientation of the chips of the benchmarks, 0.1 as a rule.
_SHOWN = 0.4  # agreement from which a picture shows walls
_EQUAL = 0.85  # part of the best agreement from which an orientation is as good
_LESS_FOUND = 0.1  # part of the walls that the stated orientation finds less than one that contradicts it
_LEAST_SURE_DEG, _LEAST_SURE_SCALE = 2.0, 0.05  # standard errors of a fit above which it tells no angle or scale
_MOST_SCALE = 1.2  # factor by which the scale may be off, to either side
# Scales that are tried, relative to the stated one: a step moves the image's border by 4 of 480 px.
_GROWTHS = tuple(np.geomspace(0.5, 2.0, 91).tolist())


@dataclass(frozen=True, slots=True)
class ImageVerdict:
    """Result of the comparison of the axes with a picture.

    Attributes
    ----------
    contradiction : one line with the settings to paste; '' if there is none.
    alike : the orientations in the image that it shows equally well; () if it does not show enough of the walls.
    """

    contradiction: str
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


def orientation_by_image(picture: NDArray[np.uint8 | np.uint16], chip: Chip, stated: Calibration) -> ImageVerdict:
    """The verdict of a picture (h, w) on the stated registration."""
    grey = np.asarray(picture, np.float32)
    if min(grey.shape) < LEAST_PX or float(np.ptp(grey)) < LEAST_CONTRAST:
        return ImageVerdict("", ())
    middle_px = (np.array(grey.shape[::-1]) - 1) / 2
    walls = WallMap(chip.mask, chip.um_per_px)
    search = WallSearch(grey, chip.mask, chip.um_per_px, walls.clearance_um)

    def score(
        orientations: tuple[Orientation, ...], growths: Sequence[float]
    ) -> dict[tuple[Orientation, float], float]:
        return {
            (each, growth): search.agreement(each.about(stated, middle_px, growth))
            for each in orientations
            for growth in growths
        }

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
    if AS_STATED in alike and 1.0 / _MOST_SCALE < growth < _MOST_SCALE:
        return ImageVerdict("", alike)
    fitter = fitter_of(grey, chip, stated.um_per_px * growth, walls)
    fits = {each: fitter.fit(each.about(stated, middle_px, growth)) for each in alike}
    shown = {each: fit for each, fit in fits.items() if _is_shown(fit)}
    if not shown:
        return ImageVerdict("", ())
    as_stated = fitter_of(grey, chip, stated.um_per_px, walls).fit(stated)
    if as_stated.found > max(fit.found for fit in shown.values()) - _LESS_FOUND:
        return ImageVerdict("", ())
    best = max(shown.values(), key=lambda fit: fit.found)
    ratio = best.calibration.um_per_px / stated.um_per_px if best.std[3] < _LEAST_SURE_SCALE else 1.0
    return ImageVerdict(_contradiction(tuple(shown), ratio, stated), tuple(shown))


def _is_shown(fit: WallFit) -> bool:
    """True if a picture shows the walls in a pose. Where along a straight channel, it need not tell."""
    return fit.found >= LEAST_FOUND and bool(fit.std[2] < _LEAST_SURE_DEG)


def _contradiction(shown: tuple[Orientation, ...], ratio: float, stated: Calibration) -> str:
    """The line on a picture that shows a chip in other orientations or at another scale, with the settings of each."""
    found, sets = [], [""]
    if AS_STATED not in shown:
        found.append(" or ".join(each.name for each in shown))
        sets = [camera_settings(each.seen_by(stated)) for each in shown]
    if not 1.0 / _MOST_SCALE < ratio < _MOST_SCALE:
        um_per_px = ratio * stated.um_per_px
        found.append(f"at {um_per_px:.4g} um per pixel instead of {stated.um_per_px:.4g}")
        sets = [", ".join(filter(None, (each, f"camera.um_per_px = {um_per_px:.4g}"))) for each in sets]
    return f"the image shows the chip {', '.join(found)}: set {', or '.join(sets)}" if found else ""
