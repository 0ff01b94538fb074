"""From coil currents to what is put out: the amplifiers, and what they can not do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.ranges import Range

Coilwise = tuple[float, float, float]  # one number for each coil: x, y, z
_H_PER_MH = 1e-3


@dataclass(frozen=True, slots=True)
class Amplifier:
    """Three amplifiers, driven by the analogue outputs of a card.

    current: each sees to its current itself, V = i / g. voltage: V = (R i + L di/dt) / gain, with the coil's
    resistance and inductance; without the second term 4 mH behind 2 ohm lag 14 degrees at 20 Hz.
    """

    kind: Literal["current", "voltage"] = "current"
    a_per_v: Annotated[Coilwise, Range(1e-6, 1e6)] = (1.0, 1.0, 1.0)  # g of a current amplifier
    v_per_v: Annotated[Coilwise, Range(1e-6, 1e6)] = (1.0, 1.0, 1.0)  # gain of a voltage amplifier
    # of each coil with its leads; for a voltage amplifier
    resistance_ohm: Annotated[Coilwise, Range(0.0, 1e5)] = (2.0, 2.0, 2.0)
    inductance_mh: Annotated[Coilwise, Range(0.0, 1e5)] = (5.0, 5.0, 5.0)
    max_voltage_v: Annotated[float, Range(1e-3, 1e4)] = 10.0  # of the outputs, not of the coils
    output_hz: Annotated[float, Range(100.0, 1e7)] = 20_000.0  # samples per second of each output

    @property
    def ohm(self) -> NDArray[np.float64]:
        """(3,) volts put out per ampere of a steady current."""
        if self.kind == "current":
            return np.divide(1.0, self.a_per_v)
        return np.divide(self.resistance_ohm, self.v_per_v)

    @property
    def henry(self) -> NDArray[np.float64]:
        """(3,) volts put out per ampere per second."""
        if self.kind == "current":
            return np.zeros(3)
        return np.divide(self.inductance_mh, self.v_per_v) * _H_PER_MH

    def held_v(self, currents_a: NDArray[np.float64], step_s: float) -> NDArray[np.float64]:
        """(n, 3) voltages, each held for a step, that take the currents (n + 1, 3) from sample to sample.

        Exact for V = R i + L di/dt under a held voltage: i' = a i + (1 - a) V / R with a = exp(-R step / L). As V is a
        weighted mean of R i + L di/dt over the step, it never exceeds the largest of these.
        """
        ohm, henry = self.ohm, self.henry
        held = ohm * currents_a[:-1]
        change = np.diff(currents_a, axis=0)
        for c in np.flatnonzero(henry > 0.0):
            # R (i' - a i) / (1 - a) = R i + R (i' - i) / (1 - a); -expm1 keeps its digits where R is small.
            per_step = step_s / henry[c]
            slope = ohm[c] / -np.expm1(-ohm[c] * per_step) if ohm[c] > 0.0 else 1.0 / per_step
            held[:, c] += slope * change[:, c]
        return held
