"""Robot, route, goal and maps as messages of foxglove's schemas: in mm on the chip, and in px on the camera's image.

Rerun draws points and images, Foxglove draws all of it. Both flow previews use one colour scale, viridis from 0 to the
highest speed of the first field; solid is black.
"""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
from foxglove import messages as fg
from numpy.typing import NDArray

from flowrec.core import MM_PER_UM, Estimate, Floats, FlowField, Route, Track, fluid_of
from flowrec.store.codec import Payload, byte_field_head
from flowrec.store.viewer_scene import CHIP, MAP, STILL, Picture, ViewerScene, speed_um_s

_GRID_DATA, _CIRCLES, _POINTS, _TRANSFORMS = 9, 1, 2, 1  # numbers of fields
# The robot and the goal are drawn as rings: a single point of Rerun's default size is hidden by the path.
_RING_POINTS, _RING_RADII = 32, 1.5  # radii of the robot
_RADII_OF_GOAL = 2.5  # of the robot, of the ring around its goal
_LINE_PX = 1.5  # of the image, at most; thinner on a small one
_LINE_SHARE = 1.0 / 200.0  # of the image's width
_ROUNDING = np.uint32(1 << 11)  # half of the last bit kept of a float's 23; the rest are 0 and compress
_NO_COLOUR = fg.Color(r=0.0, g=0.0, b=0.0, a=0.0)
Rgba = tuple[int, int, int, int]
# Red, green, blue and opacity, 0 to 255.
_ROBOT, _UNSEEN, _PATH, _GOAL = (255, 112, 32, 255), (200, 200, 200, 255), (0, 216, 255, 255), (64, 255, 96, 255)
_WALL, _WALL_POINTS = (130, 130, 130, 255), 4000  # points at most


def transforms(stamp_ns: int, scene: ViewerScene) -> Payload:
    """Coordinate frames of chip and cameras."""
    stamp = scene.stamp(stamp_ns)
    return tuple(part for each in scene.transforms() for part in _part(_TRANSFORMS, stamp, each.encode()))


def camera(picture: Picture, _scene: ViewerScene) -> Payload:
    """Calibration of a camera: the projection of the chip to its image."""
    return (picture.calibration().encode(),)


