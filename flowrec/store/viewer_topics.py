"""Derived views for other viewers: what Rerun and Foxglove show of a bare session file. The reader ignores them.

Positions are in um, one unit of the 3D view = 1 um, in the chip's frame (origin at pixel (0, 0), x right, y down),
so that pose, path and grid lie over each other; the frame_id is empty because a named one needs a transform tree.
Both flow previews use one colour scale, viridis from 0 to the highest speed of the first field; solid is black.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.declarations import Message, Vector
from flowrec.messages import Estimate, FlowField, Route, Track
from flowrec.store.form import Payload
from flowrec.store.schema import foxglove_schema
from flowrec.store.standard import timestamp
from flowrec.store.wire import head_of
from flowrec.units import NS_PER_S

_UINT8, _FLOAT32 = 1, 7  # foxglove.PackedElementField.NumericType
# A ring about the robot: a single point of Rerun's default size drowns in the path.
_MARK_POINTS, _MARK_UM = 24, 60.0
_MARK_RGBA = (255, 64, 32, 255)
# Field 3 of both, a Pose: its field 1 is a Vector3 with x and y, its field 2 a Quaternion with w alone.
_POSE = struct.Struct("<BBBBBdBdBBBd")
_POSE_HEAD, _POSE_TAIL = (0x1A, 31, 0x0A, 18), (0x12, 9, 0x21, 1.0)
_ROBOT_EVERY_NS = NS_PER_S // 125  # more often nobody can see it move
_COLOURS = ("red", "green", "blue", "alpha")


@dataclass(frozen=True, slots=True)
class Mirror:
    """One derived topic."""

    path: str
    schema: str
    source: str


ROBOT_POSE = Mirror("/view/robot_pose", "PoseInFrame", "estimate, else track")
# The same once more, for Rerun draws a point and does not draw a pose.
ROBOT_POINT = Mirror("/view/robot_point", "PointCloud", "estimate, else track")
PATH = Mirror("/view/path", "PosesInFrame", "route")
PATH_POINTS = Mirror("/view/path_points", "PointCloud", "route")
FLOW_ASSUMED = Mirror("/view/flow_assumed", "CompressedImage", "assumed")
FLOW_REFINED = Mirror("/view/flow_refined", "CompressedImage", "refined")
FLOW_REFINED_GRID = Mirror("/view/flow_refined_grid", "Grid", "refined")

MIRRORS = (ROBOT_POSE, ROBOT_POINT, PATH, PATH_POINTS, FLOW_ASSUMED, FLOW_REFINED, FLOW_REFINED_GRID)


class Mirrors:
    """Makes the derived messages of one session, but for `unwanted` topics; remembers the colour scale.

    To be used by one thread. `start_unix_ns` of the session is added to the timestamps in the messages.
    """

    def __init__(self, unwanted: frozenset[str] = frozenset(), start_unix_ns: int = 0) -> None:
        self._unwanted, self._start_unix_ns = unwanted, start_unix_ns
        self._wanted = {mirror for mirror in MIRRORS if mirror.path not in unwanted}
        self.top_um_s: float | None = None  # speed at the bright end of the scale, set by the first field
        self._robot_ns = -_ROBOT_EVERY_NS

    def twin(self) -> Mirrors:
        """One for another thread that goes on from here, with the scale that is known by now."""
        twin = Mirrors(self._unwanted, self._start_unix_ns)
        twin.top_um_s, twin._robot_ns = self.top_um_s, self._robot_ns
        return twin

    def of(self, news: Mapping[str, Message]) -> Iterator[tuple[Mirror, int, Payload]]:
        """Mirror, stamp in ns and payload of whatever follows from the new messages of one tick, by field of Tick."""
        for mirror, stamp_ns, make in self._due(news):
            if mirror in self._wanted:
                # What can not be drawn is drawn anyhow; to judge numbers is not the business of a view.
                with np.errstate(all="ignore"):
                    view = make()
                yield mirror, stamp_ns, view

    def _due(self, news: Mapping[str, Message]) -> Iterator[tuple[Mirror, int, Callable[[], Payload]]]:
        start = self._start_unix_ns
        robot = news.get("estimate") or news.get("track")
        if isinstance(robot, (Estimate, Track)) and abs(robot.stamp_ns - self._robot_ns) >= _ROBOT_EVERY_NS:
            self._robot_ns = robot.stamp_ns
            yield ROBOT_POSE, robot.stamp_ns, partial(_pose_in_frame, robot, robot.stamp_ns + start)
            yield ROBOT_POINT, robot.stamp_ns, partial(_mark, robot, robot.stamp_ns + start)
        route = news.get("route")
        if isinstance(route, Route) and route.waypoints_um.shape[1:] == (2,):
            yield PATH, route.stamp_ns, partial(_poses_in_frame, route, route.stamp_ns + start)
            yield PATH_POINTS, route.stamp_ns, partial(_point_cloud, route, route.stamp_ns + start)
        for name, mirror in (("assumed", FLOW_ASSUMED), ("refined", FLOW_REFINED)):
            field = news.get(name)
            if isinstance(field, FlowField) and _drawable(field):
                yield mirror, field.stamp_ns, partial(self._preview, field, field.stamp_ns + start)
                if mirror is FLOW_REFINED:
                    yield FLOW_REFINED_GRID, field.stamp_ns, partial(_grid, field, field.stamp_ns + start)

    def _preview(self, field: FlowField, unix_ns: int) -> Payload:
        speed = np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1])
        np.nan_to_num(speed, copy=False, posinf=0.0)
        if self.top_um_s is None:
            self.top_um_s = float(speed.max()) or 1.0
        solid = speed == 0.0
        speed *= 255.0 / self.top_um_s
        grey = np.clip(speed, 0.0, 255.0, out=speed).astype(np.uint8)
        colours = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
        colours[solid] = 0
        png = cv2.imencode(".png", colours)[1]
        return _with_data("CompressedImage", png, timestamp=timestamp(unix_ns), format="png")


def _drawable(field: FlowField) -> bool:
    return field.velocity_um_s.ndim == 3 and field.velocity_um_s.shape[2] == 2 and field.velocity_um_s.size > 0


def _wire(name: str) -> Any:
    return foxglove_schema(name).wire


def _serialized(parsed: Any) -> bytes:
    data: bytes = parsed.SerializeToString()
    return data


def _pose(x_um: float, y_um: float) -> dict[str, dict[str, float]]:
    return {"position": {"x": x_um, "y": y_um, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def _pose_in_frame(robot: Estimate | Track, unix_ns: int) -> Payload:
    return (_timestamp(unix_ns) + _placed(robot.position_um),)


def _mark(robot: Estimate | Track, unix_ns: int) -> Payload:
    return (_timestamp(unix_ns) + _placed(robot.position_um) + _mark_points(),)


@functools.lru_cache(maxsize=4)  # both views of the robot are of the same moment
def _timestamp(unix_ns: int) -> bytes:
    """The field `timestamp`, which has the same number in PoseInFrame and PointCloud."""
    return _serialized(_wire("PoseInFrame")(timestamp=timestamp(unix_ns)))


def _placed(position_um: Vector) -> bytes:
    """The field `pose`, likewise; by hand, for it is made in every tick."""
    return _POSE.pack(*_POSE_HEAD, 9, position_um[0], 17, position_um[1], *_POSE_TAIL)


@functools.cache
def _mark_points() -> bytes:
    """What is the same in every tick: protobuf merges messages that follow each other."""
    colours = [{"name": name, "offset": 12 + place, "type": _UINT8} for place, name in enumerate(_COLOURS)]
    turn = np.arange(_MARK_POINTS) * (2.0 * np.pi / _MARK_POINTS)
    points = np.zeros(1 + _MARK_POINTS, [("at", "<f4", 3), ("colour", "u1", 4)])  # the first one is the robot itself
    points["at"][1:, 0], points["at"][1:, 1] = _MARK_UM * np.cos(turn), _MARK_UM * np.sin(turn)
    points["colour"] = _MARK_RGBA
    fields = _float_fields("x", "y", "z") + colours
    return _serialized(_wire("PointCloud")(point_stride=points.itemsize, fields=fields, data=points.tobytes()))


def _poses_in_frame(route: Route, unix_ns: int) -> Payload:
    poses = [_pose(x, y) for x, y in route.waypoints_um.tolist()]
    return (_serialized(_wire("PosesInFrame")(timestamp=timestamp(unix_ns), poses=poses)),)


def _point_cloud(route: Route, unix_ns: int) -> Payload:
    points = np.zeros((len(route.waypoints_um), 3), "<f4")
    points[:, :2] = route.waypoints_um
    return _with_data(
        "PointCloud",
        points,
        timestamp=timestamp(unix_ns),
        pose=_pose(0.0, 0.0),
        point_stride=12,
        fields=_float_fields("x", "y", "z"),
    )


def _grid(field: FlowField, unix_ns: int) -> Payload:
    width, size_um = field.velocity_um_s.shape[1], field.um_per_px
    return _with_data(
        "Grid",
        np.ascontiguousarray(field.velocity_um_s, "<f4"),
        timestamp=timestamp(unix_ns),
        pose=_pose(-0.5 * size_um, -0.5 * size_um),  # the corner of pixel (0, 0), whose centre is the origin
        column_count=width,
        cell_size={"x": size_um, "y": size_um},
        row_stride=8 * width,
        cell_stride=8,
        fields=_float_fields("vx", "vy"),
    )


def _with_data(name: str, data: NDArray[Any], **values: Any) -> Payload:
    """A message with a field `data` that is not copied: protobuf makes three of it, and fields are large."""
    wire = _wire(name)
    view = data.reshape(-1).view(np.uint8).data
    number = wire.DESCRIPTOR.fields_by_name["data"].number
    return (_serialized(wire(**values)) + head_of(number, len(view)), view)


def _float_fields(*names: str) -> list[dict[str, Any]]:
    return [{"name": name, "offset": 4 * place, "type": _FLOAT32} for place, name in enumerate(names)]
