"""A log of commands, of fields and of currents of one motion of the field tell the same turns."""

import csv
import itertools

import numpy as np
import pytest

from flowrec.core import MovieError, UsageError
from flowrec.stages import Coils, FieldCommand, FieldLog, FieldState, current_columns, field_motion, read_coil_log
from flowrec.stages.rig_settings import Columns

MT_PER_A = ((2.1, 0.1, 0.0), (0.0, 1.9, -0.2), (0.05, 0.0, 1.5))
FIVE = ((1.3, 0.8, 0.1, -0.1, 0.05), (0.1, -0.05, 0.9, 1.1, 0.0), (0.0, 0.1, -0.05, 0.05, 1.0))
# frequency, heading in degrees: with reversals, small turns and a rest
COMMANDS = [(12.0, 20.0), (12.0, 35.0), (3.0, -150.0), (0.0, -150.0), (20.0, 100.0), (8.0, 170.0)]
LASTS_S, SAMPLES_HZ = 0.25, 500.0


def write(path, header, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def motion(coils):
    """The exact log, and samples (n, 3) of the field with their times."""
    log, state, times, fields = FieldLog(), FieldState(0.4, 0.1, 4.0), [], []
    steps = round(LASTS_S * SAMPLES_HZ)
    for number, (frequency, heading_deg) in enumerate(COMMANDS):
        way = field_motion(state, FieldCommand(frequency, np.radians(heading_deg), 4.0, 25.0))
        since = np.arange(steps) / SAMPLES_HZ
        fields.append(coils.field_mt(way.phase(since), way.plane(since), 4.0))
        times.append(number * LASTS_S + since)
        log.extend(round(number * LASTS_S * 1e9), way.segments(LASTS_S), 4.0)
        state = way.after(LASTS_S)
    return log, np.concatenate(times), np.concatenate(fields)


@pytest.mark.parametrize(
    "settings",
    [{}, {"surface": "ceiling"}, {"mode": "helix"}, {"mode": "helix", "handedness": "left"}, {"mt_per_a": FIVE}],
    ids=["floor", "ceiling", "right", "left", "five coils"],
)
def test_sampled_fields_and_currents_tell_the_turns_of_the_robot(settings, tmp_path):
    coils = Coils(**{"mt_per_a": MT_PER_A, "bias_mt": (0.02, -0.03, 0.01)} | settings)
    exact, times, field = motion(coils)
    currents = (field - np.array(coils.bias_mt)) @ np.linalg.pinv(np.array(coils.mt_per_a)).T
    logs = [
        read_coil_log(write(tmp_path / f"{header[1]}.csv", header, np.column_stack([times, values])), Columns(), coils)
        for header, values in (
            (["time_s", "b_x_mt", "b_y_mt", "b_z_mt"], field),
            (["time_s", *current_columns(coils.count)], currents),
        )
    ]
    np.testing.assert_allclose(logs[1].currents_a, currents)
    for log in logs:
        assert log.amplitude_mt.min() > 3.9
        ends = np.arange(1, len(COMMANDS)) * round(LASTS_S * 1e9)
        # While the plane turns a roller also drifts sideways, by up to 1 / 4 pi of a revolution for each radian.
        np.testing.assert_allclose(log.turns_until(ends), exact.turns_until(ends), atol=0.1)
        middle = log.at(round(0.1 * 1e9))
        assert abs(middle.frequency_hz - 12.0) < 0.05 and abs(np.degrees(middle.heading_rad) - 20.0) < 0.5


def test_a_field_sampled_too_rarely_is_refused_and_noise_of_a_field_that_is_off_does_not_turn(tmp_path):
    coils, header = Coils(), ["time_s", "b_x_mt", "b_y_mt", "b_z_mt"]
    _, times, field = motion(coils)
    slow = write(tmp_path / "slow.csv", header, np.column_stack([times, field])[::20])
    with pytest.raises(MovieError, match=r"1\d\d degrees"):
        read_coil_log(slow, Columns(), coils)
    field[250:] = np.random.default_rng(0).normal(0.0, 0.05, field[250:].shape)
    log = read_coil_log(write(tmp_path / "off.csv", header, np.column_stack([times, field])), Columns(), coils)
    assert not log.turns(round(0.51e9), round(1.5e9)).any()


def test_columns_have_other_names_units_signs_and_constants(tmp_path):
    path = write(tmp_path / "log.csv", ["t (ms)", "f", "phi", "x"], [[0, 10, 90, 1], [500, -5, 0, 1], [900, 0, 0, 1]])
    columns = Columns(("t (ms)", 1e-3), "f", ("phi", -1.0, 30.0), 4.0)
    log = read_coil_log(path, columns, Coils())
    np.testing.assert_allclose(log.times_ns, [0, 500_000_000, 900_000_000])
    np.testing.assert_allclose(np.degrees(log.heading_rad), [-60.0, -150.0, 30.0])  # the second one rolls backwards
    np.testing.assert_allclose(log.frequency_hz, [10.0, 5.0, 0.0])
    np.testing.assert_allclose(log.amplitude_mt, 4.0)
    turned = read_coil_log(path, columns, Coils(), heading_offset_deg=10.0, heading_mirrored=True)
    np.testing.assert_allclose(np.degrees(turned.heading_rad), [70.0, 160.0, -20.0])


ROTATING = "time_s,frequency_hz,heading_deg,amplitude_mt"


@pytest.mark.parametrize(
    ("header", "rows", "columns", "why"),
    [
        ("time_s,frequency_hz,heading_deg", [], Columns(), "has no rows"),
        ("time_s,freq,heading_deg,amplitude_mt", [[0, 1, 2, 3]], Columns(), r"frequency_hz; .*\[movie\.columns\] fr"),
        ("time_s,freq,heading_deg", [[0, 1, 2]], Columns(), "no column frequency_hz, amplitude_mt"),
        ("t,f,h,a", [[0, 1, 2, 3]], Columns("t", "g", "h", "a"), "no column 'g'; its columns are t, f, h, a"),
        ("time_s,i_x_a,i_y_a", [[0, 1, 2]], Columns(), "no column i_z_a"),
        (ROTATING, [[0, 1, 0, 4], [2, 1, 0, 4], [1, 1, 0, 4]], Columns(), "line 4: time_s goes back"),
        (ROTATING, [[0, 1, 0, 4], [2, "nan", 0, 4]], Columns(), "line 3: frequency_hz is nan"),
    ],
)  # fmt: skip
def test_a_log_that_can_not_be_used_is_refused_in_one_line(header, rows, columns, why, tmp_path):
    with pytest.raises((MovieError, UsageError), match=why) as refused:
        read_coil_log(write(tmp_path / "log.csv", header.split(","), rows), columns, Coils())
    assert "\n" not in str(refused.value)


def test_the_exported_coils_of_a_session_are_a_log_of_them(tmp_path):
    from pathlib import Path

    import flowrec

    session = flowrec.open(Path(__file__).parents[3] / "sessions" / "golden.mcap")
    folder = flowrec.export(session, tmp_path / "t", file_format="csv")
    log = read_coil_log(folder / "applied.csv", Columns(), Coils())
    applied = list(session.messages("applied"))
    assert log.times_ns.tolist() == [each.stamp_ns for each in applied]
    turns = [log.turns(before.stamp_ns, now.stamp_ns) for before, now in itertools.pairwise(applied)]
    np.testing.assert_allclose(turns, [each.turns for each in applied[1:]], atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_turns_that_a_log_states_are_all_in_it_also_where_the_field_was_switched_on_or_off_between(seed, tmp_path):
    rng = np.random.default_rng(seed)
    turns, amplitude = rng.normal(0.0, 0.5, (30, 2)), rng.choice([0.0, 4.0], 30)
    turns[1:][np.maximum(amplitude[1:], amplitude[:-1]) == 0.0] = 0.0  # without a field it does not turn
    times_s = np.cumsum(rng.uniform(0.02, 0.1, 30))
    rows = np.column_stack([times_s, turns, amplitude])
    path = write(tmp_path / "turns.csv", ["time_s", "turns_x", "turns_y", "amplitude_mt"], rows)
    log = read_coil_log(path, Columns(), Coils())
    for n in range(29):
        begin, end = (round(each * 1e9) for each in times_s[n : n + 2])
        np.testing.assert_allclose(log.turns(begin, end), turns[n + 1], atol=1e-9)