def robot_pose(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """Pose of the robot on the chip, in mm."""
    return _pose_field(*scene.place_um(robot.position_um)), _IN_CHIP


def robot_points(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """A ring around it."""
    # `pose` has the same number in both schemas, and protobuf merges messages that follow each other.
    return _pose_field(*scene.place_um(robot.position_um)), _ring(scene.robot_um, _ROBOT if robot.seen else _UNSEEN)


def robot_mark(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """Ring around the robot on the camera's image, in px."""
    assert scene.picture is not None
    place = scene.picture.pixel(*scene.place_um(robot.position_um))
    ring_px = _RING_RADII * scene.robot_um / scene.picture.um_per_px
    colour = _ROBOT if robot.seen else _UNSEEN
    return _circle(scene.stamp(robot.stamp_ns), place, ring_px, scene.picture.width_px, colour)


def path(route: Route, _scene: ViewerScene) -> Payload:
    """The route as poses on the chip, in mm."""
    return (fg.PosesInFrame(frame_id=CHIP, poses=[_pose(x, y) for x, y in route.waypoints_um.tolist()]).encode(),)


def path_points(route: Route, _scene: ViewerScene) -> Payload:
    """The route as points on the chip, in mm."""
    return (_cloud(route.waypoints_um, _PATH).encode(),)


def goal_points(_stamp_ns: int, scene: ViewerScene) -> Payload:
    """A ring with a cross around the goal; nothing without one."""
    points = np.zeros((0, 2))
    if scene.goal_um is not None:
        across = np.linspace(-1.0, 1.0, _RING_POINTS // 2)
        cross = np.concatenate((np.outer(across, (1.0, 0.0)), np.outer(across, (0.0, 1.0))))
        points = scene.goal_um + _RADII_OF_GOAL * scene.robot_um * np.concatenate((_circle_points(), cross))
    return (_cloud(points, _GOAL).encode(),)


def route_mark(stamp_ns: int, scene: ViewerScene) -> Payload:
    """Route and goal on the camera's image, in px."""
    assert scene.picture is not None
    stamp, width_px = scene.stamp(stamp_ns), scene.picture.width_px
    parts: Payload = ()
    if scene.route is not None:
        way_px = scene.picture.to_px(thin_line(scene.route.waypoints_um, scene.picture.um_per_px))
        parts += _line(stamp, way_px, fg.PointsAnnotationType.LineStrip, width_px, _PATH)
    if scene.goal_um is not None:
        place, ring_px = scene.picture.to_px(scene.goal_um), _RADII_OF_GOAL * scene.robot_um / scene.picture.um_per_px
        x_px, y_px = place.tolist()
        ends = np.array([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
        parts += _circle(stamp, (x_px, y_px), ring_px, width_px, _GOAL)
        parts += _line(stamp, place + ring_px * ends, fg.PointsAnnotationType.LineList, width_px, _GOAL)
    return parts


def thin_line(points_um: Floats, step_um: float) -> Floats:
    """Points (n, 2) of a line: the first of each step along it, and its last one."""
    if len(points_um) < 2:
        return points_um
    keep = np.diff(np.floor(distance_um(points_um) / step_um), prepend=-1.0) != 0.0
    keep[-1] = True
    return points_um[keep]


def distance_um(points_um: Floats) -> Floats:
    """(n,) distance from the first of the points (n, 2), along them."""
    steps = np.hypot(*np.diff(points_um, axis=0).T)
    return np.concatenate((np.zeros(min(len(points_um), 1)), np.cumsum(steps)))


def walls(field: FlowField, _scene: ViewerScene) -> Payload:
    """The outline of the fluid as points on the chip: what Rerun's 3-D view takes its size from, before a route."""
    outlines, _ = cv2.findContours(fluid_of(field).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    points_px = np.concatenate([np.zeros((0, 2)), *(outline[:, 0] for outline in outlines)])
    every = -(-len(points_px) // _WALL_POINTS) or 1
    return (_cloud(field.um_per_px * points_px[::every], _WALL).encode(),)


def preview(field: FlowField | None, scene: ViewerScene) -> Payload:
    """The speed of a flow as an image; without one an image that says so, because its view would be empty."""
    if field is None:
        return _image(_no_flow(scene))
    speed = speed_um_s(field)
    solid = speed == 0.0
    speed *= 255.0 / (scene.top_um_s or 1.0)
    grey = np.clip(speed, 0.0, 255.0, out=speed).astype(np.uint8)
    colours = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    colours[solid] = 0
    return _image(colours)


def _image(pixels: NDArray[Any]) -> Payload:
    data = cv2.imencode(".png", pixels)[1].tobytes()
    return (fg.CompressedImage(frame_id=MAP, data=data, format="png").encode(),)


def _no_flow(scene: ViewerScene) -> NDArray[np.uint8]:
    """(h, w) grey levels of the size of the map."""
    assert scene.field is not None
    (h, w), text = scene.field.velocity_um_s.shape[:2], "no refined flow"
    picture: NDArray[np.uint8] = np.zeros((h, w), np.uint8)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    scale = 0.8 * w / width
    place = int(0.1 * w), int(0.5 * (h + scale * height))
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 160, 1, cv2.LINE_AA)
    return picture


def grid(field: FlowField, _scene: ViewerScene) -> Payload:
    """A flow in um/s on cells in mm, with a relative precision of 2^-12: the topic of the field has all digits."""
    (height, width), size_mm = field.velocity_um_s.shape[:2], MM_PER_UM * field.um_per_px
    values = np.empty((height, width, 3), "<f4")
    values[..., :2], values[..., 2] = field.velocity_um_s, speed_um_s(field)
    bits = values.view("<u4")
    bits += _ROUNDING
    bits &= ~(2 * _ROUNDING - 1)
    head = fg.Grid(
        frame_id=CHIP,
        pose=_pose(-0.5 * field.um_per_px, -0.5 * field.um_per_px),  # the corner of pixel (0, 0)
        column_count=width,
        cell_size=fg.Vector2(x=size_mm, y=size_mm),
        row_stride=values.strides[0],
        cell_stride=values.strides[1],
        fields=_float_fields("vx_um_s", "vy_um_s", "speed_um_s"),
    )
    # Fields are large: the values follow uncopied.
    return (head.encode() + byte_field_head(_GRID_DATA, values.nbytes), values.reshape(-1).view(np.uint8).data)


def _pose(x_um: float, y_um: float) -> fg.Pose:
    place = fg.Vector3(x=MM_PER_UM * x_um, y=MM_PER_UM * y_um, z=0.0)
    return fg.Pose(position=place, orientation=STILL)


@functools.lru_cache(maxsize=2)  # asked for twice
def _pose_field(x_um: float, y_um: float) -> bytes:
    """A message with a pose alone."""
    return fg.PoseInFrame(pose=_pose(x_um, y_um)).encode()


@functools.lru_cache(maxsize=8)
def _ring(radius_um: float, rgba: Rgba) -> bytes:
    """The points about the robot, without their pose."""
    return _cloud(_RING_RADII * radius_um * _circle_points(), rgba, placed=False).encode()


def _circle_points() -> Floats:
    angle = np.arange(_RING_POINTS) * (2.0 * np.pi / _RING_POINTS)
    return np.stack((np.cos(angle), np.sin(angle)), 1)


def _cloud(points_um: Floats, rgba: Rgba, *, placed: bool = True) -> fg.PointCloud:
    """Points (n, 2) on the chip; they are about a pose that follows where they are not `placed`."""
    points = np.zeros(len(points_um), [("at", "<f4", 3), ("colour", "u1", 4)])
    points["at"][:, :2], points["colour"] = MM_PER_UM * points_um, rgba
    colours = [
        fg.PackedElementField(name=name, offset=12 + place, type=fg.PackedElementFieldNumericType.Uint8)
        for place, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    return fg.PointCloud(
        frame_id=CHIP,
        pose=_pose(0.0, 0.0) if placed else None,
        point_stride=points.itemsize,
        fields=_float_fields("x", "y", "z") + colours,
        data=points.tobytes(),
    )


def _float_fields(*names: str) -> list[fg.PackedElementField]:
    float32 = fg.PackedElementFieldNumericType.Float32
    return [fg.PackedElementField(name=name, offset=4 * place, type=float32) for place, name in enumerate(names)]


def _circle(stamp: bytes, place_px: tuple[float, float], radius_px: float, width_px: int, rgba: Rgba) -> Payload:
    """A circle as a part of ImageAnnotations."""
    x, y = place_px
    circle = fg.CircleAnnotation(position=fg.Point2(x=x, y=y), diameter=2.0 * radius_px, **_look(width_px, rgba))
    return _part(_CIRCLES, stamp, circle.encode())


def _line(stamp: bytes, points_px: Floats, kind: fg.PointsAnnotationType, width_px: int, rgba: Rgba) -> Payload:
    """A line as a part of ImageAnnotations."""
    points = [fg.Point2(x=x, y=y) for x, y in points_px.tolist()]
    return _part(_POINTS, stamp, fg.PointsAnnotation(type=kind, points=points, **_look(width_px, rgba)).encode())


def _look(width_px: int, rgba: Rgba) -> dict[str, Any]:
    red, green, blue, alpha = (value / 255.0 for value in rgba)
    return {
        "thickness": max(_LINE_PX, _LINE_SHARE * width_px),
        "fill_color": _NO_COLOUR,
        "outline_color": fg.Color(r=red, g=green, b=blue, a=alpha),
    }


def _part(number: int, *content: bytes) -> Payload:
    """A message as the field of another one with this number."""
    return byte_field_head(number, sum(map(len, content))), *content


_IN_CHIP = fg.PoseInFrame(frame_id=CHIP).encode()
