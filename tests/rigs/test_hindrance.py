"""Drag of the walls: published values, and what the robot does with them."""

import math

import numpy as np
import pytest

from flowrec.core import FlowField
from flowrec.physics import ChipSettings, Robot, clearance_um, load_chip
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.hindrance import (
    FLOOR_DRAG,
    Hindrance,
    approach_mobility,
    drag_along,
    drag_towards,
    shear_mobility,
    walls_around,
)
from flowrec.stages import Simulated

QUIET = Simulated(world="kind", position_noise_um=0.0, heading_noise_rad=0.0, speed_noise=0.0)
RADIUS_UM, PX = 50.0, 20.0


def test_the_drag_along_a_wall_is_goldmans():
    # Goldman, Cox and Brenner (1967), table 1: l / a and drag of a translating sphere.
    for distance, drag in ((3.7622, 1.1738), (2.3524, 1.3079), (1.5431, 1.5675), (1.1276, 2.1514), (1.0453, 2.6475)):
        assert drag_along(distance - 1.0) == pytest.approx(drag, rel=3e-3)
    # The lubrication limit, and the gap that makes 25 um per revolution of a sphere of 50 um radius.
    assert drag_along(0.006) == pytest.approx(-8 / 15 * math.log(0.006) + 0.9588, rel=2e-3)
    gap = 0.027
    rolled = (-2 / 15 * math.log(gap) - 0.2526) / (-8 / 15 * math.log(gap) + 0.9588)
    assert 2 * math.pi * 50.0 * rolled == pytest.approx(25.0, rel=0.02)
    assert drag_along(gap) == pytest.approx(FLOOR_DRAG, rel=0.01)


def test_the_drag_towards_a_wall_is_brenners_series():
    for gap in (0.01, 0.05, 0.2, 1.0, 3.0):
        alpha = math.acosh(1.0 + gap)
        total = 0.0
        for n in range(1, 400):
            above = 2 * math.sinh((2 * n + 1) * alpha) + (2 * n + 1) * math.sinh(2 * alpha)
            below = 4 * math.sinh((n + 0.5) * alpha) ** 2 - (2 * n + 1) ** 2 * math.sinh(alpha) ** 2
            total += n * (n + 1) / ((2 * n - 1) * (2 * n + 3)) * (above / below - 1.0)
            if (2 * n + 1) * alpha > 300:
                break
        assert drag_towards(gap) == pytest.approx(4 / 3 * math.sinh(alpha) * total, rel=0.015)


def test_two_walls_superposed_are_faxens_channel():
    for a_over_b in (0.1, 0.3, 0.5):
        gap = 1.0 / a_over_b - 1.0
        both = 1.0 / (2.0 * drag_along(gap) - 1.0)
        faxen = 1 - 1.004 * a_over_b + 0.418 * a_over_b**3 + 0.21 * a_over_b**4 - 0.169 * a_over_b**5
        assert both == pytest.approx(faxen, rel=0.03)


def test_the_flow_carries_a_sphere_as_the_lubrication_theory_and_the_reflections_say():
    # Force and torque balance of a free sphere with the constants of part I and II at a gap of half a percent.
    gap = 0.005004
    log = math.log(gap)
    drag, push, twist, spin = (
        -8 / 15 * log + 0.9588,
        -2 / 15 * log - 0.2526,
        -1 / 10 * log - 0.1895,
        -2 / 5 * log + 0.3817,
    )
    balance = np.array([[-drag, push], [twist, -spin]])
    speed, _ = np.linalg.solve(balance, [-1.7005 * (1 + gap), -0.5 * 0.944])
    assert shear_mobility(gap) == pytest.approx(speed / (1 + gap), rel=0.01)
    assert shear_mobility(2.0) == pytest.approx(1 - 5 / 16 / 27, rel=3e-3)
    assert shear_mobility(20.0) == pytest.approx(1.0, abs=1e-4)


def swimmer(place_um, hindrance, velocity):
    """A robot in a channel along x with walls at y = 190 and y = 610 um: 21 pixels wide."""
    mask = np.zeros((40, 200), np.bool_)
    mask[10:31] = True
    clearance = clearance_um(mask, PX)
    wall_px = np.clip(clearance / PX, -1.1, 1.1)
    field = FlowField(
        0, 0, "made up", PX, velocity, np.zeros((40, 200)), None, np.zeros(0), 1.0, 1000.0, "", wall_px
    )  # fmt: skip
    robot = Robot(radius_um=RADIUS_UM, max_speed_um_s=600.0, step_out_hz=30.0)
    around = Hindrance(hindrance, walls_around(clearance, PX))
    return Swimmer(place_um, robot, QUIET, field, clearance, PX, hindrance=around)


def speed_of(robot, heading_rad, frequency_hz=4.0):
    before, lasts_s = robot.position_um, 0.02
    robot.advance(lasts_s, frequency_hz, heading_rad, 1.0 if frequency_hz else 0.0)
    return (robot.position_um - before) / lasts_s


