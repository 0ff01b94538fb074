"""A flow sensor at the simulated pump: the flow over the steady one, as a sensor with noise and a delay measures it.

It measures the pump only, as a sensor in the tube does: nothing of the chip, its walls or the robot. The sensor knows
the flow that was set, so it states the flow of the pump over that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from flowrec.core import NS_PER_S, seconds
from flowrec.rigs.simulated.pump import Pump
from flowrec.rigs.streams.stream import Chunk, StreamHead


class PumpSensor:
    """See rigs.streams.stream.SampleStream.

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
