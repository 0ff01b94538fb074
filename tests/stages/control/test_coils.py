import math
from itertools import groupby

import numpy as np
import pytest
from scipy.optimize import linprog

from flowrec.core import Currents, Demand, UsageError, verdict_lines
from flowrec.physics import Robot, load_chip
from flowrec.stages import AmplifierSettings, Coils, field_limits, load_config
from flowrec.stages.resolve import resolve

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


@pytest.mark.parametrize("velocity", [(120.0, 90.0), (-70.0, 130.0), (0.0, -150.0)])
@pytest.mark.parametrize("mode", ["roller", "helix"])
def test_over_a_revolution_the_field_is_a_circle_about_the_axis_of_the_mode(mode, velocity):
    coils = Coils(mode=mode, mt_per_a=SKEWED, bias_mt=BIAS, ramp_s=0.1)
    field = field_mt(coils, turn(coils, [(velocity, 0.1 + 0.2)])[110:])
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), 4.0, rtol=1e-12)
    along = direction(velocity)
    axis = np.cross([0.0, 0.0, 1.0], along) if mode == "roller" else along
    np.testing.assert_allclose(field @ axis, 0.0, atol=1e-12)
    assert np.cross(field[:-1], field[1:]).mean(0) @ axis > 0.0, "right-handed about it"


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.5, -1.9])
def test_a_roller_goes_its_way_on_the_floor_and_set_to_the_ceiling_also_there(heading):
    ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
    for surface, contact in (("floor", [0.0, 0.0, -1.0]), ("ceiling", [0.0, 0.0, 1.0])):
        field = Coils(surface=surface).field_mt(np.linspace(0.0, 1.0, 20), heading, 4.0)
        spin = np.cross(field[:-1], field[1:]).mean(0)
        # Rolling: the point that touches rests, so the centre moves by spin x (from the contact to the centre).
        way = np.cross(spin, -np.array(contact))
        np.testing.assert_allclose(way / np.linalg.norm(way), ahead, atol=1e-12)


def test_a_left_handed_helix_turns_the_other_way_about_its_heading():
    for handedness, sign in (("right", 1.0), ("left", -1.0)):
        field = Coils(mode="helix", handedness=handedness).field_mt(np.linspace(0.0, 1.0, 20), 0.4, 4.0)
        spin = np.cross(field[:-1], field[1:])
        np.testing.assert_allclose(
            spin / np.linalg.norm(spin, axis=1)[:, None] @ direction((math.cos(0.4), math.sin(0.4))), sign
        )


def test_the_robot_rolls_its_way_in_as_many_revolutions_and_never_past_the_step_out_margin():
    said = turn(Coils(), [((0.0, 200.0), 1.0), ((900.0, 0.0), 0.1)])
    assert said[500].frequency_hz == pytest.approx(200.0 / 25.0)
    assert said[500].heading_rad == pytest.approx(math.pi / 2)
    assert said[-1].frequency_hz == pytest.approx(0.9 * 20.0)


def test_the_phase_never_jumps_whatever_frequency_and_heading_do_and_however_often_it_is_looked_at():
    plan = [((100.0, 0.0), 0.3), ((-300.0, 50.0), 0.2), ((0.0, 0.0), 0.1), ((0.0, 400.0), 0.25)]
    said = turn(Coils(), plan)
    steps = np.abs(np.diff(np.unwrap([c.phase_rad for c in said])))
    expected = [2 * math.pi * c.frequency_hz * 1e-3 for c in said[:-1]]
    np.testing.assert_allclose(steps, expected, atol=1e-9)
    assert all(0.0 <= c.phase_rad < 2 * math.pi for c in said)
    resting = [c for c in said[500:600] if c.frequency_hz == 0.0]
    assert {c.heading_rad for c in resting} == {resting[0].heading_rad} and resting[0].heading_rad != 0.0
    coarse = turn(Coils(ramp_s=0.0), [((100.0, 0.0), 3.0)], step_ms=30)
    fine = turn(Coils(ramp_s=0.0), [((100.0, 0.0), 2.971)], step_ms=1)
    assert math.isclose(coarse[-1].phase_rad, fine[-1].phase_rad, abs_tol=1e-6)


