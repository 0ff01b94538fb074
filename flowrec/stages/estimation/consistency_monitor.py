"""Health: whether the observer's estimate is consistent with the measurements, with an alarm when it is not.

There are three alarms. All means are exponential, so that the message holds their state.

- `nis`: the normalised innovation squared is far above 2, its mean when all noise is stated correctly: the robot is
  moved by something that the model does not include. A value far below 2 is no alarm: the noise is stated too large.
- `pulsation`: a spectral line in the flow, such as that of a pump. A bank of resonators z_f, exponential means of
  r exp(-i 2 pi f t), analyses the relative deviation r of the flow's strength from the map (or from its own mean), less
  the mean of r. The alarm needs a strong line that is also most of the variance of r: when the robot turns into another
  branch, r changes a lot, but not in one line.
- `tracking`: the fraction of frames without the robot.

Step-out is detected as well: the robot no longer follows the rotating field and rolls less per revolution than it
should.

The distance rolled is the displacement along the heading less that of the map's flow. A wrong map looks the same at
first, therefore

- the missing distance, as a mean over `window_s` at a high frequency, must exceed what the map's error can explain;
- after the frequency was lowered, a robot that had stepped out rolls faster, while one in a flow that differs from the
  map, or that an unknown wall holds back, rolls slower. In the first case the limit stays for the rest of the run; in
  the second it is lifted.

The limit follows from what was rolled: above its step-out frequency f_c a robot rolls, by Adler's equation, the part
s = 1 - sqrt(1 - (f_c / f)^2) of what a field of frequency f asks for, so f_c = f sqrt(1 - (1 - s)^2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated

import numpy as np

from flowrec.core import (
    Alarm,
    Applied,
    Estimate,
    Floats,
    FlowField,
    Health,
    PositiveShare,
    Range,
    Share,
    compiled,
    seconds,
)
from flowrec.physics import STEP_OUT, Robot, sample_as_seen

_NONE = np.zeros(0)
_SETTLED = 0.6  # fraction of the window's weight that must be present
_FREE_RADII = 1.3  # from a wall: nearer to it the robot may touch it or be slowed by it
_HIGH = 0.5  # fraction of the frequency limit below which step-out is not looked for
_FEWEST_FRAMES = 8  # in a window
_FULL = 0.8  # the same for a single frame whose motion enters the mean that the step-out frequency is found from
_LEAST_STEP = 0.95  # a learned limit falls at least to this fraction of the one before


@dataclass(frozen=True, slots=True)
class StepOut:
    """Settings of the detection."""

    # duration of the means, for a robot of up to 12 radii per second
    window_s: Annotated[float, Range(0.05, 60.0)] = 0.5
    map_error: Share | None = None  # relative error of the map's flow; None: from the map
    missing_share: Share = 0.3  # fraction of the commanded motion that must be missing besides; 1: never limit
    # speed gained over speed taken off, below which it was no step-out: 0.7 to 1.1 of robots that had stepped out in
    # simulated flights, -0.3 to -0.5 of one that a wall held back, -1 in a flow that differs from the map
    least_gain: Annotated[float, Range(-1.0, 1.0)] = 0.2
    learned: bool = True  # the limit is step_out_margin times what Adler's equation gives; False: lowered in steps
    lower_to: PositiveShare = 0.8  # factor on the frequency in one such step
    floor_share: PositiveShare = 0.3  # lowest limit, as a fraction of the robot's own
    wait_s: Annotated[float, Range(0.0, 1e6)] = 10.0  # time before another step after one that did not help

    def _window_s(self, robot: Robot, dt: float) -> float:
        """`window_s`, shorter for a robot that is faster than it is meant for: it is carried away sooner."""
        if not self.learned:
            return self.window_s
        return min(max(self.window_s / robot.speed_ratio, _FEWEST_FRAMES * dt), self.window_s)

    def _lower_hz(self, rolled_um_s: float, expected_um_s: float, limit_hz: float, robot: Robot) -> float:
        """Next limit of the field's frequency for a robot that rolls slower than its revolutions demand."""
        if not self.learned:
            return self.lower_to * min(limit_hz, expected_um_s / robot.um_per_rev)
        slipped = 1.0 - min(max(rolled_um_s / expected_um_s, 0.0), 1.0)
        step_out_hz = expected_um_s / robot.um_per_rev * math.sqrt(1.0 - slipped**2)
        return min(robot.step_out_margin * step_out_hz, _LEAST_STEP * limit_hz)

    def watch(
        self,
        now: Health,
        before: Estimate,
        estimate: Estimate,
        applied: Applied,
        field: FlowField | None,
        robot: Robot,
        wall_um: float = math.inf,
    ) -> Health:
        """`now`, whose fields of step-out are those of the frame before, with those after this frame.

        Parameters
        ----------
        before : the estimate of the frame before.
        robot : as in the settings, without the limit.
        wall_um : from the robot's centre to the nearest wall, which may stop the robot.
        """
        own_hz = robot.step_out_margin * robot.step_out_hz
        dt, turns = estimate.since_s(before), math.hypot(*applied.turns)
        limited_ns, rolled_before = now.limited_ns, now.rolled_before_um_s
        if not estimate.seen:
            return replace(now, rolled_sums=_NONE)
        if field is None or dt <= 0.0 or turns <= 0.0 or not before.seen or wall_um < _FREE_RADII * robot.radius_um:
            return now
        limit_hz = own_hz if now.limit_hz is None else now.limit_hz
        if self.learned and turns < _FULL * limit_hz * dt:
            return now
        heading = applied.turns / turns
        carried = dt * sample_as_seen(field, 0.5 * (before.measured_um + estimate.measured_um))
        rolled_um = float((estimate.measured_um - before.measured_um - carried) @ heading)
        newest = np.array([rolled_um, robot.um_per_rev * turns, math.hypot(*carried), dt])
        window_s = self._window_s(robot, dt)
        sums = newest + math.exp(-dt / window_s) * (now.rolled_sums if now.rolled_sums.size else 0.0)
        now = replace(now, rolled_sums=sums)
        time_s = float(sums[3])
        rolled, expected, carried_um_s = (sums[:3] / time_s).tolist()
        if time_s < _SETTLED * window_s or expected < _HIGH * limit_hz * robot.um_per_rev:
            return now
        if rolled_before.size:
            if rolled - rolled_before[0] < self.least_gain * (rolled_before[1] - expected):
                return replace(now, rolled_sums=_NONE, limit_hz=None, limited_ns=now.stamp_ns, rolled_before_um_s=_NONE)
            now = replace(now, rolled_before_um_s=_NONE)
        waiting = now.limit_hz is None and limited_ns is not None and seconds(now.stamp_ns - limited_ns) < self.wait_s
        lower_hz = max(self._lower_hz(rolled, expected, limit_hz, robot), self.floor_share * own_hz)
        explained = (
            expected - rolled <= STEP_OUT.of(field, self.map_error) * carried_um_s + self.missing_share * expected
        )
        if explained or waiting or lower_hz >= limit_hz:
            return now
        return replace(
            now,
            rolled_sums=_NONE,
            limit_hz=lower_hz,
            limited_ns=now.stamp_ns,
            rolled_before_um_s=np.array([rolled, expected]),
        )


