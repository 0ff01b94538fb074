from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Estimate, Route, UsageError
from flowrec.physics import Robot, clearance_um, sample
from flowrec.stages import Controller, Planner, load_config
from flowrec.stages.control.controller import clearance_and_slope
from flowrec.stages.control.delay_compensation import CorrectedFlow
from flowrec.stages.control.policy import Policy, distance_to_known, steepest_descent
from flowrec.stages.control.tracking_laws import Situation
from flowrec.stages.planning.time_field import TimeField
from flowrec.store import SessionReader
from flowrec.verbs.record import record
from tests.short_missions import SMALL
from tests.stages.control.plant import field_of, fly, mission, straight
from tests.stages.planning import worlds

PX_UM = 50.0
GOAL_UM = np.array([2500.0, 2500.0])
V = 600.0
SWIMMER = Robot(radius_um=50.0, max_speed_um_s=V, step_out_hz=100.0, step_out_margin=1.0, delay_s=0.04)
POLICY = Controller(method="policy")


def zermelo_s(points_um, flow_um_s):
    """Time to go in uniform flow: the root of |goal - x - v T| = V T."""
    way = GOAL_UM - points_um
    wv, room = way @ flow_um_s, V**2 - flow_um_s @ flow_um_s
    return (np.sqrt(wv**2 + room * (way**2).sum(-1)) - wv) / room


def pixels_um(h=101, w=101):
    y, x = np.mgrid[0:h, 0:w] * PX_UM
    return np.stack([x, y], -1)


def homeward_route(time_to_go_s, goal_um=GOAL_UM, **changes):
    path = np.linspace(goal_um - [1000.0, 0.0], goal_um, 11)
    return replace(Route(0, 1, "time_field", True, "", path, 0.2 * np.arange(11), time_to_go_s), **changes)


def clearance_at(walls_um, point_px):
    return clearance_and_slope(walls_um, point_px)[0]


def arrival_s(run, goal_um, within_um):
    return float(run.time_s[np.argmax(np.hypot(*(run.position_um - goal_um).T) <= within_um)])


def seen_at(position, stamp=0, flow=(0.0, 0.0)):
    return Estimate(stamp, np.array(position, float), np.array(flow, float), np.eye(4), 2.0, np.zeros(2), True)


@pytest.mark.parametrize("flow", [(0.0, 0.0), (300.0, 0.0), (380.0, -380.0)])
def test_in_uniform_flow_the_policy_swims_as_zermelo_says(flow):
    flow = np.array(flow)
    times = zermelo_s(pixels_um(), flow).astype(np.float32)
    for point in np.random.default_rng(3).uniform(600.0, 4400.0, (40, 2)):
        if np.hypot(*(point - GOAL_UM)) < 500.0:
            continue
        best = GOAL_UM - point - flow * zermelo_s(point, flow)
        chosen = steepest_descent(times, PX_UM, point, 100.0, flow / V)
        assert chosen @ best / np.hypot(*best) > np.cos(np.radians(3.0))


@pytest.mark.parametrize(("flow_um_s", "frame_um"), [(0.0, 120.0), (300.0, 180.0)])
def test_the_goal_is_held_from_where_a_frame_would_take_the_robot_past_it(flow_um_s, frame_um):
    flow = np.array([flow_um_s, 0.0])
    route = homeward_route(zermelo_s(pixels_um(), flow).astype(np.float32), time_to_go_um_per_px=PX_UM)
    law, drift = Policy(kp_per_s=3.0, hold_radii=0.5), CorrectedFlow(None, flow)

    def heading(left_um):
        there = GOAL_UM - np.array([left_um, 0.0])
        now = Situation(
            None, mission(), route, seen_at(there), None, drift, SWIMMER, there, V, dt_s=0.2, um_per_px=PX_UM
        )
        return law.reference(now).heading

    assert heading(frame_um - 5.0) is None
    assert heading(frame_um + 5.0) is not None


