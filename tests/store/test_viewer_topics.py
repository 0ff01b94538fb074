"""Views for other programs."""

import dataclasses
import math
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from flowrec.core import Demand, Estimate, Mission, Observations, Route, Track, as_read
from flowrec.physics import Calibration, on_chip, sample
from flowrec.store import Session, nonzero_window
from flowrec.store.roi import region_from
from flowrec.store.schema import foxglove_schema
from flowrec.store.session_file import Split
from flowrec.store.viewer_scene import ChipCamera, ViewerScene
from flowrec.store.viewer_topics import VIEWER_TOPICS, ViewerTopics
from tests.store.made_up import field_of, write_session

_SCHEMAS = {view.path: view.schema for view in VIEWER_TOPICS}
START_NS = 1_790_000_000_000_000_000


def parsed(path, payload):
    """A message of protobuf, or the number or text of one of ROS 2."""
    data = b"".join(payload)
    if _SCHEMAS[path].wire is not None:
        return _SCHEMAS[path].wire.FromString(data)
    return struct.unpack_from("<d", data, 20)[0] if "Float64" in _SCHEMAS[path].name else data[8:-1].decode()


def seen(views, messages):
    """The latest message of each viewer topic."""
    return {path: parsed(path, payload) for path, _, payload in views.of(messages)}


def turned(q, vector):
    """A vector turned by a quaternion: v + 2 w (u x v) + 2 u x (u x v)."""
    u = np.array([q.x, q.y, q.z])
    return vector + 2.0 * q.w * np.cross(u, vector) + 2.0 * np.cross(u, np.cross(u, vector))


def projected(found, place, camera="/view/camera"):
    """The pixel of a place in the chip's frame in mm, by the transform and the calibration of a camera alone."""
    calibration = found[camera]
    there = next(each for each in found["/view/frames"].transforms if each.child_frame_id == calibration.frame_id)
    assert there.parent_frame_id == "chip"
    back = type(there.rotation)(x=-there.rotation.x, y=-there.rotation.y, z=-there.rotation.z, w=there.rotation.w)
    t = there.translation
    x, y, depth = np.reshape(calibration.K, (3, 3)) @ turned(back, np.asarray(place) - np.array([t.x, t.y, t.z]))
    assert depth > 0.1  # Rerun clips what is nearer
    return np.array([x, y]) / depth


def point(place):
    return np.array([place.x, place.y, getattr(place, "z", 0.0)])


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("angle_deg", [0.0, 33.0, 180.0, -118.0])
def test_robot_route_and_goal_lie_on_the_image_where_the_tracker_saw_them(angle_deg, mirror):
    stated = Calibration.centre_on(3.2, (1500.0, 900.0), (640, 512), angle_deg, mirror)
    views = ViewerTopics(ViewerScene(ChipCamera(stated, (640, 512), 70.0), START_NS))
    robot_px, goal_px, way_px = (
        np.array([123.25, 400.75]),
        np.array([500.5, 31.0]),
        np.array([[20.0, 30.0], [600, 500]]),
    )
    field = field_of(1, np.random.default_rng(0), shape=(256, 320))
    # The refinement finds that the image is shifted, turned and larger than stated.
    for now, found_there in ((5, None), (10**9, np.array([[0.99, 0.03, -12.0], [-0.03, 0.99, 31.0]]))):
        robot = Track(now, True, stated.to_um(robot_px), 1.0, 0, 9.0, np.zeros(4))
        goal_um, way_um = (on_chip(found_there, stated.to_um(px)) for px in (goal_px, way_px))
        route = Route(now, 1, "x", True, "", way_um, np.arange(2.0))
        mission = Mission(now, "navigate", 0, 1, "", 0, np.zeros(2), goal_um, False, "", "")
        refined = replace(field, registration=found_there)
        found = seen(views, {"refined": refined, "route": route, "track": robot, "mission": mission})
        ring, (way, cross) = found["/view/robot_mark"].circles[0], found["/view/route_mark"].points
        pairs = [
            (robot_px, ring.position, found["/view/robot_pose"].pose.position),
            (goal_px, found["/view/route_mark"].circles[0].position, [*(1e-3 * goal_um), 0.0]),
            (way_px[0], way.points[0], found["/view/path"].poses[0].position),
            (way_px[1], way.points[-1], found["/view/path"].poses[-1].position),
        ]
        for centre_px, mark, place in pairs:
            # Viewers count from the corner of the first pixel, flowrec from its centre.
            assert np.allclose(point(mark)[:2], centre_px + 0.5, atol=1e-6)
            assert np.allclose(
                projected(found, place if isinstance(place, list) else point(place)), centre_px + 0.5, atol=1e-3
            )
        assert np.isclose(ring.diameter * stated.um_per_px, 3.0 * 70.0, rtol=0.02) and len(cross.points) == 4
        assert ring.timestamp.ToNanoseconds() == way.timestamp.ToNanoseconds() == START_NS + now
        place = point(found["/view/robot_pose"].pose.position)
        assert np.allclose(projected(found, place, "/view/map"), 1e3 * place[:2] / field.um_per_px + 0.5, atol=1e-3)
        (points,) = (found[f"/camera/frame/{name}"] for name in ("path",))
        assert np.allclose(np.frombuffer(points.data, "<f4").reshape(-1, 4)[:, :2], 1e-3 * way_um, rtol=1e-6)


