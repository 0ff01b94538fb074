"""Hydrodynamic hindrance of a sphere between side walls: of its own motion, and of its motion with a flow.

A sphere of radius a is at the distances d and d' from the two side walls of its channel; s = a / d, s' = a / d'.

- A plane wall raises the drag along it to 1 / (1 - 9/16 s + 1/8 s^3) of Stokes' (Faxen 1922; Happel and Brenner 1973,
  section 7-4): 5 % too little at s = 0.65, a quarter at s = 0.9, where a robot is rarely seen.
- A wall holds a force-free sphere back in a shear flow S by 5/16 s^3 S d (Goldman, Cox and Brenner, Chem. Eng. Sci. 22
  (1967) 653, far from the wall; within 0.02 S d of their exact values up to s = 0.89, within 0.08 S d at s = 0.96).
- In a curved profile a sphere follows v + a^2 / 6 lap v (Faxen 1922).

The excess of two walls is added (Oseen 1927), and so is their lag. In plane Poiseuille flow the shear at d is
v (d' - d) / (d d'), so the lag of both walls is v (d' - d) 5/16 (s^3 / d' - s'^3 / d): none in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class ChannelWidths:
    """Widths of the channels of a chip: that of the largest disc in the fluid that holds a place.

    This is the local thickness of Hildebrand and Rueegsegger (1997).
    """

    radii_px: NDArray[np.floating]  # of the largest disc around each pixel, with a margin of `reach_px` + 1 pixels
    reach_px: int  # no disc whose centre is farther away holds a place

    @classmethod
    def of(cls, mask: Bools, clearance_px: NDArray[np.floating]) -> ChannelWidths:
        """The channels of a mask (h, w); `clearance_px` (h, w) is the distance of pixels to the nearest wall."""
        radii = np.where(mask, np.clip(clearance_px, 0.5, max(mask.shape)), 0.0)
        reach = int(np.ceil(radii.max(initial=0.0)))
        return cls(np.pad(radii, reach + 1), reach)

    def at(self, points: Floats) -> Floats:
        """(n,) widths in px at points (n, 2) in px; half a pixel where no disc holds the point."""
        window = np.arange(-self.reach_px, self.reach_px + 2)
        widths = []
        for column, row in points:
            first_row, first_column = int(row), int(column)
            radii = self.radii_px[first_row + 1 :, first_column + 1 :][: len(window), : len(window)]
            away = ((first_row + window - row) ** 2)[:, None] + (first_column + window - column) ** 2
            widths.append(2.0 * np.where(away <= radii**2, radii, 0.25).max())
        return np.array(widths)


@dataclass(frozen=True, slots=True, eq=False)
class SphereBetweenWalls:
    """A sphere at each of a number of places. One that is seen nearer to a wall than its radius touches it."""

    radius_px: float
    near_px: Floats  # (n,) to the nearest wall
    far_px: Floats  # (n,) to the wall on the other side of the channel

    @classmethod
    def of(cls, radius_px: float, near_px: Floats, width_px: Floats) -> SphereBetweenWalls:
        """The sphere at the distances (n,) from the nearest wall, in channels of the widths (n,)."""
        near_px = np.maximum(near_px, radius_px)
        return cls(radius_px, near_px, np.maximum(width_px - near_px, near_px))

    @property
    def drag(self) -> Floats:
        """(n,) drag of both walls on a motion along them, over Stokes' drag."""
        s = self.radius_px / np.stack([self.near_px, self.far_px])
        return np.asarray((1.0 / (1.0 - 9.0 / 16.0 * s + s**3 / 8.0) - 1.0).sum(axis=0))

    @property
    def lag(self) -> Floats:
        """(n,) by what fraction of the flow at its centre both walls hold it back in shear."""
        near, far = self.near_px, self.far_px
        lags = 5.0 / 16.0 * (self.radius_px / near) ** 3 / far - 5.0 / 16.0 * (self.radius_px / far) ** 3 / near
        return np.asarray((far - near) * lags)

    def transport_slip(self, v: Floats, laplacian: Floats) -> Floats:
        """(n, 2) velocity with which a flow v (n, 2) carries the sphere, less v; `laplacian` (n, 2) is that per px2."""
        return np.asarray(self.radius_px**2 / 6.0 * laplacian - self.lag[:, None] * v)
