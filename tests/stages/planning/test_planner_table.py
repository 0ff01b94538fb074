"""What every row of PLANNERS promises."""

from dataclasses import fields, replace

import numpy as np
import pytest

from flowrec.core import UsageError, bilinear
from flowrec.physics import clearance_um
from flowrec.stages import PLANNERS, Planner, load_config, travel_time
from flowrec.stages.planning.free_space import FastFlowMargin
from tests.stages.planning.worlds import PX, channel, chip_of, field_of, length_um, loop, open_water, robot

EAST, WEST = (1330.0, 205.0), (60.0, 205.0)


def lowest_clearance_um(chip, route):
    clearance = clearance_um(chip.mask, PX).astype(float)
    return min(bilinear(clearance, *(point / PX)) for point in route.waypoints_um)


def test_in_still_fluid_the_goal_is_reached_by_nearly_the_straight_line(any_planner):
    mask = open_water()
    start, goal = (200.0, 250.0), (950.0, 620.0)
    route = any_planner.plan(field_of(mask, 0.0), start, goal, chip_of(mask), robot())
    straight = float(np.hypot(750.0, 370.0))
    assert route.reachable and route.method == any_planner.method
    np.testing.assert_allclose(route.waypoints_um[[0, -1]], [start, goal])
    # A tree keeps the corners of its random samples; the paper's A* prefers a few directions, as may that of a package.
    row = PLANNERS[any_planner.method]
    limit = 1.5 if row.extra or row.source else 1.03
    assert straight - 1e-6 <= length_um(route) <= limit * straight
    assert route.arrival_s[-1] == pytest.approx(length_um(route) / 85.0)


def test_a_route_keeps_the_margin_from_the_walls_and_its_times_are_the_models(any_planner):
    chip, field = loop()
    for start, goal in ((WEST, EAST), (EAST, (700.0, 705.0))):
        route = any_planner.plan(field, start, goal, chip, robot(200.0, radius_um=20.0))
        assert route.reachable, route.reason
        assert "margin" not in route.reason, "there is room for the whole margin, half of the radius"
        assert lowest_clearance_um(chip, route) >= 30.0 - 1e-6
        assert np.hypot(*np.diff(route.waypoints_um, axis=0).T).max() <= PX + 1e-9
        assert route.arrival_s[0] == 0.0 and (np.diff(route.arrival_s) > 0.0).all()
        arrival, feasible = travel_time(field, route.waypoints_um, 0.85 * 200.0)
        assert feasible
        np.testing.assert_array_equal(arrival, route.arrival_s)


def test_more_clearance_is_kept_where_it_is_asked_for_and_where_the_flow_is_fast(any_planner):
    mask = channel()
    chip, ends = chip_of(mask), ((100.0, 195.0), (1000.0, 195.0))
    wide = replace(any_planner, clearance_margin_um=60.0).plan(field_of(mask, 20.0), *ends, chip, robot(100.0))
    assert wide.reachable and lowest_clearance_um(chip, wide) >= 70.0 - 1e-6
    margin = FastFlowMargin(map_error=0.2, heading_error_rad=0.1, frame_s=0.05, latency_s=0.05)
    fast = replace(any_planner, swift=margin).plan(field_of(mask, 2500.0), *ends, chip, robot(600.0))
    assert not fast.reachable and "too swift to be steered at" in fast.reason


@pytest.mark.parametrize(
    ("start", "goal", "flow", "reason"),
    [
        ((100.0, 130.0), (1000.0, 130.0), -500.0, "flow"),
        ((100.0, 130.0), (300.0, 20.0), 0.0, "goal 300,20 um is in a wall"),
        ((300.0, 20.0), (100.0, 130.0), 0.0, "start 300,20 um is in a wall"),
        ((100.0, 130.0), (9000.0, 130.0), 0.0, "goal 9000,130 um is outside"),
        ((100.0, 130.0), (800.0, 270.0), 0.0, "no channel leads from start to goal"),
    ],
)
def test_a_goal_that_can_not_be_reached_has_a_reason_and_no_waypoints(any_planner, start, goal, flow, reason):
    mask = channel()
    mask[18:22] = False  # two channels
    route = any_planner.plan(field_of(mask, flow), start, goal, chip_of(mask), robot())
    assert not route.reachable and reason in route.reason.replace("rrt_star found no way", "flow")
    assert len(route.waypoints_um) == len(route.arrival_s) == 0 and route.time_to_go_s is None


def test_the_same_problem_has_the_same_route(any_planner):
    chip, field = loop()
    first, second = (any_planner.plan(field, EAST, WEST, chip, robot(200.0)) for _ in range(2))
    assert first.waypoints_um.tobytes() == second.waypoints_um.tobytes()
    assert first.arrival_s.tobytes() == second.arrival_s.tobytes() and first.reason == second.reason


def test_a_field_of_another_chip_is_an_error(any_planner):
    mask = open_water()
    with pytest.raises(UsageError, match="chip"):
        any_planner.plan(field_of(open_water(10, 10), 0.0), (200.0, 250.0), (900.0, 600.0), chip_of(mask), robot())


def test_what_a_row_says_of_time_to_go_and_energy_is_true(any_planner):
    mask, row = channel(), PLANNERS[any_planner.method]
    world = field_of(mask, 10.0), (100.0, 195.0), (900.0, 195.0), chip_of(mask), robot()
    assert (any_planner.plan(*world).time_to_go_s is not None) == ("time_to_go" in row.provides)
    thrifty = replace(any_planner, cost="energy", idle_speed_um_s=10.0)
    if "cost" in row.options:
        assert thrifty.plan(*world).arrival_s[-1] > 1.5 * any_planner.plan(*world).arrival_s[-1]
    else:
        with pytest.raises(UsageError, match=f"{row.name} .*method = 'time_field'"):
            thrifty.plan(*world)


def test_the_options_of_a_row_are_settings_of_the_planner_and_fields_of_its_class(any_planner):
    row = PLANNERS[any_planner.method]
    assert set(row.options) <= {field.name for field in fields(any_planner)}
    assert row.source or row.options == tuple(field.name for field in fields(row.load()))


def test_an_unknown_method_is_an_error_everywhere():
    mask = open_water()
    world = field_of(mask, 0.0), (200.0, 250.0), (900.0, 600.0), chip_of(mask), robot()
    for call in (
        lambda: Planner(method="astar_tme").plan(*world),
        lambda: load_config(None, ["plan.method=astar_tme"]),
    ):
        with pytest.raises(UsageError, match=r"plan\.method = 'astar_tme'.* astar_time$"):
            call()
