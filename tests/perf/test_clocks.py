"""A camera's clock fitted to the session's, on the bench's streams: the truth is known."""

import itertools

import numpy as np
import pytest

from flowrec.core import DeviceClock
from tests.perf.clocks import CASES, measure, series

FRAMES_PER_S = 100


def taken(one, clock=None):
    clock, fit, fits = clock or DeviceClock(), None, []
    for device, arrival_ns in zip(one.device, one.arrival_ns, strict=True):
        fit = clock.take(fit, device, arrival_ns)
        fits.append(fit)
    return fits


@pytest.mark.parametrize("case", CASES)
def test_frames_are_dated_to_a_fraction_of_a_millisecond_without_a_step_whatever_goes_wrong(case):
    rows = {row["method"]: row for row in measure(70.0, cases=[case], methods=("arrival", "flowrec"))["rows"]}
    ours, late = rows["flowrec"], rows["arrival"]
    assert ours["backwards"] == 0
    assert ours["max_s"] < 6e-4 and ours["rms_s"] < 0.2 * late["rms_s"]
    assert ours["step_s"] <= 0.011 / FRAMES_PER_S


@pytest.mark.slow("dates 36,000 images")
def test_skew_unit_and_every_fault_are_told():
    assert taken(series("drift", 70.0))[-1].known
    assert 1e6 * (1.0 / taken(series("stalls", 70.0))[-1].rate - 1.0) == pytest.approx(50.0, abs=1.0)
    assert taken(series("unit x10", 20.0))[-1].unit == pytest.approx(0.1, rel=0.01)
    assert taken(series("unit x0.694", 20.0))[-1].unit == pytest.approx(1.0 / 0.694, rel=0.01)
    assert all(fit.unit == 0.0 for fit in taken(series("busy host", 20.0)))
    reset = taken(series("reset", 40.0))
    assert [n for n, fit in enumerate(reset) if fit.flag] == [20 * FRAMES_PER_S] and reset[-1].resets == 1
    forwards = taken(series("set forwards", 40.0))
    assert [fit.flag for fit in forwards if fit.flag] == ["jump"] and forwards[-1].jumps == 1
    assert taken(series("32 bit", 40.0))[-1].wraps == 9
    disorder = taken(series("out of order", 40.0))
    flags = [fit.flag for fit in disorder if not fit.good]
    assert flags.count("duplicate") == disorder[-1].duplicates == 26
    assert flags.count("out of order") == disorder[-1].disordered == 26
    assert all(b.stamp_ns == a.stamp_ns for a, b in itertools.pairwise(disorder) if not b.good)


@pytest.mark.parametrize(("unit", "tells"), [(1.0, 0.0), (10.0, 0.1)])
def test_a_host_that_is_busy_at_first_and_catches_up_does_not_mistake_the_unit(unit, tells):
    one = series("plain", 30.0)
    device = [round(unit * at) for at in one.true_ns.tolist()]
    # The first frame is on time, then nothing for 0.9 s, then three frames for every one.
    arrival = [max(at, min(900_000_000 + n * 3_333_333, 10**18)) if n else at for n, at in enumerate(one.arrival_ns)]
    clock, fit, stamps = DeviceClock(), None, []
    for count, at in zip(device, arrival, strict=True):
        fit = clock.take(fit, count, at)
        stamps.append(fit.stamp_ns)
    assert fit.unit == pytest.approx(tells, rel=0.05) and fit.jumps == fit.resets == 0
    assert max(abs(np.array(stamps) - one.true_ns)[1500:]) < 2_000_000


def test_a_clock_that_stood_still_is_caught_up_with():
    one = series("plain", 40.0)
    arrival = [at + 3_000_000_000 * (n >= 2000) for n, at in enumerate(one.arrival_ns)]
    clock, fit = DeviceClock(), None
    for device, at in zip(one.device, arrival, strict=True):
        fit = clock.take(fit, device, at)
    assert fit.jumps == 1 and 0 <= arrival[-1] - fit.stamp_ns < 10_000_000
