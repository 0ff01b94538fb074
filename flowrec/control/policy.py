"""The slope of the time to go: which way a robot should swim, wherever it is.

T is inf in solid, near walls and where the flow wins. There it is continued outward from the nearest place that knows
a way, rising with the distance: so its slope leads back and onward at once, and no neighbour is missing near an edge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Raster = NDArray[np.float32]
_REACH_PX = 2  # how far around a point the slope is felt


def downhill(time_to_go_s: Raster, um_per_px: float, point_um: Vector) -> Vector:
    """Unit vector (2,) of -grad T at a point; towards the nearest place that knows a way where none is about."""
    x, y = point_um / um_per_px
    return slope_plane(time_to_go_s, float(x), float(y))


def astray_um(time_to_go_s: Raster, um_per_px: float, point_um: Vector) -> float:
    """Distance from a point to the nearest pixel with a finite T, less the pixel's own size; inf if there is none."""
    x, y = (float(value) for value in point_um / um_per_px)
    return max(_nearest(time_to_go_s, x, y)[0] - math.sqrt(0.5), 0.0) * um_per_px