def test_the_field_itself_never_jumps_not_even_when_the_robot_turns_back():
    coils = Coils(mt_per_a=SKEWED, bias_mt=BIAS)
    plan = [((100.0, 0.0), 0.35), ((-300.0, 50.0), 0.2), ((0.0, 0.0), 0.1), ((0.0, 400.0), 0.25), ((1.0, -5.0), 0.2)]
    said = turn(coils, plan)[250:]
    jumps = np.linalg.norm(np.diff(field_mt(coils, said), axis=0), axis=1)
    assert jumps.max() <= 4.0 * 2 * math.pi * 18.0 * 1e-3, "never faster than at the step-out margin"
    aside = [(c.plane_rad - c.heading_rad) % math.pi for c in said]
    longest = max(len(list(run)) for away, run in groupby(min(a, math.pi - a) > 1e-9 for a in aside) if away)
    assert longest <= 30, "a turn is over within half a revolution"


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


def test_voltages_limit_the_field_and_the_frequency_at_once_where_they_agree():
    amplifier = AmplifierSettings("voltage", resistance_ohm=(2.0, 2.2, 3.0), inductance_mh=(14.0, 15.0, 29.0))
    coils = Coils(mt_per_a=SKEWED, bias_mt=BIAS, amplifier=amplifier)
    said = turn(coils, [((900.0, 0.0), 0.5), ((30.0, 60.0), 0.3), ((-900.0, 900.0), 0.5)])
    fast, slow = said[450], said[750]
    share = fast.amplitude_mt / 4.0
    assert fast.saturated and 0.3 < share < 0.95
    assert fast.frequency_hz == pytest.approx(18.0 * share), "all the frequency that this field lets the robot follow"
    assert field_limits(coils).max_amplitude_mt(fast.frequency_hz) == pytest.approx(fast.amplitude_mt), (
        "all the field for it"
    )
    assert fast.frequency_hz > 1.05 * 18.0 * field_limits(coils).max_amplitude_mt(18.0) / 4.0, (
        "more than at the full frequency"
    )
    assert slow.amplitude_mt == fast.amplitude_mt, "no waiting for the field when the frequency rises again"
    assert coils.fastest_um_s(ROBOT) == pytest.approx(25.0 * fast.frequency_hz)
    volts = np.abs([c.voltages_v for c in said])
    assert 9.5 < volts.max() <= 10.0, "all that the ramp leaves: here 4 %"
    frequencies = np.array([c.frequency_hz for c in said[:450]])
    assert np.all(np.diff(frequencies) >= -1e-12), "no swinging on the way there"


def test_a_current_amplifier_is_told_volts_in_proportion_to_the_current_and_kept_within_its_input():
    coils = Coils(amplifier=AmplifierSettings(a_per_v=(0.5, 0.4, 0.25), max_voltage_v=8.0))
    said = turn(coils, [((100.0, 50.0), 0.5)])
    for c in said:
        np.testing.assert_allclose(c.voltages_v, c.currents_a / np.array([0.5, 0.4, 0.25]), atol=1e-12)
    assert said[-1].amplitude_mt == pytest.approx(8.0 * 0.25 * 1.5)
    assert np.abs([c.voltages_v for c in said]).max() <= 8.0 + 1e-12


def in_all_directions(count=300):
    k = np.arange(count) + 0.5
    z, azimuth = 1.0 - k / (0.5 * count), math.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z**2)
    return np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z])


