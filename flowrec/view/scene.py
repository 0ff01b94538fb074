"""The part of a picture that is constant during a session, and its place in the picture.

All pictures share one plane: the camera's pixels as Rerun draws them. Rerun counts from the corner of the first pixel,
flowrec from its centre; the half pixel between the two is added here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import Matrix, Shift, shift_px
from flowrec.physics import Calibration, Chip, Robot, on_chip

_HALF_PX = 0.5
_MARGIN = 0.03  # around the channels, of their longer side


@dataclass(frozen=True, slots=True)
class Placement:
    """Position of an image in the picture plane: offset + scale * axes (column, row), from pixel corners."""

    scale: float
    offset: tuple[float, float]
    axes: NDArray[np.float64]  # (2, 2): its columns are the directions of the image's rows and columns


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Constant content of views. The properties are listed with the recording, the key identifies the session."""

    chip: Chip
    calibration: Calibration
    robot: Robot
    title: str
    properties: dict[str, str] = field(default_factory=dict)
    image_px: tuple[int, int] | None = None  # width and height of the camera's image; None: as the chip
    windows: bool = False  # whether most images are black except for a region around the robot
    key: str = ""
    camera_shape: tuple[int, int] | None = None  # (height, width) in px of the images that were tracked
    doubts: str = ""  # why the result is doubtful, as the session states it

    def to_plane(self, points_um: ArrayLike) -> NDArray[np.float64]:
        """Chip coordinates (..., 2) in um to the picture plane (..., 2)."""
        return self.calibration.to_px(points_um) + _HALF_PX

    def image_to_plane(self, registration: Matrix | None, shift: Shift | None = None) -> NDArray[np.float64]:
        """(2, 3): where a point (x, y, 1) of the camera's image lies in the picture plane.

        `registration` (2, 3) is that of a FlowField: of a measured place in um to the chip. None: as stated. `shift` is
        that of the image; without it, the point is one as measured, from which the shift has been taken.
        """
        off_px = shift_px(shift)
        if registration is None and not any(off_px):
            return np.eye(2, 3)
        corners = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
        measured_um = self.calibration.for_shift(off_px).to_um(corners - _HALF_PX)
        moved = self.to_plane(on_chip(registration, measured_um))
        return np.column_stack((moved[1] - moved[0], moved[2] - moved[0], moved[0]))

    def directions(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vectors (..., 2) along the chip's axes as vectors of the same length in the picture plane."""
        return vectors @ self.calibration.axes.T

    def length_px(self, length_um: float) -> float:
        """A length in um in the picture plane."""
        return length_um / self.calibration.um_per_px

    def mask_placement(self) -> Placement:
        """Position of an image on the pixels of the chip's mask."""
        scale = self.length_px(self.chip.um_per_px)
        axes = self.calibration.axes
        first = self.to_plane((0.0, 0.0)) - _HALF_PX * scale * axes.sum(axis=1)  # the corner of the first pixel
        return Placement(scale, (float(first[0]), float(first[1])), axes)

    def preview_placement(self, step: int) -> Placement:
        """Position of a camera image of which only each `step`-th row and column is shown."""
        return Placement(float(step), (_HALF_PX * (1 - step), _HALF_PX * (1 - step)), np.eye(2))

    def chip_bounds(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom of the upright box around the chip's mask in the picture plane."""
        h, w = self.chip.mask.shape
        corners = (np.array([(0, 0), (w, 0), (0, h), (w, h)]) - _HALF_PX) * self.chip.um_per_px
        (left, top), (right, bottom) = (edge(self.to_plane(corners), axis=0).tolist() for edge in (np.min, np.max))
        return left, top, right, bottom

    def fluid_bounds(self) -> tuple[float, float, float, float]:
        """Bounds of the channels of the chip, inside the box of the mask."""
        rows, columns = (np.flatnonzero(self.chip.mask.any(axis=axis)) for axis in (1, 0))
        if not rows.size:
            return self.chip_bounds()
        (top, bottom), (left, right) = ((line[0] - _HALF_PX, line[-1] + _HALF_PX) for line in (rows, columns))
        corners = np.array([(left, top), (right, top), (left, bottom), (right, bottom)]) * self.chip.um_per_px
        (x0, y0), (x1, y1) = (edge(self.to_plane(corners), axis=0).tolist() for edge in (np.min, np.max))
        return x0, y0, x1, y1

    def shown_bounds(self) -> tuple[float, float, float, float]:
        """The channels with a margin: what a view of the chip or of the camera shows."""
        left, top, right, bottom = self.fluid_bounds()
        margin = _MARGIN * max(right - left, bottom - top)
        return left - margin, top - margin, right + margin, bottom + margin

    def image_bounds(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom of the camera's image in the picture plane."""
        if self.image_px is None:
            return self.chip_bounds()
        width, height = self.image_px
        return 0.0, 0.0, float(width), float(height)
