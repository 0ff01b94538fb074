"""The part of a picture that is constant during a session, and its place in the picture.

All pictures share one plane: the camera's pixels as Rerun draws them. Rerun counts from the corner of the first pixel,
flowrec from its centre; the half pixel between the two is added here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import HALF_PX, Floats, Matrix, Mission, Route, Tick, Tracers, shift_px
from flowrec.physics import Calibration, Chip, Robot, on_chip

Box = tuple[float, float, float, float]  # left, top, right, bottom
_MARGIN = 0.03  # around the channels, of their longer side
_TRACER_S = 0.3  # way of a tracer that its arrow shows
_LEAST_AGE = 3  # images that show a tracer before it is drawn
_MOVES = 3.0  # standard deviations of its speed: slower ones stick, or are texture of a wall


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

    def to_plane(self, points_um: ArrayLike) -> Floats:
        """Chip coordinates (..., 2) in um to the picture plane (..., 2)."""
        return self.calibration.to_px(points_um) + HALF_PX

    def image_to_plane(self, tick: Tick) -> Floats:
        """(2, 3): where a point (x, y, 1) of the camera's image of a tick lies in the picture plane.

        That is as stated, until a refinement has found another registration, or the image is shifted.
        """
        off_px = shift_px(tick.shift)
        if _registration(tick) is None and not any(off_px):
            return np.eye(2, 3)
        corners = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
        measured_um = self.calibration.for_shift(off_px).to_um(corners - HALF_PX)
        moved = self.to_plane(place_on_chip(tick, measured_um))
        return np.column_stack((moved[1] - moved[0], moved[2] - moved[0], moved[0]))

    def plane_to_image(self, tick: Tick) -> Floats:
        """(2, 3): the inverse of `image_to_plane`."""
        return np.asarray(cv2.invertAffineTransform(self.image_to_plane(tick)), np.float64)

    def from_plane(self, places: Floats) -> Floats:
        """The picture plane (..., 2) to chip coordinates (..., 2) in um."""
        return self.calibration.to_um(places - HALF_PX)

    def directions(self, vectors: Floats) -> Floats:
        """Vectors (..., 2) along the chip's axes as vectors of the same length in the picture plane."""
        return vectors @ self.calibration.axes.T

    def length_px(self, length_um: float) -> float:
        """A length in um in the picture plane."""
        return length_um / self.calibration.um_per_px

    def mask_to_plane(self) -> Matrix:
        """(2, 3): where a point (x, y, 1) of an image on the pixels of the chip's mask lies; from pixel corners."""
        scale, axes = self.length_px(self.chip.um_per_px), self.calibration.axes
        return np.column_stack((scale * axes, self.to_plane((0.0, 0.0)) - HALF_PX * scale * axes.sum(axis=1)))

    def preview_to_plane(self, step: int) -> Matrix:
        """(2, 3): the same for a camera image of which only each `step`-th row and column is shown."""
        return np.column_stack((step * np.eye(2), np.full(2, HALF_PX * (1 - step))))

    def outlines(self) -> list[Floats]:
        """The walls in the picture plane: closed lines (n, 2) along the border of the mask."""
        contours, _ = cv2.findContours(self.chip.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        return [self.to_plane(np.concatenate([c, c[:1]])[:, 0] * self.chip.um_per_px) for c in contours]

    def chip_bounds(self) -> Box:
        """Left, top, right, bottom of the upright box around the chip's mask in the picture plane."""
        height, width = self.chip.mask.shape
        return self._box((0, width), (0, height))

    def fluid_bounds(self) -> Box:
        """Bounds of the channels of the chip, inside the box of the mask."""
        columns, rows = (np.flatnonzero(self.chip.mask.any(axis=axis)) for axis in (0, 1))
        return self._box(columns[[0, -1]] + (0, 1), rows[[0, -1]] + (0, 1)) if rows.size else self.chip_bounds()

    def _box(self, columns: ArrayLike, rows: ArrayLike) -> Box:
        """The upright box around the pixels of the mask from a column to another, and from a row to another."""
        corners = (np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2) - HALF_PX) * self.chip.um_per_px
        places = self.to_plane(corners)
        (left, top), (right, bottom) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        return left, top, right, bottom

    def shown_bounds(self) -> Box:
        """The channels with a margin: what a view of the chip or of the camera shows."""
        left, top, right, bottom = self.fluid_bounds()
        margin = _MARGIN * max(right - left, bottom - top)
        return left - margin, top - margin, right + margin, bottom + margin

    def image_bounds(self) -> Box:
        """Left, top, right, bottom of the camera's image in the picture plane."""
        if self.image_px is None:
            return self.chip_bounds()
        width, height = self.image_px
        return 0.0, 0.0, float(width), float(height)


def place_on_chip(tick: Tick, measured_um: Floats) -> Floats:
    """Places on the chip of measured points (..., 2), in um, by the registration that a refinement found."""
    return on_chip(_registration(tick), measured_um)


def _registration(tick: Tick) -> Matrix | None:
    return None if tick.refined is None else tick.refined.registration


def goal_of(mission: Mission | None) -> Floats | None:
    """Goal (2,) of a mission on the chip, in um; None: none was set."""
    return mission.goal_um if mission is not None and np.isfinite(mission.goal_um).all() else None


def way_of(route: Route | None) -> Floats:
    """Points (n, 2) of a route on the chip, in um; none of one that leads nowhere."""
    if route is None or not route.reachable or len(route.waypoints_um) < 2:
        return np.empty((0, 2))
    return route.waypoints_um


def tracer_ways_um(tracers: Tracers) -> tuple[Floats, Floats]:
    """Places (n, 2) of the tracers that move, and where they will be soon."""
    moves = np.hypot(*tracers.velocity_um_s.T) > _MOVES * tracers.velocity_std_um_s
    drawn = (tracers.age_frames >= _LEAST_AGE) & moves
    begins_um = tracers.position_um[drawn]
    return begins_um, begins_um + _TRACER_S * tracers.velocity_um_s[drawn]
