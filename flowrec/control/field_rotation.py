"""How the field turns from one command to the next: one phase, the plane it turns in, its amplitude. Closed form.

The field of length a turns in a vertical plane that holds z and the horizontal direction h of its heading:
B = a (z cos theta + h sin theta). With every new command
- the phase theta goes on from where it is, at the new frequency;
- for a way of more than a quarter turn the field turns back in its plane instead (theta runs the other way): to
  reverse the robot nothing has to be waited for;
- the plane turns to the new heading at the rate that is left up to `limit_hz`, so that the direction of B never
  turns faster than a robot can follow: |dB/dt| <= 2 pi limit_hz a. Where B stands on z the plane means nothing, and
  what is left of the turn is done there at once: half a revolution is the longest that a turn can last;
- the amplitude goes to the new one at the rate of the ramp. Without a field the plane is free.

Nothing here jumps but derivatives: B is continuous. While the plane turns a roller also creeps sideways, by up to
um_per_rev / 4 pi for each radian (2 um at 25 um per revolution), to either side by chance; that is not counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.units import wrap_rad

_TURN_RAD = 2.0 * math.pi
_ON_Z_RAD = 1e-9  # so near to the axis z the field is taken to stand on it


@dataclass(frozen=True, slots=True)
class Rotation:
    """The turning field at one instant. Its direction of travel is that of the plane, or the opposite: see `Course`."""

    phase_rad: float = 0.0  # theta, one accumulator; within a turn
    plane_rad: float = 0.0  # heading of h, the horizontal direction of the plane
    amplitude_mt: float = 0.0


@dataclass(frozen=True, slots=True)
class Order:
    """What the field is to do from now on."""

    frequency_hz: float = 0.0
    heading_rad: float = 0.0
    amplitude_mt: float = 0.0  # where the ramp goes to
    limit_hz: float = 0.0  # the fastest that the direction of the field may turn in all; at least frequency_hz counts
    ramp_mt_s: float = math.inf  # how fast the amplitude may change


@dataclass(frozen=True, slots=True)
class Leg:
    """A while with an unchanging plane, or the mean of one that turned: the robot's way is the same."""

    duration_s: float
    frequency_hz: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class Course:
    """All that follows from an order, as functions of the time since."""

    order: Order
    phase_rad: float
    plane_rad: float
    amplitude_mt: float
    spin: int  # 1: the robot travels along the plane's heading; -1: the field turns back, the robot against it
    slew_rad_s: float  # how fast the plane turns
    slew_s: float  # for how long, until it is there or the field stands on z
    plane_end_rad: float

    def phase(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Theta in rad, unbounded; shape of `time_s`."""
        return self.phase_rad + self.spin * _TURN_RAD * self.order.frequency_hz * np.asarray(time_s, np.float64)

    def plane(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Heading of the plane in rad; shape of `time_s`."""
        time = np.asarray(time_s, np.float64)
        return np.where(time < self.slew_s, self.plane_rad + self.slew_rad_s * time, self.plane_end_rad)

    def amplitude(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """In mT; shape of `time_s`."""
        time, change = np.asarray(time_s, np.float64), self.order.amplitude_mt - self.amplitude_mt
        if math.isinf(self.order.ramp_mt_s) or change == 0.0:
            return np.where(time > 0.0, self.order.amplitude_mt, self.amplitude_mt)
        step = np.minimum(self.order.ramp_mt_s * time, abs(change))
        # The end itself, not the sum that rounds to it: nothing is exactly nothing.
        return np.where(step < abs(change), self.amplitude_mt + np.copysign(step, change), self.order.amplitude_mt)

    def after(self, time_s: float) -> Rotation:
        """The field a while later."""
        return Rotation(
            float(self.phase(time_s)) % _TURN_RAD, wrap_rad(float(self.plane(time_s))), float(self.amplitude(time_s))
        )

    def heading_rad(self, time_s: float) -> float:
        """Where the robot travels to at that time."""
        return wrap_rad(float(self.plane(time_s)) + (math.pi if self.spin < 0 else 0.0))

    def legs(self, duration_s: float) -> tuple[Leg, ...]:
        """The robot's way under a following field: frequency times heading, integrated exactly, in at most two legs.

        While the plane turns by d the way is the chord of an arc: shorter by sin(d / 2) / (d / 2), half way between.
        """
        f, back = self.order.frequency_hz, math.pi if self.spin < 0 else 0.0
        turning_s = min(self.slew_s, duration_s)
        legs = []
        if turning_s > 0.0:
            half = 0.5 * self.slew_rad_s * turning_s
            legs.append(Leg(turning_s, f * float(np.sinc(half / math.pi)), wrap_rad(self.plane_rad + half + back)))
        if duration_s > turning_s:
            legs.append(Leg(duration_s - turning_s, f, wrap_rad(self.plane_end_rad + back)))
        return tuple(legs)


def course(state: Rotation, order: Order) -> Course:
    """What the field does from now on, under an order that stays."""
    plane, way, spin = state.plane_rad, wrap_rad(order.heading_rad - state.plane_rad), 1
    if state.amplitude_mt <= 0.0:
        plane, way = order.heading_rad, 0.0
    elif abs(way) > 0.5 * math.pi + _ON_Z_RAD:
        way, spin = wrap_rad(way + math.pi), -1
    left_hz = math.sqrt(max(order.limit_hz**2 - order.frequency_hz**2, 0.0))
    rate = _TURN_RAD * left_hz
    there_s = abs(way) / rate if rate > 0.0 else math.inf
    slew_s = min(there_s, _until_on_z_s(spin * state.phase_rad, order.frequency_hz)) if way != 0.0 else 0.0
    return Course(
        order=order,
        phase_rad=state.phase_rad,
        plane_rad=plane,
        amplitude_mt=state.amplitude_mt,
        spin=spin,
        slew_rad_s=math.copysign(rate, way),
        slew_s=slew_s,
        plane_end_rad=plane + way,
    )


def _until_on_z_s(phase_rad: float, frequency_hz: float) -> float:
    """Until the field next stands on z, up or down; `phase_rad` as it grows."""
    past = phase_rad % math.pi
    if min(past, math.pi - past) < _ON_Z_RAD:
        return 0.0
    return (math.pi - past) / (_TURN_RAD * frequency_hz) if frequency_hz > 0.0 else math.inf
