import numpy as np

from flowrec.stages import refine_path, travel_time
from flowrec.stages.planning.cost_rasters import CostRasters
from tests.stages.planning.worlds import field_of, open_water


def test_a_refined_path_takes_less_time_and_keeps_its_ends():
    even = np.ones((80, 120))
    y = np.mgrid[0:80, 0:120][0]
    vx, vy = 6.0 * np.sin(y / 9.0), np.zeros((80, 120))
    path = np.array([[10.0, 10.0], [60.0, 70.0], [110.0, 10.0]])
    rasters = CostRasters(even > 0.0, 50.0 * even, 1.0, vx, vy, 10.0 * even)
    straightened = refine_path(path, rasters)
    field = field_of(open_water(), 10.0 * vx)
    assert travel_time(field, straightened * 10.0, 100.0)[0][-1] < 0.75 * travel_time(field, path * 10.0, 100.0)[0][-1]
    np.testing.assert_allclose(straightened[[0, -1]], path[[0, -1]])


def test_a_refined_path_keeps_the_clearance_that_it_had_or_that_is_needed():
    y = np.mgrid[0:60, 0:120][0]
    one = np.ones((60, 120))
    clearance = np.minimum(y - 9.5, 50.5 - y)  # a channel; the flow against the path is slowest along its walls
    flow = -8.0 * np.maximum(1.0 - ((y - 30.0) / 20.5) ** 2, 0.0)
    rasters = CostRasters(clearance >= 4.0, clearance, 4.0, flow, 0.0 * one, 10.0 * one)
    path = np.array([[5.0, 30.0], [60.0, 30.0], [115.0, 30.0]])
    refined = refine_path(path, rasters)
    lowest = np.interp(refined[:, 1], np.arange(60.0), clearance[:, 0]).min()
    assert 4.0 - 1e-6 <= lowest < 6.0, "it goes to the wall, and no nearer than the robot may"
    np.testing.assert_allclose(refined[[0, -1]], path[[0, -1]])
