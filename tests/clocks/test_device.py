"""A camera's clock fitted to the session's: an independent optimum, and streams of nonsense."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from flowrec.clocks import DeviceClock
from flowrec.clocks.device_clock import envelope


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
