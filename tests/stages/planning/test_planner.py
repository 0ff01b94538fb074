import math
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import FlowError, UsageError, as_read
from flowrec.stages import Planner
from tests.stages.planning.worlds import PX, channel, chip_of, field_of, length_um, loop, open_water, poiseuille, robot

START, GOAL = np.array([200.0, 250.0]), np.array([950.0, 620.0])


def zermelo_s(leg, flow, speed):
    """Closed form in a uniform flow: |leg - flow T| = speed T."""
    along, left = float(leg @ flow), speed**2 - float(flow @ flow)
    root = math.sqrt(along**2 + left * float(leg @ leg))
    return (root - along) / left if left else float(leg @ leg) / (2 * along)


@pytest.mark.parametrize("flow", [(0.0, 0.0), (60.0, 0.0), (-50.0, 40.0), (20.0, -70.0), (100.0, 90.0)])
def test_in_a_uniform_flow_the_plan_takes_zermelos_time(flow):
    mask = open_water()
    route = Planner(speed_share=1.0).plan(field_of(mask, *flow), START, GOAL, chip_of(mask), robot())
    assert route.reachable, route.reason
    assert route.arrival_s[-1] == pytest.approx(zermelo_s(GOAL - START, np.array(flow), 100.0), rel=0.003)
    np.testing.assert_allclose(route.waypoints_um[[0, -1]], [START, GOAL])
    assert (np.diff(route.arrival_s) > 0).all()


@pytest.mark.parametrize("sign", [1.0, pytest.param(-1.0, marks=pytest.mark.slow("the same shear, mirrored"))])
def test_in_a_linear_shear_the_plan_is_within_one_percent_of_the_shooting_solution(sign):
    # v = (s y, 0): along the fastest way the heading turns as phi' = -s cos^2 phi (Zermelo's navigation formula).
    mask, rate, speed = open_water(120, 160), 0.4 * sign, 100.0
    start, goal = np.array([150.0, 600.0]), np.array([1400.0, 600.0])
    field = field_of(mask, lambda x, y: rate * (y - 600.0))
    best = np.inf
    for phi in np.linspace(-np.pi, np.pi, 1441):
        (x, y), dt, heading = start, 0.02, phi
        for step in range(1, 1500):
            x += dt * (speed * math.cos(heading) + rate * (y - 600.0))
            y += dt * speed * math.sin(heading)
            heading -= dt * rate * math.cos(heading) ** 2
            if step * dt >= best or math.hypot(x - goal[0], y - goal[1]) < 8.0:
                break
        else:
            continue
        if math.hypot(x - goal[0], y - goal[1]) < 8.0:
            best = min(best, step * dt + math.hypot(x - goal[0], y - goal[1]) / (speed + 50.0))
    route = Planner(speed_share=1.0).plan(field, start, goal, chip_of(mask), robot(speed))
    assert best < 0.75 * 12.5, "bending into the helping flow beats the straight way"
    assert route.arrival_s[-1] == pytest.approx(best, rel=0.01)


def test_upstream_the_plan_takes_the_slow_long_branch_and_downstream_the_fast_short_one():
    chip, field = loop()
    west, east = (60.0, 205.0), (1330.0, 205.0)
    down = Planner().plan(field, west, east, chip, robot(200.0))
    up = Planner().plan(field, east, west, chip, robot(200.0))
    shortest = Planner(method="astar_length").plan(field, east, west, chip, robot(200.0))
    assert down.waypoints_um[:, 1].max() < 300.0 and shortest.waypoints_um[:, 1].max() < 300.0
    assert up.waypoints_um[:, 1].max() > 600.0
    assert up.arrival_s[-1] < shortest.arrival_s[-1]
    assert length_um(up) > 1.5 * length_um(down)


def test_upstream_in_a_channel_the_plan_hugs_the_wall_and_beats_the_paper_and_the_shortest_way():
    mask = channel()
    field, chip = poiseuille(mask, 80.0), chip_of(mask)
    times = {
        method: Planner(method=method).plan(field, (1100.0, 195.0), (100.0, 195.0), chip, robot()).arrival_s[-1]
        for method in ("astar_time", "astar_paper", "astar_length")
    }
    assert times["astar_time"] < times["astar_paper"] < times["astar_length"]
    down = Planner().plan(field, (100.0, 195.0), (1100.0, 195.0), chip, robot())
    assert np.abs(down.waypoints_um[:, 1] - 195.0).max() < 15.0, "downstream the middle is fastest"


