"""How a flow answers to its boundary values: what assimilation fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.messages import FlowField


@dataclass(frozen=True, slots=True, eq=False)
class FlowModes:
    """First order around `base`: v(values) = base + sum_i (values_i - base values_i) velocity[i].

    For Stokes flow this is exact, and base = sum_i values_i velocity[i].
    """

    base: FlowField
    velocity: NDArray[np.float64]  # (openings, h, w, 2) um/s per unit boundary value (um/s, or Pa)
    pressure: NDArray[np.float64]  # (openings, h, w) Pa per unit boundary value
    viscosity_velocity: NDArray[np.float64]  # (h, w, 2) um/s per unit of ln mu
    viscosity_pressure: NDArray[np.float64]  # (h, w) Pa per unit of ln mu
