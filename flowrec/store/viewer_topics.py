"""The table of viewer topics: derived messages that Rerun and Foxglove show of a session file. The reader ignores them.

Frames, units and cameras are those of viewer_scene.py. What Rerun is to draw on the camera's image is below that
image's topic, because Rerun's own layout of a file shows an image with all that is below it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.core import NS_PER_S, Demand, Estimate, FlowField, Message, Observations, Track
from flowrec.store import viewer_drawings as drawings
from flowrec.store import viewer_numbers as numbers
from flowrec.store.codec import Payload
from flowrec.store.schema import Schema, foxglove_schema
from flowrec.store.viewer_scene import ViewerScene, drawable

# The fields of Tick that viewer topics are made of.
INPUTS = frozenset(("assumed", "refined", "shift", "route", "mission", "estimate", "track", "observations", "demand"))
_ROBOT_EVERY_NS = NS_PER_S // 125  # a higher rate is not visible
_NEVER = -(1 << 62)
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
    ViewerTopic(VERDICT, numbers.TEXT, "outcome", "outcome of the run", numbers.verdict, False),
    ViewerTopic("/view/flow_at_robot_um_s", numbers.NUMBER, "robot", "estimate", numbers.flow_speed, False),
    ViewerTopic(
        "/view/flow_difference_um_s",
        numbers.NUMBER,
        "robot",
        "estimate, assumed, refined",
        numbers.flow_difference,
        False,
    ),
    ViewerTopic("/view/tracking_error_um", numbers.NUMBER, "demand", "demand", numbers.tracking_error, False),
    ViewerTopic("/view/robot_flow", numbers.ROBOT_FLOW, "robot", f"{_ROBOT}; assumed, refined", numbers.robot_flow),
    ViewerTopic("/view/observation", numbers.OBSERVATION, "observations", "observations", numbers.observation),
    ViewerTopic("/view/route_flow", numbers.ROUTE_FLOW, "route on map", "route, assumed, refined", numbers.route_flow),
)
