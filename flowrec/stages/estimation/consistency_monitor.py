"""Health: whether the observer's estimate is consistent with the measurements, with an alarm when it is not.

There are three alarms. All means are exponential, so that the message holds their state.

- `nis`: the normalised innovation squared is far above 2, its mean when all noise is stated correctly: the robot is
  moved by something that the model does not include. A value far below 2 is no alarm: the noise is stated too large.
- `pulsation`: a spectral line in the flow, such as that of a pump. A bank of resonators z_f, exponential means of
  r exp(-i 2 pi f t), analyses the relative deviation r of the flow's strength from the map (or from its own mean), less
  the mean of r. The alarm needs a strong line that is also most of the variance of r: when the robot turns into another
  branch, r changes a lot, but not in one line.
- `tracking`: the fraction of frames without the robot.

Step-out is detected as well, see step_out.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated

import numpy as np

from flowrec.core import Alarm, Applied, Estimate, Floats, FlowField, Health, Range, Share, compiled, seconds
from flowrec.physics import Robot, sample_as_seen
from flowrec.stages.estimation.step_out import StepOut

_BANK_HZ, _STEP, _ABOVE = 0.3, 1.125, 24  # of the bank: a frequency, the ratio of neighbours, how many from there on
_EXPECTED_NIS = 2.0
_LARGEST_NIS = 50.0  # a single lost step must not cause a minute of alarm
_SLOW_FRACTION = 0.1  # of v_max: a deviation relative to a slower flow is not meaningful


@dataclass(frozen=True, slots=True)
class HealthMonitor:
    """Alarms: the robot does not move as the model says, is not seen, or the pump pulsates."""

    window_s: Annotated[float, Range(0.05, 3600.0)] = 3.0  # duration over which NIS and lost frames are averaged
    # lowest frequency of a line that is looked for: that of the slowest syringe pumps. Its resonator needs the periods
    # below to swing up, so a line of 0.1 Hz and 30 % is an alarm after half a minute, not in a short survey.
    slowest_hz: Annotated[float, Range(0.01, 1.0)] = 0.05
    # alarm if the mean NIS (normalised innovation squared) exceeds 2 by this many standard deviations of the mean of
    # white innovations
    nis_sigma: Annotated[float, Range(0.1, 1e6)] = 8.0
    lost_share: Share = 0.3  # alarm above this fraction of frames without the robot
    # memory of a resonator in periods of its frequency; one second at least
    periods: Annotated[float, Range(0.5, 1e3)] = 2.0
    pulsation_share: Annotated[float, Range(1e-3, 1e3)] = 0.15  # alarm above this amplitude relative to the flow
    line_share: Share = 0.5  # alarm only if the line is at least this fraction of the variance
    settle_s: Annotated[float, Range(0.0, 3600.0)] = 2.0  # the flow must have been accurate for this long
    # the spectrum is not updated while the flow's sigma exceeds this fraction of v_max
    settled_share: Annotated[float, Range(0.0, 10.0)] = 0.1
    ends_at: Share = 0.8  # an alarm ends below this fraction of its thresholds
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
        """Health after this frame.

        Parameters
        ----------
        before : the estimate that `previous` was made with.
        applied : None switches the detection of step-out off.
        wall_um : from the robot's centre to the nearest wall.
        """
        bank_hz = _bank_hz(self.slowest_hz)
        if previous is None or before is None:
            return _first_health(estimate.stamp_ns, np.zeros(len(bank_hz)))
        dt = max(seconds(estimate.stamp_ns - before.stamp_ns), 0.0)
        weight = min(dt / self.window_s, 1.0)
        lost = previous.lost_share + weight * (float(not estimate.seen) - previous.lost_share)
        nis = previous.nis
        if math.isfinite(estimate.nis):
            nis += weight * (min(estimate.nis, _LARGEST_NIS) - nis)
        settled_s, mean, offset = previous.heard_s, previous.mean_um_s, previous.offset_share
        deviation = heard_s = 0.0
        variance = 0.5 * float(estimate.covariance[2, 2] + estimate.covariance[3, 3])
        if estimate.seen and dt > 0.0 and variance < (self.settled_share * robot.max_speed_um_s) ** 2:
            settled_s += dt
            mean = mean + weight * (estimate.flow_um_s - mean)
            expected = mean if field is None else sample_as_seen(field, estimate.position_um)
            deviation = _flow_deviation(estimate, expected, robot)
            offset += weight * (deviation - offset)
            deviation, heard_s = deviation - offset, dt
        bank = previous.bank_re, previous.bank_im, previous.bank_power
        time_s = seconds(estimate.stamp_ns)
        re, im, power = _resonate(bank_hz, self.periods, *bank, deviation, heard_s, time_s)
        sizes = np.abs(re + 1j * im)
        strongest = int(sizes.argmax())
        amplitude = 2.0 * float(sizes[strongest])
        line = min(0.5 * amplitude**2 / float(power[strongest]), 1.0) if power[strongest] > 0.0 else 0.0
        nis_std = self.nis_sigma * math.sqrt(2.0 * weight)
        levels = {  # relative to the thresholds
            Alarm.NIS: (nis - _EXPECTED_NIS) / nis_std if weight > 0.0 else 0.0,
            Alarm.PULSATION: min(amplitude / self.pulsation_share, line / self.line_share, settled_s / self.settle_s),
            Alarm.TRACKING: lost / self.lost_share,
        }
        now = replace(
            previous,
            stamp_ns=estimate.stamp_ns,
            alarm=self._alarms(previous.alarm.split("; "), levels),
            nis=nis,
            lost_share=lost,
            heard_s=settled_s,
            pulsation_hz=float(bank_hz[strongest]),
            pulsation_share=amplitude,
            line_share=line,
            bank_re=re,
            bank_im=im,
            bank_power=power,
            mean_um_s=mean,
            offset_share=offset,
        )
        return now if applied is None else self.step_out.watch(now, before, estimate, applied, field, robot, wall_um)

    def _alarms(self, active: list[str], levels: dict[Alarm, float]) -> str:
        return "; ".join(name for name, level in levels.items() if level > (self.ends_at if name in active else 1.0))


def _first_health(stamp_ns: int, bank: Floats) -> Health:
    return Health(stamp_ns, "", _EXPECTED_NIS, 0.0, 0.0, 0.0, 0.0, 0.0, bank, bank, bank, np.zeros(2), 0.0)


@compiled
def _resonate(
    bank_hz: Floats, periods: float, re: Floats, im: Floats, power: Floats, deviation: float, dt: float, time_s: float
) -> tuple[Floats, Floats, Floats]:
    """Real and imaginary part and mean square input (n,) of the resonators after dt seconds with an input.

    With dt = 0 they stay as they are.
    """
    after_re, after_im, after_power = re.copy(), im.copy(), power.copy()
    for k in range(len(bank_hz)):
        weight = 1.0 - math.exp(-dt / max(periods / bank_hz[k], 1.0))
        phase = 2.0 * math.pi * bank_hz[k] * time_s
        after_re[k] += weight * (deviation * math.cos(phase) - re[k])
        after_im[k] += weight * (-deviation * math.sin(phase) - im[k])
        after_power[k] += weight * (deviation * deviation - power[k])
    return after_re, after_im, after_power


def _flow_deviation(estimate: Estimate, expected_um_s: Floats, robot: Robot) -> float:
    """Deviation of the flow's strength from an expected flow (2,), relative to it; -1 to 1."""
    speed = max(math.hypot(*expected_um_s), _SLOW_FRACTION * robot.max_speed_um_s)
    deviation = float((estimate.flow_um_s - expected_um_s) @ expected_um_s) / speed**2
    return min(max(deviation, -1.0), 1.0)


@lru_cache(maxsize=16)
def _bank_hz(slowest_hz: float) -> Floats:
    """(n,) frequencies of the resonators."""
    below = math.floor(math.log(_BANK_HZ / slowest_hz) / math.log(_STEP) + 1e-9)
    bank_hz = np.asarray(_BANK_HZ * _STEP ** np.arange(-below, _ABOVE))
    bank_hz.flags.writeable = False
    return bank_hz
