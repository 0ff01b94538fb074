"""The robot as a refinement found it, where it is: judged by Poiseuille flow and the laws of a sphere beside walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Applied, Estimate, Tick
from flowrec.physics import load_chip
from flowrec.stages import Pipeline, assemble, load_config, resolve
from flowrec.stages.learned_robot import LearnedRobot, learned_robot

RADIUS_UM, FOUND = 60.0, 0.7


@pytest.fixture(scope="module")
def duct() -> Pipeline:
    asked = load_config(None, ["chip.name=straight", f"robot.radius_um={RADIUS_UM}", "simulated.world=kind"])
    chip = load_chip(asked.chip)
    return assemble(resolve(asked, chip), chip)


def at(duct: Pipeline, point_um: np.ndarray, found: float = FOUND, **changed: bool) -> LearnedRobot:
    """The robot at a point (2,), by a refinement that found a part of the lag of a sphere."""
    flow = replace(duct.solver.solve(duct.chip), parameter_names="sphere_share", parameters=np.array([found]))
    flow = replace(flow, parameter_std=np.array([0.4]))
    estimate = Estimate(0, point_um, np.zeros(2), np.eye(4), 0.0, point_um, True)
    refiner = replace(duct.refiner, **changed)
    return learned_robot(replace(duct, refiner=refiner), Tick(stamp_ns=0, estimate=estimate), flow, flow)


@pytest.mark.parametrize("share_of_width", [0.22, 0.3, 0.5, 0.78])
def test_a_flow_carries_a_sphere_by_faxens_law_less_the_lag_beside_the_walls(duct, share_of_width) -> None:
    rows, columns = np.nonzero(duct.chip.mask)
    px = duct.chip.um_per_px
    width = px * (np.ptp(rows) + 1.0)
    near = min(share_of_width, 1.0 - share_of_width) * width
    point = np.array([px * columns.mean(), px * (rows.min() - 0.5) + share_of_width * width])
    assert near > 1.1 * RADIUS_UM
    peak = np.hypot(*duct.solver.solve(duct.chip).velocity_um_s.max(axis=(0, 1)))
    speed, far, a = 4.0 * peak * (near / width) * (1.0 - near / width), width - near, RADIUS_UM
    lag = 5.0 / 16.0 * (far - near) * ((a / near) ** 3 / far - (a / far) ** 3 / near)
    expected = -FOUND * (a**2 / 6.0 * 8.0 * peak / width**2 + lag * speed)
    assert at(duct, point).slip_um_s == pytest.approx([expected, 0.0], abs=0.04 * abs(expected))
    assert at(duct, point, correct_lag=False).slip_um_s is None
    assert at(duct, point, found=-0.2).slip_um_s is None, "walls do not hurry a robot"


def test_what_moves_the_robot_and_what_is_ordered_hold_the_slip_once(duct) -> None:
    slip = np.array([-30.0, 4.0])
    robot = LearnedRobot(duct.robot, duct.robot, np.array([[0.0, -1.0], [1.0, 0.0]]), slip)
    before, after = (Applied(ns, 0.0, 0.0, 10.0, np.zeros(2), np.array([0.5, 0.0])) for ns in (0, 50_000_000))
    turns = robot.correct_turns(before, after).turns
    np.testing.assert_allclose(
        turns * duct.robot.um_per_rev, [0.05 * slip[0], 0.5 * duct.robot.um_per_rev + 0.05 * slip[1]]
    )
    assert replace(robot, turn=None).is_other_than(duct.robot) and replace(robot, slip_um_s=None).is_other_than(
        duct.robot
    )
    assert not LearnedRobot(duct.robot, duct.robot).is_other_than(duct.robot)

    wanted = np.array([70.0, 4.0])
    np.testing.assert_allclose(robot.heading_velocity(wanted, 500.0, slips=True), [0.0, -100.0], atol=1e-9)
    np.testing.assert_allclose(robot.heading_velocity(wanted, 50.0, slips=True), [0.0, -50.0], atol=1e-9)
    np.testing.assert_allclose(robot.heading_velocity(wanted, 500.0, slips=False), [4.0, -70.0], atol=1e-9)
    assert not robot.heading_velocity(np.zeros(2), 500.0, slips=True).any(), "a robot that is to rest is not turned"
