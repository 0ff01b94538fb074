"""The pump, which makes the flow differ from the steady one by drift and pulsation, and a flow sensor at it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from flowrec.core import NS_PER_S, seconds
from flowrec.rigs.streams.stream import Chunk, StreamHead

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


class PumpSensor:
    """A flow sensor at the pump, which adds noise and a delay; see rigs.streams.stream.SampleStream.

    It measures the pump only, as a sensor in the tube does: nothing of the chip, its walls or the robot. The sensor
    knows the flow that was set, so it states the flow of the pump over that.

    Parameters
    ----------
    pump : the true one.
    rate_hz : samples a second.
    noise_share : standard deviation of a sample, as a ratio.
    delay_s : from the flow to the sample that shows it; the stamp is that of the sample.
    seed : of the noise.
    now_ns : the rig's present stamp.
    """

    polled: ClassVar[bool] = True

    def __init__(
        self, pump: Pump, rate_hz: float, noise_share: float, delay_s: float, seed: int, now_ns: Callable[[], int]
    ) -> None:
        self._pump, self._rate_hz, self._noise, self._delay_s = pump, rate_hz, noise_share, delay_s
        self._rng = np.random.default_rng([seed, 34])
        self._now_ns = now_ns
        self._next = 0

    def open(self) -> StreamHead:
        return StreamHead(("flow",), ("1",), self._rate_hz, "simulated pump")

    def read(self, timeout_s: float) -> Chunk | None:
        now_ns = self._now_ns()
        end = math.floor(seconds(now_ns) * self._rate_hz) + 1
        if end <= self._next:
            return None
        times_ns = np.rint(np.arange(self._next, end) * (NS_PER_S / self._rate_hz)).astype(np.int64)
        self._next = end
        true = np.array([self._pump.strength(seconds(int(time)) - self._delay_s) for time in times_ns])
        measured = true * (1.0 + self._noise * self._rng.standard_normal(len(true)))
        return Chunk(times_ns, measured[:, None], now_ns)

    def correction_s(self) -> float:
        return 0.0

    def close(self) -> None:
        """There is nothing to disconnect."""
