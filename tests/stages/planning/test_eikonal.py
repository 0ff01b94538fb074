import math
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import FlowField, UsageError
from flowrec.stages import Planner, time_field, travel_time
from flowrec.stages.planning.cost_rasters import CostRasters
from flowrec.stages.planning.time_field import extend_to_walls
from tests.extras import why
from tests.stages.planning.worlds import PX, channel, chip_of, field_of, length_um, loop, open_water, poiseuille, robot

FULL = Planner(speed_share=1.0, robust_deviations=0.0)


def water(flow, size=121, speed=1.0, idle=-1.0):
    one = np.ones((size, size))
    return CostRasters(one > 0.0, 60.0 * one, 1.0, flow[0] * one, flow[1] * one, speed * one, idle)


def zermelo(flow, size=121):
    """Closed form of the time to the middle of a square at speed 1, inf where the flow carries everything past it."""
    y, x = np.mgrid[0:size, 0:size]
    dx, dy = size // 2 - x, size // 2 - y
    along, left = dx * flow[0] + dy * flow[1], 1.0 - flow[0] ** 2 - flow[1] ** 2
    inside = along**2 + left * (dx**2 + dy**2)
    with np.errstate(invalid="ignore"):
        times = (np.sqrt(inside) - along) / left
    return np.where((inside >= 0.0) & (times >= 0.0), times, np.inf), np.hypot(dx, dy)


@pytest.mark.parametrize("flow", [(0.0, 0.0), (0.6, 0.0), (-0.5, 0.4), (0.0, 0.8)])
def test_in_a_uniform_flow_the_time_to_go_is_zermelos_everywhere(flow):
    times = time_field(water(flow), np.array([60.0, 60.0]))
    exact, away = zermelo(flow)
    error = times / np.where(away > 0.0, exact, 1.0) - 1.0
    assert np.abs(error[away > 5.0]).max() < 0.06 and np.median(error) < 0.006
    assert (error[away > 0.0] > -1e-9).all(), "never faster than is possible"
    assert np.abs(error[(away > 0.0) & (away <= 3.0)]).max() < 1e-9, "near the goal times are those of straight lines"


def test_in_a_flow_faster_than_the_robot_only_what_drifts_towards_the_goal_reaches_it():
    flow = (1.0, 0.9)
    times = time_field(water(flow), np.array([60.0, 60.0]))
    exact, away = zermelo(flow)
    assert np.isinf(times[np.isinf(exact) & (away > 4.0)]).mean() > 0.99
    both = np.isfinite(times) & np.isfinite(exact) & (away > 10.0)
    assert both.sum() > 0.85 * np.isfinite(exact).sum()
    assert np.median(times[both] / exact[both]) < 1.02


def test_without_flow_the_time_to_go_is_that_of_scikit_fmm_around_walls():
    skfmm = pytest.importorskip("skfmm", reason=why("skfmm"))
    chip, _ = loop()
    one = np.ones(chip.mask.shape)
    rasters = CostRasters(chip.mask, np.where(chip.mask, 50.0, -1.0), 1.0, 0.0 * one, 0.0 * one, 2.0 * one)
    times = time_field(rasters, np.array([6.0, 20.0]))
    y, x = np.mgrid[0 : one.shape[0], 0 : one.shape[1]]
    seed = np.ma.MaskedArray(np.hypot(x - 6.0, y - 20.0) - 2.0, ~chip.mask)
    theirs = skfmm.travel_time(seed, 2.0 * one) + 1.0
    far = chip.mask & (np.hypot(x - 6, y - 20) > 6.0)
    np.testing.assert_allclose(times[far], np.asarray(theirs)[far], rtol=0.02)
    assert np.isinf(times[~chip.mask]).all()