@pytest.mark.parametrize("flow", [(0.0, 0.0), (300.0, 0.0), (380.0, -380.0)])
@pytest.mark.parametrize("left_um", [45.0, 60.0, 100.0, 200.0])
def test_up_to_where_it_holds_the_robot_it_swims_as_zermelo_says_also_from_within_a_radius_of_the_goal(flow, left_um):
    flow, fine_um = np.array(flow), 5.0
    corner_um = GOAL_UM - 250.0
    times = zermelo_s(corner_um + pixels_um() * fine_um / PX_UM, flow).astype(np.float32)
    route = homeward_route(times, GOAL_UM - corner_um, time_to_go_um_per_px=fine_um)
    law = Policy(kp_per_s=3.0, hold_radii=0.5)
    for angle in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False):
        point = GOAL_UM + left_um * np.array([np.cos(angle), np.sin(angle)])
        there, drift = point - corner_um, CorrectedFlow(None, flow)
        now = Situation(
            None, mission(), route, seen_at(there), None, drift, SWIMMER, there, V, dt_s=0.033, um_per_px=PX_UM
        )
        best = GOAL_UM - point - flow * zermelo_s(point, flow)
        assert law.reference(now).heading @ best / np.hypot(*best) > np.cos(np.radians(6.0))


@pytest.mark.parametrize(("flow", "start"), [((300.0, 0.0), (4200.0, 1000.0)), ((-380.0, 380.0), (700.0, 3900.0))])
def test_it_arrives_when_the_time_to_go_says_and_then_stays(flow, start):
    flow, start = np.array(flow), np.array(start)
    route = homeward_route(zermelo_s(pixels_um(), flow).astype(np.float32))
    told = field_of(lambda x, y: (flow[0] + 0.0 * x, flow[1] + 0.0 * x))
    planned = zermelo_s(start, flow)
    options = {"robot": SWIMMER, "noise_um": 3.0, "clearance": (None, PX_UM)}
    run = fly(POLICY, route, lambda x, y: flow, planned + 3.0, start, told, **options)
    # The command comes 40 ms late, and the last radius is left to the hold.
    assert arrival_s(run, GOAL_UM, 50.0) < 1.02 * planned + 0.04
    assert np.hypot(*(run.position_um[-1000:] - GOAL_UM).T).max() < 25.0
    assert max(np.hypot(*demand.velocity_um_s) for demand in run.demands) <= V * (1.0 + 1e-9)
    assert max(demand.error_um for demand in run.demands) == 0.0, "away from the route is no error"


@pytest.fixture(scope="module")
def ring():
    """Two branches with flows of their own, the planner's time to go from everywhere, and the walls."""
    chip, field = worlds.loop()
    robot = worlds.robot(speed_um_s=160.0)
    route = Planner(method="time_field").plan(field, (50.0, 200.0), (1350.0, 200.0), chip, robot)
    back = Planner(method="time_field").plan(field, (1350.0, 200.0), (50.0, 200.0), chip, robot)
    return chip, field, replace(robot, delay_s=0.04), route, back


@pytest.mark.parametrize("way", [0, pytest.param(1, marks=pytest.mark.slow("flies the other way"))])
def test_from_wherever_a_way_is_known_the_goal_is_reached_in_about_that_time_and_no_wall_is_touched(ring, way):
    chip, field, robot, *routes = ring
    route = routes[way]
    goal, px = route.waypoints_um[-1], chip.um_per_px
    walls = clearance_um(chip.mask, px)
    k = round(px / route.time_to_go_um_per_px)
    times = route.time_to_go_s[::k, ::k]  # at the pixels
    roomy = np.argwhere(np.isfinite(times) & (walls > 1.6 * robot.radius_um))
    for row, column in np.random.default_rng(way).choice(roomy, 4, replace=False):
        start, planned = np.array([column, row]) * px, float(times[row, column])
        options = {"robot": robot, "clearance": (walls, px)}
        run = fly(POLICY, route, lambda x, y: sample(field, (x, y)), 1.1 * planned + 0.5, start, field, **options)
        assert arrival_s(run, goal, robot.radius_um) < 1.03 * planned + 0.1
        assert min(clearance_at(walls, point / px) for point in run.position_um[::10]) > robot.radius_um


