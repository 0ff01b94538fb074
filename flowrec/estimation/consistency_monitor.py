"""Health: whether what the observer believes can be believed, with an alarm when not.

Three signs, all leaky means that the message itself remembers:

- `nis`: the normalised innovation squared, far above the 2 that it has when all noise is stated right: something moves
  the robot that the model does not know. Far below is no alarm: noise stated too large is only careful.
- `pulsation`: a spectral line in the flow, as of a pump. A bank of resonators z_f, leaky means of r exp(-i 2 pi f t),
  listens to r, the share by which the flow is stronger than the map (or than its own mean) says, less the mean of r. A
  line alarms when it is strong and when it is most of what r does: a turn into another branch is strong, but no line.
- `tracking`: the share of frames without the robot.

Step-out is found beside these, see step_out.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flowrec.estimation.step_out import StepOut
from flowrec.flow import sample
from flowrec.messages import Applied, Estimate, FlowField, Health
from flowrec.ranges import Range, Share
from flowrec.robot import Robot
from flowrec.units import seconds

_BANK_HZ = 0.3 * 1.125 ** np.arange(24)  # 0.3 to 4.5 Hz
_MOST_NIS = 50.0  # one lost step is not a minute of alarm
_SLOW_SHARE = 0.1  # of v_max: a share of a slower flow than that says nothing


@dataclass(frozen=True, slots=True)
class HealthMonitor:
    """Settings of the alarms."""

    window_s: Annotated[float, Range(0.05, 3600.0)] = 3.0  # of the means of NIS and of lost frames
    # alarm where the mean NIS is above 2 by so many standard deviations of a mean of white ones
    nis_sigma: Annotated[float, Range(0.1, 1e6)] = 8.0
    lost_share: Share = 0.3  # alarm above this share of frames without the robot
    # of its frequency that a resonator remembers, but a second at least
    periods: Annotated[float, Range(0.5, 1e3)] = 2.0
    pulsation_share: Annotated[float, Range(1e-3, 1e3)] = 0.15  # alarm above this share of the flow ...
    line_share: Share = 0.5  # ... if the line is this share of the flow's unrest
    settle_s: Annotated[float, Range(0.0, 3600.0)] = 2.0  # no `pulsation` before the flow was known for so long
    # nothing is listened to while the flow's sigma is above this share of v_max
    settled_share: Annotated[float, Range(0.0, 10.0)] = 0.1
    ends_at: Share = 0.8  # an alarm ends below this share of its thresholds
    step_out: StepOut = field(default_factory=StepOut)

    def watch(
        self,
        previous: Health | None,
        before: Estimate | None,
        estimate: Estimate,
        field: FlowField | None,
        robot: Robot,
        applied: Applied | None = None,
        wall_um: float = math.inf,
    ) -> Health:
        """The state of health after this frame. `before` is the estimate that `previous` was made with.

        Without `applied` step-out is not looked for. `wall_um` is from the robot's centre to the nearest wall.
        """
        if previous is None or before is None:
            bank = np.zeros(len(_BANK_HZ))
            return Health(estimate.stamp_ns, "", 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, bank, bank, bank, np.zeros(2), 0.0)
        dt = max(seconds(estimate.stamp_ns - before.stamp_ns), 0.0)
        share = min(dt / self.window_s, 1.0)
        lost = previous.lost_share + share * (float(not estimate.seen) - previous.lost_share)
        nis = previous.nis
        if math.isfinite(estimate.nis):
            nis += share * (min(estimate.nis, _MOST_NIS) - nis)
        heard_s, mean, offset = previous.heard_s, previous.mean_um_s, previous.offset_share
        z, power = previous.bank_re + 1j * previous.bank_im, previous.bank_power
        variance = 0.5 * float(estimate.covariance[2, 2] + estimate.covariance[3, 3])
        if estimate.seen and dt > 0.0 and variance < (self.settled_share * robot.max_speed_um_s) ** 2:
            heard_s += dt
            mean = mean + share * (estimate.flow_um_s - mean)
            expected = mean if field is None else sample(field, estimate.position_um)
            size = max(math.hypot(expected[0], expected[1]), _SLOW_SHARE * robot.max_speed_um_s)
            stronger = float((estimate.flow_um_s - expected) @ expected) / size**2
            stronger = min(max(stronger, -1.0), 1.0)
            offset += share * (stronger - offset)
            fresh = _fresh(dt, self.periods)
            phase = np.exp(-2j * math.pi * _BANK_HZ * seconds(estimate.stamp_ns))
            z = z + fresh * ((stronger - offset) * phase - z)
            power = power + fresh * ((stronger - offset) ** 2 - power)
        best = int(np.argmax(np.abs(z)))
        strength = 2.0 * float(np.abs(z[best]))
        line = min(0.5 * strength**2 / float(power[best]), 1.0) if power[best] > 0.0 else 0.0
        worst = {
            "nis": (nis - 2.0) / (self.nis_sigma * math.sqrt(2.0 * share)) if share > 0.0 else 0.0,
            "pulsation": min(strength / self.pulsation_share, line / self.line_share, heard_s / self.settle_s),
            "tracking": lost / self.lost_share,
        }
        was = previous.alarm.split("; ")
        alarms = [name for name, level in worst.items() if level > (self.ends_at if name in was else 1.0)]
        now = Health(
            stamp_ns=estimate.stamp_ns,
            alarm="; ".join(alarms),
            nis=nis,
            lost_share=lost,
            heard_s=heard_s,
            pulsation_hz=float(_BANK_HZ[best]),
            pulsation_share=strength,
            line_share=line,
            bank_re=z.real,
            bank_im=z.imag,
            bank_power=power,
            mean_um_s=mean,
            offset_share=offset,
        )
        if applied is None:
            return now
        return self.step_out.watch(previous, now, before, estimate, applied, field, robot, wall_um)


@lru_cache(maxsize=16)
def _fresh(dt: float, periods: float) -> NDArray[np.float64]:
    """Weight of the newest frame in each resonator."""
    return np.asarray(1.0 - np.exp(-dt / np.maximum(periods / _BANK_HZ, 1.0)))