def test_a_finer_rasters_has_the_same_ways_and_the_same_times():
    chip, field = loop()
    free = chip.mask
    clearance = np.where(free, 2.0, -2.0)
    speed = np.full(free.shape, 20.0)
    vx, vy = (np.ascontiguousarray(field.velocity_um_s[..., c], float) / PX for c in (0, 1))
    rasters = CostRasters(free, clearance, 2.0, vx, vy, speed)
    goal = np.array([60.0, 20.0])
    coarse, fine = time_field(rasters, goal), time_field(rasters.finer(3), 3.0 * goal)[::3, ::3]
    np.testing.assert_array_equal(np.isfinite(coarse), np.isfinite(fine))
    known = np.isfinite(coarse) & (coarse > 0.5)
    np.testing.assert_allclose(coarse[known], fine[known], rtol=0.03)


def test_following_the_slope_from_the_band_leads_away_from_the_wall_and_never_into_solid():
    mask = channel()
    route = Planner().plan(
        poiseuille(mask, 60.0), (1100.0, 195.0), (100.0, 195.0), chip_of(mask), robot(radius_um=30.0)
    )
    times = route.time_to_go_s
    closer = round(PX / route.time_to_go_um_per_px)
    times = times[::closer, ::closer]
    assert times.dtype == np.float32 and times.shape == mask.shape
    np.testing.assert_array_equal(np.isfinite(times), mask)
    down = np.diff(times[8:12, 40:100].astype(float), axis=0)
    along = np.diff(times[8:12, 40:100].astype(float), axis=1)
    assert (down < 0).all() and np.abs(down[0]).min() > 1.5 * np.abs(along).max()


def test_a_short_cut_too_narrow_for_the_robot_does_not_attract():
    # Two channels side by side, joined far away to the right and by a slit of one pixel near the goal.
    free = np.zeros((23, 80), bool)
    free[3:9, 2:78] = free[14:20, 2:78] = True
    free[3:20, 70:78] = True
    fluid = free.copy()
    fluid[9:14, 20] = True
    one = np.ones(free.shape)
    clearance = np.where(free, 2.0, np.where(fluid, 0.5, -1.0))
    times = time_field(CostRasters(free, clearance, 2.0, 0.0 * one, 0.0 * one, one), np.array([20.0, 5.0]))
    band = extend_to_walls(times, free, clearance, 2.0, 1.0)
    assert times[16, 20] > 90.0 and times[5, 24] < 5.0
    assert (band[13, 20] > band[14, 20]) and np.isinf(band[9:14, 20]).any(), "closed where the two sides meet"
    assert np.isinf(band[~fluid]).all()


def test_what_is_too_fast_with_no_reserve_is_unreachable_and_the_place_is_named():
    mask = channel()
    route = FULL.plan(field_of(mask, 130.0), (1100.0, 195.0), (100.0, 195.0), chip_of(mask), robot())
    assert not route.reachable and "130 um/s at" in route.reason and route.time_to_go_s is None


def test_in_a_narrow_channel_against_the_flow_the_time_to_go_is_that_of_a_much_finer_grid():
    mask = channel(h=24, wall=8)  # 8 px wide: the slow flow along the wall is a part of a pixel wide
    field, swimmer = poiseuille(mask, 90.0), robot(radius_um=17.0)
    ends = (1100.0, 115.0), (100.0, 115.0)

    def seconds_to_go(**changes):
        route = replace(FULL, clearance_margin_um=0.0, **changes).plan(field, *ends, chip_of(mask), swimmer)
        assert route.time_to_go_s is not None
        column, row = np.rint(np.array(ends[0]) / route.time_to_go_um_per_px).astype(int)
        return route.time_to_go_s[row, column]

    finest = seconds_to_go(policy_points_per_px=16, policy_points_per_radius=100.0)
    assert seconds_to_go() < 1.06 * finest
    assert seconds_to_go(policy_points_per_radius=3.0) > 1.15 * finest


