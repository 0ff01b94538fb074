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

from flowrec.core import Floats

_MOST_PAIRS = 2_000_000  # of a point and a disc that are compared at once, for the memory that they take


@dataclass(frozen=True, slots=True, eq=False)
class SphereBetweenWalls:
    """A sphere at each of a number of places. One that is seen nearer to a wall than its radius touches it."""

    radius_px: float
    near_px: Floats  # (n,) to the nearest wall
    far_px: Floats  # (n,) to the wall on the other side of the channel

    @classmethod
    def of(
        cls, radius_px: float, mask: NDArray[np.bool_], clearance_px: NDArray[np.floating], points: Floats, near: Floats
    ) -> SphereBetweenWalls:
        """The sphere at points (n, 2) in px, which are at the distances (n,) from the nearest wall.

        A channel is as wide as the largest disc in it that holds the point: the local thickness of Hildebrand and
        Rueegsegger (1997). `clearance_px` (h, w) is the distance of pixels to the nearest wall.
        """
        radii = np.where(mask, np.maximum(clearance_px, 0.5), 0.0)
        reach = int(np.ceil(radii.max(initial=0.0)))  # no disc whose centre is farther away holds a point
        around, window = np.pad(radii, reach + 1), np.arange(-reach, reach + 2)
        widths = []
        for part in np.array_split(points, 1 + len(points) * len(window) ** 2 // _MOST_PAIRS):
            corner = part.astype(np.intp)
            rows, columns = (corner[:, axis, None] + window for axis in (1, 0))
            discs = around[(rows + reach + 1)[:, :, None], (columns + reach + 1)[:, None, :]]
            away = ((rows - part[:, 1:]) ** 2)[:, :, None] + ((columns - part[:, :1]) ** 2)[:, None, :]
            widths.append(2.0 * np.where(away <= discs**2, discs, 0.25).max(axis=(1, 2)))
        near = np.maximum(near, radius_px)
        return cls(radius_px, near, np.maximum(np.concatenate(widths) - near, near))

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