def test_what_did_not_move_is_drawn_once_and_a_robot_out_of_sight_is_pale():
    scene = ViewerScene(ChipCamera(Calibration(2.0), (64, 48), 10.0), 0)
    views, place = ViewerTopics(scene), np.array([10.0, 20.0])
    track = Track(0, True, place, 1.0, 0, 9.0, np.zeros(4))
    mission = Mission(0, "navigate", 0, 1, "", 0, place, place, False, "", "")
    first = seen(views, {"track": track, "mission": mission})
    assert {"/view/frames", "/view/camera", "/camera/frame/goal", "/view/route_mark"} <= first.keys()
    late = 10**9
    again = seen(
        views, {"track": replace(track, stamp_ns=late, seen=False), "mission": replace(mission, stamp_ns=late)}
    )
    numbers = {"/view/robot_flow", "/view/flow_at_robot_um_s", "/view/flow_difference_um_s"}
    assert again.keys() == {"/view/robot_pose", "/camera/frame/robot", "/view/robot_mark", *numbers}
    colours = [each["/view/robot_mark"].circles[0].outline_color for each in (first, again)]
    assert colours[0].b < colours[0].r == 1.0 and colours[1].r == colours[1].b
    gone = seen(views, {"mission": replace(mission, stamp_ns=late, goal_um=np.full(2, np.nan))})
    assert not gone["/camera/frame/goal"].data


def test_plotted_numbers_are_those_of_the_observer_and_of_the_map_where_the_robot_is():
    field = dataclasses.replace(
        field_of(1, np.random.default_rng(2)), error_share=0.25, std_um_s=np.full((24, 32, 2), 3.0, "<f4")
    )
    place, flow = np.array([30.0, 25.0]), np.array([3.0, -4.0])
    here = Estimate(5, place, flow, np.eye(4), 1.0, place, True)
    route = Route(5, 0, "x", True, "", np.array([[10.0, 20.0], [10.0, 40.0]]), np.arange(2.0))
    made = Observations(5, place[None], flow[None], np.array([2.0]))
    found = seen(ViewerTopics(), {"assumed": field, "estimate": here, "route": route, "observations": made})
    on_map = sample(field, place)
    for numbers in (found["/view/robot_flow"], found["/view/observation"]):
        assert (numbers.x_um, numbers.y_um, numbers.flow_um_s) == (30.0, 25.0, 5.0)
        assert np.isclose(numbers.map_um_s, np.hypot(*on_map), rtol=1e-6)
        assert np.isclose(numbers.difference_um_s, np.hypot(*(flow - on_map)), rtol=1e-6)
    assert found["/view/flow_at_robot_um_s"] == 5.0
    assert np.isclose(found["/view/flow_difference_um_s"], np.hypot(*(flow - on_map)), rtol=1e-12)
    assert (found["/view/robot_flow"].map_error_share, found["/view/observation"].std_um_s) == (0.25, 2.0)
    along = found["/view/route_flow"]
    there = sample(field, route.waypoints_um)
    assert list(along.distance_um) == [0.0, 20.0] and list(along.std_um_s) == [3.0, 3.0]
    assert np.allclose(along.along_um_s, there[:, 1], rtol=1e-6) and np.allclose(along.map_um_s, np.hypot(*there.T))


def test_rerun_gets_no_view_that_stays_empty():
    fluid = np.zeros((24, 32), "<f4")
    fluid[5:9, 3:30] = 1.0  # rows 5 to 8, columns 3 to 29
    flow = dataclasses.replace(field_of(1, np.random.default_rng(2)), wall_px=fluid)
    demand = Demand(5, np.zeros(2), np.zeros(2), 0.0, math.nan, False, np.zeros((0, 2)))
    views = ViewerTopics()
    first = seen(views, {"assumed": flow, "demand": demand})
    points = np.frombuffer(first["/view/walls"].data, "<f4").reshape(-1, 4)[:, :2]
    edges = [(3, 5), (29, 8)] * np.array(1e-3 * flow.um_per_px)
    assert np.allclose((points.min(axis=0), points.max(axis=0)), edges, rtol=1e-6) and len(points) == 2 * (26 + 3)
    assert "/view/tracking_error_um" not in first, "a line of NaN"
    found = [seen(views, {"demand": replace(demand, error_um=error)}) for error in (3.0, math.nan)]
    assert found[0]["/view/tracking_error_um"] == 3.0 and math.isnan(found[1]["/view/tracking_error_um"])
    later = seen(views, {"refined": flow})
    at_once = [path for path, _, _ in ViewerTopics().of({"assumed": flow, "refined": flow})]
    assert at_once.count("/view/flow_refined") == 1
    pictures = [
        cv2.imdecode(np.frombuffer(each["/view/flow_refined"].data, np.uint8), cv2.IMREAD_COLOR)
        for each in (first, later)
    ]
    assert [picture.shape for picture in pictures] == [(24, 32, 3)] * 2 and first[
        "/view/flow_refined"
    ].frame_id == "map"
    grey = [(picture == picture[..., :1]).all() for picture in pictures]
    assert grey == [True, False] and pictures[0].any(), "words first, then the flow in colours"
    assert "/view/flow_refined_grid" not in first


