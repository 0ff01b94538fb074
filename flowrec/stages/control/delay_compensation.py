"""Delay compensation: the flow near the robot, and where the robot will be when a demand of now takes effect."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowrec.core import Estimate, Floats, Floats32, FlowField, compiled, nearest_pixel
from flowrec.physics import MapRaster, raster_velocity, sample

_MOST_DEMANDS = 100  # remembered, whatever delay and frame rate


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedFlow:
    """The map of the flow, corrected by what the observer finds at the robot."""

    field: FlowField | None
    correction_um_s: Floats  # (2,) added to the map near the robot; without a map the flow itself

    def at(self, point_um: Floats) -> Floats:
        """(2,) um/s."""
        if self.field is None:
            return self.correction_um_s
        return sample(self.field, point_um) + self.correction_um_s


def corrected_flow(
    field: FlowField | None, estimate: Estimate, sent_um_s: Floats, map_error: float, lag_s: float
) -> CorrectedFlow:
    """The map plus the observer's residual, weighted by the variances of both.

    The observer's variance is that of the estimate, so an observer without measurements has no weight. An observer that
    assumes a constant flow lags by about `lag_s`, so the change of the map over the displacement in that time is added
    to its variance: where the robot enters another stream the map is better. The standard deviation of the map is its
    own where it states one, else `map_error` times the speed; the correction never exceeds twice that. `sent_um_s`: (m,
    2) demands that may still be on their way to the coils, oldest first.
    """
    if field is None:
        return CorrectedFlow(None, estimate.flow_um_s)
    mapped = sample(field, estimate.position_um)
    map_std = map_error * math.hypot(*mapped) + 1.0
    x, y = (estimate.position_um / field.um_per_px).tolist()
    if field.std_um_s is not None and math.isfinite(x + y):
        map_std = max(0.3 * map_std, float(field.std_um_s[nearest_pixel(x, y, field.std_um_s.shape)].max()))
    velocity = mapped + sent_um_s[0] if len(sent_um_s) else mapped
    change = mapped - sample(field, estimate.position_um - lag_s * velocity)
    variance = estimate.flow_variance + float(change @ change)
    residual = estimate.flow_um_s - mapped
    length = math.hypot(*residual)
    weight = min(map_std**2 / (map_std**2 + variance), 2.0 * map_std / length if length > 0.0 else 1.0)
    return CorrectedFlow(field, weight * residual)


def predict_position(
    position_um: Floats, sent_um_s: Floats, dt_s: float, delay_s: float, flow: CorrectedFlow
) -> Floats:
    """(2,) um: the robot after the delay, moved by the demands still on their way and by the flow.

    `sent_um_s` (m, 2), oldest first, were sent one frame (dt_s) apart, the last of them a frame ago. A demand takes
    effect one delay after it was sent.
    """
    (x_um, y_um), (more_x, more_y) = position_um.tolist(), flow.correction_um_s.tolist()
    raster = MapRaster.of(flow.field, as_seen=False)
    return np.array(_drift_um(x_um, y_um, sent_um_s, dt_s, delay_s, more_x, more_y, *raster))


@compiled
def _drift_um(
    x: float,
    y: float,
    sent_um_s: Floats,
    dt_s: float,
    delay_s: float,
    more_x: float,
    more_y: float,
    velocity: Floats32,
    wall_px: Floats32,
    um_per_px: float,
    registration: Floats,
) -> tuple[float, float]:
    """The point after one delay of the flow, a bilinear raster and a constant, and of the demands (m, 2)."""
    elapsed, m = 0.0, len(sent_um_s)
    for k in range(m + 1, 0, -1):  # before the first demand only the flow moves the robot
        until = delay_s - (k - 1) * dt_s  # the demand sent k frames ago acts until its successor does
        if until > elapsed:
            vx, vy = raster_velocity(velocity, wall_px, um_per_px, registration, x, y)
            vx, vy = vx + more_x, vy + more_y
            if k <= m:
                vx, vy = vx + sent_um_s[m - k, 0], vy + sent_um_s[m - k, 1]
            x, y = x + (until - elapsed) * vx, y + (until - elapsed) * vy
            elapsed = until
    return x, y


def append_demand(sent_um_s: Floats, velocity_um_s: Floats, dt_s: float, delay_s: float) -> Floats:
    """(m, 2) the demands with the newest appended, as many as are sent within a delay."""
    count = min(int(np.ceil(delay_s / dt_s - 1e-9)) + 1, _MOST_DEMANDS) if dt_s > 0.0 else 1
    return np.concatenate([sent_um_s, velocity_um_s[None]])[-count:]
