"""The coil amplifiers, and the limits that currents and voltages set to the rotating field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from flowrec.core import Floats, Range

PerCoil = tuple[float, float, float]  # one number for each coil: x, y, z
WORST_CONDITION = 1e3  # largest condition number of the matrix mt_per_a that is accepted
_TURN_RAD = 2.0 * math.pi
_H_PER_MH = 1e-3  # henry per millihenry


@dataclass(frozen=True, slots=True)
class AmplifierSettings:
    """Three amplifiers, driven by the analogue outputs of a card.

    A current amplifier controls its own current: V = i / g. A voltage amplifier needs V = (R i + L di/dt) / gain, with
    resistance and inductance of the coil; without the second term, 4 mH in series with 2 ohm lag 14 degrees at 20 Hz.
    """

    kind: Literal["current", "voltage"] = "current"  # what the amplifier controls
    a_per_v: Annotated[PerCoil, Range(1e-6, 1e6)] = (1.0, 1.0, 1.0)  # gain g of a current amplifier
    v_per_v: Annotated[PerCoil, Range(1e-6, 1e6)] = (1.0, 1.0, 1.0)  # gain of a voltage amplifier
    # resistance of each coil with its leads; used for a voltage amplifier
    resistance_ohm: Annotated[PerCoil, Range(0.0, 1e5)] = (2.0, 2.0, 2.0)
    # inductance of the coil pairs along x, y and z
    inductance_mh: Annotated[PerCoil, Range(0.0, 1e5)] = (5.0, 5.0, 5.0)
    max_voltage_v: Annotated[float, Range(1e-3, 1e4)] = 10.0  # largest voltage of the outputs, not of the coils
    output_hz: Annotated[float, Range(100.0, 1e7)] = 20_000.0  # samples per second of each output

    @property
    def ohm(self) -> Floats:
        """(3,) output volts per ampere of constant current."""
        if self.kind == "current":
            return np.divide(1.0, self.a_per_v)
        return np.divide(self.resistance_ohm, self.v_per_v)

    @property
    def henry(self) -> Floats:
        """(3,) output volts per ampere per second."""
        if self.kind == "current":
            return np.zeros(3)
        return np.divide(self.inductance_mh, self.v_per_v) * _H_PER_MH

    def sample_and_hold_v(self, currents_a: Floats, step_s: float) -> Floats:
        """Voltages (n, 3), each held for one step, that produce the currents (n + 1, 3) at the samples.

        Exact for V = R i + L di/dt with V constant over a step: i' = a i + (1 - a) V / R with a = exp(-R step / L).
        V is a weighted mean of R i + L di/dt over the step, so it never exceeds the maximum of that expression.
        """
        return self.ohm * currents_a[:-1] + self.slope_ohm(step_s) * np.diff(currents_a, axis=0)

    def slope_ohm(self, step_s: float) -> Floats:
        """(3,) output volts per ampere of change within a step, besides R times the current at its beginning.

        R (i' - a i) / (1 - a) = R i + R (i' - i) / (1 - a); -expm1 keeps its digits where R is small.
        """
        slope = np.zeros(3)
        for c, (ohm, henry) in enumerate(zip(self.ohm, self.henry, strict=True)):
            if henry > 0.0:
                per_step = step_s / henry
                slope[c] = ohm / -np.expm1(-ohm * per_step) if ohm > 0.0 else 1.0 / per_step
        return slope


@dataclass(frozen=True, slots=True, eq=False)
class FieldLimits:
    """The rotating field that coils and amplifiers can produce in any direction.

    The same limit applies to all headings and all coils are scaled alike, so the field describes a circle and its
    amplitude does not depend on the heading. A field of amplitude b that rotates at angular frequency w needs at most
    |row c of A^-1| b amperes and |row c of A^-1| b |R + j w L| volts at coil c, when it points along that row.
    """

    inverse: Floats  # (3, 3) A^-1, A per mT
    bias_a: Floats  # (3,) currents that would produce the bias field; their negative compensates it
    row_a_per_mt: Floats  # (3,) norms of the rows of A^-1
    a_per_mt_ramp: Floats  # (3,) A/s per mT/s while the amplitude ramps, and the bias compensation with it
    available_a: Floats  # (3,) current left for the rotating field after bias compensation
    available_v: Floats  # (3,) voltage left for the rotating field after bias compensation and ramp
    ohm: Floats  # (3,)
    henry: Floats  # (3,)
    nominal_mt: float  # amplitude that the settings ask for

    def max_amplitude_mt(self, frequency_hz: float) -> float:
        """Largest amplitude of a field that rotates at a frequency."""
        volts_per_mt = self.row_a_per_mt * np.hypot(self.ohm, _TURN_RAD * frequency_hz * self.henry)
        amplitude = np.minimum(self.available_a / self.row_a_per_mt, self.available_v / np.maximum(volts_per_mt, 1e-12))
        return max(float(amplitude.min()), 0.0)

    def operating_amplitude_mt(self, follow_hz: float) -> float:
        """Amplitude to run at: the nominal one, or the largest that can rotate as fast as the robot follows it.

        The robot follows the nominal field up to `follow_hz`, and a weaker field up to a frequency that is lower in
        proportion; slower rotation in turn permits a stronger field. The amplitude at which both limits agree,
        f = follow_hz max_amplitude(f) / nominal, is used at every frequency. With max_amplitude(f) =
        V / (row |R + j w L|), f^2 is the root of a quadratic equation for each coil.
        """
        static_mt = min(self.nominal_mt, self.max_amplitude_mt(0.0))
        if follow_hz <= 0.0:
            return max(static_mt, 0.0)
        product = follow_hz * np.maximum(self.available_v, 0.0) / (self.row_a_per_mt * self.nominal_mt)  # f |R + j w L|
        square = (_TURN_RAD * self.henry) ** 2
        root = np.sqrt(self.ohm**4 + 4.0 * square * product**2)
        f = np.sqrt(2.0 * product**2 / np.maximum(self.ohm**2 + root, 1e-300))
        return max(min(static_mt, self.nominal_mt * float(f.min()) / follow_hz), 0.0)


def direction_name(direction: Floats) -> str:
    """A direction (3,) as text: x, or (0.71, 0.00, -0.71)."""
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.98:
        return "xyz"[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in direction * np.sign(direction[largest])) + ")"
