"""The pump: by what factor the flow differs from the steady one at a time, by drift and by pulsation."""

from __future__ import annotations

import math

import numpy as np

_STEP_S = 0.5  # of the drift, linear between
_FARTHEST = 3.0  # standard deviations: the drift is cut off there


class Pump:
    """(1 + drift) (1 + share sin(2 pi hz t + phase)); the drift is a stationary Ornstein-Uhlenbeck process.

    Parameters
    ----------
    pulsation_share, pulsation_hz, phase_rad : of the pulsation.
    drift_share, drift_s : one sigma of the drift, and its correlation time.
    rng : its random numbers.
    step_share, step_s : ratio to which the flow changes once, and when.
    """

    def __init__(
        self,
        pulsation_share: float,
        pulsation_hz: float,
        phase_rad: float,
        drift_share: float,
        drift_s: float,
        rng: np.random.Generator,
        step_share: float = 1.0,
        step_s: float = 0.0,
    ) -> None:
        self._share, self._hz, self._phase_rad = pulsation_share, pulsation_hz, phase_rad
        self._drift_share = drift_share
        self._decay = math.exp(-_STEP_S / drift_s)
        self._rng = rng
        self._step_share, self._step_s = step_share, step_s
        self._drift = [float(rng.standard_normal())]  # in standard deviations, every _STEP_S

    def strength(self, time_s: float) -> float:
        """The flow at a time over the steady one."""
        pulsation = 1.0 + self._share * math.sin(2.0 * math.pi * self._hz * time_s + self._phase_rad)
        if self._step_share != 1.0 and time_s >= self._step_s:
            pulsation *= self._step_share
        return (1.0 + self._drift_at(time_s)) * pulsation if self._drift_share > 0.0 else pulsation

    def mean_drift(self, until_s: float) -> float:
        """Mean of 1 + drift from the start to a time: what a steady map of that time is, over the steady flow."""
        if self._drift_share == 0.0:
            return 1.0
        times = np.arange(0.0, max(until_s, _STEP_S), _STEP_S)
        return 1.0 + float(np.mean([self._drift_at(float(time)) for time in times]))

    def _drift_at(self, time_s: float) -> float:
        place = max(time_s, 0.0) / _STEP_S
        index = int(place)
        while len(self._drift) < index + 2:
            kick = math.sqrt(1.0 - self._decay**2) * float(self._rng.standard_normal())
            self._drift.append(self._decay * self._drift[-1] + kick)
        before, after = self._drift[index : index + 2]
        drift = before + (place - index) * (after - before)
        return self._drift_share * min(max(drift, -_FARTHEST), _FARTHEST)
