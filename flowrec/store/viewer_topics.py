"""The table of viewer topics: derived messages that Rerun and Foxglove show of a session file. The reader ignores them.

Positions are in um, one unit of the 3D view = 1 um, in the chip's frame (origin at pixel (0, 0), x right, y down),
so that pose, path and grid lie over each other; the frame_id is empty because a named one needs a transform tree.
Both flow previews use one colour scale, viridis from 0 to the highest speed of the first field; solid is black.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from foxglove import messages as fg
from numpy.typing import NDArray

from flowrec.declarations import Message
from flowrec.messages import Estimate, FlowField, Route, Track
from flowrec.store.codec import Payload, byte_field_head, timestamp
from flowrec.store.schema import foxglove_schema
from flowrec.units import NS_PER_S

_GRID_DATA = 9  # number of the field that holds the values
# The robot is drawn as a ring: a single point of Rerun's default size is hidden by the path.
_RING_POINTS, _RING_UM = 24, 60.0
_RING_RGBA = (255, 64, 32, 255)
_ROBOT_EVERY_NS = NS_PER_S // 125  # a higher rate is not visible


@dataclass(frozen=True, slots=True)
class ViewerTopic:
    """One row of the table.

    Attributes
    ----------
    path, schema : of the topic; the schema is one of foxglove's.
    input : what it is derived from: robot, route, assumed or refined.
    source : the same, in words, for the channel's metadata.
    make : message, highest speed of the colour scale in um/s -> payload without its timestamp.
    """

    path: str
    schema: str
    input: str
    source: str
    make: Callable[[Any, float], Payload]


class ViewerTopics:
    """Makes the viewer topics of one session but for `left_out`; remembers the colour scale. For use by one thread.

    `start_unix_ns` of the session is added to the timestamps in the messages.

    Attributes
    ----------
    top_um_s : speed at the bright end of the colour scale; None before the first flow field.
    """

    def __init__(self, left_out: frozenset[str] = frozenset(), start_unix_ns: int = 0) -> None:
        self.top_um_s: float | None = None
        self._start_unix_ns = start_unix_ns
        self._views = [view for view in VIEWER_TOPICS if view.path not in left_out]
        self._robot_ns = -_ROBOT_EVERY_NS

    def copy(self) -> ViewerTopics:
        """One for another thread that continues from here, with the present colour scale."""
        return copy.copy(self)

    def of(self, messages: Mapping[str, Message]) -> Iterator[tuple[str, int, Payload]]:
        """Topic, stamp in ns and payload of all that follows from the new messages of one tick, by field of Tick."""
        for source, message in self._inputs(messages):
            for view in self._views:
                if view.input == source:
                    # Numbers that can not be drawn are no error here.
                    with np.errstate(all="ignore"):
                        payload = view.make(message, self.top_um_s or 1.0)
                    stamp_ns = message.stamp_ns
                    yield view.path, stamp_ns, (_timestamp(stamp_ns + self._start_unix_ns), *payload)

    def _inputs(self, messages: Mapping[str, Message]) -> Iterator[tuple[str, Estimate | Track | Route | FlowField]]:
        robot = messages.get("estimate") or messages.get("track")
        if isinstance(robot, (Estimate, Track)) and abs(robot.stamp_ns - self._robot_ns) >= _ROBOT_EVERY_NS:
            self._robot_ns = robot.stamp_ns
            yield "robot", robot
        route = messages.get("route")
        if isinstance(route, Route) and route.waypoints_um.shape[1:] == (2,):
            yield "route", route
        for name in ("assumed", "refined"):
            field = messages.get(name)
            if isinstance(field, FlowField) and field.velocity_um_s.shape[2:] == (2,) and field.velocity_um_s.size:
                if self.top_um_s is None:
                    self.top_um_s = float(_speed_um_s(field).max()) or 1.0
                yield name, field


@functools.lru_cache(maxsize=4)  # several views are of the same moment
def _timestamp(unix_ns: int) -> bytes:
    """The field `timestamp`, which has the same number in all schemas; foxglove's class refuses times out of range."""
    data: bytes = foxglove_schema("PoseInFrame").wire(timestamp=timestamp(unix_ns)).SerializeToString()
    return data


