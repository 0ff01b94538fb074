"""A lab's own controller: proportional and integral, a row of `flowrec.controllers`.

pyproject.toml of the package:

    [project.entry-points."flowrec.controllers"]
    pi = "lab_laws:ProportionalIntegral"

and then `control.method = "pi"`, with its gains in [control.pi]. A stage keeps nothing from frame to frame but the
messages, or a replay from the middle would find another integral. So the law is written by its change,

    u(k) = u(k-1) + kp (e(k) - e(k-1)) + ki e(k) dt,

where u(k-1) is the demand before, which is recorded. It is the limited one, so that the integral does not wind up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from flowrec.core import Floats, Range
from flowrec.stages.control.tracking_laws import Reference, Situation, TrackingLaw


@dataclass(frozen=True, slots=True)
class ProportionalIntegral(TrackingLaw):
    """proportional and integral control of the distance to the reference."""

    kp_per_s: Annotated[float, Range(0.0, 100.0)] = 3.0  # velocity for an error
    ki_per_s2: Annotated[float, Range(0.0, 100.0)] = 3.0  # change of the velocity for an error that stays

    def velocity(self, now: Situation, reference: Reference) -> tuple[Floats, bool]:
        """The demanded velocity (2,) in um/s, relative to the fluid, and whether the robot's speed limits it."""
        error_um = reference.future_um - now.predicted_um
        if now.previous is None or not now.previous.velocity_um_s.any():  # after a rest the integral begins anew
            demanded = reference.velocity_um_s - now.flow_um_s + self.kp_per_s * error_um
        else:
            before = now.previous.velocity_um_s
            # The error changes as the reference moves, less the robot with the demand before and the flow.
            change_um = (reference.velocity_um_s - before - now.flow_um_s) * now.dt_s
            demanded = before + self.kp_per_s * change_um + self.ki_per_s2 * error_um * now.dt_s
        speed = float(np.hypot(*demanded))
        if speed <= now.limit_um_s:
            return demanded, False
        return demanded * (now.limit_um_s / speed), True
