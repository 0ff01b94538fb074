"""Several robots of the simulated rig: one field, one flow, a response and a look of each, truth of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import RigError, Truth
from flowrec.physics import median_width_um
from flowrec.stages import robot_topic
from tests.rigs.test_simulated import EXACT, MIDDLE, NOISELESS, ROBOT, STRAIGHT, command, fly, rig_with, steady

FLOW = steady(120.0)


def places(seen: list, number: int) -> np.ndarray:
    """Way (n, 2) of a robot."""
    path = robot_topic("/truth/robot", number)
    return np.array([(each.truth if number == 0 else each.extra[path]).position_um for each in seen])


def test_the_first_robot_and_its_world_do_not_depend_on_the_others() -> None:
    commands = {0: command(8.0, 0.4), 12: command(12.0, -0.9)}
    noisy = replace(EXACT, seed=3, position_noise_um=2.0, heading_noise_rad=0.05, speed_noise=0.05)
    alone, among = (fly(rig_with(flow=FLOW, simulated=replace(noisy, robots=n)), commands) for n in (1, 4))
    np.testing.assert_array_equal(places(alone, 0), places(among, 0))
    assert all(not each.extra for each in alone)
    assert all(len(each.extra) == 3 and all(isinstance(told, Truth) for told in each.extra.values()) for each in among)


def test_one_field_drives_all_each_by_its_own_response_and_lag() -> None:
    rig = rig_with(flow=steady(0.0), simulated=replace(EXACT, seed=4, robots=4), duration_s=0.8)
    seen = fly(rig, {0: command(5.0, 0.3), 12: command(5.0, 0.3 + np.pi)})
    ways = [np.diff(places(seen, number), axis=0) for number in range(4)]
    speeds = np.array([np.hypot(*way[8]) for way in ways])
    headings = [np.arctan2(*way[8][::-1]) for way in ways]
    np.testing.assert_allclose(headings, 0.3, atol=1e-6)
    shares = speeds[1:] / speeds[0]
    assert (np.abs(shares - 1.0) < 0.25).all() and np.ptp(shares) > 0.05
    late = np.array([(way[:, 0] / way[8, 0])[10:18].sum() for way in ways])  # in images, while the heading turns back
    assert (late[1:] > late[0]).all() and np.ptp(late) < 2.0 and np.ptp(late[1:]) > 0.1, "the others follow later"


def test_the_flow_carries_all_of_them() -> None:
    seen = fly(rig_with(flow=FLOW, simulated=replace(EXACT, seed=5, robots=3)))
    for number in range(3):
        way = places(seen, number)
        np.testing.assert_allclose(way[-1] - way[0], [120.0, 0.0], atol=0.5)


def test_each_is_drawn_with_its_look_and_hides_what_is_below_it() -> None:
    alone, among = (fly(rig_with(flow=FLOW, simulated=replace(NOISELESS, seed=6, robots=n))) for n in (1, 3))
    um_per_px = 64 * 20.0 / 64
    for before, after in zip(alone[::10], among[::10], strict=True):
        darker = before.frame.image.astype(int) - after.frame.image
        for number in (1, 2):
            x, y = np.rint(after.extra[robot_topic("/truth/robot", number)].position_um / um_per_px).astype(int)
            assert darker[y, x] > 60
        x, y = np.rint(np.array([before.truth.position_um[0], MIDDLE]) / um_per_px).astype(int)
        assert abs(darker[y, x]) < 3


def test_contacts_with_walls_are_counted_for_each() -> None:
    up = command(12.0, -np.pi / 2)
    seen = fly(rig_with(simulated=replace(EXACT, seed=7, robots=4), duration_s=2.0), {0: up})
    assert all(told.contacts >= 1 and told.clearance_um > -1.0 for told in seen[-1].extra.values())


def test_a_chip_without_room_for_another_robot_is_refused_in_one_line() -> None:
    wide = replace(ROBOT, radius_um=0.4 * float(median_width_um(STRAIGHT)))
    rig = rig_with(flow=FLOW, simulated=replace(EXACT, robots=2), robot=wide)
    with pytest.raises(RigError, match=r"no room for another robot; set simulated\.robots = 1"):
        fly(rig)


@pytest.mark.parametrize("robots", [1, 2])
def test_a_run_on_a_copy_of_the_rig_leaves_the_rig_as_it_was(robots: int) -> None:
    rig = rig_with(flow=FLOW, simulated=replace(EXACT, seed=8, robots=robots), duration_s=0.2)
    tried = [each.frame.image.tobytes() for each in rig.tried()]
    assert tried == [each.frame.image.tobytes() for each in fly(rig)]
