"""The robot: its kinematics, its size and its limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import Floats, FlowField, PositiveShare, Range

_SIGNIFICANT = 2.0  # standard deviations
_NOMINAL_RADII_PER_S = 12.0  # top speed of the robot that the settings are meant for
USUAL_DELAY_S = 0.04  # two buffered blocks of coil samples and a frame of exposure and transfer

_Radius = Annotated[float, Range(0.05, 1e4)]
_Speed = Annotated[float, Range(0.01, 1e6)]
_Frequency = Annotated[float, Range(0.01, 1e5)]
_Delay = Annotated[float, Range(0.0, 10.0)]


@dataclass(frozen=True, slots=True)
class RobotSettings:
    """Size, response and limits of the robot; None: chosen to fit the chip when the configuration is resolved."""

    # radius of the sphere, or half of its longest side; walls are kept at least so far away. None: fits the channels
    radius_um: _Radius | None = None
    um_per_rev: Annotated[float, Range(0.01, 1e5)] = 25.0  # distance k rolled per revolution of the field
    # largest speed relative to the fluid, v_max. None: at least 1.3 times the peak of the assumed flow
    max_speed_um_s: _Speed | None = None
    # frequency of the field above which the robot no longer follows it. None: a fifth above that of v_max
    step_out_hz: _Frequency | None = None
    step_out_margin: PositiveShare = 0.9  # fraction of the step-out frequency that is commanded at most
    delay_s: _Delay | None = None  # time from command to motion. None: fits channels and speed


@dataclass(frozen=True, slots=True, kw_only=True)
class Robot(RobotSettings):
    """The robot of a resolved configuration: kinematics xdot = u (cos phi, sin phi) + v(x), u = k f.

    This is eq. kinematic of the paper; k is `um_per_rev`, f the frequency of the field, phi its heading.
    """

    radius_um: _Radius
    max_speed_um_s: _Speed
    step_out_hz: _Frequency
    delay_s: _Delay = USUAL_DELAY_S  # sessions recorded before the setting existed do not hold it

    @property
    def speed_limit_um_s(self) -> float:
        """The fastest speed through the fluid that may be commanded, um/s."""
        return min(self.max_speed_um_s, self.step_out_margin * self.step_out_hz * self.um_per_rev)

    @property
    def speed_ratio(self) -> float:
        """Top speed in radii per second over that of the robot that the settings are meant for; at least 1."""
        return max(1.0, self.max_speed_um_s / self.radius_um / _NOMINAL_RADII_PER_S)

    def limited_to(self, frequency_hz: float | None) -> Robot:
        """A copy that is never driven at more than a frequency; None: without that limit."""
        return self if frequency_hz is None else replace(self, step_out_hz=frequency_hz / self.step_out_margin)

    def slowed_to(self, speed_um_s: float | None) -> Robot:
        """A copy that is never commanded to swim faster than a speed; None: without that limit."""
        return self if speed_um_s is None else replace(self, max_speed_um_s=min(speed_um_s, self.max_speed_um_s))

    def learned_from(self, refined: FlowField | None) -> Robot:
        """A copy with the um per revolution that a refinement found, where that is significant.

        A robot that moves less per revolution is slower, one that moves more is not commanded to swim faster.
        """
        found = None if refined is None else refined.parameter("um_per_rev_share")
        if found is None:
            return self
        change, std = found  # of the true um per revolution over the stated one, less 1
        if abs(change) <= _SIGNIFICANT * std or change <= -1.0:
            return self
        slower = min(1.0 + change, 1.0)
        return replace(self, max_speed_um_s=slower * self.max_speed_um_s, um_per_rev=(1.0 + change) * self.um_per_rev)

    @staticmethod
    def course_turn(refined: FlowField | None) -> Floats | None:
        """The turn (2, 2) from heading to course that a refinement found; None where it is not significant."""
        found = None if refined is None else refined.parameter("heading_deg")
        if found is None or abs(found[0]) <= _SIGNIFICANT * found[1]:
            return None
        c, s = math.cos(math.radians(found[0])), math.sin(math.radians(found[0]))
        return np.array([[c, -s], [s, c]])

    def speed_limit_at(self, strength: float) -> float:
        """Speed limit in a field of this fraction of the full amplitude, um/s: step-out falls with the torque."""
        return min(self.speed_limit_um_s, strength * self.step_out_margin * self.step_out_hz * self.um_per_rev)

    def rolled_speed_um_s(self, frequency_hz: float) -> float:
        """Speed at a field frequency: proportional up to step-out, then the mean of Adler's equation, um/s."""
        if frequency_hz <= self.step_out_hz:
            return self.um_per_rev * frequency_hz
        return self.um_per_rev * (frequency_hz - math.sqrt(frequency_hz**2 - self.step_out_hz**2))