def test_the_time_to_go_leads_around_pixels_that_touch_at_their_corners_where_the_robot_does_not_fit_between():
    mask = np.zeros((44, 44), bool)
    mask[2:14, 2:14] = mask[26:42, 26:42] = mask[3:9, 2:42] = mask[3:42, 34:41] = True  # two rooms, and the way around
    mask[np.arange(12, 28)[:, None], np.arange(12, 28)[:, None] + [-1, 0, 1]] = True  # the oblique way
    chip, still = chip_of(mask), field_of(mask, 0.0)

    def seconds_to_go(radius_um):
        planner = replace(FULL, clearance_margin_um=0.0)
        route = planner.plan(still, (80.0, 80.0), (330.0, 330.0), chip, robot(radius_um=radius_um))
        k = round(80.0 / route.time_to_go_um_per_px)
        return route.time_to_go_s[k, k]

    # On the oblique way 9.1 um are free at the centres of the pixels, and 7.1 um between them.
    assert seconds_to_go(6.0) < 4.0 < seconds_to_go(10.0)
    assert seconds_to_go(9.0) == pytest.approx(seconds_to_go(10.0), rel=0.01)


def test_a_start_on_the_outer_half_of_the_last_pixel_has_a_time_to_go():
    mask = open_water()
    edge_um = (mask.shape[1] - 0.6) * 10.0
    route = FULL.plan(field_of(mask, 0.0), (edge_um, 300.0), (400.0, 300.0), chip_of(mask), robot())
    assert route.reachable and route.time_to_go_s is not None


def test_robust_deviations_lead_around_a_flow_at_the_edge_and_are_given_up_with_a_remark():
    chip, field = loop(fast=80.0, slow=20.0)
    std = np.zeros_like(field.velocity_um_s)
    std[16:25, 35:105] = 30.0
    unsure = replace(field, std_um_s=std)
    east, west = (1330.0, 205.0), (60.0, 205.0)
    bold = FULL.plan(unsure, east, west, chip, robot(170.0))
    careful = replace(FULL, robust_deviations=2.0).plan(unsure, east, west, chip, robot(170.0))
    assert bold.waypoints_um[:, 1].max() < 300.0 < careful.waypoints_um[:, 1].max()
    assert travel_time(unsure, careful.waypoints_um, 170.0)[0][-1] == careful.arrival_s[-1], "timed in the mean flow"
    blocked = replace(field, std_um_s=np.full_like(std, 90.0))
    lean = replace(FULL, robust_deviations=2.0).plan(blocked, east, west, chip, robot(170.0))
    assert lean.reachable and "1 of 2 deviations" in lean.reason


def test_a_flow_that_knows_no_error_is_taken_to_be_wrong_by_a_share_of_its_speed():
    # Upstream at 96 of 100 um/s there is a way, but none that a flow faster by a tenth would leave.
    mask = channel()
    field, chip = field_of(mask, 93.0), chip_of(mask)
    careful = replace(FULL, robust_deviations=1.0, flow_error_share=0.1)
    route = careful.plan(field, (1100.0, 195.0), (100.0, 195.0), chip, robot())
    assert route.reachable and "0.5 of 1 deviations" in route.reason
    assert "spare" not in careful.plan(field, (100.0, 195.0), (1100.0, 195.0), chip, robot()).reason


@pytest.mark.parametrize(("flow", "idle"), [((0.0, 0.0), 30.0), ((40.0, 0.0), 30.0), ((-30.0, 20.0), 60.0)])
def test_in_a_uniform_flow_the_least_energy_is_spent_at_the_speed_of_the_closed_form(flow, idle):
    mask = open_water()
    start, goal = np.array([200.0, 250.0]), np.array([950.0, 620.0])
    planner = replace(FULL, cost="energy", idle_speed_um_s=idle)
    route = planner.plan(field_of(mask, *flow), start, goal, chip_of(mask), robot())
    ground = math.hypot(idle, *flow)
    assert route.time_to_go_s is None, "the slope of the energy is no time"
    assert length_um(route) == pytest.approx(np.hypot(*(goal - start)), rel=2e-3)
    assert route.arrival_s[-1] == pytest.approx(np.hypot(*(goal - start)) / ground, rel=2e-3)


