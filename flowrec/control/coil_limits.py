"""How strong a field coils and amplifiers can make, and how fast they can turn it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TURN_RAD = 2.0 * math.pi
WORST_CONDITION = 1e3  # of three coils that are still said to span the room


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """What the coils and their amplifiers can do, for a field in any direction.

    One limit for all headings and one scale for all coils: the circle stays round, the field is as strong whichever
    way the robot turns, and so is the robot. A field b turning at rate w asks of coil c at most |row c of A^-1| b
    amperes and |row c| b |R + j w L| volts, both reached where it passes the coil's own direction.
    """

    inverse: NDArray[np.float64]  # (3, 3) A per mT
    bias_a: NDArray[np.float64]  # (3,) the currents that would make the bias; their negative compensates it
    row_a_per_mt: NDArray[np.float64]  # (3,)
    left_a: NDArray[np.float64]  # (3,) for the circle, after the bias
    left_v: NDArray[np.float64]  # (3,) for the circle, after the bias and the ramp
    ohm: NDArray[np.float64]  # (3,)
    henry: NDArray[np.float64]  # (3,)
    wanted_mt: float

    def room_mt(self, frequency_hz: float) -> float:
        """The largest amplitude of a field whose direction turns at a rate."""
        volts = self.row_a_per_mt * np.hypot(self.ohm, _TURN_RAD * frequency_hz * self.henry)
        room = np.minimum(self.left_a / self.row_a_per_mt, self.left_v / np.maximum(volts, 1e-12))
        return max(float(room.min()), 0.0)

    def amplitude_mt(self, followed_hz: float) -> float:
        """The amplitude to run at: as wanted, or the largest that can be turned as fast as it lets a robot follow.

        A robot follows the wanted field up to `followed_hz`, a weaker one up to a share of that, and a slower turn
        leaves room for a stronger field. The one field where both meet, f = followed_hz room(f) / wanted, is taken for
        all frequencies, so that the amplitude need not wait for the frequency nor the other way round. With
        room(f) = V / (row |R + j w L|) it is the root of a quadratic in f^2 for each coil.
        """
        top = min(self.wanted_mt, self.room_mt(0.0))
        if followed_hz <= 0.0:
            return max(top, 0.0)
        product = followed_hz * np.maximum(self.left_v, 0.0) / (self.row_a_per_mt * self.wanted_mt)  # f |R + j w L|
        square = (_TURN_RAD * self.henry) ** 2
        root = np.sqrt(self.ohm**4 + 4.0 * square * product**2)
        f = np.sqrt(2.0 * product**2 / np.maximum(self.ohm**2 + root, 1e-300))
        return max(min(top, self.wanted_mt * float(f.min()) / followed_hz), 0.0)


def named(direction: NDArray[np.float64]) -> str:
    """A direction (3,) in words: x, or (0.71, 0, -0.71)."""
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.98:
        return "xyz"[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in direction * np.sign(direction[largest])) + ")"
