"""What the coils are made to play between commands, for any state and any order."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flowrec.core import Demand, wrap_rad
from flowrec.physics import Robot
from flowrec.stages import AmplifierSettings, Coils, FieldCommand, FieldState, field_limits, field_motion
from tests.stages.control.waveform import block, outputs, tail

SKEWED = ((2.1, 0.1, -0.05), (0.08, 1.9, 0.1), (0.02, -0.1, 1.5))
BIAS = np.array([0.02, -0.01, -0.045])
INDUCTIVE = AmplifierSettings(
    "voltage", v_per_v=(1.0, 1.2, 1.0), resistance_ohm=(2.0, 2.2, 3.0), inductance_mh=(4.0, 5.0, 9.0)
)
COILS = Coils(mt_per_a=SKEWED, bias_mt=tuple(BIAS), amplifier=INDUCTIVE)
RATE = INDUCTIVE.output_hz
FOLLOWED_HZ = 30.0
FULL_MT = field_limits(COILS).operating_amplitude_mt(FOLLOWED_HZ)
angles = st.floats(-math.pi, math.pi)
share = st.floats(0.0, 1.0)


@st.composite
def situations(draw, least=0.0):
    """A state and an order as Coils.drive would give them."""
    state = FieldState(draw(angles) % (2 * math.pi), draw(angles), FULL_MT * draw(st.floats(least, 1.0)))
    to_mt = FULL_MT * draw(share)
    limit = FOLLOWED_HZ * max(state.amplitude_mt, to_mt) / COILS.amplitude_mt
    return state, FieldCommand(limit * draw(share), draw(angles), to_mt, limit, COILS.ramp_mt_s)


@settings(max_examples=150)
@given(situations())
def test_the_circle_is_round_and_no_sample_is_further_from_the_last_than_the_field_can_be_followed(situation):
    state, order = situation
    played = block(COILS, state, order, 1200)
    lengths = np.linalg.norm(played.field_mt, axis=1)
    np.testing.assert_allclose(lengths, field_motion(state, order).amplitude(np.arange(1200) / RATE), atol=1e-12)
    steps = np.linalg.norm(np.diff(played.field_mt, axis=0), axis=1)
    turning = 2 * math.pi * order.limit_hz * lengths.max() / RATE
    assert np.all(steps <= turning * (1 + 1e-9) + COILS.ramp_mt_s / RATE + 1e-12)
    reached = played.field_mt[-1] / max(lengths[-1], 1e-9)
    if order.frequency_hz > 10.0 and lengths[-1] > 1e-6:
        across = np.array([-math.sin(order.heading_rad), math.cos(order.heading_rad), 0.0])
        assert abs(reached @ across) < 1e-6, "half a revolution has passed: the plane is there"


@settings(max_examples=150)
@given(situations(), st.integers(1, 400), st.integers(1, 400))
@example((FieldState(0.0, 2.0, 0.125), FieldCommand(0.9375, 0.0, 0.0, 0.9375, 20.0)), 125, 3)  # ends on a sample
def test_two_blocks_on_end_are_one_of_both_lengths(situation, first, second):
    state, order = situation
    whole = block(COILS, state, order, first + second)
    one = block(COILS, state, order, first)
    two = block(COILS, one.after, order, second)
    for name in ("field_mt", "currents_a"):
        np.testing.assert_allclose(
            np.concatenate([getattr(one, name), getattr(two, name)]), getattr(whole, name), atol=1e-9
        )
    np.testing.assert_allclose(np.concatenate([one.voltages_v, two.voltages_v]), whole.voltages_v, atol=1e-6)
    assert two.after.amplitude_mt == pytest.approx(whole.after.amplitude_mt)
    if whole.after.amplitude_mt > 0.0:  # without a field a phase says nothing
        assert math.cos(two.after.phase_rad - whole.after.phase_rad) == pytest.approx(1.0)


@settings(max_examples=200)
@given(situations())
def test_neither_currents_nor_voltages_ever_leave_their_limits(situation):
    state, order = situation
    for played in (block(COILS, state, order, 1000), tail(COILS, state, order)):
        assert np.abs(played.currents_a).max() <= COILS.max_current_a + 1e-9
        assert np.abs(played.voltages_v).max() <= INDUCTIVE.max_voltage_v + 1e-9


@pytest.mark.parametrize("heading", [0.0, 0.5 * math.pi])
def test_a_short_ramp_of_inductive_coils_leaves_so_much_less_voltage_for_the_field(heading):
    coils = replace(COILS, ramp_s=0.02)
    full = field_limits(coils).operating_amplitude_mt(FOLLOWED_HZ)
    limit = FOLLOWED_HZ * full / coils.amplitude_mt
    order = FieldCommand(limit, heading, full, limit, coils.ramp_mt_s)
    count = round(0.2 * full / coils.ramp_mt_s * RATE)
    phases = np.linspace(0.0, 2.0 * math.pi, 24)
    volts = [coils.output_samples(FieldState(phase, heading, 0.8 * full), order, count)[1] for phase in phases]
    largest = np.abs(volts).max()
    assert 0.5 * INDUCTIVE.max_voltage_v < largest <= INDUCTIVE.max_voltage_v


@settings(max_examples=100)
@given(situations())
def test_a_robot_is_carried_exactly_where_the_field_travels(situation):
    state, order = situation
    way, duration = field_motion(state, order), 0.1
    time = np.linspace(0.0, duration, 20001)
    middle = 0.5 * (time[1:] + time[:-1])
    heading = way.plane(middle) + (math.pi if way.direction < 0 else 0.0)
    summed = order.frequency_hz * duration * np.array([np.cos(heading).mean(), np.sin(heading).mean()])
    legs = way.segments(duration)
    closed = sum(
        g.duration_s * g.frequency_hz * np.array([math.cos(g.heading_rad), math.sin(g.heading_rad)]) for g in legs
    )
    assert sum(g.duration_s for g in legs) == pytest.approx(duration)
    np.testing.assert_allclose(closed, summed, atol=1e-3 * FOLLOWED_HZ * duration / 10)


def commanded(coils, plan, robot, frame_s=0.033):
    """The commands of a plan of (velocity, frames)."""
    said, previous = [], None
    for velocity, frames in plan:
        for _ in range(frames):
            stamp = round(len(said) * frame_s * 1e9)
            demand = Demand(stamp, np.array(velocity), np.zeros(2), 0.0, 0.0, False, np.zeros((0, 2)))
            previous = coils.drive(previous, demand, robot, False)
            said.append(previous)
    return said


def test_inductive_coils_driven_with_these_voltages_make_this_field():
    robot = Robot(radius_um=50.0, max_speed_um_s=900.0, step_out_hz=40.0)
    plan = [((500.0, 0.0), 12), ((450.0, 300.0), 6), ((-400.0, 100.0), 6), ((0.0, 60.0), 6), ((-300.0, -700.0), 9)]
    state, wanted, volts = FieldState(), [], []
    for command in commanded(COILS, plan, robot):
        for _ in range(3):  # blocks of 10 ms; the command changes between them
            played = outputs(COILS, state, command)
            state = played.after
            wanted.append(played.field_mt)
            volts.append(played.voltages_v)
    assert np.abs(volts).max() <= INDUCTIVE.max_voltage_v
    wanted, volts = np.concatenate(wanted), np.concatenate(volts) * np.array(INDUCTIVE.v_per_v)
    ohm, henry = np.array(INDUCTIVE.resistance_ohm), 1e-3 * np.array(INDUCTIVE.inductance_mh)
    from scipy.signal import lfilter

    fine = 50  # steps of Euler's method in a sample
    step = henry * RATE * fine
    flowing = [
        lfilter([0.0, 1.0 / s], [1.0, r / s - 1.0], np.repeat(v, fine))
        for s, r, v in zip(step, ohm, volts.T, strict=True)
    ]
    made = np.stack(flowing, -1)[::fine] @ np.array(SKEWED).T + BIAS
    full = slice(round(0.25 * RATE), None)
    error = np.linalg.norm(made - wanted, axis=1)[full]
    assert error.max() < 0.001 * 4.0
    without = np.linalg.norm(wanted[full], axis=1)
    assert without.min() > 3.9


@settings(max_examples=60)
@given(situations(least=0.02))
@example((FieldState(0.0, 0.0, 3.44), FieldCommand(limit_hz=25.8, ramp_mt_s=20.0)))  # 3440 samples less a rounding
def test_after_a_stop_or_when_no_one_orders_the_next_block_the_field_turns_down_to_nothing(situation):
    state, order = situation
    end = tail(COILS, state, order)
    assert not end.voltages_v[-1].any() and not end.currents_a[-1].any() and not end.field_mt[-1].any()
    assert end.after.amplitude_mt == 0.0
    assert len(end.voltages_v) <= COILS.ramp_s * RATE + 2
    lengths = np.linalg.norm(end.field_mt, axis=1)
    assert np.all(np.diff(lengths) <= 1e-12) and lengths[0] == pytest.approx(state.amplitude_mt)
    # Played into the coils the current is gone as well, not only asked to go.
    ohm, henry = INDUCTIVE.ohm, INDUCTIVE.henry
    keep = np.exp(-ohm / henry / RATE)
    current = end.currents_a[0]
    for held in end.voltages_v:
        current = keep * current + (1 - keep) * held / ohm
    assert np.abs(current).max() < 1e-9
    still = block(COILS, end.after, replace(order, amplitude_mt=0.0), 100)
    assert not still.voltages_v.any() and not still.currents_a.any()


def test_a_turn_waits_for_half_a_revolution_at_most_and_a_turn_back_for_nothing():
    state = FieldState(phase_rad=0.3, plane_rad=0.2, amplitude_mt=4.0)
    at_limit = field_motion(state, FieldCommand(20.0, 1.5, 4.0, 20.0))  # nothing left to turn the plane with
    assert float(at_limit.plane(0.0)) == 0.2
    assert at_limit.slew_s == pytest.approx((math.pi - 0.3) / (2 * math.pi * 20.0))
    assert float(at_limit.plane(at_limit.slew_s)) == pytest.approx(1.5)
    slow = field_motion(state, FieldCommand(0.5, 1.5, 4.0, 20.0))
    assert slow.slew_s == pytest.approx(1.3 / (2 * math.pi * math.sqrt(20.0**2 - 0.25))), "not a second, but 10 ms"
    back = field_motion(state, FieldCommand(20.0, 0.2 - math.pi, 4.0, 20.0))
    assert back.slew_s == 0.0 and back.heading_rad(0.0) == pytest.approx(0.2 - math.pi)
    off = field_motion(replace(state, amplitude_mt=0.0), FieldCommand(20.0, 1.5, 4.0, 20.0))
    assert off.slew_s == 0.0 and off.direction == 1 and float(off.plane(0.0)) == 1.5


@settings(max_examples=200)
@given(angles, angles, angles, share, st.sampled_from([0.5, 20.0, 30.0]))
@example(3.0, -3.0, 0.3, 1.0, 0.5)  # across the cut of the angle, forward
@example(-3.0, 3.0, 0.3, 1.0, 0.5)
@example(-3.0, 0.2, 0.3, 1.0, 0.5)  # and backward
@example(3.1, -0.2, 0.3, 1.0, 0.5)
def test_the_plane_turns_the_shorter_way_and_by_a_quarter_turn_at_most(plane, heading, phase, amplitude, frequency):
    state = FieldState(phase % (2 * math.pi), plane, 0.1 + amplitude)
    order = FieldCommand(frequency, heading, state.amplitude_mt, 30.0)
    way = field_motion(state, order)
    assert abs(way.plane_end_rad - plane) <= 0.5 * math.pi + 1e-8
    assert abs(way.slew_rad_s) * way.slew_s <= 0.5 * math.pi + 1e-8
    # Where it ends the robot travels as it was told to.
    end = way.heading_rad(way.slew_s + 1e-9)
    assert math.cos(end - heading) == pytest.approx(1.0, abs=1e-9)
    # No direction is special: with everything turned by an angle the field_motion is the same, but for that angle.
    turn = 1.0
    turned = field_motion(
        replace(state, plane_rad=wrap_rad(plane + turn)), replace(order, heading_rad=wrap_rad(heading + turn))
    )
    if abs(abs(way.plane_end_rad - plane) - 0.5 * math.pi) > 1e-6:  # to a quarter turn both ways are as short
        assert turned.direction == way.direction
        if abs(way.plane_end_rad - plane) > 1e-9:  # a turn of the size of rounding errors may wait or not
            assert turned.slew_s == pytest.approx(way.slew_s, abs=1e-9)
        assert turned.slew_rad_s * turned.slew_s == pytest.approx(way.slew_rad_s * way.slew_s, abs=1e-6)


@pytest.mark.parametrize("phase", [0.3, 1.2, 2.5, 4.0, 5.9])
@pytest.mark.parametrize("heading", [0.6, 2.6, -2.6])
def test_a_field_that_turns_as_fast_as_it_can_be_followed_takes_its_new_plane_where_it_is_vertical(phase, heading):
    # No rate is left for the plane, forwards (0.6 rad) or backwards: any other instant would be a jump of the field.
    way = field_motion(FieldState(phase, 0.0, FULL_MT), FieldCommand(20.0, heading, FULL_MT, 20.0, COILS.ramp_mt_s))
    assert way.direction == (1 if abs(heading) < 1.5 else -1)
    up = math.cos(float(way.phase(way.slew_s)))
    assert abs(up) == pytest.approx(1.0, abs=1e-9)
    time = np.linspace(0.0, 0.06, 6001)
    theta, plane = way.phase(time), way.plane(time)
    field = np.stack([np.sin(theta) * np.cos(plane), np.sin(theta) * np.sin(plane), np.cos(theta)], axis=1)
    assert np.linalg.norm(np.diff(field, axis=0), axis=1).max() < 1.01 * 2.0 * math.pi * 20.0 * 1e-5


def test_half_a_turn_is_plus_pi_whichever_way_it_was_made():
    for turns in (-1.5, -0.5, 0.5, 1.5):
        assert wrap_rad(2.0 * np.pi * turns) == pytest.approx(np.pi)
