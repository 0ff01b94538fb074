"""A camera's clock fitted to the session's: an independent optimum, and streams of nonsense."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from flowrec.core import DeviceClock, envelope, nanoseconds, seconds


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.one_of(st.integers(0, 10**8), st.integers(-(2**66), 2**66), st.sampled_from([0, 1, 2**32, -(10**9)])),
            st.integers(0, 10**9),
        ),
        max_size=120,
    )
)
def test_stamps_grow_whatever_a_camera_says(steps):
    clock, fit, device, arrival_ns, last = DeviceClock(), None, 0, 0, -(10**30)
    for further, wait_ns in steps:
        device, arrival_ns = device + further, arrival_ns + wait_ns
        fit = clock.take(fit, device, arrival_ns)
        assert fit.stamp_ns > last if fit.good else fit.stamp_ns == last
        last = fit.stamp_ns


def test_the_envelope_is_the_optimum_of_the_linear_program():
    rng = np.random.default_rng(2)
    for _ in range(20):
        x = np.unique(rng.integers(0, 10**6, 40))
        y = (1.3 * x + rng.exponential(300.0, len(x))).astype(int)
        (x0, y0), rate = envelope(tuple(zip(x.tolist(), y.tolist(), strict=True)))
        # Least sum of the distances of y from a line that is below all of it (Moon, Skelly & Towsley).
        best = linprog([-len(x), -x.sum()], np.column_stack([np.ones(len(x)), x]), y, bounds=[(None, None)] * 2)
        below = y - (y0 + rate * (x - x0))
        assert below.min() > -1e-6
        assert below.sum() == pytest.approx((y - best.x[0] - best.x[1] * x).sum(), rel=1e-6)


def stamps_of(clock, devices, arrivals_ns):
    """The fit after every frame."""
    fits, fit = [], None
    for device, arrival_ns in zip(devices.tolist(), arrivals_ns.tolist(), strict=True):
        fit = clock.take(fit, device, arrival_ns)
        fits.append(fit)
    return fits


def test_stamps_go_towards_a_better_fit_faster_or_slower_by_a_hundredth_of_its_rate():
    # For eight seconds every frame comes 40 ms late, then none: the fit jumps by 40 ms, the stamps slide.
    frame_ns = 33_333_333
    device = 10**12 + frame_ns * np.arange(900)
    fits = stamps_of(DeviceClock(), device, device + np.where(np.arange(900) < 240, 40_000_000, 0))
    rate = np.diff([fit.stamp_ns for fit in fits]) / (frame_ns * np.array([fit.rate for fit in fits[:-1]]))
    assert not any(fit.flag for fit in fits[1:])
    assert np.abs(rate[60:] - 1.0).max() == pytest.approx(0.01, rel=0.02)
    assert abs(fits[-1].stamp_ns - device[-1]) < 2_000_000


@pytest.mark.parametrize("unit_ns", [1.0, 1000.0, 1e9 / 125e6])
def test_the_window_of_a_fit_is_a_minute_whatever_the_camera_counts(unit_ns):
    # After 90 s the clock runs faster by 200 ppm. A window later nothing of the rate before is left.
    true_s = 0.2 * np.arange(900)
    slow_s = np.minimum(true_s, 90.0) + (1.0 + 2e-4) * np.maximum(true_s - 90.0, 0.0)
    device = np.round(1e9 * slow_s / unit_ns).astype(np.int64) + 5_000
    late_ns = np.random.default_rng(0).exponential(2e5, 900)
    fits = stamps_of(DeviceClock(unit=unit_ns), device, np.round(1e9 * true_s + late_ns).astype(np.int64))
    before, after = fits[440], fits[-1]
    assert before.rate / unit_ns == pytest.approx(1.0, abs=1e-5)
    assert after.rate / unit_ns == pytest.approx(1.0 / (1.0 + 2e-4), abs=1e-5)


@pytest.mark.parametrize("set_back_ns", [400_000_000, 2**32])
def test_a_counter_that_is_set_back_is_followed_from_its_third_frame_on_at_the_latest(set_back_ns):
    # A counter of 64 bits, of which that of 32 bits would only have begun again.
    frame_ns = 33_333_333
    arrival = 10**9 + frame_ns * np.arange(240)
    device = 10**13 + arrival - np.where(np.arange(240) < 200, 0, set_back_ns)
    fits = stamps_of(DeviceClock(), device, arrival)
    skipped = [n for n, fit in enumerate(fits) if not fit.good]
    assert skipped == ([200, 201] if set_back_ns < 10**9 else [])
    assert [n for n, fit in enumerate(fits) if fit.flag == "reset"] == [200 + len(skipped)]
    assert not any(fit.flag == "wrapped" for fit in fits)
    assert abs(fits[-1].stamp_ns - arrival[-1]) < 2_000_000


@given(st.floats(-1e5, 1e5))
def test_a_stamp_is_the_nearest_to_its_time(time_s):
    assert abs(nanoseconds(time_s) - time_s * 1e9) <= 0.51
    assert seconds(nanoseconds(time_s)) == pytest.approx(time_s, rel=0.0, abs=0.6e-9)


def test_a_camera_whose_counter_stood_still_for_a_while_is_dated_by_its_arrivals_again_after_four_intervals():
    frame_ns = 33_333_333
    device = 10**12 + frame_ns * np.arange(900)
    fits = stamps_of(DeviceClock(), device, device + np.where(np.arange(900) < 300, 0, 500_000_000))
    flags = [index for index, fit in enumerate(fits) if fit.flag]
    assert [fits[index].flag for index in flags] == ["jump"] and 300 < flags[0] < 600
    assert fits[flags[0] - 1].late_ns == 500_000_000 and fits[-1].late_ns == 0
    assert fits[-1].stamp_ns == device[-1] + 500_000_000


def test_a_unit_that_is_measured_while_the_host_catches_up_is_not_taken():
    counts = 3_333_333 * np.arange(300)  # of 10 ns, where 1 ns is stated
    busy_ns = 30 * counts[:14]
    arrivals = np.concatenate([busy_ns, busy_ns[-1] + 10 * (counts[14:] - counts[13])])
    fits = stamps_of(DeviceClock(), counts, arrivals)
    assert [fit.flag for fit in fits if fit.flag] == ["unit"]
    assert fits[-1].unit == pytest.approx(10.0, rel=0.01)
