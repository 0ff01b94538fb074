"""Uncertainty of a flow: the modes of its error, their covariance, and the variance that they do not explain.

It is not a message: it follows from the recorded observations and is computed anew where it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Doubts:
    """Alternatives in one place: k changes of the flow that exclude each other."""

    changes_um_s: NDArray[np.floating]  # (k, n, 2) of the flow
    probability: Floats  # (k,) of each; what is left to 1 is that of no change

    @classmethod
    def none(cls, pixels: int) -> Doubts:
        """Nothing is doubted."""
        return cls(np.zeros((0, pixels, 2)), np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Chip point of a measured point x: x + offset - scale (x - c) - angle J (x - c); J turns from +x to +y."""

    offset_um: Floats  # (2,)
    scale: float  # relative error of um per pixel
    angle_rad: float  # from +x to +y
    centre_um: Floats  # (2,) c

    @classmethod
    def identity(cls) -> Registration:
        """Measured places are those of the chip."""
        return cls(np.zeros(2), 0.0, 0.0, np.zeros(2))

    def on_chip(self, measured_um: Floats) -> Floats:
        """(n, 2) places on the chip of measured places (n, 2)."""
        return self.centre_um + self.offset_um + (measured_um - self.centre_um) @ self._turn.T

    @property
    def matrix(self) -> Floats:
        """R (2, 3): a measured place x (2,) lies on the chip at R (x, 1)."""
        return np.column_stack((self._turn, self.centre_um + self.offset_um - self._turn @ self.centre_um))

    def to_measured(self, on_chip_um: Floats) -> Floats:
        """(n, 2) where places (n, 2) on the chip are measured."""
        away = on_chip_um - self.centre_um - self.offset_um
        return self.centre_um + np.linalg.solve(self._turn, away.T).T

    @property
    def _turn(self) -> Floats:
        grown = 1.0 - self.scale
        return np.array([[grown, self.angle_rad], [-self.angle_rad, grown]])


@dataclass(frozen=True, eq=False)  # no slots, for what many ways are weighed by
class FlowUncertainty:
    """The flow is mean + z columns with z ~ N(0, covariance), on the n fluid pixels of a mask in raster order.

    The first p unknowns are those of the flow. The last r are constants of the robot: each adds to an *observed* flow
    a multiple of the robot's own velocity through the fluid, and nothing to the flow itself.
    """

    mean_um_s: Floats  # (n, 2) the most probable flow
    columns_um_s: Floats  # (p, n, 2) per unit of each unknown of the flow
    # (r, n) ratio of what a unit of each constant of the robot adds to an observed flow to its own velocity; 1
    # everywhere for the relative error of um per revolution
    rolled: Floats
    covariance: Floats  # (p + r, p + r) of all unknowns
    error_um_s: Floats  # (n,) standard deviation of a component that no unknown explains
    # by which the noise of observations was wider than stated, neighbours that err alike included
    noise_factor: float = 1.0
    # what may be wrong in one place; neither `std_um_s` nor `error_share` contains it
    doubts: Doubts = field(default_factory=lambda: Doubts.none(0))
    registration: Registration = field(default_factory=Registration.identity)  # the most probable one

    @property
    def std_um_s(self) -> Floats:
        """(n, 2) standard deviation of each component of the flow."""
        count = len(self.columns_um_s)
        modes = np.tensordot(self.covariance[:count, :count], self.columns_um_s, axes=1)
        variance = (modes * self.columns_um_s).sum(axis=0)
        return np.sqrt(np.maximum(variance, 0.0) + self.error_um_s[:, None] ** 2)

    @property
    def error_share(self) -> float:
        """The expected relative error of the flow over the mask, as in `FlowField.error_share`."""
        speed = float(np.sqrt((self.mean_um_s**2).sum()))
        return float(np.sqrt((self.std_um_s**2).sum())) / max(speed, 1e-300)

    def effect(self, pixels: Ints, own_um_s: Floats) -> Floats:
        """(m, 2, p + r + k) what a unit of each unknown, and each doubt, adds to the flow observed in m fluid pixels.

        `own_um_s` (m, 2) is the velocity of the robot through the fluid there.
        """
        found, first = self._of_pixels[pixels], len(self.columns_um_s)
        found[:, :, first : first + len(self.rolled)] = self.rolled[:, pixels].T[:, None] * own_um_s[:, :, None]
        return found

    @cached_property
    def _of_pixels(self) -> Floats:
        """(n, 2, p + r + k) `effect` of a robot at rest."""
        still = np.zeros((len(self.rolled), *self.mean_um_s.shape))
        changes = self.doubts.changes_um_s.reshape(-1, *self.mean_um_s.shape)
        return np.ascontiguousarray(np.moveaxis(np.concatenate([self.columns_um_s, still, changes]), 0, 2), np.float64)
