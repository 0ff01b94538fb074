"""The clock inside the simulated camera, and how long its frames take to the host. Drawn from the seed."""

from __future__ import annotations

import numpy as np

from flowrec.rig_settings import Simulated
from flowrec.units import NS_PER_S

_SKEW_PPM = 50.0  # of a crystal, at most
_STARTED_S = 3600.0  # ago, at most


class CameraClock:
    """Counts nanoseconds from when the camera was switched on, a little too fast or too slow."""

    def __init__(self, simulated: Simulated) -> None:
        rng = np.random.default_rng([simulated.seed, 6])
        drawn_ppm, started_s = float(rng.uniform(-_SKEW_PPM, _SKEW_PPM)), float(rng.uniform(0.0, _STARTED_S))
        skew_ppm = drawn_ppm if simulated.clock_skew_ppm is None else simulated.clock_skew_ppm
        self._rate = 1.0 + 1e-6 * skew_ppm
        self._started = round(started_s * NS_PER_S)
        self._jitter_s = simulated.arrival_jitter_s
        self._rng = rng

    def device(self, world_ns: int) -> int:
        """What it shows."""
        return self._started + round(self._rate * world_ns)

    def delay_s(self) -> float:
        """By how much the next frame arrives late, besides what all of them do."""
        return self._jitter_s * float(self._rng.standard_exponential())
