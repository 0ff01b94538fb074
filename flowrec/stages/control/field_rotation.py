"""Motion of the rotating field from one command to the next, in closed form.

The field of amplitude a rotates in a vertical plane that contains z and the horizontal unit vector h of its heading:
B = a (z cos theta + h sin theta). After a new command
- the phase theta continues from its present value at the new frequency;
- if the heading changes by more than a quarter turn, the field rotates backwards (theta decreases) in the plane of the
  opposite heading, so a reversal takes no time;
- the plane turns to the new heading at the angular rate that remains below `limit_hz`, so that the direction of B never
  changes faster than a robot can follow: |dB/dt| <= 2 pi limit_hz a. When B is vertical the plane is undefined, so the
  rest of the turn is applied then; a turn lasts at most half a revolution;
- the amplitude ramps to its new value. Without a field the plane is free.

B is continuous, its derivatives are not. While the plane turns, a roller also drifts sideways by up to
um_per_rev / 4 pi for each radian (2 um at 25 um per revolution), to either side at random; this is neglected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import Floats, wrap_rad

_TURN_RAD = 2.0 * math.pi
_VERTICAL_RAD = 1e-9  # within this angle of the axis z the field counts as vertical


@dataclass(frozen=True, slots=True)
class FieldState:
    """The rotating field at one instant. The robot travels along the plane's heading or against it: `FieldMotion`."""

    phase_rad: float = 0.0  # theta, accumulated over all commands; within one turn
    plane_rad: float = 0.0  # heading of h, the horizontal direction of the plane
    amplitude_mt: float = 0.0


@dataclass(frozen=True, slots=True)
class FieldCommand:
    """Rotation, heading and amplitude of the field from now on."""

    frequency_hz: float = 0.0
    heading_rad: float = 0.0
    amplitude_mt: float = 0.0  # final value of the ramp
    limit_hz: float = 0.0  # largest rate at which the direction of the field may change; at least frequency_hz is used
    ramp_mt_s: float = math.inf  # rate at which the amplitude may change


@dataclass(frozen=True, slots=True)
class MotionSegment:
    """An interval with a fixed plane, or the mean over an interval in which it turns: the displacement is the same."""

    duration_s: float
    frequency_hz: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class FieldMotion:
    """The motion that follows from a state and a command, as functions of the time since then."""

    command: FieldCommand
    phase_rad: float
    plane_rad: float
    amplitude_mt: float
    direction: (
        int  # 1: the robot travels along the plane's heading; -1: the field rotates backwards, it travels against
    )
    slew_rad_s: float  # rate at which the plane turns
    slew_s: float  # duration of the turn: until it is complete or the field is vertical
    plane_end_rad: float

    def phase(self, time_s: ArrayLike) -> Floats:
        """Theta in rad, unbounded; shape of `time_s`."""
        return self.phase_rad + self.direction * _TURN_RAD * self.command.frequency_hz * np.asarray(time_s, np.float64)

    def plane(self, time_s: ArrayLike) -> Floats:
        """Heading of the plane in rad; shape of `time_s`."""
        time = np.asarray(time_s, np.float64)
        return np.where(time < self.slew_s, self.plane_rad + self.slew_rad_s * time, self.plane_end_rad)

    def amplitude(self, time_s: ArrayLike) -> Floats:
        """In mT; shape of `time_s`."""
        time, change = np.asarray(time_s, np.float64), self.command.amplitude_mt - self.amplitude_mt
        if math.isinf(self.command.ramp_mt_s) or change == 0.0:
            return np.where(time > 0.0, self.command.amplitude_mt, self.amplitude_mt)
        step = np.minimum(self.command.ramp_mt_s * time, abs(change))
        # The final value itself, not a rounded sum: zero is exactly zero.
        return np.where(step < abs(change), self.amplitude_mt + np.copysign(step, change), self.command.amplitude_mt)

    def after(self, time_s: float) -> FieldState:
        """The state of the field at a time: the three functions above, in plain numbers for the control loop."""
        command, change = self.command, self.command.amplitude_mt - self.amplitude_mt
        phase = self.phase_rad + self.direction * _TURN_RAD * command.frequency_hz * time_s
        plane = self.plane_rad + self.slew_rad_s * time_s if time_s < self.slew_s else self.plane_end_rad
        amplitude = self.amplitude_mt
        if change != 0.0 and time_s > 0.0:
            step = command.ramp_mt_s * time_s
            amplitude = amplitude + math.copysign(step, change) if step < abs(change) else command.amplitude_mt
        return FieldState(phase % _TURN_RAD, wrap_rad(plane), amplitude)

    def heading_rad(self, time_s: float) -> float:
        """Direction in which the robot travels at a time."""
        return wrap_rad(float(self.plane(time_s)) + (math.pi if self.direction < 0 else 0.0))

    def segments(self, duration_s: float) -> tuple[MotionSegment, ...]:
        """At most two segments with the robot's displacement: frequency times heading, integrated exactly.

        While the plane turns by an angle d the displacement is the chord of an arc: shorter than the arc by the factor
        sin(d / 2) / (d / 2), in the mean direction.
        """
        f, reversal_rad = self.command.frequency_hz, math.pi if self.direction < 0 else 0.0
        slew_s = min(self.slew_s, duration_s)
        segments = []
        if slew_s > 0.0:
            half = 0.5 * self.slew_rad_s * slew_s
            heading_rad = wrap_rad(self.plane_rad + half + reversal_rad)
            segments.append(MotionSegment(slew_s, f * float(np.sinc(half / math.pi)), heading_rad))
        if duration_s > slew_s:
            segments.append(MotionSegment(duration_s - slew_s, f, wrap_rad(self.plane_end_rad + reversal_rad)))
        return tuple(segments)


def field_motion(state: FieldState, command: FieldCommand) -> FieldMotion:
    """The motion of the field from a state on, while the command does not change."""
    plane, turn, direction = state.plane_rad, wrap_rad(command.heading_rad - state.plane_rad), 1
    if state.amplitude_mt <= 0.0:
        plane, turn = command.heading_rad, 0.0
    elif abs(turn) > 0.5 * math.pi + _VERTICAL_RAD:
        turn, direction = wrap_rad(turn + math.pi), -1
    rate = _TURN_RAD * math.sqrt(max(command.limit_hz**2 - command.frequency_hz**2, 0.0))
    turn_s = abs(turn) / rate if rate > 0.0 else math.inf
    slew_s = min(turn_s, _time_to_vertical_s(direction * state.phase_rad, command.frequency_hz)) if turn != 0.0 else 0.0
    return FieldMotion(
        command=command,
        phase_rad=state.phase_rad,
        plane_rad=plane,
        amplitude_mt=state.amplitude_mt,
        direction=direction,
        slew_rad_s=math.copysign(rate, turn),
        slew_s=slew_s,
        plane_end_rad=plane + turn,
    )


def _time_to_vertical_s(phase_rad: float, frequency_hz: float) -> float:
    """Time until the field next points up or down, for a phase that increases."""
    past = phase_rad % math.pi
    if min(past, math.pi - past) < _VERTICAL_RAD:
        return 0.0
    return (math.pi - past) / (_TURN_RAD * frequency_hz) if frequency_hz > 0.0 else math.inf
