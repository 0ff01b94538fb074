"""Views for other programs."""

import dataclasses

import numpy as np

from flowrec.messages import Estimate, Route
from flowrec.store.schema import foxglove_schema
from flowrec.store.viewer_topics import ViewerTopics
from tests.store.made_up import field_of


def test_the_robot_is_where_it_is_when_protobuf_reads_its_views():
    for stamp_ns, x_um, y_um in ((0, 0.0, -0.0), (5 * 10**18 + 7, 1234.5, -2.0)):
        here = Estimate(stamp_ns, np.array([x_um, y_um]), np.zeros(2), np.eye(4), 1.0, np.zeros(2), True)
        views = {path: view for path, _, view in ViewerTopics().of({"estimate": here})}
        for path, schema in (("/view/robot_pose", "PoseInFrame"), ("/view/robot_point", "PointCloud")):
            seen = foxglove_schema(schema).wire.FromString(b"".join(views[path]))
            assert (seen.pose.position.x, seen.pose.position.y, seen.pose.position.z) == (x_um, y_um, 0.0)
            assert seen.pose.orientation.w == 1.0
            assert seen.timestamp.seconds * 10**9 + seen.timestamp.nanos == stamp_ns


def test_numbers_beyond_all_measure_are_drawn_without_a_warning():
    way_um = np.array([[0.0, 1e300], [np.nan, -np.inf]])
    route = Route(1, 0, "x", True, "", way_um, np.arange(2.0))
    field = dataclasses.replace(field_of(1, np.random.default_rng(0)), velocity_um_s=np.full((4, 4, 2), 3e38, "<f4"))
    assert len(list(ViewerTopics().of({"route": route, "refined": field}))) == 4