def test_the_energy_to_go_is_that_of_the_closed_form_and_the_speed_limit_only_adds_to_it():
    flow, idle = np.array([0.3, 0.2]), 0.5
    goal = np.array([60.0, 60.0])
    y, x = np.mgrid[0:121, 0:121]
    leg = np.stack([60 - x, 60 - y], -1)
    away = np.hypot(leg[..., 0], leg[..., 1])
    exact = 2.0 * (math.hypot(idle, *flow) * away - leg @ flow)
    free = time_field(water(flow, speed=5.0, idle=idle), goal)
    np.testing.assert_allclose(free[away > 8], exact[away > 8], rtol=0.06)
    bound = time_field(water(flow, speed=0.5, idle=idle), goal)
    assert (bound >= free - 1e-9).all() and bound[60, 110] > 1.01 * free[60, 110]


def test_saving_energy_takes_longer_and_spends_less():
    mask = channel()
    field, chip = poiseuille(mask, 50.0), chip_of(mask)
    ends = (1100.0, 195.0), (100.0, 195.0)

    def energy(route, idle):
        legs, dt = np.diff(route.waypoints_um, axis=0), np.diff(route.arrival_s)
        middles = 0.5 * (route.waypoints_um[1:] + route.waypoints_um[:-1])
        from flowrec.physics import sample

        swum = legs / dt[:, None] - sample(field, middles)
        return float(((swum**2).sum(1) + idle**2) @ dt)

    fast = FULL.plan(field, *ends, chip, robot())
    thrifty = replace(FULL, cost="energy", idle_speed_um_s=20.0).plan(field, *ends, chip, robot())
    assert energy(thrifty, 20.0) < 0.8 * energy(fast, 20.0)
    assert thrifty.arrival_s[-1] > 1.2 * fast.arrival_s[-1]


def test_settings_that_make_no_sense_are_refused():
    mask = channel()
    world = field_of(mask, 10.0), (100.0, 195.0), (900.0, 195.0), chip_of(mask), robot()
    for wrong, named in (
        (Planner(method="astar_time", cost="energy"), "astar_time"),
        (Planner(cost="energy", idle_speed_um_s=0.0), "idle_speed_um_s = 0:"),
        (Planner(robust_deviations=-1.0), "robust_deviations = -1:"),
    ):
        with pytest.raises(UsageError, match=named):
            wrong.plan(*world)


def test_a_wide_margin_asked_for_by_hand_names_the_narrowest_place():
    mask = channel(h=40, w=120, wall=8)
    mask[:16, 60:64] = mask[24:, 60:64] = False
    route = Planner(clearance_margin_um=500.0).plan(
        field_of(mask, 10.0), (100.0, 195.0), (1100.0, 195.0), chip_of(mask), robot(radius_um=50.0)
    )
    assert isinstance(field_of(mask, 0.0), FlowField)
    assert not route.reachable and "too narrow at 6" in route.reason


def test_a_place_at_the_edge_of_the_chip_takes_as_long_as_one_half_a_pixel_nearer_to_a_wall():
    free, deep = np.ones((6, 7), bool), np.full((6, 7), 9.0)
    speed, need = 2.0, 2.0
    at_edge = extend_to_walls(np.zeros((6, 7)), free, deep, need, speed)
    assert at_edge[1:-1, 1:-1].max() == 0.0
    in_band = free.copy()
    in_band[:, 3] = False
    nearer = extend_to_walls(np.zeros((6, 7)), in_band, np.where(in_band, deep, need - 0.5), need, speed)[2, 3]
    assert nearer > 0.0
    for edge in (at_edge[0, 1:-1], at_edge[-1, 1:-1], at_edge[1:-1, 0], at_edge[1:-1, -1]):
        np.testing.assert_allclose(edge, nearer)


@pytest.mark.parametrize("idle", [-1.0, 0.5])
def test_what_a_way_costs_does_not_depend_on_how_many_points_a_pixel_has(idle):
    rasters, target = water((0.3, -0.2), size=31, idle=idle), np.array([15.0, 15.0])
    costs, fine = time_field(rasters, target), time_field(rasters.finer(2), 2.0 * target)[::2, ::2]
    away = np.hypot(*(np.mgrid[0:31, 0:31] - 15.0)) > 5.0
    unit = 4.0 if idle > 0.0 else 1.0  # an energy counts square pixels
    np.testing.assert_allclose(fine[away], unit * costs[away], rtol=0.05)
