"""The piecewise constant record of the field: turns are integrals, however it was made."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowrec.stages import FieldCommand, FieldLog, FieldState, field_motion

MS = 1_000_000
ROWS = st.lists(
    st.tuples(st.integers(0, 500), st.floats(0.0, 30.0), st.floats(-4.0, 4.0), st.sampled_from([0.0, 4.0])), max_size=8
)


def log_of(rows):
    times = np.cumsum([gap for gap, *_ in rows]) * MS
    return FieldLog(times, *np.array([row[1:] for row in rows]).reshape(-1, 3).T), times


def brute(rows, times, from_ms, to_ms):
    """Turns by one step of a millisecond after another."""
    total = np.zeros(2)
    for ms in range(from_ms, to_ms):
        row = np.searchsorted(times, ms * MS, "right") - 1
        if row >= 0 and rows[row][3] > 0.0:
            _, f, heading, _ = rows[row]
            total += f * 1e-3 * np.array([np.cos(heading), np.sin(heading)])
    return total


@settings(max_examples=40, deadline=None)
@given(ROWS, st.integers(-50, 1500), st.integers(0, 1500))
def test_turns_are_the_integral_over_the_rows(rows, from_ms, lasts_ms):
    log, times = log_of(rows)
    expected = brute(rows, times, from_ms, from_ms + lasts_ms)
    np.testing.assert_allclose(log.turns(from_ms * MS, (from_ms + lasts_ms) * MS), expected, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(ROWS, st.integers(0, 2000))
def test_a_log_grown_row_by_row_and_forgotten_behind_is_the_same_log(rows, at_ms):
    whole, times = log_of(rows)
    grown = FieldLog()
    for time, (_, f, heading, amplitude) in zip(times, rows, strict=True):
        grown.append(int(time), f, heading, amplitude)
    now = at_ms * MS
    expected = whole.applied_at(now, now - 40 * MS)
    np.testing.assert_allclose(grown.applied_at(now, now - 40 * MS).turns, expected.turns, atol=1e-9)
    grown.forget(now - 40 * MS)
    after = grown.applied_at(now, now - 40 * MS)
    np.testing.assert_allclose(after.turns, expected.turns, atol=1e-9)
    assert (after.frequency_hz, after.heading_rad) == (expected.frequency_hz, expected.heading_rad)


def test_before_the_first_row_there_is_no_field_and_the_last_one_lasts_on():
    log = FieldLog([1_000 * MS], [10.0], [0.5], [4.0], [[1.0, 2.0, 3.0]])
    assert log.at(999 * MS).amplitude_mt == 0.0
    np.testing.assert_array_equal(log.at(1_000 * MS).currents_a, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(log.turns(0, 3_000 * MS), 20.0 * np.array([np.cos(0.5), np.sin(0.5)]))


def test_a_log_of_any_number_of_coils_keeps_their_currents():
    for coils in (1, 3, 6):
        log = FieldLog(coils=coils)
        assert log.at(0).currents_a.tolist() == [0.0] * coils
        for number in range(100):  # it grows
            log.append(number * MS, 1.0, 0.0, 1.0, np.full(coils, float(number)) if number else None)
        np.testing.assert_array_equal(log.currents_a, np.tile(np.arange(100.0)[:, None], coils))
        assert log.shift_clock(5).applied_at(99 * MS, None).currents_a.tolist() == [98.0] * coils
        assert FieldLog([1], [1.0], [0.0], [1.0], np.ones((1, coils))).at(0).currents_a.shape == (coils,)


def test_the_turns_of_a_plane_that_turns_are_those_of_the_motion():
    """Independent reference: f (cos, sin) of the momentary plane, integrated finely."""
    motion = field_motion(FieldState(0.3, 0.2, 4.0), FieldCommand(12.0, 1.4, 4.0, 20.0))
    log = FieldLog()
    end = log.extend(0, motion.segments(0.1), 4.0)
    time = (np.arange(100_000) + 0.5) * 1e-6
    heading = motion.plane(time)
    expected = 12.0 * 1e-6 * np.array([np.cos(heading).sum(), np.sin(heading).sum()])
    assert abs(end - 100 * MS) <= 2
    np.testing.assert_allclose(log.turns(0, end), expected, rtol=1e-6)


def test_on_another_clock_the_turns_between_the_same_instants_are_scaled_by_its_rate():
    log, _ = log_of([(100, 10.0, 0.3, 4.0), (200, 5.0, -1.0, 4.0), (300, 0.0, 0.0, 0.0)])
    moved = log.shift_clock(40 * MS, 1.2)
    np.testing.assert_allclose(moved.turns(160 * MS, 520 * MS), 1.2 * log.turns(100 * MS, 400 * MS), rtol=1e-9)


@settings(max_examples=40, deadline=None)
@given(ROWS)
def test_between_samples_the_field_turns_as_their_mean_also_where_it_is_switched_on_or_off(rows):
    rows = [(gap + 8, *values) for gap, *values in rows]
    log, times = log_of(rows)
    even = log.interpolate()
    rates = [f * (b > 0.0) * np.array([np.cos(heading), np.sin(heading)]) for _, f, heading, b in rows]
    for n in range(len(rows) - 1):
        lasts_s = (times[n + 1] - times[n]) * 1e-9
        expected = 0.5 * lasts_s * (rates[n] + rates[n + 1])
        np.testing.assert_allclose(even.turns(int(times[n]), int(times[n + 1])), expected, atol=1e-6)
        assert even.at(int(times[n + 1])).amplitude_mt <= 4.0


def test_a_stamp_that_goes_back_is_refused():
    log = FieldLog([5, 9], [1.0, 1.0], [0.0, 0.0], [4.0, 4.0])
    with pytest.raises(ValueError, match="last row"):
        log.append(8, 1.0, 0.0, 4.0)
    with pytest.raises(ValueError, match="decrease"):
        FieldLog([5, 4], [1.0, 1.0], [0.0, 0.0], [4.0, 4.0])