def test_between_two_ways_that_are_equally_fast_it_takes_one_of_them():
    # Round a wall across the middle: on the axis behind it the slope of T points at the wall.
    points = pixels_um() - [2500.0, 2500.0]
    corners = [np.array([0.0, 800.0]), np.array([0.0, -800.0])]
    goal = np.array([1500.0, 0.0])
    times = np.min([np.hypot(*(points - c).transpose(2, 0, 1)) + np.hypot(*(goal - c)) for c in corners], axis=0) / V
    for offset in (-20.0, 0.0, 20.0):
        heading = steepest_descent(times.astype(np.float32), PX_UM, np.array([1700.0, 2500.0 + offset]), 100.0)
        assert abs(heading[1]) > 0.6, "along the kink it would be 0"


def test_outside_of_what_it_knows_it_turns_back_and_says_how_far_it_has_strayed():
    times = zermelo_s(pixels_um(), np.zeros(2)).astype(np.float32)
    times[:, 60:] = np.inf
    lost = np.array([4000.0, 2000.0])
    np.testing.assert_allclose(steepest_descent(times, PX_UM, lost, 100.0), [-1.0, 0.0], atol=1e-9)
    assert distance_to_known(times, PX_UM, lost) == pytest.approx(4000.0 - 59 * PX_UM, abs=PX_UM)
    assert distance_to_known(times, PX_UM, np.array([1010.0, 1030.0])) == 0.0
    nowhere = np.full_like(times, np.inf)
    assert distance_to_known(nowhere, PX_UM, lost) == np.inf
    np.testing.assert_array_equal(steepest_descent(nowhere, PX_UM, lost, 100.0), [0.0, 0.0])


def test_blown_off_the_route_it_plans_nothing_anew_unless_no_way_is_known_there():
    times = zermelo_s(pixels_um(), np.zeros(2)).astype(np.float32)
    times[:20] = np.inf
    route, field = homeward_route(times), field_of(lambda x, y: (0.0 * x, 0.0 * x))
    for place, strayed in (((2500.0, 4500.0), False), ((2500.0, 500.0), True)):
        demand = POLICY.control(None, mission(), route, seen_at(place), field, SWIMMER, None, PX_UM)
        assert (demand.error_um > 6.0 * SWIMMER.radius_um) == strayed
        assert demand.velocity_um_s @ (GOAL_UM - place) > 0.9 * V * np.hypot(*(GOAL_UM - place))


def test_a_route_without_a_time_to_go_is_followed_as_by_vector():
    field, route = field_of(lambda x, y: (100.0 + 0.0 * x, 0.0 * x)), straight()
    demands = [
        controller.control(None, mission("survey"), route, seen_at((480.0, 2530.0)), field, SWIMMER, None, PX_UM)
        for controller in (POLICY, Controller())
    ]
    assert demands[0].same_as(demands[1])


def test_a_planner_that_does_not_know_the_time_to_go_is_refused_at_once():
    with pytest.raises(UsageError, match="time_field"):
        load_config(None, ["control.method=policy", "plan.method=astar_time"])
    assert load_config(None, ["control.method=policy", "plan.method=time_field"]).control.method == "policy"


def test_the_policy_is_refused_where_the_plan_is_one_of_least_energy():
    with pytest.raises(UsageError, match=r"plan\.cost = 'time', or control\.method = 'vector'"):
        load_config(None, ["control.method=policy", "plan.cost=energy"])
    assert load_config(None, ["control.method=vector", "plan.cost=energy"]).plan.cost == "energy"


def test_a_robot_out_of_sight_is_soon_asked_for_nothing_under_the_policy_too():
    route = homeward_route(zermelo_s(pixels_um(), np.zeros(2)).astype(np.float32))
    options = {"robot": SWIMMER, "clearance": (None, PX_UM), "blind": (0.5, 9.0)}
    run = fly(POLICY, route, lambda x, y: (0.0, 0.0), 4.0, (600.0, 600.0), None, **options)
    assert not run.demands[-1].velocity_um_s.any()


def test_a_route_without_a_time_to_go_is_told_to_who_asked_for_the_policy(tmp_path, monkeypatch):
    monkeypatch.setattr(TimeField, "_with_time_to_go", lambda self, route, *others: route)
    for method, told in (("policy", 1), ("vector", 0)):
        sets = [*SMALL, f"control.method={method}", "mission.phases=plan"]
        done = record(load_config(None, sets), tmp_path / f"{method}.mcap")
        events = [event for event in SessionReader(done.path).messages("event") if "no time to go" in event.text]
        assert [event.level for event in events] == told * ["warning"]
