"""The robot: its kinematics, its size and its limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np

from flowrec.core import Applied, Floats, FlowField, PositiveShare, Range, UsageError

_SIGNIFICANT = 2.0  # standard deviations
_NOMINAL_RADII_PER_S = 12.0  # top speed of the robot that the settings are meant for
# What a refinement found of the um per revolution, over the stated one, less 1: without side walls, and by how much it
# changes per unit of their drag (sphere_between_walls.py).
ROLLING_BY_DRAG = ("um_per_rev_open_share", "um_per_rev_drag_share")
# The latter of a roller is -1 / (F + D) at a drag D of 0.5, where its floor has F = 2.2 to 3.4 times Stokes' drag
# (Goldman, Cox and Brenner 1967, at gaps of a tenth to a hundredth of its radius); robots of other kinds spread more.
_ROLLER_BY_DRAG = (-0.3, 0.1)
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
    # Speed that is not in proportion to the frequency: pairs of frequency (Hz) and speed through the fluid (um/s), both
    # rising, as measured. um_per_rev is then that of the first pair. []: um_per_rev holds at every frequency
    speed_at_hz: Annotated[tuple[tuple[float, float], ...], Range(1e-3, 1e6)] = ()

    def check(self, where: str) -> None:
        """Refuse a table that does not tell one frequency for each speed.

        Raises UsageError: one line, the key first; `where` is the origin of the settings.
        """
        if any(b[0] <= a[0] or b[1] <= a[1] for a, b in pairwise(self.speed_at_hz)):
            raise UsageError(
                f"{where}: robot.speed_at_hz: frequencies and speeds must both rise from pair to pair; sort them, and "
                "leave out what lies beyond the fastest speed, where the robot steps out"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Robot(RobotSettings):
    """The robot of a resolved configuration: kinematics xdot = u (cos phi, sin phi) + v(x), u = k f.

    This is eq. kinematic of the paper; k is `um_per_rev`, f the frequency of the field, phi its heading. A robot with a
    table has u = k g(f), where g is linear between the pairs of the table and g(f) = f up to the first one. Estimation,
    planning and control know its `proportional` alone, which is as fast in a field of the frequency g(f); coils and rig
    know the frequency itself.
    """

    radius_um: _Radius
    max_speed_um_s: _Speed
    step_out_hz: _Frequency
    delay_s: _Delay = USUAL_DELAY_S  # sessions recorded before the setting existed do not hold it

    @property
    def speed_limit_um_s(self) -> float:
        """The fastest speed through the fluid that may be commanded, um/s."""
        return min(self.max_speed_um_s, self.proportional_hz(self.step_out_margin * self.step_out_hz) * self.um_per_rev)

    def proportional_hz(self, frequency_hz: float) -> float:
        """The g(f) of a frequency f; above the last pair that of the last pair."""
        if not self.speed_at_hz:
            return frequency_hz
        hz, proportional_hz = self._pairs()
        return float(np.interp(frequency_hz, hz, proportional_hz))

    def frequency_hz(self, proportional_hz: float) -> float:
        """The frequency f of a g(f); at most that of the last pair."""
        if not self.speed_at_hz:
            return proportional_hz
        hz, found_hz = self._pairs()
        return float(np.interp(proportional_hz, found_hz, hz))

    def proportional(self) -> Robot:
        """The robot without a table that is as fast at g(f) as this one at f, up to the same speed."""
        return self._with_response((), self.proportional_hz)

    def responding(self, proportional: Robot) -> Robot:
        """A robot like `proportional` with the table of this one: the reverse of `proportional`."""
        return proportional._with_response(self.speed_at_hz, self.frequency_hz)

    def proportional_turns(self, before: Applied | None, applied: Applied) -> Applied:
        """The message with the turns of the field that would have moved the `proportional` robot as far.

        The frequency is the mean since the message before.
        """
        if not self.speed_at_hz or before is None or applied.stamp_ns <= before.stamp_ns:
            return applied
        mean_hz = math.hypot(*applied.turns) / applied.since_s(before)
        return replace(applied, turns=self.proportional_hz(mean_hz) / mean_hz * applied.turns) if mean_hz else applied

    def _with_response(self, table: tuple[tuple[float, float], ...], changed: Callable[[float], float]) -> Robot:
        if self.speed_at_hz == table:
            return self
        fastest_hz = changed(self.step_out_margin * self.step_out_hz)
        return replace(self, speed_at_hz=table, step_out_hz=fastest_hz / self.step_out_margin)

    def _pairs(self) -> tuple[list[float], list[float]]:
        """Frequencies f of the table, and their g(f), both from 0."""
        first_hz, first_um_s = self.speed_at_hz[0]
        scale = first_hz / first_um_s
        return [0.0, *(hz for hz, _ in self.speed_at_hz)], [0.0, *(scale * um_s for _, um_s in self.speed_at_hz)]

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

    def um_per_rev_at(self, drag: float, refined: FlowField) -> float | None:
        """The um per revolution of this robot where side walls have a drag on it, by what a refinement found.

        `drag` is over Stokes' drag, that of `SphereBetweenWalls`. None: no effect of the walls is significant, or it is
        none of drag, which slows a sphere that is pulled through open fluid by 1 per unit, and one over a floor less.
        """
        everywhere, in_open, by_drag = (refined.parameter(name) for name in ("um_per_rev_share", *ROLLING_BY_DRAG))
        if everywhere is None or in_open is None or by_drag is None:
            return None
        found, std = by_drag
        if abs(found) <= _SIGNIFICANT * std or not -1.0 - in_open[0] <= found < 0.0:
            return None
        seen_drag = (everywhere[0] - in_open[0]) / found  # the mean of those that the robot was observed with
        roller, spread = _ROLLER_BY_DRAG
        weight = spread**2 / (spread**2 + std**2)
        share = 1.0 + everywhere[0] + (weight * found + (1.0 - weight) * roller) * (drag - seen_drag)
        return share * self.um_per_rev if share > 0.0 else None

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
        fastest_hz = self.proportional_hz(strength * self.step_out_margin * self.step_out_hz)
        return min(self.speed_limit_um_s, fastest_hz * self.um_per_rev)

    def rolled_speed_um_s(self, frequency_hz: float) -> float:
        """Speed at a field frequency: proportional up to step-out, then the mean of Adler's equation, um/s."""
        if frequency_hz <= self.step_out_hz:
            return self.um_per_rev * self.proportional_hz(frequency_hz)
        slipping_hz = frequency_hz - math.sqrt(frequency_hz**2 - self.step_out_hz**2)
        if not self.speed_at_hz:
            return self.um_per_rev * slipping_hz
        return self.um_per_rev * self.proportional_hz(self.step_out_hz) / self.step_out_hz * slipping_hz
