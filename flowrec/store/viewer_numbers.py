"""Numbers that viewers plot and that the recorded messages hold as arrays or not at all: the flow where the robot is,
the newest observation, and the flow along the route, each beside what the map says there; and the end of the run.

What has a schema of ROS 2, a number or a text each, Rerun plots and shows without a layout, titled by its topic. All is
derived for viewers; evaluations use the recorded messages, which have all digits.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from flowrec.core import (
    Demand,
    Estimate,
    Observations,
    Route,
    Track,
    of_text,
    printable,
    verdict_lines,
)
from flowrec.store.codec import Payload
from flowrec.store.schema import plot_schema, ros_schema
from flowrec.store.viewer_drawings import distance_um, thin_line
from flowrec.store.viewer_scene import ViewerScene

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
    flow = robot.flow_um_s.tolist() if isinstance(robot, Estimate) else (math.nan, math.nan)
    numbers, _ = _beside_map(scene, scene.place_um(robot.position_um), flow)
    return (ROBOT_FLOW.wire(**numbers, map_error_share=scene.map_error_share).SerializeToString(),)


def flow_speed(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """Speed of the flow where the robot is, by the observer."""
    return _number(math.hypot(*robot.flow_um_s.tolist()) if isinstance(robot, Estimate) else math.nan)


def flow_difference(robot: Estimate | Track, scene: ViewerScene) -> Payload:
    """Length of the difference of the observer's flow and the map's."""
    flow = robot.flow_um_s.tolist() if isinstance(robot, Estimate) else (math.nan, math.nan)
    return _number(_beside_map(scene, scene.place_um(robot.position_um), flow)[0]["difference_um_s"])


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
