"""What the controller believes of the flow, and where the robot will be when a demand of now takes effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import Estimate, FlowField

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FlowBelief:
    """Map and observer together: the map's shape, corrected by what the observer sees the map miss at the robot."""

    field: FlowField | None
    residual_um_s: Vector  # (2,) added to the map everywhere near the robot

    def at(self, point_um: Vector) -> Vector:
        """(2,) um/s."""
        if self.field is None:
            return self.residual_um_s
        return sample(self.field, point_um) + self.residual_um_s


def blend(
    field: FlowField | None, estimate: Estimate, sent_um_s: NDArray[np.float64], map_error: float, lag_s: float
) -> FlowBelief:
    """The map plus a share of the observer's residual, each trusted by its variance.

    The observer's comes with the estimate, so that one that has seen nothing yet does not count. As an observer of
    a flow that it thinks constant lags by about `lag_s`, the change of the map over the way of that time is added:
    where the robot turns from one stream into another the map knows better. The map's own error is its standard
    deviation where it knows it, else the share `map_error` of the speed; more than twice of it is not believed.
    """
    if field is None:
        return FlowBelief(None, estimate.flow_um_s)
    mapped = sample(field, estimate.position_um)
    doubt = map_error * float(np.hypot(mapped[0], mapped[1])) + 1.0
    if field.std_um_s is not None:
        h, w = field.std_um_s.shape[:2]
        column, row = np.rint(estimate.position_um / field.um_per_px).astype(int)
        doubt = max(0.3 * doubt, float(field.std_um_s[min(max(row, 0), h - 1), min(max(column, 0), w - 1)].max()))
    moving = mapped + sent_um_s[0] if len(sent_um_s) else mapped
    change = mapped - sample(field, estimate.position_um - lag_s * moving)
    variance = 0.5 * float(estimate.covariance[2, 2] + estimate.covariance[3, 3]) + float(change @ change)
    residual = estimate.flow_um_s - mapped
    length = float(np.hypot(residual[0], residual[1]))
    share = min(doubt**2 / (doubt**2 + variance), 2.0 * doubt / length if length > 0.0 else 1.0)
    return FlowBelief(field, share * residual)


def roll_forward(
    position_um: Vector, sent_um_s: NDArray[np.float64], dt_s: float, delay_s: float, flow: FlowBelief
) -> Vector:
    """(2,) um: the robot `delay_s` from now, moved by the demands still on their way and by the flow.

    `sent_um_s` (m, 2), oldest first, were sent one frame (dt_s) apart, the last of them a frame ago. What was
    sent a delay before now is taking effect now.
    """
    point = np.array(position_um, np.float64)
    elapsed = max(delay_s - len(sent_um_s) * dt_s, 0.0)  # before the first demand only the flow moves it
    point = point + elapsed * flow.at(point)
    for k in range(len(sent_um_s), 0, -1):
        until = delay_s - (k - 1) * dt_s  # the demand sent k frames ago acts until its successor does
        if until > elapsed:
            point = point + (until - elapsed) * (sent_um_s[-k] + flow.at(point))
            elapsed = until
    return point


def remembered(
    sent_um_s: NDArray[np.float64], velocity_um_s: Vector, dt_s: float, delay_s: float
) -> NDArray[np.float64]:
    """(m, 2) the demands with the newest added, as many as a delay holds."""
    count = min(int(np.ceil(delay_s / dt_s - 1e-9)) + 1, 100) if dt_s > 0.0 else 1
    return np.concatenate([sent_um_s, velocity_um_s[None]])[-count:]
