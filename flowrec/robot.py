"""The robot as every room sees it: how it moves, how big it is, where its limits are."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from flowrec.ranges import PositiveShare, Range

USUAL_DELAY_S = 0.04  # two buffered blocks of coil samples and a frame of exposure and transfer


@dataclass(frozen=True, slots=True)
class Robot:
    """Kinematics xdot = u (cos phi, sin phi) + v(x) with u = k f (the paper's eq. kinematic).

    None means: chosen to fit the chip when the configuration is resolved.
    """

    radius_um: Annotated[float, Range(0.05, 1e4)] | None = None
    um_per_rev: Annotated[float, Range(0.01, 1e5)] = 25.0  # k: distance rolled per revolution of the field
    max_speed_um_s: Annotated[float, Range(0.01, 1e6)] | None = None  # v_max, relative to the fluid
    step_out_hz: Annotated[float, Range(0.01, 1e5)] | None = None  # above it the robot no longer follows the field
    step_out_margin: PositiveShare = 0.9  # share of the step-out frequency that is ever commanded
    # from command to motion; 0.04 where the channel leaves time for it
    delay_s: Annotated[float, Range(0.0, 10.0)] | None = None

    @property
    def radius(self) -> float:
        """Radius in um of a resolved robot."""
        assert self.radius_um is not None, "robot.radius_um is resolved with the chip"
        return self.radius_um

    @property
    def delay(self) -> float:
        """From command to motion, s."""
        return USUAL_DELAY_S if self.delay_s is None else self.delay_s

    @property
    def speed_limit_um_s(self) -> float:
        """The fastest speed through the fluid that may be commanded, um/s."""
        assert self.max_speed_um_s is not None and self.step_out_hz is not None, "robot is resolved with the chip"
        return min(self.max_speed_um_s, self.step_out_margin * self.step_out_hz * self.um_per_rev)

    def limited_to(self, frequency_hz: float | None) -> Robot:
        """The same robot, never driven at more than a frequency; None: without that limit."""
        return self if frequency_hz is None else replace(self, step_out_hz=frequency_hz / self.step_out_margin)

    def speed_limit_at(self, strength: float) -> float:
        """The same with a field of this share of its full amplitude, um/s: step-out falls with the torque."""
        assert self.step_out_hz is not None, "robot is resolved with the chip"
        return min(self.speed_limit_um_s, strength * self.step_out_margin * self.step_out_hz * self.um_per_rev)

    def rolled_speed_um_s(self, frequency_hz: float) -> float:
        """Speed at a field frequency: proportional up to step-out, then the mean of Adler's equation, um/s."""
        assert self.step_out_hz is not None
        if frequency_hz <= self.step_out_hz:
            return self.um_per_rev * frequency_hz
        return self.um_per_rev * (frequency_hz - math.sqrt(frequency_hz**2 - self.step_out_hz**2))