def test_a_current_faster_than_the_robot_is_named_as_the_reason():
    mask = channel()
    route = Planner().plan(field_of(mask, 150.0), (1100.0, 195.0), (100.0, 195.0), chip_of(mask), robot())
    assert not route.reachable and len(route.waypoints_um) == len(route.arrival_s) == 0
    assert "150 um/s at" in route.reason and "85 um/s" in route.reason
    assert Planner().plan(field_of(mask, 150.0), (100.0, 195.0), (1100.0, 195.0), chip_of(mask), robot()).reachable


def test_the_margin_is_given_up_where_there_is_no_room_for_it_and_the_narrowest_place_is_named_where_none_is():
    mask = channel(h=40, w=120, wall=8)
    mask[:16, 60:64] = mask[24:, 60:64] = False  # a gap of 8 px
    field, chip = field_of(mask, 10.0), chip_of(mask)
    tight = Planner().plan(field, (100.0, 195.0), (1100.0, 195.0), chip, robot(radius_um=30.0))
    assert tight.reachable and "15 um" in tight.reason
    stuck = Planner().plan(field, (100.0, 195.0), (1100.0, 195.0), chip, robot(radius_um=50.0))
    assert not stuck.reachable and "narrow at 6" in stuck.reason and "50 um" in stuck.reason


def test_a_robot_pushed_to_the_wall_is_led_away_from_it_with_a_remark():
    mask = channel()
    plan = Planner(clearance_margin_um=15.0)
    route = plan.plan(field_of(mask, 10.0), (300.0, 81.0), (900.0, 195.0), chip_of(mask), robot(radius_um=30.0))
    assert route.reachable and "start 300,81 um is only 6 um" in route.reason
    np.testing.assert_allclose(route.waypoints_um[0], [300.0, 81.0])
    beyond = route.waypoints_um[np.abs(route.waypoints_um[:, 0] - 300.0) > 60.0]
    assert beyond[:, 1].min() >= 75.0 + 30.0 - 1e-6
    # A goal there is not the robot's to reach: the route ends at the nearest place with room.
    route = plan.plan(field_of(mask, 10.0), (900.0, 195.0), (300.0, 95.0), chip_of(mask), robot(radius_um=30.0))
    assert route.reachable and "goal 300,95 um is only 20 um" in route.reason
    assert route.waypoints_um[-1, 1] >= 75.0 + 30.0 - 1e-6


def test_start_and_goal_in_one_place_are_a_route_of_no_time():
    mask = open_water()
    route = Planner().plan(field_of(mask, 10.0), (303.0, 304.0), (303.0, 304.0), chip_of(mask), robot())
    assert route.reachable and route.arrival_s[-1] == 0.0


def test_a_broken_field_and_a_robot_without_speed_are_errors():
    mask = open_water()
    field, chip = field_of(mask, 10.0), chip_of(mask)
    bad = np.array(field.velocity_um_s)
    bad[5, 5, 0] = np.nan
    with as_read():
        broken = type(field)(0, 0, "broken", PX, bad, field.pressure_pa, None, np.zeros(0), 1.0, 1000.0, "")
    with pytest.raises(FlowError, match="not finite"):
        Planner().plan(broken, START, GOAL, chip, robot())
    with pytest.raises(UsageError, match="no speed"):
        Planner(speed_share=0.0).plan(field, START, GOAL, chip, robot())


def test_a_robot_that_was_found_to_roll_less_per_revolution_is_planned_with_as_the_slower_one_it_is():
    mask = channel()
    chip, field, ends = chip_of(mask), field_of(mask, 20.0), ((1100.0, 195.0), (100.0, 195.0))

    def duration_s(change, std, speed_um_s=100.0, swimmer=None):
        found = replace(field, parameter_names="depth_um; um_per_rev_share", parameters=[90.0, change])
        found = replace(found, parameter_std=[9.0, std])
        return Planner().plan(found, *ends, chip, swimmer or robot(speed_um_s)).arrival_s[-1]

    usual = duration_s(0.0, 0.01)
    assert duration_s(-0.2, 0.02) == pytest.approx(duration_s(0.0, 0.01, 80.0))
    assert duration_s(-0.2, 0.15) == duration_s(0.2, 0.02) == usual
    steps_out = replace(robot(), step_out_hz=80.0 / robot().um_per_rev)  # no plan needs more than was stated
    assert duration_s(0.2, 0.02, swimmer=steps_out) == duration_s(0.0, 0.01, swimmer=steps_out) > usual
