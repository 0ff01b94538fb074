"""`luenberger`: the disturbance observer of the paper, eq. (19): d vhat/dt = L_p (dx/dt - d xhat/dt)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from flowrec.core import Applied, Estimate, FlowField, Range, Track
from flowrec.physics import Robot


@dataclass(frozen=True, slots=True)
class Luenberger:
    """With xhat' = u + vhat it is a first-order low-pass filter of the measured drift, discretised exactly."""

    gain_per_s: Annotated[float, Range(1e-3, 1e4)] = 1.0  # gain L_p, the same on both axes
    # one sigma, for the stated covariance only; None: 4 % of the radius
    position_noise_um: Annotated[float, Range(1e-4, 1e4)] | None = None

    def estimate(
        self, previous: Estimate | None, track: Track, applied: Applied, robot: Robot, field: FlowField | None = None
    ) -> Estimate:
        """The position is the measured one; the covariance is nominal, that of filtered noise; `field` is not used."""
        sigma_um = self.position_noise_um if self.position_noise_um is not None else 0.04 * robot.radius_um
        moved = robot.um_per_rev * applied.turns
        flow = np.zeros(2) if previous is None else previous.flow_um_s
        position = track.position_um
        dt = track.since_s(previous)
        # Weight of the newest drift.
        weight = 1.0 - math.exp(-self.gain_per_s * dt) if dt > 0 else 0.0
        if previous is not None and dt > 0:
            if track.seen and previous.seen:
                drift = (track.position_um - previous.measured_um - moved) / dt
                flow = flow + weight * (drift - flow)
            elif not track.seen:
                position = previous.position_um + moved + flow * dt
        # White noise of the positions, differenced over dt and filtered with the weight w, has the stationary variance
        # 2 / (2 - w) (w sigma / dt)^2, which tends to (gain sigma)^2 for short dt.
        per_s = weight / dt if dt > 0 else self.gain_per_s
        flow_variance = 2.0 / (2.0 - weight) * (per_s * sigma_um) ** 2
        return Estimate(
            stamp_ns=track.stamp_ns,
            position_um=position,
            flow_um_s=flow,
            covariance=np.diag([sigma_um**2, sigma_um**2, flow_variance, flow_variance]),
            nis=float("nan"),
            measured_um=track.position_um,
            seen=track.seen,
        )
