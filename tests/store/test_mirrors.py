"""Views for other programs."""

import numpy as np

from flowrec.messages import Estimate
from flowrec.store.mirrors import ROBOT_POINT, ROBOT_POSE, Mirrors
from flowrec.store.schemas import foxglove_schema


def test_the_robot_is_where_it_is_when_protobuf_reads_its_views():
    for stamp_ns, x_um, y_um in ((0, 0.0, -0.0), (5 * 10**18 + 7, 1234.5, -2.0)):
        here = Estimate(stamp_ns, np.array([x_um, y_um]), np.zeros(2), np.eye(4), 1.0, np.zeros(2), True)
        views = {mirror: view for mirror, _, view in Mirrors().of({"estimate": here})}
        for mirror in (ROBOT_POSE, ROBOT_POINT):
            seen = foxglove_schema(mirror.schema).wire.FromString(b"".join(views[mirror]))
            assert (seen.pose.position.x, seen.pose.position.y, seen.pose.position.z) == (x_um, y_um, 0.0)
            assert seen.pose.orientation.w == 1.0
            assert seen.timestamp.seconds * 10**9 + seen.timestamp.nanos == stamp_ns
