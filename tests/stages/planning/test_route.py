import itertools

import numpy as np
import pytest

from flowrec.stages import travel_time
from flowrec.stages.planning.route import too_fast
from tests.stages.planning.worlds import channel, field_of, open_water, poiseuille


def test_travel_time_does_not_depend_on_how_densely_the_path_is_marked():
    field = poiseuille(channel(), 80.0)
    corners = np.array([[100.0, 120.0], [400.0, 260.0], [700.0, 195.0], [1100.0, 130.0]])
    times = []
    for count in (1, 7, 60, 1000):
        share = np.arange(count)[:, None] / count
        legs = [a + share * (b - a) for a, b in itertools.pairwise(corners)]
        times.append(travel_time(field, np.concatenate([*legs, corners[-1:]]), 100.0)[0][-1])
    np.testing.assert_allclose(times, times[-1], rtol=1e-3)


def test_travel_time_agrees_with_a_robot_that_is_stepped_along_the_path():
    field = field_of(open_water(), lambda x, y: 0.05 * y, lambda x, y: -0.03 * x)
    path = np.array([[100.0, 600.0], [1000.0, 200.0]])
    unit = (path[1] - path[0]) / np.hypot(*(path[1] - path[0]))
    position, elapsed, dt = path[0].copy(), 0.0, 1e-3
    while (path[1] - position) @ unit > 0:
        flow = np.array([0.05 * position[1], -0.03 * position[0]])
        across = flow - (flow @ unit) * unit
        position = position + dt * (flow - across + np.sqrt(100.0**2 - across @ across) * unit)
        elapsed += dt
    arrival, feasible = travel_time(field, path, 100.0)
    assert feasible and arrival[-1] == pytest.approx(elapsed, rel=1e-3)


def test_what_can_not_be_done_takes_for_ever_from_there_on():
    field = field_of(open_water(), lambda x, y: np.where(x > 500.0, -150.0, 0.0))
    arrival, feasible = travel_time(field, np.array([[100.0, 300.0], [400.0, 300.0], [800.0, 300.0]]), 100.0)
    assert not feasible and arrival[1] == pytest.approx(3.0) and arrival[2] == np.inf
    sideways = field_of(open_water(), 0.0, 150.0)
    assert not travel_time(sideways, np.array([[100.0, 300.0], [400.0, 300.0]]), 100.0)[1]


def test_to_stay_where_one_is_takes_no_time_also_where_the_flow_is_faster_than_the_robot():
    field = field_of(open_water(), lambda x, y: np.where(x > 500.0, -150.0, 0.0))
    arrival, feasible = travel_time(field, np.array([[800.0, 300.0], [800.0, 300.0]]), 100.0)
    assert feasible and arrival.tolist() == [0.0, 0.0]
    path = np.array([[100.0, 300.0], [100.0, 300.0], [200.0, 300.0], [200.0, 300.0]])
    assert travel_time(field, path, 100.0)[0] == pytest.approx([0.0, 0.0, 1.0, 1.0])


def test_the_place_where_the_flow_is_too_fast_is_named_by_x_and_then_y():
    field = field_of(open_water(), lambda x, y: -50.0 - 100.0 * ((x > 295.0) & (x < 325.0)))
    said = too_fast(field, np.array([[100.0, 200.0], [500.0, 200.0]]), 80.0)
    x_um, y_um = map(float, said.split(" at ")[1].split(" um")[0].split(","))
    assert 290.0 < x_um < 330.0 and y_um == 200.0 and said.startswith("the flow is too fast: 150 um/s")