def test_the_robot_is_where_it_is_when_protobuf_reads_its_views():
    for stamp_ns, x_um, y_um in ((0, 0.0, -0.0), (5 * 10**18 + 7, 1234.5, -2.0)):
        here = Estimate(stamp_ns, np.array([x_um, y_um]), np.zeros(2), np.eye(4), 1.0, np.zeros(2), True)
        found = seen(ViewerTopics(), {"estimate": here})
        for path in ("/view/robot_pose", "/camera/frame/robot"):
            place = found[path].pose.position
            assert np.allclose((place.x, place.y, place.z), (1e-3 * x_um, 1e-3 * y_um, 0.0), rtol=1e-12)
            assert (found[path].pose.orientation.w, found[path].frame_id) == (1.0, "chip")
            assert found[path].timestamp.seconds * 10**9 + found[path].timestamp.nanos == stamp_ns


def test_numbers_beyond_all_measure_are_drawn_without_a_warning():
    way_um = np.array([[0.0, 1e300], [np.nan, -np.inf]])
    with as_read():
        route = Route(1, 0, "x", True, "", way_um, np.arange(2.0))
        huge = np.full((4, 4, 2), 3e38, "<f4")
        field = dataclasses.replace(
            field_of(1, np.random.default_rng(0)),
            velocity_um_s=huge,
            um_per_px=np.nan,
            registration=np.full((2, 3), np.inf),
        )
        here = Estimate(1, way_um[0], way_um[1], np.eye(4), 1.0, way_um[0], True)
        made = Observations(1, way_um, way_um, np.array([1e300, np.nan]))
    messages = {"route": route, "refined": field, "estimate": here, "observations": made}
    views = ViewerTopics(ViewerScene(ChipCamera(Calibration(2.0), (64, 48), 10.0), 0))
    assert len(list(views.of(messages))) >= 12


def in_file(path):
    """The messages of viewer topics of a file in order: topic, log time and message; and the channels."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        return [
            (channel.topic, message.log_time, parsed(channel.topic, (message.data,)))
            for _, channel, message in reader.iter_messages()
            if channel.topic in _SCHEMAS
        ]


def test_each_file_of_a_run_with_windows_of_images_shows_the_robot_inside_the_window(session, tmp_path):
    recorded = Session(session)
    ticks = list(recorded.ticks())[:60]
    cut = replace(region_from({"region": "robot", "pad_px": "4", "full_every_s": "100"}), cut=True)
    write_session(tmp_path / "a.mcap", ticks, recorded.header, region=cut, files=Split(seconds=0.8))
    files = sorted(tmp_path.glob("a.part*.mcap"))
    start_ns, stated, windows = recorded.header.start_unix_ns, recorded.calibration, 0
    assert len(files) > 1
    for file in files:
        views = in_file(file)
        topics = [topic for topic, _, _ in views]
        assert topics[0] == "/view/frames" and {"/view/camera", "/view/robot_mark"} <= set(topics)
        first = {topic: message for topic, _, message in reversed(views)}
        marks = {log_ns: message for topic, log_ns, message in views if topic == "/view/robot_mark"}
        poses = {log_ns: message for topic, log_ns, message in views if topic == "/view/robot_pose"}
        for tick in Session(file).ticks():
            mark, pose = marks[start_ns + tick.stamp_ns].circles[0], poses[start_ns + tick.stamp_ns]
            assert pose.timestamp.ToNanoseconds() == mark.timestamp.ToNanoseconds() == start_ns + tick.stamp_ns
            expected = stated.to_px(tick.estimate.position_um) + 0.5
            assert np.allclose(point(mark.position)[:2], expected, atol=1e-6)
            assert np.allclose(projected(first, point(pose.pose.position)), expected, atol=0.01)
            x0, y0, x1, y1 = nonzero_window(tick.frame.image)
            assert x0 < expected[0] < x1 and y0 < expected[1] < y1
            windows += (x0, y0) != (0, 0)
    assert windows > 10


def test_images_say_in_which_frame_they_are(session):
    with session.open("rb") as stream:
        schema, _, message = next(make_reader(stream).iter_messages(topics=["/camera/frame"]))
    image = foxglove_schema(schema.name.removeprefix("foxglove.")).wire.FromString(message.data)
    assert image.frame_id == "camera"
