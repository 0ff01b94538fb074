"""The eight orientations of a square: turned by quarters, and each of these mirrored.

A turned camera, exchanged cables or a reversed coil change the axes of a run by one of them. An orientation is the
(2, 2) matrix R(turned) diag(1, -1 if mirrored) with x right and y down, as `Calibration.axes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import Floats
from flowrec.physics.chip.registration import Calibration

_NAMES = {
    (0, False): "as stated",
    (90, False): "turned by 90 degrees to the right",
    (180, False): "turned by 180 degrees",
    (270, False): "turned by 90 degrees to the left",
    (0, True): "mirrored top to bottom",
    (90, True): "with its axes x and y exchanged",
    (180, True): "mirrored left to right",
    (270, True): "with its axes x and y exchanged and both reversed",
}


@dataclass(frozen=True, slots=True)
class Orientation:
    """One of ORIENTATIONS.

    Attributes
    ----------
    turned_deg : 0, 90, 180 or 270, from right to down (clockwise as seen).
    mirrored : y is reversed before the turn.
    """

    turned_deg: int
    mirrored: bool

    @property
    def name(self) -> str:
        """In words, after "the image shows the chip" or "the robot moves"."""
        return _NAMES[self.turned_deg, self.mirrored]

    @property
    def matrix(self) -> Floats:
        """(2, 2) of directions."""
        return Calibration(1.0, angle_deg=float(self.turned_deg), mirror=self.mirrored).axes

    def seen_by(self, stated: Calibration) -> Calibration:
        """The calibration of an image that shows the chip in this orientation relative to a stated one.

        The image is turned about its first pixel; see `about`.
        """
        angle_deg = self.turned_deg + (-stated.angle_deg if self.mirrored else stated.angle_deg)
        return replace(stated, angle_deg=_wrap_deg(angle_deg), mirror=stated.mirror != self.mirrored)

    def about(self, stated: Calibration, middle_px: ArrayLike, growth: float = 1.0) -> Calibration:
        """Turn a calibration about a pixel (2,), which keeps its chip point; pixels become `growth` times as large."""
        middle = np.asarray(middle_px, np.float64)
        turned = replace(self.seen_by(stated), um_per_px=stated.um_per_px * growth, origin_um=(0.0, 0.0))
        x, y = (stated.to_um(middle) - turned.to_um(middle)).tolist()
        return replace(turned, origin_um=(x, y))

    def in_image(self, stated: Calibration) -> Orientation:
        """The orientation in the image of one on the chip, with the axes A of a calibration: nearest to A D A^T."""
        axes = stated.axes
        return nearest(axes @ self.matrix @ axes.T)


AS_STATED = Orientation(0, mirrored=False)
ORIENTATIONS = tuple(Orientation(turned, mirrored) for mirrored in (False, True) for turned in (0, 90, 180, 270))


def likeness(matrix: ArrayLike) -> Floats:
    """(8,) how much of each of ORIENTATIONS is in a matrix (2, 2): tr(D^T M) / 2, for D itself 1."""
    m = np.asarray(matrix, np.float64)
    return np.array([0.5 * float((each.matrix * m).sum()) for each in ORIENTATIONS])


def nearest(matrix: ArrayLike) -> Orientation:
    """The orientation that a matrix (2, 2) is most like."""
    return ORIENTATIONS[int(likeness(matrix).argmax())]


def camera_settings(seen: Calibration) -> str:
    """The settings of section [camera] that state an orientation, to paste into a configuration."""
    return f"camera.mirror = {str(seen.mirror).lower()}, camera.angle_deg = {_wrap_deg(seen.angle_deg):g}"


def _wrap_deg(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0 if angle_deg % 360.0 != 180.0 else 180.0