def _pose(x_um: float, y_um: float) -> fg.Pose:
    return fg.Pose(position=fg.Vector3(x=x_um, y=y_um, z=0.0), orientation=fg.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def _robot_pose(robot: Estimate | Track, _top_um_s: float) -> Payload:
    return (fg.PoseInFrame(pose=_pose(float(robot.position_um[0]), float(robot.position_um[1]))).encode(),)


def _robot_ring(robot: Estimate | Track, top_um_s: float) -> Payload:
    # `pose` has the same number in both schemas, and protobuf merges messages that follow each other.
    return (*_robot_pose(robot, top_um_s), _ring())


@functools.cache
def _ring() -> bytes:
    """The points about the robot; the first one is the robot itself."""
    angle = np.arange(_RING_POINTS) * (2.0 * np.pi / _RING_POINTS)
    points = np.zeros(1 + _RING_POINTS, [("at", "<f4", 3), ("colour", "u1", 4)])
    points["at"][1:, 0], points["at"][1:, 1] = _RING_UM * np.cos(angle), _RING_UM * np.sin(angle)
    points["colour"] = _RING_RGBA
    colours = [
        fg.PackedElementField(name=name, offset=12 + place, type=fg.PackedElementFieldNumericType.Uint8)
        for place, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    fields = _float_fields("x", "y", "z") + colours
    return fg.PointCloud(point_stride=points.itemsize, fields=fields, data=points.tobytes()).encode()


def _path(route: Route, _top_um_s: float) -> Payload:
    return (fg.PosesInFrame(poses=[_pose(x, y) for x, y in route.waypoints_um.tolist()]).encode(),)


def _path_points(route: Route, _top_um_s: float) -> Payload:
    points = np.zeros((len(route.waypoints_um), 3), "<f4")
    points[:, :2] = route.waypoints_um
    fields, data = _float_fields("x", "y", "z"), points.tobytes()
    return (fg.PointCloud(pose=_pose(0.0, 0.0), point_stride=12, fields=fields, data=data).encode(),)


def _preview(field: FlowField, top_um_s: float) -> Payload:
    speed = _speed_um_s(field)
    solid = speed == 0.0
    speed *= 255.0 / top_um_s
    grey = np.clip(speed, 0.0, 255.0, out=speed).astype(np.uint8)
    colours = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    colours[solid] = 0
    return (fg.CompressedImage(data=cv2.imencode(".png", colours)[1].tobytes(), format="png").encode(),)


def _speed_um_s(field: FlowField) -> NDArray[np.float32]:
    """(h, w) speed; 0 where it is not finite."""
    with np.errstate(over="ignore"):
        speed: NDArray[np.float32] = np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1])
    np.nan_to_num(speed, copy=False, posinf=0.0)
    return speed


def _grid(field: FlowField, _top_um_s: float) -> Payload:
    width, size_um = field.velocity_um_s.shape[1], field.um_per_px
    grid = fg.Grid(
        pose=_pose(-0.5 * size_um, -0.5 * size_um),  # the corner of pixel (0, 0), whose centre is the origin
        column_count=width,
        cell_size=fg.Vector2(x=size_um, y=size_um),
        row_stride=8 * width,
        cell_stride=8,
        fields=_float_fields("vx", "vy"),
    )
    # Fields are large: the values follow uncopied.
    data = field.velocity_um_s.astype("<f4", copy=False).reshape(-1).view(np.uint8).data
    return (grid.encode() + byte_field_head(_GRID_DATA, len(data)), data)


def _float_fields(*names: str) -> list[fg.PackedElementField]:
    float32 = fg.PackedElementFieldNumericType.Float32
    return [fg.PackedElementField(name=name, offset=4 * place, type=float32) for place, name in enumerate(names)]


VIEWER_TOPICS = (
    ViewerTopic("/view/robot_pose", "PoseInFrame", "robot", "estimate, else track", _robot_pose),
    # The same as points, because Rerun draws no pose.
    ViewerTopic("/view/robot_point", "PointCloud", "robot", "estimate, else track", _robot_ring),
    ViewerTopic("/view/path", "PosesInFrame", "route", "route", _path),
    ViewerTopic("/view/path_points", "PointCloud", "route", "route", _path_points),
    ViewerTopic("/view/flow_assumed", "CompressedImage", "assumed", "assumed", _preview),
    ViewerTopic("/view/flow_refined", "CompressedImage", "refined", "refined", _preview),
    ViewerTopic("/view/flow_refined_grid", "Grid", "refined", "refined", _grid),
)
