"""Step-out: the robot no longer follows the rotating field and rolls less per revolution than it should.

The distance rolled is the displacement along the heading less that of the map's flow. A wrong map looks the same at
first, therefore

- the missing distance, as a mean over `window_s` at a high frequency, must exceed what the map's error can explain;
- after the frequency was lowered, a robot that had stepped out rolls faster, while one in a flow that differs from the
  map rolls slower in proportion. In the first case the limit stays for the rest of the run; in the second it is lifted.

The limit follows from what was rolled: above its step-out frequency f_c a robot rolls, by Adler's equation, the part
s = 1 - sqrt(1 - (f_c / f)^2) of what a field of frequency f asks for, so f_c = f sqrt(1 - (1 - s)^2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import Applied, Estimate, FlowField, Health, PositiveShare, Range, Share, seconds
from flowrec.physics import STEP_OUT, Robot, sample_as_seen

_NONE = np.zeros(0)
_SETTLED = 0.6  # fraction of the window's weight that must be present
# Ratio of the speed gained to the speed taken off: positive for a robot that had stepped out, by the Adler equation,
# and -1 for one in a flow that differs from the map. The threshold lies between the two.
_IMPROVEMENT = -0.5
_FREE_RADII = 1.3  # from a wall: nearer to it the robot may touch it or be slowed by it
_HIGH = 0.5  # fraction of the frequency limit below which step-out is not looked for
_NOMINAL_RADII_PER_S = (
    12.0  # top speed of the robot that `window_s` is meant for, as in stages/control/tracking_laws.py
)
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
    learned: bool = True  # the limit is step_out_margin times what Adler's equation gives; False: lowered in steps
    lower_to: PositiveShare = 0.8  # factor on the frequency in one such step
    floor_share: PositiveShare = 0.3  # lowest limit, as a fraction of the robot's own
    wait_s: Annotated[float, Range(0.0, 1e6)] = 10.0  # time before another step after one that did not help

    def _window_s(self, robot: Robot, dt: float) -> float:
        """`window_s`, shorter for a robot that is faster than it is meant for: it is carried away sooner."""
        if not self.learned:
            return self.window_s
        ratio = max(robot.max_speed_um_s / robot.radius_um / _NOMINAL_RADII_PER_S, 1.0)
        return min(max(self.window_s / ratio, _FEWEST_FRAMES * dt), self.window_s)

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
        dt, turns = seconds(estimate.stamp_ns - before.stamp_ns), math.hypot(*applied.turns)
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
            if rolled - rolled_before[0] < _IMPROVEMENT * (rolled_before[1] - expected):
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
