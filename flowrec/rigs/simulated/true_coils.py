"""True field of coils whose calibration is wrong: its vector moves on an ellipse in a tilted plane.

The commanded field B(theta) = B0 (h sin theta + z cos theta) is made with the currents A^-1 B; with the true matrix A'
it is M B, M = A' A^-1. It turns about the normal of the plane of M h and M z, so the robot travels at an angle to the
heading; and it follows up to a frequency that is proportional to the shorter axis of the ellipse. What the tilt takes
of the rolled distance is of second order and left out, and so is a wrong bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import wrap_rad
from flowrec.rigs.simulated.world import drawn_from
from flowrec.stages import Coils, Simulated


@dataclass(frozen=True, slots=True, eq=False)
class TrueCoils:
    """Coils as they are calibrated, and the matrix from a commanded field to the true one."""

    coils: Coils
    made: NDArray[np.float64]  # (3, 3) M

    @classmethod
    def of(cls, coils: Coils | None, simulated: Simulated) -> TrueCoils | None:
        """The coils of a world; None: as they are calibrated."""
        error = simulated.value("coil_error")
        if coils is None or error == 0.0:
            return None
        stated = np.array(coils.mt_per_a)
        draws = drawn_from(simulated.seed, "coils").uniform(-1.0, 1.0, (3, 3))
        return cls(coils, np.eye(3) + error * draws * np.linalg.norm(stated, axis=0) @ np.linalg.inv(stated))

    def motion(self, heading_rad: float) -> tuple[float, float]:
        """The direction in which the robot travels when this heading is asked for, and the field's strength, 1: full.

        The heading may be that of the plane or the opposite one: the answer turns with it.
        """
        forward, up = self.coils.field_mt([0.5 * math.pi, 0.0], heading_rad, 1.0)
        asked, axis = np.cross(forward, up), np.cross(self.made @ forward, self.made @ up)
        turned_rad = math.atan2(axis[1], axis[0]) - math.atan2(asked[1], asked[0])
        ellipse = np.linalg.svd(self.made @ np.column_stack([forward, up]), compute_uv=False)
        return wrap_rad(heading_rad + turned_rad), min(float(ellipse[-1]), 1.0)
