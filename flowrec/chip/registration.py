"""Where camera pixels lie on the chip, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class Calibration:
    """Camera pixel (c, r), counted at pixel centres, lies at origin + um_per_px * (c, r) in the chip frame."""

    um_per_px: float
    origin_um: tuple[float, float] = (0.0, 0.0)

    def to_um(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Camera pixels (..., 2) as (column, row) to chip coordinates (..., 2) in um."""
        return np.asarray(points_px, np.float64) * self.um_per_px + np.asarray(self.origin_um, np.float64)

    def to_px(self, points_um: ArrayLike) -> NDArray[np.float64]:
        """Chip coordinates (..., 2) in um to camera pixels (..., 2) as (column, row)."""
        return (np.asarray(points_um, np.float64) - np.asarray(self.origin_um, np.float64)) / self.um_per_px
