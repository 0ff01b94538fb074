"""The coil amplifiers, and the limits that currents and voltages set to the rotating field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from flowrec.core import Floats, Range

PerCoil = float | tuple[float, ...]  # one number for all coils, or one for each
WORST_CONDITION = 1e3  # largest condition number of the matrix mt_per_a that is accepted
_TURN_RAD = 2.0 * math.pi
_H_PER_MH = 1e-3  # henry per millihenry
_MOST_ROUNDS = 200  # of the weights of coils; the amplitude of six coils rises by less than 0.1 % in the last 100
_LEAST_SHARE = 1e-6  # of a coil that the field does not need


@dataclass(frozen=True, slots=True)
class AmplifierSettings:
    """An amplifier for each coil, driven by the analogue outputs of a card.

    A current amplifier controls its own current: V = i / g. A voltage amplifier needs V = (R i + L di/dt) / gain, with
    resistance and inductance of the coil; without the second term, 4 mH in series with 2 ohm lag 14 degrees at 20 Hz.
    """

    kind: Literal["current", "voltage"] = "current"  # what the amplifier controls
    # gain g of a current amplifier: one number for all coils, or a list with one for each
    a_per_v: Annotated[PerCoil, Range(1e-6, 1e6)] = 1.0
    v_per_v: Annotated[PerCoil, Range(1e-6, 1e6)] = 1.0  # gain of a voltage amplifier, of all coils or of each
    # resistance of each coil with its leads, or of all; used for a voltage amplifier
    resistance_ohm: Annotated[PerCoil, Range(0.0, 1e5)] = 2.0
    inductance_mh: Annotated[PerCoil, Range(0.0, 1e5)] = 5.0  # inductance of each coil, or of all
    max_voltage_v: Annotated[float, Range(1e-3, 1e4)] = 10.0  # largest voltage of the outputs, not of the coils
    output_hz: Annotated[float, Range(100.0, 1e7)] = 20_000.0  # samples per second of each output

    @property
    def ohm(self) -> Floats:
        """(n,) output volts per ampere of constant current, of n coils; (1,): of all coils."""
        if self.kind == "current":
            return np.atleast_1d(np.divide(1.0, self.a_per_v))
        return np.atleast_1d(np.divide(self.resistance_ohm, self.v_per_v))

    @property
    def henry(self) -> Floats:
        """(n,) output volts per ampere per second; (1,): of all coils."""
        if self.kind == "current":
            return np.zeros(1)
        return np.atleast_1d(np.divide(self.inductance_mh, self.v_per_v) * _H_PER_MH)

    def sample_and_hold_v(self, currents_a: Floats, step_s: float) -> Floats:
        """Voltages (n, 3), each held for one step, that produce the currents (n + 1, 3) at the samples.

        Exact for V = R i + L di/dt with V constant over a step: i' = a i + (1 - a) V / R with a = exp(-R step / L).
        V is a weighted mean of R i + L di/dt over the step, so it never exceeds the maximum of that expression.
        """
        return self.ohm * currents_a[:-1] + self.slope_ohm(step_s) * np.diff(currents_a, axis=0)

    def slope_ohm(self, step_s: float) -> Floats:
        """(n,) output volts per ampere of change within a step, besides R times the current at its beginning.

        R (i' - a i) / (1 - a) = R i + R (i' - i) / (1 - a); -expm1 keeps its digits where R is small.
        """
        per_coil = np.broadcast_arrays(self.ohm, self.henry)
        slope = np.zeros(per_coil[0].shape)
        for c, (ohm, henry) in enumerate(zip(*per_coil, strict=True)):
            if henry > 0.0:
                per_step = step_s / henry
                slope[c] = ohm / -np.expm1(-ohm * per_step) if ohm > 0.0 else 1.0 / per_step
        return slope


@dataclass(frozen=True, slots=True, eq=False)
class FieldLimits:
    """The rotating field that coils and amplifiers can produce in any direction.

    The same limit applies to all headings and all coils are scaled alike, so the field describes a circle and its
    amplitude does not depend on the heading. A field of amplitude b that rotates at angular frequency w needs at most
    |row c of A^-1| b amperes and |row c of A^-1| b |R + j w L| volts at coil c, when it points along that row. Of n
    coils A^-1 is a right inverse of the (3, n) matrix A: see `shared_inverse`.
    """

    inverse: Floats  # (n, 3) A^-1, A per mT
    bias_a: Floats  # (n,) currents that would produce the bias field; their negative compensates it
    row_a_per_mt: Floats  # (n,) norms of the rows of A^-1
    a_per_mt_ramp: Floats  # (n,) A/s per mT/s while the amplitude ramps, and the bias compensation with it
    available_a: Floats  # (n,) current left for the rotating field after bias compensation
    available_v: Floats  # (n,) voltage left for the rotating field after bias compensation and ramp
    ohm: Floats  # (n,)
    henry: Floats  # (n,)
    nominal_mt: float  # amplitude that the settings ask for

    def max_amplitude_mt(self, frequency_hz: float) -> float:
        """Largest amplitude of a field that rotates at a frequency."""
        return max(float(self.coil_amplitudes_mt(frequency_hz).min()), 0.0)

    def coil_amplitudes_mt(self, frequency_hz: float) -> Floats:
        """(n,) the amplitude at which each coil reaches a limit of its own, at a frequency."""
        volts_per_mt = self.row_a_per_mt * np.hypot(self.ohm, _TURN_RAD * frequency_hz * self.henry)
        amplitudes: Floats = np.minimum(
            self.available_a / self.row_a_per_mt, self.available_v / np.maximum(volts_per_mt, 1e-12)
        )
        return amplitudes

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


def shared_inverse(matrix: Floats, limits_of: Callable[[Floats], FieldLimits]) -> Floats:
    """Currents per field (n, 3) of n > 3 coils with the matrix A (3, n): of all G with A G = 1 the one to use.

    The pseudo-inverse, whose currents have the least norm, where no coil exceeds a limit with it at the nominal
    amplitude, whatever the direction of the field. Else the coils that limit the amplitude give way to others:
    G = W A^T (A W A^T)^-1 minimises sum |g_c|^2 / w_c, and Lawson's rule, which multiplies the weight of each coil by
    its load, leads to the G with the largest amplitude (C. L. Lawson, Contributions to the theory of linear least
    maximum approximation, 1961). It stops as soon as the nominal amplitude is reached.

    The map is linear, so that a tick, the samples of a card and a firmware, which know a field only by its three
    vectors, make the same currents, and bounds of current, voltage and slew hold between samples too. `limits_of`: the
    limits of a G.
    """
    least_norm: Floats = np.linalg.pinv(matrix).astype(np.float64)
    best = inverse = least_norm
    most_mt, shares = -math.inf, None
    for _ in range(_MOST_ROUNDS):
        limits = limits_of(inverse)
        amplitudes_mt = np.maximum(limits.coil_amplitudes_mt(0.0), 1e-3 * limits.nominal_mt)
        if amplitudes_mt.min() > most_mt:
            best, most_mt = inverse, float(amplitudes_mt.min())
        if most_mt >= limits.nominal_mt:
            break
        limit_a = amplitudes_mt * np.maximum(limits.row_a_per_mt, 1e-12)
        shares = limit_a**2 if shares is None else shares  # with which W = 1
        shares = np.maximum(shares / amplitudes_mt, _LEAST_SHARE * shares.max())
        shares /= shares.sum()
        weighted = (limit_a**2 / shares)[:, None] * matrix.T
        inverse = weighted @ np.linalg.inv(matrix @ weighted)
        inverse = inverse + least_norm @ (np.eye(len(matrix)) - matrix @ inverse)  # A G = 1 but for rounding
    return best


def direction_name(direction: Floats) -> str:
    """A direction (3,) as text: x, or (0.71, 0.00, -0.71)."""
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.98:
        return "xyz"[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in direction * np.sign(direction[largest])) + ")"
