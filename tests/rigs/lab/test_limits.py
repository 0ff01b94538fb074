"""No sequence of commands gets a current, a voltage, a slew or a time beyond its limit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from flowrec.core import Currents, Measured, RigError, UsageError, as_read
from flowrec.physics import Robot
from flowrec.rigs import CommandLimits
from flowrec.rigs.lab.amplifiers.amplifier import AmplifierInfo
from flowrec.rigs.lab.amplifiers.limits import ReadBack
from flowrec.rigs.lab.amplifiers.serial_protocol import field_line
from flowrec.rigs.lab.amplifiers.waveform import Waveform
from flowrec.stages import AmplifierSettings, Coils, FieldCommand, OutputLimits

RATE_HZ = 2500.0
ROBOT = Robot(radius_um=50.0, max_speed_um_s=500.0, step_out_hz=30.0)
COUPLED = ((2.1, 0.2, 0.1), (-0.3, 1.9, 0.2), (0.1, 0.2, 1.5))
VOLTAGE = Coils(
    mt_per_a=COUPLED,
    bias_mt=(0.3, -0.2, 0.1),
    amplifier=AmplifierSettings(kind="voltage", max_voltage_v=6.0, output_hz=RATE_HZ, inductance_mh=(8.0, 5.0, 12.0)),
)
CURRENT = Coils(
    mt_per_a=COUPLED, bias_mt=(0.3, -0.2, 0.1), max_current_a=2.5, amplifier=AmplifierSettings(output_hz=RATE_HZ)
)
SUDDEN = replace(CURRENT, ramp_s=0.0)
SLEWED = OutputLimits(slew_a_s=420.0, longest_on_s=0.2, rest_s=2.0)

numbers = st.one_of(
    st.sampled_from([0.0, 4.0, 27.0, math.pi, -1.0, 1e300, math.inf, -math.inf, math.nan]),
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(0.0, 60.0),
)
likely = st.sampled_from([27.0, 27.0, 26.0, 10.0, 1e300])
amplitudes = st.one_of(st.sampled_from([4.0, 4.0, 3.0, 1e300]), numbers)
LONGEST = 700  # samples of one command
commands = st.lists(
    st.tuples(st.one_of(likely, numbers), numbers, amplitudes, st.one_of(likely, numbers), st.integers(1, LONGEST)),
    min_size=1,
    max_size=8,
)


class JudgedHere(CommandLimits):
    """Limits that let all samples pass, so that the test sees them."""

    def check_samples(self, *_samples: object) -> None:
        pass


def command(frequency: float, heading: float, amplitude: float, limit: float) -> Currents:
    with as_read():  # no stage can make one with NaN; the limits are the second line of defence
        return Currents(0, frequency, heading, amplitude, 0.0, np.zeros(3), False, limit_hz=limit)


@pytest.mark.parametrize(
    ("coils", "output"),
    [(VOLTAGE, OutputLimits()), (CURRENT, SLEWED), (SUDDEN, SLEWED), (SUDDEN, OutputLimits())],
    ids=["voltage", "current, slew", "sudden, slew", "sudden"],
)
@settings(max_examples=25, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(sequence=commands)
def test_no_sequence_of_commands_gets_a_sample_beyond_a_limit(
    coils: Coils, output: OutputLimits, sequence: list[tuple[float, float, float, float, int]]
) -> None:
    limits = JudgedHere(coils, ROBOT, output)
    waveform = Waveform(limits, RATE_HZ)
    now_s, currents, voltages = 0.0, [np.zeros((1, 3))], []
    for *numbers_of_command, count in sequence:
        admitted = limits.admit(command(*numbers_of_command), round(now_s * 1e9))
        block = waveform.block(admitted, count)
        currents.append(block.currents_a[:-1])
        voltages.append(block.voltages_v)
        now_s += count / RATE_HZ
    i, v = np.concatenate(currents), np.concatenate(voltages)
    assert (np.abs(i) <= coils.max_current_a * (1 + 1e-9)).all()
    assert (np.abs(v) <= coils.amplifier.max_voltage_v * (1 + 1e-9)).all()
    if output.slew_a_s is not None:
        assert (np.abs(np.diff(i, axis=0)) * RATE_HZ <= output.slew_a_s * (1 + 1e-6)).all()
    off = np.flatnonzero(~(i != 0.0).any(axis=1))
    longest_s = np.diff(off, append=len(i)).max() / RATE_HZ
    assert longest_s <= output.longest_on_s + limits.off_s + LONGEST / RATE_HZ  # a command may last that long


def test_samples_beyond_a_limit_or_that_are_no_numbers_are_refused_whoever_made_them() -> None:
    limits = CommandLimits(CURRENT, ROBOT, SLEWED)
    rest, none = np.zeros((3, 3)), np.zeros((2, 3))
    limits.check_samples(rest, none)
    for spoil in (2.6, math.nan, -math.inf):
        with pytest.raises(RigError, match="current"):
            limits.check_samples(np.tile([0.0, spoil, 0.0], (3, 1)), none)
    with pytest.raises(RigError, match=r"11 V.* 10 V"):
        limits.check_samples(rest, np.full((2, 3), 11.0))
    with pytest.raises(RigError, match="slew"):
        limits.check_samples(np.array([[0.0] * 3, [0.0] * 3, [0.2] * 3]), none)


def measured(at_ms: float, *currents_a: float) -> Measured:
    return Measured(round(1e6 * at_ms), np.array(currents_a), np.array([1.0, -1.0, 0.5]))


def test_a_measured_current_that_differs_for_too_long_is_told_with_its_coil() -> None:
    check = ReadBack(0.1, 0.05)
    assert check.fault(None) == "" and ReadBack(None, 0.05).fault(measured(0, 9.0, 9.0, 9.0)) == ""
    right, wrong = (1.05, -0.95, 0.5), (1.0, -0.5, 0.5)
    assert [check.fault(measured(ms, *right)) for ms in (0, 100)] == ["", ""]
    assert [check.fault(measured(ms, *wrong)) for ms in (200, 240)] == ["", ""]
    assert check.fault(measured(245, *right)) == "", "it was right in between: the time begins anew"
    assert [check.fault(measured(ms, *wrong)) for ms in (250, 299)] == ["", ""]
    assert check.fault(measured(301, *wrong)).startswith("coil y has -0.5 A where -1 A")
    with as_read():
        blind = measured(400, math.nan, -1.0, 0.5)
    assert ReadBack(0.1, 0.0).fault(blind), "a sensor that tells nothing does not agree"


def test_currents_that_nobody_measures_can_not_be_compared() -> None:
    asked = CommandLimits(CURRENT, ROBOT, OutputLimits(measured_within_a=0.1))
    info = AmplifierInfo("board", "", 9.0, 99.0, 1e6, 0.01, 0.1)
    with pytest.raises(UsageError, match=r"measured_within_a = 0\.1: board"):
        asked.check(info)
    asked.check(replace(info, measures=True))


def test_impossible_numbers_become_zero_field_and_are_told_once() -> None:
    told: list[str] = []
    limits = CommandLimits(CURRENT, ROBOT, OutputLimits(), told.append)
    impossible = (math.nan, math.inf, -math.inf, -4.0)
    right = (5.0, 0.0, 4.0, 9.0)
    spoiled_ones = [(*right[:at], wrong, *right[at + 1 :]) for at in range(4) for wrong in impossible]
    spoiled_ones.remove((5.0, -4.0, 4.0, 9.0))  # a heading may be negative
    for spoiled in spoiled_ones:
        admitted = limits.admit(command(*spoiled), 0)
        assert (admitted.amplitude_mt, admitted.frequency_hz) == (0.0, 0.0)
    assert len(told) == 1 and "impossible" in told[0]
    assert limits.admit(command(5.0, 0.0, 9.0 * CURRENT.amplitude_mt, 9.0), 0).amplitude_mt == limits.amplitude_mt
    assert len(told) == 2 and "held to the limits" in told[1]


def test_commands_of_the_coil_stage_pass_unchanged() -> None:
    limits = CommandLimits(VOLTAGE, ROBOT, OutputLimits(), pytest.fail)
    full = VOLTAGE.full_mt(ROBOT)
    admitted = limits.admit(command(limits.rotation_hz, 1.0, full, limits.rotation_hz), 0)
    assert (admitted.frequency_hz, admitted.amplitude_mt) == (limits.rotation_hz, full)


def test_coils_that_were_on_for_the_longest_time_rest_before_they_are_on_again() -> None:
    told: list[str] = []
    limits = CommandLimits(CURRENT, ROBOT, OutputLimits(longest_on_s=10.0, rest_s=5.0), told.append)
    at_s = np.arange(0.0, 40.0, 0.1)
    on = np.array([limits.admit(command(5.0, 0.0, 2.0, 9.0), round(s * 1e9)).amplitude_mt > 0.0 for s in at_s])
    edges = at_s[1:][np.diff(on.astype(int)) != 0]
    np.testing.assert_allclose(edges, [10.0, 15.0, 25.0, 30.0], atol=0.45)
    assert on[0] and len(told) == 2 and "lab.output.longest_on_s" in told[0]


def test_limits_beyond_the_amplifier_are_refused_in_one_line() -> None:
    info = AmplifierInfo(
        "NI 9263", "", max_current_a=2.0, max_voltage_v=10.0, max_output_hz=1e5, latency_s=0, timer_s=0
    )
    wide = replace(CURRENT, amplifier=AmplifierSettings(max_voltage_v=12.0))
    for coils, words in (
        (CURRENT, "coils.max_current_a = 2.5 A: NI 9263 makes at most 2 A"),
        (replace(wide, max_current_a=2.0), "coils.amplifier.max_voltage_v = 12 V: NI 9263 makes at most 10 V"),
    ):
        with pytest.raises(UsageError) as refused:
            CommandLimits(coils, ROBOT, OutputLimits()).check(info)
        assert words in str(refused.value) and "\n" not in str(refused.value)


def test_a_slew_limit_that_the_field_exceeds_is_refused_in_one_line() -> None:
    with pytest.raises(UsageError, match=r"lab\.output\.slew_a_s = 100: .* need \d+ A/s"):
        CommandLimits(CURRENT, ROBOT, OutputLimits(slew_a_s=100.0))


def test_the_phase_is_continuous_from_block_to_block_whatever_the_commands() -> None:
    limits = CommandLimits(CURRENT, ROBOT, OutputLimits())
    waveform, rng = Waveform(limits, RATE_HZ), np.random.default_rng(1)
    samples = []
    for _ in range(200):
        admitted = limits.admit(command(rng.uniform(0, 27), rng.uniform(-4, 4), CURRENT.amplitude_mt, 27.0), 0)
        samples.append(waveform.block(admitted, 125).currents_a[:-1])
    step = np.abs(np.diff(np.concatenate(samples), axis=0)).max()
    assert step * RATE_HZ <= limits.slew_a_s * (1 + 1e-9)


@pytest.mark.parametrize(
    ("amplitude_mt", "ut"), [(3.9999, 3999), (3.9991, 3999), (4.0, 4000), (0.0019, 1), (2.3, 2300)]
)
def test_a_board_that_counts_in_microtesla_gets_no_more_than_was_commanded(amplitude_mt: float, ut: int) -> None:
    """Digits that are rounding errors of a whole number take nothing away."""
    words = field_line(7, FieldCommand(5.0, 0.0, amplitude_mt, 20.0, 20.0)).split(b"*")[0].split()
    assert words[:3] == [b"F", b"7", b"5000"]
    assert int(words[4]) == ut <= 1e3 * amplitude_mt + 1e-6
