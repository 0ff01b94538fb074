"""Step-out: the robot no longer follows the rotating field, and rolls less per revolution than it should.

What the robot rolled is its displacement along its heading less that of the map's flow. A map that is wrong looks the
same for a moment, so that

- what is missing must be more than the map's error can explain, on a mean over `window_s`, at a high frequency;
- after the frequency was lowered, a robot that had stepped out rolls faster, while one in another flow than the map's
  rolls slower by what was taken off. The limit stays for the rest of the run in the first case, and is lifted in the
  second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.flow import sample
from flowrec.messages import Applied, Estimate, FlowField, Health
from flowrec.ranges import PositiveShare, Range, Share
from flowrec.robot import Robot
from flowrec.units import seconds

_NONE = np.zeros(0)
_SETTLED = 0.6  # share of the window's weight that has to be there
# Speed that a robot which had stepped out has gained then, as a share of what was taken off: more than 0 by the Adler
# equation. One in another flow than the map's has lost all of it. Between the two lies the limit.
_BETTER = -0.5
_FREE_RADII = 1.3  # from a wall: nearer to it the robot may touch it or feel its drag
_HIGH = 0.5  # share of the frequency limit: below it step-out is not looked for


@dataclass(frozen=True, slots=True)
class StepOut:
    """Settings of the detection."""

    window_s: Annotated[float, Range(0.05, 60.0)] = 0.5  # of the means
    map_error: Share = 0.2  # share of the map's flow that may be wrong
    missing_share: Share = 0.3  # of the commanded motion that must be missing beside that; 1: no limit is ever set
    lower_to: PositiveShare = 0.8  # share of the frequency that is left by one step
    floor_share: PositiveShare = 0.3  # of the robot's own limit, below which no step leads
    wait_s: Annotated[float, Range(0.0, 1e6)] = 10.0  # before another step where the one before had been for nothing

    def watch(
        self,
        previous: Health,
        now: Health,
        before: Estimate,
        estimate: Estimate,
        applied: Applied,
        field: FlowField | None,
        robot: Robot,
        wall_um: float = math.inf,
    ) -> Health:
        """`now`, with what is known of step-out after this frame.

        `previous` and `before` are health and estimate of the frame before, `robot` is as the settings say.
        `wall_um` is from the robot's centre to the nearest wall: a robot at a wall may be stopped by it.
        """
        own_hz = robot.step_out_margin * robot.step_out_hz
        dt, turns = seconds(estimate.stamp_ns - before.stamp_ns), math.hypot(applied.turns[0], applied.turns[1])
        was_ns, was_before = previous.limited_ns, previous.rolled_before_um_s
        now = replace(
            now,
            rolled_sums=previous.rolled_sums,
            limit_hz=previous.limit_hz,
            limited_ns=was_ns,
            rolled_before_um_s=was_before,
        )
        if not estimate.seen:
            return replace(now, rolled_sums=_NONE)
        if field is None or dt <= 0.0 or turns <= 0.0 or not before.seen:
            return now
        if wall_um < _FREE_RADII * robot.radius_um:
            return now
        heading = applied.turns / turns
        carried = dt * sample(field, 0.5 * (before.measured_um + estimate.measured_um))
        rolled_um = float((estimate.measured_um - before.measured_um - carried) @ heading)
        news = np.array([rolled_um, robot.um_per_rev * turns, math.hypot(carried[0], carried[1]), dt])
        sums = news + math.exp(-dt / self.window_s) * (previous.rolled_sums if previous.rolled_sums.size else 0.0)
        now = replace(now, rolled_sums=sums)
        time_s = float(sums[3])
        rolled, asked, carried_um_s = (sums[:3] / time_s).tolist()
        limit_hz = own_hz if previous.limit_hz is None else previous.limit_hz
        if time_s < _SETTLED * self.window_s or asked < _HIGH * limit_hz * robot.um_per_rev:
            return now
        if was_before.size:
            if rolled - was_before[0] < _BETTER * (was_before[1] - asked):
                return replace(now, rolled_sums=_NONE, limit_hz=None, limited_ns=now.stamp_ns, rolled_before_um_s=_NONE)
            now = replace(now, rolled_before_um_s=_NONE)
        lifted = previous.limit_hz is None and was_ns is not None
        waits = lifted and seconds(now.stamp_ns - (was_ns or 0)) < self.wait_s
        lower_hz = self.lower_to * min(limit_hz, asked / robot.um_per_rev)
        lower_hz = max(lower_hz, self.floor_share * own_hz)
        enough = asked - rolled <= self.map_error * carried_um_s + self.missing_share * asked
        if enough or waits or lower_hz >= limit_hz:
            return now
        return replace(
            now,
            rolled_sums=_NONE,
            limit_hz=lower_hz,
            limited_ns=now.stamp_ns,
            rolled_before_um_s=np.array([rolled, asked]),
        )
