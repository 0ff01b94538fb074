import sys

import numpy as np
import pytest

from flowrec.core import UsageError
from flowrec.stages import Planner
from flowrec.stages.planning.planner import RrtSettings
from tests.extras import why
from tests.stages.planning.worlds import loop, robot

EAST, WEST = (1330.0, 205.0), (60.0, 205.0)


def test_trees_find_a_way_the_same_one_every_time_and_the_star_a_faster_one_but_none_beats_the_time_field():
    pytest.importorskip("ompl", reason=why("ompl"))
    chip, field = loop()
    tree = Planner(method="rrt", rrt=RrtSettings(iterations=3000))
    first, again = (tree.plan(field, EAST, WEST, chip, robot(200.0)) for _ in range(2))
    np.testing.assert_array_equal(first.waypoints_um, again.waypoints_um)
    star = Planner(method="rrt_star", rrt=RrtSettings(iterations=1500)).plan(field, EAST, WEST, chip, robot(200.0))
    best = Planner(robust_deviations=0.0).plan(field, EAST, WEST, chip, robot(200.0))
    assert first.reachable and star.reachable
    assert best.arrival_s[-1] < star.arrival_s[-1] < first.arrival_s[-1]
    few = Planner(method="rrt", rrt=RrtSettings(iterations=5)).plan(field, EAST, WEST, chip, robot(200.0))
    assert not few.reachable and "5 iterations" in few.reason


def test_without_ompl_the_trees_say_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    monkeypatch.delitem(sys.modules, "flowrec.stages.planning.rrt", raising=False)
    chip, field = loop()
    with pytest.raises(UsageError, match=r"pip install 'flowrec\[ompl\]'"):
        Planner(method="rrt").plan(field, EAST, WEST, chip, robot(200.0))
