"""Similarity, with or without mirror, between camera pixels and points on the chip.

A turned camera, exchanged cables or a reversed coil change the axes of a run by one of the eight orientations of a
square: turned by quarters, and each of these mirrored. An orientation is the (2, 2) matrix R(turned)
diag(1, -1 if mirrored) with x right and y down, as `Calibration.axes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import Floats

# Cosine and sine by angle in degrees.
_EXACT = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}


def on_chip(registration: Floats | None, measured_um: ArrayLike) -> Floats:
    """Positions on the chip of measured ones (..., 2) in um, by the registration of a FlowField; None: as measured."""
    measured = np.asarray(measured_um, np.float64)
    if registration is None:
        return measured
    # Not a matrix product, whose last bits depend on the machine.
    x, y = measured[..., 0], measured[..., 1]
    (xx, xy, x0), (yx, yy, y0) = registration
    return np.stack((xx * x + xy * y + x0, yx * x + yy * y + y0), -1)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Camera pixel p = (column, row), counted at pixel centres, lies at origin + um_per_px * A^T p in the chip frame.

    A (2, 2) turns directions on the chip into directions in the image: a rotation by the angle from right to down
    (clockwise as seen), after the chip's y axis is reversed if the image shows a mirror image.

    Attributes
    ----------
    um_per_px : size of a camera pixel on the chip.
    origin_um : chip point at the centre of the image's first pixel.
    angle_deg : direction of the chip's x axis in the image: 0 right, 90 down.
    mirror : the image shows the chip as in a mirror.
    """

    um_per_px: float
    origin_um: tuple[float, float] = (0.0, 0.0)
    angle_deg: float = 0.0
    mirror: bool = False

    @classmethod
    def centre_on(
        cls,
        um_per_px: float,
        centre_um: ArrayLike,
        size_px: tuple[int, int],
        angle_deg: float = 0.0,
        mirror: bool = False,
    ) -> Calibration:
        """The calibration with a given chip point (2,) at the centre of an image of `size_px` (width, height)."""
        (x, y), (width, height) = np.asarray(centre_um, np.float64).tolist(), size_px
        (a, b), (c, d) = _axes(angle_deg, mirror)
        right, down = um_per_px * (width - 1) / 2, um_per_px * (height - 1) / 2
        return cls(um_per_px, (x - (a * right + c * down), y - (b * right + d * down)), angle_deg, mirror)

    @property
    def axes(self) -> Floats:
        """A (2, 2): its columns are the directions of the chip's axes in the image."""
        return np.array(_axes(self.angle_deg, self.mirror), np.float64)

    @property
    def matrix(self) -> Floats:
        """(2, 3): chip coordinates in um of (column, row, 1)."""
        return np.column_stack((self.um_per_px * self.axes.T, self.origin_um))

    def for_shift(self, shift_px: tuple[float, float]) -> Calibration:
        """The transform for an image that lies `shift_px` (columns, rows) farther than this one is for."""
        x_um, y_um = self.to_um((-shift_px[0], -shift_px[1])).tolist()
        return replace(self, origin_um=(x_um, y_um))

    def to_um(self, points_px: ArrayLike) -> Floats:
        """Camera pixels (..., 2) as (column, row) to chip coordinates (..., 2) in um."""
        turned = self._rotate(np.asarray(points_px, np.float64), back=True)
        return turned * self.um_per_px + np.asarray(self.origin_um, np.float64)

    def to_px(self, points_um: ArrayLike) -> Floats:
        """Chip coordinates (..., 2) in um to camera pixels (..., 2) as (column, row)."""
        return self.vectors_to_px(np.asarray(points_um, np.float64) - np.asarray(self.origin_um, np.float64))

    def vectors_to_px(self, vectors_um: ArrayLike) -> Floats:
        """Differences (..., 2) of chip points in um to differences of camera pixels (..., 2)."""
        return self._rotate(np.asarray(vectors_um, np.float64), back=False) / self.um_per_px

    def _rotate(self, vectors: Floats, *, back: bool) -> Floats:
        """Directions (..., 2) on the chip to those in the image, or back."""
        if self.angle_deg == 0.0 and not self.mirror:
            return vectors
        # Not a matrix product, whose last bits depend on the machine.
        (a, b), (c, d) = _axes(self.angle_deg, self.mirror)
        if back:
            b, c = c, b
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack((a * x + b * y, c * x + d * y), -1)


def _axes(angle_deg: float, mirror: bool) -> tuple[tuple[float, float], tuple[float, float]]:
    """The rows of A; exact at multiples of a right angle."""
    angle = math.radians(angle_deg)
    cos, sin = _EXACT.get(angle_deg % 360.0, (math.cos(angle), math.sin(angle)))
    return ((cos, sin), (sin, -cos)) if mirror else ((cos, -sin), (sin, cos))


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
    """One of ORIENTATIONS."""

    turned_deg: int  # 0, 90, 180 or 270, from right to down (clockwise as seen)
    mirrored: bool  # y is reversed before the turn

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
