"""Viscosity of a case without dimensions, where it depends on the shear rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats
from flowrec.physics import Chip, ViscosityLaw


@dataclass(frozen=True, slots=True)
class LocalViscosity:
    """mu over the viscosity of the case, which is that at the shear rate V / L of its units."""

    law: ViscosityLaw
    rate_1_s: float  # V / L
    gap: float  # shear rate across the depth per speed, in units of 1 / L
    scale: float  # viscosity of the case over that of the chip

    @classmethod
    def of(cls, chip: Chip, speed_um_s: float, length_um: float) -> LocalViscosity | None:
        """Viscosity of a chip's fluid in units of a speed and a length; None for a Newtonian fluid."""
        if chip.law is None:
            return None
        rate = speed_um_s / length_um
        gap = 0.0 if chip.depth_um is None else 6.0 * chip.law.slit_factor * length_um / chip.depth_um
        return cls(chip.law, rate, gap, float(chip.law.relative(np.array([rate**2]))[0][0]))

    def relative(self, rate2: Floats) -> tuple[Floats, Floats]:
        """Viscosity and its derivative, at any number of squared shear rates in units of (V / L)^2."""
        value, slope = self.law.relative(rate2.ravel().astype(np.float64) * self.rate_1_s**2)
        return value.reshape(rate2.shape) / self.scale, slope.reshape(rate2.shape) * (self.rate_1_s**2 / self.scale)


def viscosity_scale(local: LocalViscosity | None) -> float:
    """Viscosity of a case over that of the chip."""
    return 1.0 if local is None else local.scale
