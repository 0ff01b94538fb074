import math

import numpy as np
import pytest

from flowrec.control import Coils
from flowrec.messages import Currents, Demand
from flowrec.robot import Robot

ROBOT = Robot(radius_um=50.0, um_per_rev=25.0, max_speed_um_s=600.0, step_out_hz=20.0, step_out_margin=0.9)
SKEWED = ((2.1, 0.1, -0.05), (0.08, 1.9, 0.1), (0.02, -0.1, 1.5))
BIAS = (0.02, -0.01, -0.045)
MS = 1_000_000


def demand(velocity, stamp=0, error=0.0):
    return Demand(stamp, np.array(velocity, float), np.zeros(2), 0.0, error, False, np.zeros((0, 2)))


def turn(coils, plan, previous=None, step_ms=1, finished=False):
    """Drive through (velocity, seconds) after seconds of each other."""
    said = []
    for velocity, seconds in plan:
        for _ in range(round(1000 * seconds / step_ms)):
            stamp = (previous.stamp_ns if previous is not None else -step_ms * MS) + step_ms * MS
            previous = coils.drive(previous, demand(velocity, stamp), ROBOT, finished)
            said.append(previous)
    return said


def field_mt(coils, said):
    return np.array([np.array(coils.mt_per_a) @ c.currents_a + np.array(coils.bias_mt) for c in said])


def direction(velocity):
    phi = math.atan2(velocity[1], velocity[0])
    return np.array([math.cos(phi), math.sin(phi), 0.0])


@pytest.mark.parametrize("mode", ["roller", "helix"])
def test_over_a_revolution_the_field_is_a_circle_about_the_axis_of_the_mode(mode):
    coils, velocity = Coils(mode=mode, mt_per_a=SKEWED, bias_mt=BIAS, ramp_s=0.1), (120.0, 90.0)
    field = field_mt(coils, turn(coils, [(velocity, 0.1 + 0.2)])[110:])
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), 4.0, rtol=1e-12)
    along = direction(velocity)
    axis = np.cross([0.0, 0.0, 1.0], along) if mode == "roller" else along
    np.testing.assert_allclose(field @ axis, 0.0, atol=1e-12)
    spin = np.cross(field[:-1], field[1:]).mean(0)
    assert spin @ axis > 0.0, "right-handed about it"
    if mode == "roller":
        # On a floor below, a ball that turns about n rolls along n x z: that is the heading.
        assert np.cross(spin, [0.0, 0.0, 1.0]) @ along > 0.0


def test_the_robot_rolls_its_way_in_as_many_revolutions_and_never_past_the_step_out_margin():
    said = turn(Coils(), [((0.0, 200.0), 1.0), ((900.0, 0.0), 0.1)])
    assert said[500].frequency_hz == pytest.approx(200.0 / 25.0)
    assert said[500].heading_rad == pytest.approx(math.pi / 2)
    assert said[-1].frequency_hz == pytest.approx(0.9 * 20.0)


def test_the_phase_never_jumps_whatever_frequency_and_heading_do_and_however_often_it_is_looked_at():
    plan = [((100.0, 0.0), 0.3), ((-300.0, 50.0), 0.2), ((0.0, 0.0), 0.1), ((0.0, 400.0), 0.25)]
    said = turn(Coils(), plan)
    steps = np.diff(np.unwrap([c.phase_rad for c in said]))
    expected = [2 * math.pi * c.frequency_hz * 1e-3 for c in said[:-1]]
    np.testing.assert_allclose(steps, expected, atol=1e-9)
    assert all(0.0 <= c.phase_rad < 2 * math.pi for c in said)
    resting = [c for c in said[500:600] if c.frequency_hz == 0.0]
    assert {c.heading_rad for c in resting} == {resting[0].heading_rad} and resting[0].heading_rad != 0.0
    coarse = turn(Coils(ramp_s=0.0), [((100.0, 0.0), 3.0)], step_ms=30)
    fine = turn(Coils(ramp_s=0.0), [((100.0, 0.0), 2.971)], step_ms=1)
    assert math.isclose(coarse[-1].phase_rad, fine[-1].phase_rad, abs_tol=1e-6)


def test_at_the_limit_of_one_coil_all_are_scaled_so_that_the_circle_stays_round():
    coils = Coils(mt_per_a=SKEWED, bias_mt=BIAS, max_current_a=1.5)
    said = turn(coils, [((120.0, 90.0), 0.6)])[300:]
    lengths = np.linalg.norm(field_mt(coils, said), axis=1)
    assert all(c.saturated for c in said)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-12)
    assert lengths[0] == pytest.approx(said[0].amplitude_mt) and lengths[0] < 3.0
    highest = np.abs([c.currents_a for c in said]).max()
    assert 0.95 * 1.5 < highest <= 1.5 + 1e-9
    assert max(c.frequency_hz for c in turn(coils, [((900.0, 0.0), 0.6)])) < 0.75 * 18.0, (
        "less torque, earlier step-out"
    )


def test_the_field_ramps_up_rests_with_a_resting_robot_and_ramps_to_nothing_at_the_end_or_without_a_robot():
    coils = Coils(ramp_s=0.2)
    up = turn(coils, [((100.0, 0.0), 0.5)])
    assert up[0].amplitude_mt == 0.0 and not up[0].currents_a.any()
    assert up[100].amplitude_mt == pytest.approx(2.0) and up[-1].amplitude_mt == 4.0
    rest = turn(coils, [((0.0, 0.0), 0.5)], up[-1])
    assert rest[-1].amplitude_mt == 4.0 and rest[-1].frequency_hz == 0.0
    done = turn(coils, [((0.0, 0.0), 0.3)], rest[-1], finished=True)
    assert done[99].amplitude_mt == pytest.approx(2.0)
    assert done[-1].amplitude_mt == 0.0 and not done[-1].currents_a.any()
    lost: Currents | None = rest[-1]
    for k in range(1, 11):
        lost = coils.drive(lost, demand((0.0, 0.0), rest[-1].stamp_ns + 30 * k * MS, math.nan), ROBOT, False)
    assert lost is not None and lost.amplitude_mt == 0.0
