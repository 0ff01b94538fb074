"""The table of viewer topics: derived messages that Rerun and Foxglove show of a session file. The reader ignores them.

Frames, units and cameras are those of viewer_scene.py. What Rerun is to draw on the camera's image is below that
image's topic, because Rerun's own layout of a file shows an image with all that is below it.

The drawings are made in viewer_drawings.py, here the numbers that the recorded messages hold as arrays or not at all:
the flow where the robot is, the newest observation, and the flow along the route, each beside what the map says there;
and the end of the run. What has a schema of ROS 2, a number or a text each, Rerun plots and shows without a layout,
titled by its topic. Evaluations use the recorded messages, which have all digits.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.core import (
    NS_PER_S,
    Demand,
    Estimate,
    FlowField,
    Message,
    Observations,
    Route,
    Track,
    of_text,
    printable,
    verdict_lines,
)
from flowrec.store import viewer_drawings as drawings
from flowrec.store.codec import Payload
from flowrec.store.schema import Schema, foxglove_schema, plot_schema, ros_schema
from flowrec.store.viewer_drawings import distance_um, thin_line
from flowrec.store.viewer_scene import ViewerScene, drawable

_RULE = "=" * 80
NUMBER = ros_schema(
    "std_msgs/msg/Float64MultiArray",
    f"std_msgs/MultiArrayLayout layout\nfloat64[] data\n{_RULE}\nMSG: std_msgs/MultiArrayLayout\n"
    f"std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n{_RULE}\nMSG: std_msgs/MultiArrayDimension\n"
    "string label\nuint32 size\nuint32 stride\n",
)
TEXT = ros_schema("std_msgs/msg/String", "string data\n")
_CDR = b"\x00\x01\x00\x00"  # little-endian
_ROUTE_POINTS = 200  # along a route, at most; more are not visible

# Places are on the chip; the map is the refined flow, before there is one the assumed one. NaN: not known.
ROBOT_FLOW = plot_schema(
    "RobotFlow",
    (
        "x_um",
        "y_um",
        "flow_um_s",  # speed of the flow by the observer
        "map_um_s",  # by the map
        "difference_um_s",  # length of the difference of the two velocities
        "map_error_share",  # relative error that the map states of itself
    ),
)
OBSERVATION = plot_schema(
    "Observation",
    (
        "x_um",
        "y_um",
        "flow_x_um_s",
        "flow_y_um_s",
        "flow_um_s",
        "std_um_s",  # of a component
        "map_x_um_s",
        "map_y_um_s",
        "map_um_s",
        "difference_um_s",
        "count",  # observations so far
    ),
)
ROUTE_FLOW = plot_schema(
    "RouteFlow",
    (),
    (
        "distance_um",  # from the start of the route, along it
        "map_um_s",
        "along_um_s",  # component along the route, positive where the flow helps
        "std_um_s",  # one standard deviation of a component, root mean square of the two
    ),
)


def robot_flow(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """The flow where the robot is."""
    return (ROBOT_FLOW.wire(**_of_robot(robot, scene), map_error_share=scene.map_error_share).SerializeToString(),)


def flow_speed(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """Speed of the flow where the robot is, by the observer."""
    return _number(math.hypot(*robot.flow_um_s.tolist()) if isinstance(robot, Estimate) else math.nan)


def flow_difference(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """Length of the difference of the observer's flow and the map's."""
    return _number(_of_robot(robot, scene)["difference_um_s"])


def _of_robot(robot: Estimate | Track, scene: ViewerScene) -> dict[str, float]:
    flow = robot.flow_um_s.tolist() if isinstance(robot, Estimate) else (math.nan, math.nan)
    return _beside_map(scene, scene.place_um(robot.position_um), flow)[0]


def tracking_error(demand: Demand, _scene: ViewerScene) -> Payload:
    """Distance to the reference."""
    return _number(demand.error_um)


def verdict(outcome: Mapping[str, str], scene: ViewerScene) -> Payload:
    """The sentences of the end of a run, and what the colours mean, a line each."""
    ended = {"outcome": "not finished", **of_text(outcome)}
    top = f"; speed of the maps: 0 (violet) to {scene.top_um_s:.0f} µm/s (yellow)" if scene.top_um_s else ""
    lines = (
        *verdict_lines(ended, scene.refined),
        f"robot: orange; route: cyan; goal: green{top}; a square of the 3-D view: 1 mm",
        "more, with error bars: flowrec view FILE",
    )
    data = "\n\n".join(map(printable, lines)).encode() + b"\0"
    return (_CDR, struct.pack("<I", len(data)), data)


def _number(value: float) -> Payload:
    """One number as an array without dimensions."""
    return (_CDR, struct.pack("<III4xd", 0, 0, 1, value))


def observation(observations: Observations, scene: ViewerScene) -> Payload:
    """The newest observation; only their number where there is none."""
    count = len(observations.position_um)
    if not count:
        return (OBSERVATION.wire(count=0).SerializeToString(),)
    u, v = flow = observations.flow_um_s[-1].tolist()
    numbers, (map_u, map_v) = _beside_map(scene, scene.place_um(observations.position_um[-1]), flow)
    message = OBSERVATION.wire(
        **numbers,
        flow_x_um_s=u,
        flow_y_um_s=v,
        std_um_s=observations.std_um_s[-1],
        map_x_um_s=map_u,
        map_y_um_s=map_v,
        count=count,
    )
    return (message.SerializeToString(),)


def route_flow(route: Route, scene: ViewerScene) -> Payload:
    """The flow along the route."""
    way_um = route.waypoints_um
    if len(way_um) > _ROUTE_POINTS:
        way_um = thin_line(way_um, distance_um(way_um)[-1] / (_ROUTE_POINTS - 1) or 1.0)
    along = np.gradient(way_um, axis=0) if len(way_um) > 1 else np.zeros_like(way_um)
    along /= np.maximum(np.hypot(*along.T), 1e-12)[:, None]
    flow, std = np.full(way_um.shape, math.nan), np.full(way_um.shape, math.nan)
    if scene.field is not None:
        from flowrec.physics import sample  # late: what reads a session needs no compiled kernels

        flow = sample(scene.field, way_um)
        if scene.field.std_um_s is not None:
            height, width = scene.field.std_um_s.shape[:2]
            columns, rows = np.nan_to_num(np.rint(way_um / scene.field.um_per_px)).astype(np.int64).T
            std = scene.field.std_um_s[rows.clip(0, height - 1), columns.clip(0, width - 1)].astype(np.float64)
    message = ROUTE_FLOW.wire(
        distance_um=distance_um(way_um).tolist(),
        map_um_s=np.hypot(*flow.T).tolist(),
        along_um_s=(flow * along).sum(axis=1).tolist(),
        std_um_s=np.sqrt((std**2).mean(axis=1)).tolist(),
    )
    return (message.SerializeToString(),)


def _beside_map(
    scene: ViewerScene, place_um: tuple[float, float], flow: Sequence[float]
) -> tuple[dict[str, float], tuple[float, float]]:
    """A place on the chip and the flow (2,) there, compared with the map's; and the map's, NaN without a map."""
    (x_um, y_um), (u, v), map_u, map_v = place_um, flow, math.nan, math.nan
    if scene.field is not None and math.isfinite(x_um) and math.isfinite(y_um):
        from flowrec.physics import sample  # late, as above

        map_u, map_v = sample(scene.field, (x_um, y_um)).tolist()
    numbers = {
        "x_um": x_um,
        "y_um": y_um,
        "flow_um_s": math.hypot(u, v),
        "map_um_s": math.hypot(map_u, map_v),
        "difference_um_s": math.hypot(u - map_u, v - map_v),
    }
    return numbers, (map_u, map_v)


# The fields of Tick that viewer topics are made of.
INPUTS = frozenset(("assumed", "refined", "shift", "route", "mission", "estimate", "track", "observations", "demand"))
_ROBOT_EVERY_NS = NS_PER_S // 125  # a higher rate is not visible
_NEVER = -(1 << 62)  # ns, before every stamp
VERDICT = "/verdict"


@dataclass(frozen=True, slots=True)
class ViewerTopic:
    """One row of the table.

    Attributes
    ----------
    path, schema : of the topic.
    input : what it is derived from, a name of ViewerTopics._inputs.
    source : the same, in words, for the channel's metadata.
    make : input, scene -> payload, without its timestamp.
    has_timestamp : whether the message has one, in field 1; its parts may have timestamps of their own.
    """

    path: str
    schema: Schema
    input: str
    source: str
    make: Callable[[Any, ViewerScene], Payload]
    has_timestamp: bool = True


class ViewerTopics:
    """Makes the viewer topics of one session but for `left_out`, and remembers what they depend on. For one thread."""

    def __init__(self, scene: ViewerScene | None = None, left_out: frozenset[str] = frozenset()) -> None:
        self._views: dict[str, list[ViewerTopic]] = {}
        for view in VIEWER_TOPICS:
            if view.path not in left_out:
                self._views.setdefault(view.input, []).append(view)
        self._scene = ViewerScene() if scene is None else scene
        self._drawn: dict[str, tuple[object, ...]] = {"frames": (None, None), "goal": (None,)}  # what, by name
        self._robot_ns = _NEVER

    def of_end(self, outcome: Mapping[str, str], stamp_ns: int) -> Iterator[tuple[str, int, Payload]]:
        """As `of`, of the outcome of the run, when all of its messages are drawn; the stamp is that of its begin."""
        for view in self._views.get("outcome", ()):
            yield view.path, stamp_ns, view.make(outcome, self._scene)

    def of(self, messages: Mapping[str, Message]) -> Iterator[tuple[str, int, Payload]]:
        """Topic, stamp in ns and payload of all that follows from the new messages of one tick, by field of Tick."""
        # Numbers that can not be drawn are no error here.
        with np.errstate(all="ignore"):
            self._scene.update(messages)
            for source, stamp_ns, made_of in list(self._inputs(messages)):
                for view in self._views.get(source, ()):
                    payload = view.make(made_of, self._scene)
                    if view.has_timestamp:
                        payload = (self._scene.stamp(stamp_ns), *payload)
                    yield view.path, stamp_ns, payload

    def _inputs(self, messages: Mapping[str, Any]) -> Iterator[tuple[str, int, Any]]:
        """Name, stamp in ns and message of what viewer topics are made of; a stamp alone where the scene says all."""
        scene, last_ns = self._scene, max((message.stamp_ns for message in messages.values()), default=0)
        if self._is_new("frames", scene.picture, scene.map):
            yield "frames", last_ns, last_ns
        for name, picture in (("picture", scene.picture), ("map", scene.map)):
            if picture is not None and self._is_new(name, picture):
                yield name, last_ns, picture
        robot = messages.get("estimate") or messages.get("track")
        if isinstance(robot, (Estimate, Track)) and abs(robot.stamp_ns - self._robot_ns) >= _ROBOT_EVERY_NS:
            self._robot_ns = robot.stamp_ns
            yield "robot", robot.stamp_ns, robot
            if scene.picture is not None and np.isfinite(robot.position_um).all():
                yield "robot on picture", robot.stamp_ns, robot
        if messages.get("route") is scene.route and scene.route is not None:
            yield "route", scene.route.stamp_ns, scene.route
        goal = None if scene.goal_um is None else tuple(scene.goal_um.tolist())
        if self._is_new("goal", goal):
            yield "goal", last_ns, last_ns
        there = scene.picture is not None and (scene.route, goal) != (None, None)
        if there and self._is_new("marks", scene.route, goal, scene.picture):
            yield "marks", last_ns, last_ns
        if scene.route is not None and ("route" in messages or scene.field in messages.values()):
            yield "route on map", last_ns, scene.route
        demand = messages.get("demand")
        # NaN is a gap in the line; before the first number it would be a plot without a line.
        if isinstance(demand, Demand) and ("error" in self._drawn or math.isfinite(demand.error_um)):
            self._drawn["error"] = ()
            yield "demand", demand.stamp_ns, demand
        observations = messages.get("observations")
        if isinstance(observations, Observations) and observations.position_um.shape[1:] == (2,):
            yield "observations", observations.stamp_ns, observations
        for name in ("assumed", "refined"):
            field = messages.get(name)
            if isinstance(field, FlowField) and drawable(field):
                yield name, field.stamp_ns, field
                if name == "refined":
                    yield "refined picture", field.stamp_ns, field
                elif scene.refined is None and self._is_new("no refined flow", True):
                    yield "refined picture", field.stamp_ns, None

    def _is_new(self, name: str, *made_of: object) -> bool:
        """True if a drawing was last made of something else; then it is noted as made of this."""
        before, self._drawn[name] = self._drawn.get(name), made_of
        return made_of != before


_FRAMES, _CAMERA, _POSE, _POSES, _POINTS, _MARKS, _IMAGE, _GRID = map(
    foxglove_schema,
    (
        *("FrameTransforms", "CameraCalibration", "PoseInFrame", "PosesInFrame"),
        *("PointCloud", "ImageAnnotations", "CompressedImage", "Grid"),
    ),
)
_ROBOT = "estimate, else track"
VIEWER_TOPICS = (
    ViewerTopic("/view/frames", _FRAMES, "frames", "config, assumed, refined", drawings.transforms, False),
    ViewerTopic("/view/camera", _CAMERA, "picture", "config, refined", drawings.camera),
    ViewerTopic("/view/map", _CAMERA, "map", "assumed, refined", drawings.camera),
    ViewerTopic("/view/robot_pose", _POSE, "robot", _ROBOT, drawings.robot_pose),
    # The same as points, because Rerun draws no pose.
    ViewerTopic("/camera/frame/robot", _POINTS, "robot", _ROBOT, drawings.robot_points),
    ViewerTopic("/view/path", _POSES, "route", "route", drawings.path),
    ViewerTopic("/camera/frame/path", _POINTS, "route", "route", drawings.path_points),
    ViewerTopic("/camera/frame/goal", _POINTS, "goal", "mission", drawings.goal_points),
    ViewerTopic("/view/robot_mark", _MARKS, "robot on picture", _ROBOT, drawings.robot_mark, False),
    ViewerTopic("/view/route_mark", _MARKS, "marks", "route, mission, refined", drawings.route_mark, False),
    ViewerTopic("/view/walls", _POINTS, "assumed", "assumed", drawings.walls),
    ViewerTopic("/view/flow_assumed", _IMAGE, "assumed", "assumed", drawings.preview),
    ViewerTopic("/view/flow_refined", _IMAGE, "refined picture", "refined", drawings.preview),
    ViewerTopic("/view/flow_refined_grid", _GRID, "refined", "refined", drawings.grid),
    ViewerTopic(VERDICT, TEXT, "outcome", "outcome of the run", verdict, False),
    ViewerTopic("/view/flow_at_robot_um_s", NUMBER, "robot", "estimate", flow_speed, False),
    ViewerTopic("/view/flow_difference_um_s", NUMBER, "robot", "estimate, assumed, refined", flow_difference, False),
    ViewerTopic("/view/tracking_error_um", NUMBER, "demand", "demand", tracking_error, False),
    ViewerTopic("/view/robot_flow", ROBOT_FLOW, "robot", f"{_ROBOT}; assumed, refined", robot_flow),
    ViewerTopic("/view/observation", OBSERVATION, "observations", "observations", observation),
    ViewerTopic("/view/route_flow", ROUTE_FLOW, "route on map", "route, assumed, refined", route_flow),
)