_BANK_HZ, _STEP, _ABOVE = 0.3, 1.125, 24  # of the bank: a frequency, the ratio of neighbours, how many from there on
EXPECTED_NIS = 2.0  # of a measurement in two dimensions by a consistent filter
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
            bank = (np.zeros(len(bank_hz)),) * 3
            return Health(estimate.stamp_ns, "", EXPECTED_NIS, 0.0, 0.0, 0.0, 0.0, 0.0, *bank, np.zeros(2), 0.0)
        dt = max(estimate.since_s(before), 0.0)
        weight = min(dt / self.window_s, 1.0)
        lost = previous.lost_share + weight * (float(not estimate.seen) - previous.lost_share)
        nis = previous.nis
        if math.isfinite(estimate.nis):
            nis += weight * (min(estimate.nis, _LARGEST_NIS) - nis)
        settled_s, mean, offset = previous.heard_s, previous.mean_um_s, previous.offset_share
        deviation = heard_s = 0.0
        variance = estimate.flow_variance
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
            Alarm.NIS: (nis - EXPECTED_NIS) / nis_std if weight > 0.0 else 0.0,
            Alarm.PULSATION: min(amplitude / self.pulsation_share, line / self.line_share, settled_s / self.settle_s),
            Alarm.TRACKING: lost / self.lost_share,
        }
        now = replace(
            previous,
            stamp_ns=estimate.stamp_ns,
            alarm=self._alarms(previous.alarms, levels),
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
