"""More clearance where the flow is fast, and the reason where there is not enough."""

import numpy as np
import pytest

from flowrec.physics import Opening
from flowrec.stages import Planner, open_space
from flowrec.stages.planning.feasibility import swept_out
from flowrec.stages.planning.free_space import CourseError, FastFlowMargin
from flowrec.stages.planning.problem import attach_goal, attach_start
from tests.stages.planning.worlds import PX, channel, chip_of, downstream, field_of, poiseuille, robot

FAST = FastFlowMargin(map_error=0.2, heading_error_rad=0.1, frame_s=0.05, latency_s=0.05)


def lowest_um(route, wall_um=75.0, height_um=390.0):
    """Least distance of a route to the walls of `channel()`."""
    y = route.waypoints_um[:, 1]
    return min(y.min() - wall_um, height_um - wall_um - y.max())


def test_a_route_keeps_as_far_from_walls_as_the_robot_may_drift():
    mask = channel()
    field, chip = field_of(mask, 600.0), chip_of(mask)
    ends = (100.0, 195.0), (1000.0, 195.0)
    calm = open_space(chip, field, 10.0, 1.0)
    fast = open_space(chip, field, 10.0, 1.0, FAST.course_error(robot(), 100.0))
    # The robot's radius, 0.2 x 600 x 0.1 um for the map, 0.1 x 100 x 0.1 for the heading, the rest for the bend.
    need_um = 10.0 + 12.0 + 1.0 + (0.05 * 700.0) ** 2 / 160.0
    assert (fast.clearance - fast.usable_clearance + fast.need)[20, 50] * PX == pytest.approx(need_um)
    assert calm.free.sum() > fast.free.sum() > 0
    assert (fast.clearance[fast.free] * PX >= need_um).all()
    assert lowest_um(Planner(swift=FAST).plan(field, *ends, chip, robot())) >= need_um


def test_a_little_speed_is_left_where_the_flow_may_be_wrong_by_more_than_all_of_it():
    mask = channel()
    space = open_space(chip_of(mask), field_of(mask, 60.0), 10.0, 1.0)
    assert np.unique(space.cost_rasters(10.0, 4.0).speed).tolist() == [6.0]
    assert np.unique(space.cost_rasters(10.0, 25.0).speed).tolist() == pytest.approx([0.2])


@pytest.mark.parametrize(("flow_um_s", "swept_um"), [(100.0, 45.0), (400.0, 280.0)])
def test_a_robot_that_starts_where_the_flow_takes_it_out_before_the_coils_are_up_is_told_how_far(flow_um_s, swept_um):
    mask = np.ones((30, 100), bool)
    field, chip = field_of(mask, flow_um_s), chip_of(mask, [Opening("right", 0, 29, "outlet", 0.0)])
    error = CourseError(blind_s=0.2, speed_um_s=200.0, radius_um=20.0)
    edge_um = chip.size_um[0] - 0.5 * PX

    def told(left_um):
        return swept_out(chip, field, np.array([edge_um - left_um, 220.0]), error, 1.0)

    assert f"carries the robot {swept_um:.0f} um before" in told(swept_um + 15.0)
    assert told(swept_um + 25.0) == ""


@pytest.mark.parametrize("method", ["time_field", "astar_time", "astar_length"])
def test_where_the_drift_fills_the_channel_the_place_and_the_reason_are_named(method):
    mask = channel()
    chip = chip_of(mask)
    plan = Planner(method=method, swift=FAST)
    ends = (100.0, 195.0), (1000.0, 195.0)
    assert plan.plan(field_of(mask, 500.0), *ends, chip, robot(600.0)).reachable
    field = field_of(mask, lambda x, y: 500.0 + 2000.0 * ((x > 500.0) & (x < 600.0)))
    route = plan.plan(field, *ends, chip, robot(600.0))
    assert not route.reachable and "too swift to be steered at" in route.reason
    x_um = float(route.reason.split("at ")[1].split(",")[0])
    assert 500.0 < x_um < 600.0
    # 0.2 x 2500 x 0.1 um for the map, 0.1 x 600 x 0.1 for the heading, (0.05 x 3100)^2 / 160 for the bend.
    assert "in a flow of 2500 um/s and with 600 um/s of its own the robot may be 206 um off" in route.reason
    assert "the walls leave 105 um" in route.reason  # 115 from the middle pixel to the wall, less the radius
    assert Planner(method=method).plan(field, *ends, chip, robot(600.0)).reachable, (
        "times that nobody set count for nothing"
    )


def test_no_survey_leads_into_what_is_too_swift():
    mask = channel()
    field = poiseuille(mask, 20000.0)
    assert downstream(field, (100.0, 195.0), chip_of(mask), robot(30000.0)).reachable
    assert not downstream(field, (100.0, 195.0), chip_of(mask), robot(30000.0), swift=FAST).reachable


def test_the_time_to_go_lets_the_robot_as_near_to_the_wall_as_it_fits_between_the_pixels():
    mask = channel()
    plan = Planner(clearance_margin_um=0.0, robust_deviations=0.0, speed_share=1.0)
    route = plan.plan(poiseuille(mask, 90.0), (1000.0, 195.0), (100.0, 195.0), chip_of(mask), robot(100.0, 11.0))
    assert 11.0 - 1e-6 <= lowest_um(route) < 13.0  # pixels with room for it are 15 um away
    assert (len(route.time_to_go_s) - 1) % (len(mask) - 1) == 0 and len(route.time_to_go_s) > len(mask)


def test_against_the_flow_the_time_to_go_leads_as_near_to_the_wall_as_walls_and_registration_are_known():
    mask = channel(h=40, wall=8)
    flow, swimmer = poiseuille(mask, 80.0), robot(radius_um=20.0)
    ends = (1100.0, 195.0), (100.0, 195.0)

    def clearance_um(**known):
        route = Planner(clearance_margin_um=30.0, robust_deviations=0.0, **known).plan(
            flow, *ends, chip_of(mask), swimmer
        )
        # Upstream the robot is earliest where T is least: in the middle of the way that is beside a wall.
        px = route.time_to_go_um_per_px
        column = route.time_to_go_s[:, round(600.0 / px)]
        return float(np.nanargmin(column) * px) - (8 - 0.5) * PX  # from the wall, half a pixel above the first row

    fastest, some, most = clearance_um(wall_error_um=0.0), clearance_um(wall_error_um=12.0), clearance_um()
    assert fastest == pytest.approx(20.0 + 0.2 * 30.0, abs=3.0)
    assert some == pytest.approx(20.0 + 12.0, abs=3.0)
    assert most == pytest.approx(20.0 + 30.0, abs=3.0)
    assert clearance_um(wall_error_um=1e3) == most, "never more than a planned route keeps"


def test_a_robot_starts_from_beside_a_wall_and_a_goal_must_be_within_its_radius_of_a_place_with_room():
    mask = channel(h=40, w=60, wall=8)
    space = open_space(chip_of(mask), field_of(mask, 0.0), 20.0, 20.0)  # it keeps 4 px from walls, and its radius is 2
    for clearance_px, near in ((0.7, False), (1.6, False), (2.7, True)):
        place_um = PX * np.array([30.0, 7.5 + clearance_px])
        start, goal = attach_start(space, place_um), attach_goal(space, place_um)
        assert not start.error and start.node >= 0
        assert bool(goal.error) != near and (goal.node >= 0) == near
        if near:
            assert np.hypot(*(space.pixel(goal.node) - place_um / PX)) <= 2.0
