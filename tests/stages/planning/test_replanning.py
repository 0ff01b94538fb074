"""On the way another route is taken only if it gains more than the map is uncertain; it continues the present one."""

import numpy as np
import pytest

from flowrec.physics import FlowUncertainty
from flowrec.stages import Planner, better_route, route_elsewhere
from tests.stages.planning.worlds import loop, robot

WEST, EAST = (60.0, 205.0), (1330.0, 205.0)
SWIMMER = robot(200.0)


def uncertain(chip, field, share):
    """The flow of the upper branch is known to a share of its speed."""
    velocity = field.velocity_um_s[chip.mask].astype(float)
    upper = (np.nonzero(chip.mask)[0] < 25)[:, None]
    nothing = np.zeros((0, len(velocity)))
    return FlowUncertainty(velocity, (velocity * upper)[None], nothing, np.eye(1) * share**2, np.zeros(len(velocity)))


def present_route(fast):
    """The route in a map in which the upper branch flows at `fast` um/s."""
    chip, field = loop(fast=fast)
    return Planner().plan(field, WEST, EAST, chip, SWIMMER)


def replanned(fast, believed_fast, share, from_s=0.3):
    chip, field = loop(fast=fast)
    present = present_route(believed_fast)
    return present, better_route(Planner(), field, uncertain(chip, field, share), present, from_s, EAST, chip, SWIMMER)


def test_a_route_that_gains_more_than_its_uncertainty_is_taken_and_begins_as_the_present_one() -> None:
    present, new = replanned(fast=100.0, believed_fast=-190.0, share=0.05)
    assert present.waypoints_um[:, 1].max() > 600.0 and new.waypoints_um[:, 1].max() < 300.0, "the upper branch"
    assert "gains" in new.reason and new.time_to_go_s is not None
    shared = present.arrival_s < 0.3
    np.testing.assert_array_equal(new.waypoints_um[: shared.sum()], present.waypoints_um[shared])
    np.testing.assert_array_equal(new.arrival_s[: shared.sum()], present.arrival_s[shared])
    assert (np.diff(new.arrival_s) > 0.0).all()
    at = [np.interp(0.3, route.arrival_s, route.waypoints_um[:, 0]) for route in (present, new)]
    assert at[0] == pytest.approx(at[1])


def test_in_a_map_that_is_certain_a_route_that_is_a_few_per_cent_better_is_taken() -> None:
    chip, field = loop(fast=-60.0)
    present = present_route(-190.0)
    new = better_route(Planner(), field, None, present, 0.3, EAST, chip, SWIMMER)
    gained = 1.0 - new.arrival_s[-1] / present.arrival_s[-1]
    assert 0.03 < gained < 0.1 and "another route gains" in new.reason


def test_the_present_route_is_kept_where_the_gain_is_within_its_noise_or_none() -> None:
    present, sure = replanned(fast=0.0, believed_fast=-190.0, share=0.05)
    assert sure.waypoints_um[:, 1].max() < 300.0
    chip, field = loop(fast=30.0)
    present = present_route(-190.0)
    doubted = better_route(Planner(), field, uncertain(chip, field, 4.0), present, 0.3, EAST, chip, SWIMMER)
    assert "kept" in doubted.reason and "+-" in doubted.reason
    np.testing.assert_array_equal(doubted.waypoints_um, present.waypoints_um)
    np.testing.assert_array_equal(doubted.arrival_s, present.arrival_s)
    same = better_route(Planner(), field, None, present_route(30.0), 0.3, EAST, chip, SWIMMER)
    assert "kept" in same.reason, "a plan anew of the same way is no gain"


def test_an_impossible_route_is_left_however_uncertain_the_map_and_kept_where_there_is_no_other() -> None:
    present, new = replanned(fast=-300.0, believed_fast=140.0, share=5.0)
    assert present.waypoints_um[:, 1].max() < 300.0 and new.waypoints_um[:, 1].max() > 600.0
    assert "impossible" in new.reason
    chip, field = loop(fast=-300.0, slow=-300.0)
    kept = better_route(Planner(), field, None, present_route(140.0), 0.3, EAST, chip, SWIMMER)
    assert kept.reachable and kept.reason.startswith("route kept: ")


def test_a_route_to_another_goal_leaves_the_present_one_at_its_time_and_none_leaves_it_as_it_is() -> None:
    chip, field = loop(fast=0.0)
    present = present_route(30.0)
    back = np.array(WEST)
    new = route_elsewhere(Planner(), field, present, 0.3, back, chip, SWIMMER)
    shared = present.arrival_s < 0.3
    np.testing.assert_array_equal(new.waypoints_um[: shared.sum()], present.waypoints_um[shared])
    assert (np.diff(new.arrival_s) > 0.0).all()
    assert new.arrival_s[shared.sum()] == 0.3
    np.testing.assert_array_equal(new.goal_um, back)
    np.testing.assert_allclose(new.waypoints_um[-1], back, atol=1.0)
    late = route_elsewhere(Planner(), field, present, 1e9, back, chip, SWIMMER)  # at its end
    np.testing.assert_array_equal(late.waypoints_um[: len(present.waypoints_um)], present.waypoints_um)
    np.testing.assert_array_equal(late.arrival_s[: len(present.arrival_s)], present.arrival_s)
    at_waypoint = route_elsewhere(Planner(), field, present, float(present.arrival_s[5]), back, chip, SWIMMER)
    np.testing.assert_array_equal(at_waypoint.arrival_s[:6], present.arrival_s[:6])
    for each in (late, at_waypoint):
        assert (np.diff(each.arrival_s) > 0.0).all() and np.hypot(*np.diff(each.waypoints_um, axis=0).T).min() > 0.0
    kept = route_elsewhere(Planner(), field, present, 0.3, np.array([700.0, 450.0]), chip, SWIMMER)
    assert "wall" in kept.reason and kept.goal_um.size == 0
    np.testing.assert_array_equal(kept.waypoints_um, present.waypoints_um)