def test_a_wall_slows_the_robot_down_along_it_and_more_so_towards_it():
    still = np.zeros((40, 200, 2), np.float32)
    for y, gaps in ((400.0, (3.2, 3.2)), (610.0 - 60.0, (0.2, 6.2)), (190.0 + 75.0, (0.5, 5.9))):
        along = FLOOR_DRAG / (FLOOR_DRAG + sum(drag_along(gap) - 1.0 for gap in gaps))
        across = FLOOR_DRAG / (FLOOR_DRAG + sum(drag_towards(gap) - 1.0 for gap in gaps))
        vx, vy = speed_of(swimmer((2000.0, y), 1.0, still), 0.0)
        assert (vx, vy) == pytest.approx((100.0 * along, 0.0), rel=0.01, abs=0.1)
        away = math.pi / 2 if y < 400.0 else -math.pi / 2
        vx, vy = speed_of(swimmer((2000.0, y), 1.0, still), away)
        assert (vx, vy) == pytest.approx((0.0, 100.0 * across * math.sin(away)), rel=0.06, abs=0.1)
        vx, vy = speed_of(swimmer((2000.0, y), 0.0, still), away)
        assert (vx, vy) == pytest.approx((0.0, 100.0 * math.sin(away)), abs=1e-3)


def test_a_flow_carries_a_finite_sphere_by_faxens_law_and_a_wall_holds_it_back_by_the_shear():
    y = np.arange(40) * PX - 400.0
    velocity = np.zeros((40, 200, 2), np.float32)
    velocity[10:31, :, 0] = (300.0 * (1.0 - (y / 210.0) ** 2))[10:31, None]
    for place, gaps in ((400.0, (3.2, 3.2)), (610.0 - 75.0, (0.5, 5.9)), (190.0 + 60.0, (0.2, 6.2))):
        undisturbed = 300.0 * (1.0 - ((place - 400.0) / 210.0) ** 2)
        faxen = undisturbed - 300.0 / 3.0 * (RADIUS_UM / 210.0) ** 2
        shear = 2.0 * 300.0 * abs(place - 400.0) / 210.0**2
        near, far = (RADIUS_UM * (1.0 + gap) * (1.0 - shear_mobility(gap)) for gap in gaps)
        vx, vy = speed_of(swimmer((2000.0, place), 1.0, velocity), 0.0, 0.0)
        assert vx == pytest.approx(faxen - shear * (near - far), rel=3e-3)
        assert vy == pytest.approx(0.0, abs=0.05)
        vx, _ = speed_of(swimmer((2000.0, place), 0.0, velocity), 0.0, 0.0)
        assert vx == pytest.approx(undisturbed, rel=1e-3)


def test_a_robot_that_a_flow_presses_to_a_wall_can_leave_it_again() -> None:
    velocity = np.zeros((40, 200, 2), np.float32)
    velocity[10:31, :, 1] = 60.0
    robot = swimmer((2000.0, 450.0), 1.0, velocity)
    robot.advance(4.0, 0.0, 0.0, 0.0)
    assert robot.position_um[1] == pytest.approx(610.0 - RADIUS_UM, abs=0.1 * RADIUS_UM)
    robot.advance(1.0, 18.0, -math.pi / 2, 1.0)
    assert robot.position_um[1] < 610.0 - 1.5 * RADIUS_UM
    # Nearly in contact: the force of a stagnation flow, 3.23 times Stokes', over the drag.
    assert approach_mobility(0.01) == pytest.approx(3.23 / drag_towards(0.01), rel=0.02)


def test_a_sphere_in_a_shear_flow_along_one_wall_is_as_fast_as_goldman_says():
    y = np.arange(200) * PX - 190.0
    velocity = np.zeros((200, 60, 2), np.float32)
    velocity[10:, :, 0] = y[10:, None]
    mask = np.zeros((200, 60), np.bool_)
    mask[10:] = True  # the other wall is far away
    clearance = clearance_um(mask, PX)
    field = FlowField(
        0, 0, "made up", PX, velocity, np.zeros(mask.shape), None, np.zeros(0), 1.0, 1000.0, "",
        np.clip(clearance / PX, -1.1, 1.1),
    )  # fmt: skip
    robot = Robot(radius_um=RADIUS_UM, max_speed_um_s=600.0, step_out_hz=30.0)
    for distance, ratio in ((1.5431, 0.92185), (1.1276, 0.76692)):
        place = 190.0 + distance * RADIUS_UM
        walls = Hindrance(1.0, walls_around(clearance, PX))
        body = Swimmer((600.0, place), robot, QUIET, field, clearance, PX, hindrance=walls)
        assert speed_of(body, 0.0, 0.0)[0] == pytest.approx(ratio * distance * RADIUS_UM, rel=5e-3)


def test_the_width_of_a_channel_is_found_from_either_side_and_from_its_middle():
    chip = load_chip(ChipSettings("bifurcation"))
    clearance = clearance_um(chip.mask, chip.um_per_px)
    width_um, cosine, sine = walls_around(clearance, chip.um_per_px)
    inlet = chip.mask & (np.arange(320) < 30)
    assert np.abs(width_um[inlet] - 500.0).max() < 30.0  # drawn 0.5 mm wide
    assert np.abs(np.arctan2(sine, cosine)[inlet]).min() > 3.0  # normal to x: twice 90 degrees
    narrow = chip.mask & (np.indices(chip.mask.shape)[0] < 90)
    assert np.median(width_um[narrow]) == pytest.approx(200.0, rel=0.1)
