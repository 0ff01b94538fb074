"""State that viewers need to draw a session: coordinate frames, cameras, and the map, route and goal of the moment.

Frames, in mm: `chip` has its origin at the centre of the mask's pixel (0, 0), x right, y down, z away from who looks at
the mask; all that is drawn lies in its plane z = 0. `camera` and `map` are pinhole cameras (x right, y down, z ahead)
that look straight at that plane and show on it the camera's image and the pixels of the mask; what lies in one plane
has no perspective, so the height is of no importance. The camera of a mirrored image looks from the other side. The
root of the tree is `tf#/`, which Rerun gives to all that has no frame; its z points to who looks at the mask. Rerun's
own 3-D view looks down on what is some units wide: a chip in mm; of one in m it shows nothing.

Pixels are counted from the corner of the first one, as foxglove's schemas and both viewers count them; flowrec counts
from its centre. https://docs.foxglove.dev/docs/sdk/schemas/camera-calibration
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from foxglove import messages as fg

from flowrec.core import (
    HALF_PX,
    MM_PER_UM,
    Floats,
    Floats32,
    FlowField,
    FlowrecError,
    Matrix,
    Message,
    Mission,
    Route,
    Shift,
    shift_px,
)
from flowrec.physics import Calibration, on_chip
from flowrec.store.codec import timestamp
from flowrec.store.frame_encodings import CAMERA_FRAME
from flowrec.store.schema import foxglove_schema
from flowrec.store.session_metadata import SessionHeader

ROOT, CHIP, MAP = "tf#/", "chip", "map"
LENGTHS, UNIT = "lengths", "mm"  # key and value in the metadata of viewer topics; absent in older files: m
HEIGHT = {"mm": 3.0, "m": 0.2}  # of the cameras over the chip; Rerun clips what is nearer than 0.1
_RADIUS_UM = 60.0  # of a robot whose size is not known
_Number = TypeVar("_Number", float, Floats)
STILL, _OVER = fg.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0), fg.Quaternion(x=1.0, y=0.0, z=0.0, w=0.0)


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels on the chip: pixel (column, row) has its centre at `matrix` (2, 3) (column, row, 1) in um.

    The left two columns of the matrix are a similarity, with or without mirror.
    """

    frame: str
    width_px: int
    height_px: int
    matrix: Matrix

    @functools.cached_property
    def um_per_px(self) -> float:
        """Size of a pixel on the chip."""
        return math.sqrt(abs(self._determinant))

    @property
    def _determinant(self) -> float:
        (a, b, _), (c, d, _) = self.matrix.tolist()
        return float(a * d - b * c)

    @functools.cached_property
    def _inverse(self) -> list[list[float]]:
        """(2, 3): pixel, from the corner of the first, of chip coordinates (x, y, 1) in um."""
        back = np.linalg.inv(self.matrix[:, :2])
        return np.column_stack((back, HALF_PX - back @ self.matrix[:, 2])).tolist()

    def to_px(self, points_um: Floats) -> Floats:
        """Chip points (n, 2) in um as pixels (n, 2), counted from the corner of the first."""
        x, y = self.pixel(points_um[..., 0], points_um[..., 1])
        return np.stack((x, y), -1)

    def pixel(self, x_um: _Number, y_um: _Number) -> tuple[_Number, _Number]:
        """Pixel of one point, or of arrays of coordinates."""
        (xx, xy, x0), (yx, yy, y0) = self._inverse
        return xx * x_um + xy * y_um + x0, yx * x_um + yy * y_um + y0

    def calibration(self) -> fg.CameraCalibration:
        """The pinhole camera: focal length by its height, principal point in the middle of the image."""
        f, cx, cy = HEIGHT[UNIT] / (self.um_per_px * MM_PER_UM), 0.5 * self.width_px, 0.5 * self.height_px
        return fg.CameraCalibration(
            frame_id=self.frame,
            width=self.width_px,
            height=self.height_px,
            K=[f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0],
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P=[f, 0.0, cx, 0.0, 0.0, f, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        )

    def transform(self) -> fg.FrameTransform:
        """Pose of the pinhole camera: over the middle of the image, or behind it if that is mirrored."""
        middle = np.array([0.5 * self.width_px - HALF_PX, 0.5 * self.height_px - HALF_PX, 1.0])
        x, y = (MM_PER_UM * (self.matrix @ middle)).tolist()
        angle_rad = math.atan2(self.matrix[1, 0], self.matrix[0, 0])  # of the rows of pixels, from x to y
        sin, cos = math.sin(0.5 * angle_rad), math.cos(0.5 * angle_rad)
        # A turn about z; of a picture that shows the chip as in a mirror half a turn about x before it.
        turn, height = {"x": 0.0, "y": 0.0, "z": sin, "w": cos}, -HEIGHT[UNIT]
        if self._determinant < 0.0:
            turn, height = {"x": cos, "y": sin, "z": 0.0, "w": 0.0}, HEIGHT[UNIT]
        return fg.FrameTransform(
            parent_frame_id=CHIP,
            child_frame_id=self.frame,
            translation=fg.Vector3(x=x, y=y, z=height),
            rotation=fg.Quaternion(**turn),
        )


@dataclass(frozen=True, slots=True)
class ChipCamera:
    """The camera as the settings state it, its image's (width, height), and the radius of the robot in it."""

    calibration: Calibration
    size_px: tuple[int, int]
    robot_um: float

    @classmethod
    def of(cls, header: SessionHeader) -> ChipCamera | None:
        """The camera of a session; None where its settings or its chip can not be read, as in a damaged file."""
        # Loaded late: listing sessions needs no settings.
        from flowrec.stages import calibration_of

        try:
            config = header.config()
            calibration = calibration_of(config, header.chip())
        except FlowrecError:
            return None
        return cls(calibration, config.camera.size_px, config.robot.radius_um)

    def picture(self, registration: Matrix | None, shift: Shift | None = None) -> Picture:
        """The camera's image on the chip, by the registration that a refinement found and the shift of the image."""
        if registration is not None and not _is_similarity(registration):
            registration = None
        calibration = self.calibration.for_shift(shift_px(shift))
        corners = on_chip(registration, calibration.to_um([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]))
        matrix = np.column_stack((corners[1] - corners[0], corners[2] - corners[0], corners[0]))
        return Picture(CAMERA_FRAME, *self.size_px, matrix)


def _is_similarity(registration: Matrix) -> bool:
    """True if a registration (2, 3) turns, shifts and scales only; one of a damaged file may do anything."""
    if registration.shape != (2, 3) or not np.isfinite(registration).all():
        return False
    (a, b, _), (c, d, _) = registration.tolist()
    return bool(a * d - b * c > 0.0 and math.isclose(a, d, abs_tol=1e-6) and math.isclose(b, -c, abs_tol=1e-6))


class ViewerScene:
    """Camera, flow and route as far as they are known.

    Attributes
    ----------
    camera : of the session; None if its settings are not known.
    start_unix_ns : Unix time of stamp 0.
    top_um_s : speed at the bright end of the colour scale; None before the first flow field.
    refined : the refined flow; None before there is one.
    field : the best flow known: refined where there is one, else assumed.
    route, goal_um : the latest; None without one.
    picture, map : the camera's image and the pixels of the flow on the chip; None where they are not known.
    """

    def __init__(self, camera: ChipCamera | None = None, start_unix_ns: int = 0) -> None:
        self.camera = camera
        self.start_unix_ns = start_unix_ns
        self.top_um_s: float | None = None
        self.refined: FlowField | None = None
        self.field: FlowField | None = None
        self.route: Route | None = None
        self.goal_um: Floats | None = None
        self.picture = camera.picture(None) if camera is not None else None
        self.map: Picture | None = None
        self._shift: Shift | None = None

    @property
    def robot_um(self) -> float:
        """Radius of the robot."""
        return self.camera.robot_um if self.camera is not None else _RADIUS_UM

    @property
    def map_error_share(self) -> float:
        """The error that the map states of itself; NaN where it states none."""
        share = self.field.error_share if self.field is not None else None
        return math.nan if share is None else share

    def place_um(self, measured_um: Floats) -> tuple[float, float]:
        """Place on the chip of one measured place (2,), quicker than `on_chip` of flowrec.physics."""
        x, y = measured_um.tolist()
        if self.refined is None or self.refined.registration is None:
            return x, y
        (xx, xy, x0), (yx, yy, y0) = self.refined.registration.tolist()
        return xx * x + xy * y + x0, yx * x + yy * y + y0

    def update(self, messages: Mapping[str, Message]) -> None:
        """Take over the new messages of one tick, by field of Tick."""
        for name in ("assumed", "refined"):
            field = messages.get(name)
            if isinstance(field, FlowField) and drawable(field):
                if self.top_um_s is None:
                    self.top_um_s = float(speed_um_s(field).max()) or 1.0
                if name == "refined":
                    self.refined = field
                if name == "refined" or self.refined is None:
                    self.field = field
                self.map = _map(field) or self.map
        shift, route, mission = (messages.get(name) for name in ("shift", "route", "mission"))
        if isinstance(shift, Shift):
            self._shift = shift
        refined = self.refined
        moved = isinstance(shift, Shift) or (refined is not None and refined is messages.get("refined"))
        if moved and self.camera is not None:
            self.picture = self.camera.picture(None if refined is None else refined.registration, self._shift)
        if isinstance(route, Route) and route.waypoints_um.shape[1:] == (2,):
            self.route = route
        if isinstance(mission, Mission):
            self.goal_um = mission.goal_um if np.isfinite(mission.goal_um).all() else None

    def transforms(self) -> list[fg.FrameTransform]:
        """The tree of the frames that are known."""
        chip = fg.FrameTransform(parent_frame_id=ROOT, child_frame_id=CHIP, translation=fg.Vector3(), rotation=_OVER)
        return [chip, *(picture.transform() for picture in (self.picture, self.map) if picture is not None)]

    def stamp(self, stamp_ns: int) -> bytes:
        """The field `timestamp`, which has the number 1 in nearly all schemas."""
        return _stamp(stamp_ns + self.start_unix_ns)


@functools.lru_cache(maxsize=4)  # several views are of the same moment
def _stamp(unix_ns: int) -> bytes:
    # Not by foxglove's class, which refuses times out of range.
    return foxglove_schema("PoseInFrame").wire(timestamp=timestamp(unix_ns)).SerializeToString()


def _map(field: FlowField) -> Picture | None:
    size_um = field.um_per_px
    if not (math.isfinite(size_um) and size_um > 0.0):
        return None
    height, width = field.velocity_um_s.shape[:2]
    return Picture(MAP, width, height, np.array([[size_um, 0.0, 0.0], [0.0, size_um, 0.0]]))


def drawable(field: FlowField) -> bool:
    """True if a field has velocities on pixels."""
    return field.velocity_um_s.shape[2:] == (2,) and field.velocity_um_s.size > 0


def speed_um_s(field: FlowField) -> Floats32:
    """(h, w) speed; 0 where it is not finite."""
    with np.errstate(over="ignore"):
        speed: Floats32 = np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1])
    np.nan_to_num(speed, copy=False, posinf=0.0)
    return speed