def drawn_coils(seed, count, **more):
    """Coils that point anywhere, and that differ by up to three times."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(3, count)) * rng.uniform(0.5, 1.5, count)
    return Coils(mt_per_a=tuple(map(tuple, matrix.tolist())), bias_mt=BIAS, **more)


@pytest.mark.parametrize("count", [4, 6, 8])
def test_of_more_than_three_coils_those_currents_are_taken_whose_sum_of_squares_is_least(count):
    coils = drawn_coils(1, count, max_current_a=50.0, amplifier=AmplifierSettings(a_per_v=10.0))
    field = 4.0 * in_all_directions()
    least = np.linalg.lstsq(np.array(coils.mt_per_a), (field - BIAS).T)[0].T
    np.testing.assert_allclose(coils.currents_a(field, np.full(len(field), 4.0)), least, atol=1e-12)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("count", [4, 6, 8])
def test_where_a_coil_would_exceed_its_limit_the_others_take_over_within_theirs(count, seed):
    """The best of all is a linear program for each direction: the longest field there that bounded currents make."""
    coils = drawn_coils(seed, count, amplitude_mt=4.0, max_current_a=1.0)
    matrix, directions = np.array(coils.mt_per_a), in_all_directions()
    full_mt = coils.full_mt(ROBOT)
    currents = coils.currents_a(full_mt * directions, np.full(len(directions), full_mt))
    assert np.abs(currents).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(currents @ matrix.T + BIAS, full_mt * directions, atol=1e-12)
    least_norm = np.linalg.pinv(matrix)
    rows, bias_a = np.linalg.norm(least_norm, axis=1), np.abs(least_norm @ BIAS)
    assert full_mt >= min(((1.0 - bias_a) / rows).min(), 4.0) - 1e-9, "never less than with the pseudo-inverse"
    longest = [0.0] * count + [-1.0]
    bounds = [(-1.0, 1.0)] * count + [(0.0, 4.0)]
    best_mt = min(
        linprog(longest, A_eq=np.column_stack([matrix, -d]), b_eq=-np.array(BIAS), bounds=bounds).x[-1]
        for d in directions[::10]
    )
    assert full_mt >= 0.85 * best_mt


def test_a_field_of_six_coils_turns_as_that_of_three_and_what_is_missing_of_it_is_stated():
    coils = drawn_coils(3, 6, max_current_a=0.8, ramp_s=0.1)
    plan = [((120.0, 90.0), 0.5), ((-300.0, 50.0), 0.2)]
    said = turn(coils, plan)
    three = turn(Coils(ramp_s=0.1, amplitude_mt=4.0), plan)
    assert {c.unmet_mt for c in three} == {0.0}
    full_mt = coils.full_mt(ROBOT)
    assert 1.0 < full_mt < 4.0 and {c.unmet_mt for c in said} == {4.0 - full_mt}
    assert all(c.currents_a.shape == c.voltages_v.shape == (6,) for c in said)
    assert np.abs([c.currents_a for c in said]).max() <= 0.8 + 1e-9
    np.testing.assert_allclose(np.linalg.norm(field_mt(coils, said[200:]), axis=1), full_mt, rtol=1e-9)
    steady = said[200:480]
    assert [c.phase_rad for c in steady[:1]] != [0.0] and np.ptp([c.frequency_hz for c in steady]) == 0.0
    assert said[300].heading_rad == three[300].heading_rad


def test_a_mission_with_six_coils_says_once_what_the_coils_could_not_do():
    assert "weaker" not in " ".join(verdict_lines({"outcome": "reached"}))
    lines = verdict_lines({"outcome": "reached", "unmet_mt": 0.8})
    assert "0.8 mT" in lines[1]


@pytest.mark.parametrize(
    ("sets", "says"),
    [
        (["coils.mt_per_a=[[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]"], "rows of 2, 2, 2 numbers; give three rows"),
        (["coils.mt_per_a=[[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]"], "rows of 4, 3, 3 numbers"),
        (
            ["coils.mt_per_a=[[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]]", "coils.amplifier.a_per_v=[1.0, 1.0, 1.0]"],
            "a_per_v: 3 numbers, where coils.mt_per_a has 4 columns; give one number for all coils, or one for each",
        ),
        (["coils.mt_per_a=[[1, 0, 1, 1], [0, 1, 1, 1], [0, 0, 0, 0]]"], "no currents make a field along z"),
        (
            ["coils.mt_per_a=[[1, 0, 0, 0.001], [0, 1, 0, 0], [0, 0, 1, 0]]", "coils.bias_mt=[0, 6, 0]"],
            r"coil 2 needs all of it against coils\.bias_mt",
        ),
    ],
)
def test_matrices_that_are_none_are_refused_in_one_line(sets, says):
    with pytest.raises(UsageError, match=rf"--set: coils\..*{says}") as caught:
        load_config(None, sets)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("mt_per_a", "[[2.0, 0.0, 2.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]", "no currents make a field along z"),
        ("mt_per_a", "[[2.0, 2.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]", r"along \(-0.45, 0.89, 0.00\)"),
        ("amplitude_mt", "0.0", "must be from 0.001"),
        ("max_current_a", "0", "must be from 0.001"),
        ("ramp_s", "-0.1", "must be from 0 to"),
        ("bias_mt", "[nan, 0.0, 0.0]", "must be from -1000"),
        ("amplifier.a_per_v", "[1.0, 0.0, 1.0]", "must be from 1e-06"),
        ("amplifier.max_voltage_v", "-10.0", "must be from 0.001"),
        ("amplifier.kind", "magic", "one of current, voltage"),
        ("surface", "wall", "one of floor, ceiling"),
    ],
)
def test_coils_that_can_not_be_are_refused_before_anything_is_switched_on(key, value, says):
    with pytest.raises(UsageError, match=rf"--set: coils\.{key}.*{says}") as caught:
        load_config(None, [f"coils.{key}={value}"])
    assert "\n" not in str(caught.value)
    for sets, told in (
        (["coils.amplifier.kind=voltage", "coils.ramp_s=0"], r"coils\.ramp_s"),
        (["coils.bias_mt=[0.0, 9.6, 0.0]"], r"max_current_a = 5 A: coil y .*\+5\.05 A"),
        (["coils.amplifier.max_voltage_v=0.05", "coils.bias_mt=[0.0, 0.0, 0.1]"], r"coil z .*coils\.bias_mt"),
    ):
        with pytest.raises(UsageError, match=told):
            load_config(None, sets)


def test_a_plan_is_made_for_the_speed_that_the_coils_leave_the_robot():
    sets = ["coils.max_current_a=1.5", "robot.max_speed_um_s=600"]
    config = load_config(None, sets)
    resolved = resolve(config, load_chip(config.chip))
    share = 1.5 * 1.5 / 4.0  # of the full field, by the z coil
    assert resolved.robot.max_speed_um_s == pytest.approx(600.0 * 1.2 * 0.9 * share, abs=0.1)
    assert resolve(resolved, load_chip(config.chip)).robot == resolved.robot
    slow = load_config(None, [sets[0], "robot.max_speed_um_s=100", "robot.step_out_hz=30"])
    assert resolve(slow, load_chip(slow.chip)).robot.max_speed_um_s == 100.0, (
        "the coils leave it more than it is to have"
    )


@pytest.mark.parametrize(("kind", "ramp_s"), [("current", 0.0), ("current", 0.2), ("voltage", 0.2)])
@pytest.mark.parametrize("mode", ["roller", "helix"])
def test_a_tick_states_the_first_of_the_samples_that_a_card_puts_out(mode, kind, ramp_s):
    amplifier = AmplifierSettings(kind=kind, resistance_ohm=(2.0, 0.0, 1.0), inductance_mh=(5.0, 4.0, 0.0))
    coils = Coils(mode, "ceiling", "left", mt_per_a=SKEWED, bias_mt=BIAS, ramp_s=ramp_s, amplifier=amplifier)
    said = turn(coils, [((120.0, 90.0), 0.3), ((-70.0, -130.0), 0.3), ((0.0, 0.0), 0.1)], step_ms=7)
    said += turn(coils, [((120.0, 90.0), 0.3)], said[-1], step_ms=7, finished=True)
    for currents in said:
        samples_a, samples_v = coils.output_samples(*coils.state_and_command(currents), 1)
        np.testing.assert_allclose(currents.currents_a, samples_a[0], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(currents.voltages_v, samples_v[0], rtol=1e-10, atol=1e-12)
