"""Laws, pace and limits in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Demand, Estimate, Route
from flowrec.stages import CONTROLLERS, Controller
from flowrec.stages.control.delay_compensation import CorrectedFlow, corrected_flow
from flowrec.stages.control.tracking_laws import (
    FeedforwardFeedback,
    LiteralFeedforwardFeedback,
    Situation,
    compensate_flow,
)
from flowrec.stages.control.trajectory import feasible_pace, follow, nearest_time
from tests.stages.control.plant import ROBOT, field_of, fly, mission, straight

STILL = field_of(lambda x, y: (0.0 * x, 0.0 * y))
WEAK = replace(ROBOT, max_speed_um_s=300.0)


def seen_at(position, stamp=0, flow=(0.0, 0.0)):
    return Estimate(stamp, np.array(position, float), np.array(flow, float), np.eye(4), 2.0, np.zeros(2), True)


def after_a_frame(controller, route, position, field, robot=ROBOT, strength=1.0, flow=(0.0, 0.0)):
    """The demand on the second frame: on the first the phase has only begun."""
    first = controller.control(None, mission(), route, seen_at(position, 1, flow), field, robot, None, 50.0)
    later = seen_at(position, 33_000_001, flow)
    return controller.control(first, mission(), route, later, field, robot, None, 50.0, strength)


@pytest.mark.parametrize("seed", range(5))
def test_away_from_the_cut_of_angles_the_law_is_that_of_the_paper(seed):
    rng = np.random.default_rng(seed)
    wanted, flow = rng.uniform(100.0, 300.0, 2), rng.uniform(-50.0, 50.0, 2)
    error, dt_s, gain_per_s = rng.uniform(5.0, 40.0, 2), 1 / 30, 3.0
    e = error - flow * dt_s
    course = np.arctan2(*wanted[::-1])
    along, across = np.abs(np.array([[np.cos(course), np.sin(course)], [-np.sin(course), np.cos(course)]]) @ e)
    headings = np.arctan2(*(wanted - flow)[::-1]), np.arctan2(*e[::-1])
    heading = (along * headings[0] + across * headings[1]) / (along + across)
    speed = np.hypot(*(wanted - flow)) + gain_per_s * (e[0] * np.cos(heading) + e[1] * np.sin(heading))
    for kind in (FeedforwardFeedback, LiteralFeedforwardFeedback):
        demand = kind(gain_per_s).law(error, wanted, flow, dt_s)
        np.testing.assert_allclose(demand, speed * np.array([np.cos(heading), np.sin(heading)]))


def test_as_printed_the_mean_of_two_headings_near_180_degrees_points_the_other_way():
    moving, still = np.array([-300.0, 0.0]), np.zeros(2)
    ahead = np.array([-300.0, 0.1])  # pi less a little, while the error points to -pi and a little
    error = np.array([-20.0, -20.0])
    laws = [kind(1.0).law for kind in (FeedforwardFeedback, LiteralFeedforwardFeedback)]
    assert laws[0](error, ahead, still, 0.0)[0] < -200.0
    assert laws[1](error, ahead, still, 0.0)[0] > 0.0
    # Away from the cut they are one and the same.
    pair = [law(-error, -moving, still, 0.0) for law in laws]
    np.testing.assert_allclose(pair[0], pair[1])


@pytest.mark.parametrize("method", list(CONTROLLERS))
@pytest.mark.parametrize("strength", [1.0, 0.4, 0.0])
def test_no_law_ever_asks_for_more_than_the_field_of_the_moment_can_drive(method, strength):
    controller = Controller(method=method)
    limit = min(300.0, strength * WEAK.step_out_margin * WEAK.step_out_hz * WEAK.um_per_rev)
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:101, 0:101] * 50.0
    route = replace(straight(), time_to_go_s=np.hypot(3500.0 - x, 2500.0 - y) / 300.0)
    field = field_of(lambda x, y: (200.0 + 0.0 * x, 350.0 + 0.0 * x))
    for position in rng.uniform(300.0, 4700.0, (12, 2)):
        demand = after_a_frame(controller, route, position, field, WEAK, strength, flow=(210.0, 330.0))
        assert np.hypot(*demand.velocity_um_s) <= limit * (1.0 + 1e-9)
        assert np.isfinite(demand.velocity_um_s).all()


def test_the_laws_differ_in_the_flow_that_they_make_up_for():
    field = field_of(lambda x, y: (0.0 * x, 100.0 + 0.0 * x))
    position, observed = (520.0, 2510.0), (0.0, 60.0)

    def demand(method, told):
        made = after_a_frame(Controller(method=method), straight(), position, told, flow=observed)
        return made.velocity_um_s

    np.testing.assert_allclose(demand("ff_fb_no_flow", field), demand("ff_fb", STILL))
    np.testing.assert_allclose(demand("ff_fb_observer", field), demand("ff_fb", None))
    np.testing.assert_allclose(demand("ff_fb_observer", STILL), demand("ff_fb", None))
    assert not np.allclose(demand("ff_fb", field), demand("ff_fb", STILL))


@pytest.mark.parametrize(
    ("flow", "pace"),
    [
        ((0.0, 0.0), 0.5),  # 300 um/s of 600
        ((-100.0, 0.0), 1.0 / 3.0),
        ((400.0, 0.0), 1.0),
        ((0.0, 180.0), 0.4),  # 3-4-5
        ((0.0, 400.0), 0.0),  # swept away sideways: it asks least of the robot to stay
        ((-500.0, 0.0), 0.0),
    ],
)
def test_the_pace_of_the_reference_is_the_fastest_that_the_robot_can_keep(flow, pace):
    planned, flow = np.array([600.0, 0.0]), np.array(flow)
    found = feasible_pace(planned, flow, 300.0, 1.0)
    assert found == pytest.approx(pace)
    assert feasible_pace(np.zeros(2), flow, 300.0, 1.0) == 1.0
    assert feasible_pace(planned, flow, 300.0, 0.2) <= 0.2


def test_a_reference_faster_than_the_robot_is_slowed_before_the_robot_is_lost():
    route = straight(speed_um_s=500.0)
    head_on = field_of(lambda x, y: (-100.0 + 0.0 * x, 0.0 * x))
    ungoverned = Controller(lag_free_radii=1e9, lag_full_radii=2e9)
    run = fly(ungoverned, route, lambda x, y: (-100.0, 0.0), 18.0, (500.0, 2500.0), head_on, robot=WEAK)
    late = [demand for demand in run.demands if demand.stamp_ns > 2e9]
    assert max(demand.error_um for demand in late) < 25.0
    assert run.demands[-1].progress_s == route.arrival_s[-1]
    lost = fly(
        replace(ungoverned, pace_share=1e9),
        route,
        lambda x, y: (-100.0, 0.0),
        6.0,
        (500.0, 2500.0),
        head_on,
        robot=WEAK,
    )
    assert lost.demands[-1].error_um > 1000.0


def test_in_a_flow_stronger_than_the_robot_the_reference_is_not_left_behind_for_ever():
    route = straight(speed_um_s=100.0, start_um=(3000.0, 2500.0), length_um=1000.0)
    field = field_of(lambda x, y: (-400.0 + 0.0 * x, 0.0 * x))
    run = fly(Controller(), route, lambda x, y: (-400.0, 0.0), 3.0, (3000.0, 2500.0), field, robot=WEAK)
    assert run.demands[-1].progress_s < 0.2, "it waits where the robot was swept from"
    assert all(np.hypot(*demand.velocity_um_s) <= 300.0 + 1e-9 for demand in run.demands)


def test_a_path_of_one_point_is_a_place_to_hold_and_one_of_none_is_no_route():
    point = Route(0, 1, "point", True, "", [[2600.0, 2450.0]], [0.0])
    run = fly(Controller(), point, lambda x, y: (60.0, -20.0), 4.0, (2500.0, 2500.0), None, robot=WEAK)
    assert np.hypot(*(run.position_um[-500:] - [2600.0, 2450.0]).T).max() < 5.0
    nothing = Route(0, 1, "nothing", True, "", np.zeros((0, 2)), np.zeros(0))
    for method in list(CONTROLLERS):
        demand = after_a_frame(Controller(method=method), nothing, (2500.0, 2500.0), STILL)
        np.testing.assert_allclose(demand.reference_um, [2500.0, 2500.0])
        assert np.isfinite(after_a_frame(Controller(method=method), point, (2500.0, 2500.0), STILL).velocity_um_s).all()


def test_a_route_that_begins_far_away_waits_for_the_robot_at_its_beginning():
    route = straight(speed_um_s=200.0)
    run = fly(Controller(), route, lambda x, y: (0.0, 0.0), 12.0, (1500.0, 3500.0), STILL, robot=WEAK)
    on_the_way = [demand for demand in run.demands if demand.error_um > 200.0]
    assert max(demand.progress_s for demand in on_the_way) < 0.01
    assert run.demands[-1].progress_s > 5.0 and run.demands[-1].error_um < 10.0


@pytest.mark.parametrize("behind_um", [0.0, 60.0, 90.0, 120.0, 300.0])
def test_where_the_reference_will_be_and_how_fast_it_goes_agree_whatever_its_pace(behind_um):
    route, delay_s = straight(speed_um_s=200.0), 0.2
    robot, place = replace(ROBOT, delay_s=delay_s), np.array([1500.0 - behind_um, 2500.0])
    before = Demand(1, np.zeros(2), place, 5.0, 0.0, False, np.zeros((0, 2)))
    still = CorrectedFlow(None, np.zeros(2))
    now = Situation(before, mission(), route, seen_at(place, 33_000_001), None, still, robot, place, 600.0, 0.033, 50.0)
    reference = follow(now, route, 25.0, 150.0, 0.95)
    paces = np.clip((150.0 - behind_um) / 125.0, 0.0, 1.0)
    np.testing.assert_allclose(reference.velocity_um_s, [200.0 * paces, 0.0], atol=1e-6)
    np.testing.assert_allclose(reference.position_um, [1500.0 + 0.033 * 200.0 * paces, 2500.0])
    np.testing.assert_allclose(
        reference.future_um - reference.position_um, delay_s * reference.velocity_um_s, atol=1e-6
    )


def test_the_place_on_a_route_nearest_to_a_robot_is_that_of_the_projection():
    route = straight(speed_um_s=300.0)
    assert nearest_time(route, np.array([1234.0, 2700.0])) == pytest.approx((1234.0 - 500.0) / 300.0)
    assert nearest_time(route, np.array([0.0, 0.0])) == 0.0


def test_an_observer_that_knows_the_map_is_not_thought_to_lag_behind_it():
    corner = field_of(lambda x, y: (300.0 * (x < 2500.0), 300.0 * (x >= 2500.0)))
    place, sent = np.array([2575.0, 2525.0]), np.array([[400.0, -300.0]])
    corrected = Estimate(0, place, np.array([20.0, 330.0]), np.diag([1.0, 1.0, 4.0, 4.0]), 2.0, place, True)
    np.testing.assert_allclose(corrected_flow(corner, corrected, sent, 0.3, 0.0).at(place), [20.0, 330.0], atol=1.0)
    doubted = corrected_flow(corner, corrected, sent, 0.3, 0.3).at(place)
    assert np.hypot(*(doubted - [0.0, 300.0])) < 10.0, "as one that lags it is hardly believed just behind a corner"


def test_the_demand_makes_up_for_the_flow_that_an_observer_finds_on_the_map_and_hardly_for_that_of_one_that_lags():
    corner = field_of(lambda x, y: (300.0 * (x < 2500.0), 300.0 * (x >= 2500.0)))
    place, sent = np.array([2575.0, 2525.0]), np.array([[400.0, -300.0]])
    before = Demand(1, sent[0], place, 0.0, 0.0, False, sent)
    estimate = Estimate(33_000_001, place, np.array([20.0, 330.0]), np.diag([1.0, 1.0, 4.0, 4.0]), 2.0, place, True)

    def made_up_for(knows_map):
        law = Controller(map_error=0.3, kp_per_s=0.0, observer_lag_s=0.3 * ROBOT.speed_ratio)
        at_rest = law.control(before, mission(), None, estimate, corner, ROBOT, None, 50.0, estimate_uses_map=knows_map)
        return -at_rest.velocity_um_s

    assert np.hypot(*(made_up_for(True) - [20.0, 330.0])) < 2.0
    assert np.hypot(*(made_up_for(False) - [0.0, 300.0])) < 10.0


def test_of_all_demands_within_the_limit_that_keep_the_course_the_one_nearest_to_its_speed_is_taken():
    rng, factors = np.random.default_rng(4), np.linspace(-16.0, 16.0, 64_001)
    slow = rng.uniform(60.0, 300.0, 150)[:, None] * np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, 150)).view(float).reshape(
        -1, 2
    )
    for wanted, flow in zip(slow, rng.uniform(-400.0, 400.0, (150, 2)), strict=True):
        demand, limited = compensate_flow(wanted, flow, 300.0)
        speeds = np.hypot(*(factors[:, None] * wanted - flow).T)
        able = factors[speeds <= 300.0]
        assert limited == (np.hypot(*(wanted - flow)) > 300.0)
        if len(able):
            best = able[np.argmin(np.abs(able - 1.0))] * wanted - flow
            np.testing.assert_allclose(demand, best if limited else wanted - flow, atol=0.2)
        else:  # swept off its course, it opposes the flow as well as it can
            assert np.hypot(*demand) == pytest.approx(300.0)
