"""The coil stage: a velocity to a rotating field, and the three currents that make it (science.md, section 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.control.amplifier import Amplifier, Coilwise
from flowrec.control.coil_limits import WORST_CONDITION, Reach, named
from flowrec.control.field_rotation import Order, Rotation, course
from flowrec.errors import UsageError
from flowrec.messages import Currents, Demand
from flowrec.ranges import Range
from flowrec.robot import Robot
from flowrec.units import seconds

Matrix3 = tuple[Coilwise, Coilwise, Coilwise]
_TURN_RAD = 2.0 * math.pi
_FADE_SHARE = 0.1  # below this share of the full amplitude the compensation of the bias fades with the field


@dataclass(frozen=True, slots=True)
class Coils:
    """A field that turns once per revolution of the robot: f = |u| / um_per_rev, heading that of u.

    x and y are those of the chip, z points up from the floor. roller: B = B0 (z cos theta + h sin theta) about the
    horizontal axis across the heading h: up, forward, down, so that a robot on the floor rolls along h, and one under
    the ceiling along -h unless `surface` says so. helix: B = B0 (z cos theta + (h x z) sin theta) about h itself,
    right-handed in these axes; seen from above, where y points down in the image, x, y, z are a left-handed triple
    and a right-handed screw is `left`.
    """

    mode: Literal["roller", "helix"] = "roller"
    surface: Literal["floor", "ceiling"] = "floor"  # which one a roller rolls on
    handedness: Literal["right", "left"] = "right"  # of a helix
    amplitude_mt: Annotated[float, Range(1e-3, 1e3)] = 4.0  # B0
    # field at the robot by coil currents
    mt_per_a: Annotated[Matrix3, Range(-1e4, 1e4)] = ((2.1, 0.0, 0.0), (0.0, 1.9, 0.0), (0.0, 0.0, 1.5))
    # field without currents: the earth's, the microscope's
    bias_mt: Annotated[Coilwise, Range(-1e3, 1e3)] = (0.0, 0.0, 0.0)
    max_current_a: Annotated[float, Range(1e-3, 1e3)] = 5.0  # of each coil
    ramp_s: Annotated[float, Range(0.0, 60.0)] = 0.2  # from nothing to the full amplitude and back
    amplifier: Amplifier = field(default_factory=Amplifier)

    def drive(
        self, previous: Currents | None, demand: Demand, robot: Robot, finished: bool, cut: bool = False
    ) -> Currents:
        """The field and the currents at the time of a demand, and what the field is to do from then on.

        A robot that only rests keeps its field; when the run is finished, or no one knows where the robot is,
        the amplitude goes down to zero; when it is `cut`, at once. How the field gets from one command to the next
        says rotation.py.
        """
        if previous is not None and previous.stamp_ns == demand.stamp_ns:
            return previous
        dt_s = seconds(demand.stamp_ns - previous.stamp_ns) if previous is not None else 0.0
        now = course(*self.state_and_order(previous)).after(dt_s) if previous is not None else Rotation()
        full_mt, followed_hz = self.full_mt(robot), _followed_hz(robot)
        amplitude_mt = self._ramped_mt(now.amplitude_mt, dt_s, full_mt, finished or math.isnan(demand.error_um))
        if cut:
            amplitude_mt = 0.0
        # The torque goes with the field, and so does the frequency up to which the robot follows it.
        limit_hz = followed_hz * min(amplitude_mt / self.amplitude_mt, 1.0)
        speed_um_s = math.hypot(demand.velocity_um_s[0], demand.velocity_um_s[1])
        heading = previous.heading_rad if previous is not None else 0.0
        if speed_um_s > 1e-6:
            heading = math.atan2(demand.velocity_um_s[1], demand.velocity_um_s[0])
        frequency_hz = min(speed_um_s / robot.um_per_rev, limit_hz)
        state = Rotation(now.phase_rad, now.plane_rad if now.amplitude_mt > 0.0 else heading, amplitude_mt)
        order = Order(frequency_hz, heading, amplitude_mt, limit_hz, self.ramp_mt_s)
        currents, voltages = self.sampled(state, order, 1)
        return Currents(
            stamp_ns=demand.stamp_ns,
            frequency_hz=frequency_hz,
            heading_rad=heading,
            amplitude_mt=amplitude_mt,
            phase_rad=now.phase_rad,
            currents_a=currents[0],
            saturated=full_mt < self.amplitude_mt,
            plane_rad=state.plane_rad,
            limit_hz=limit_hz,
            voltages_v=voltages[0],
        )

    def full_mt(self, robot: Robot) -> float:
        """The amplitude to run at: as wanted, or what currents and voltages leave of it for this robot."""
        return reach_of(self).amplitude_mt(_followed_hz(robot))

    def fastest_um_s(self, robot: Robot) -> float:
        """The robot's speed at the highest frequency up to which it follows that amplitude."""
        return robot.um_per_rev * _followed_hz(robot) * min(self.full_mt(robot) / self.amplitude_mt, 1.0)

    @property
    def ramp_mt_s(self) -> float:
        """How fast the amplitude may change."""
        return self.amplitude_mt / self.ramp_s if self.ramp_s > 0.0 else math.inf

    def state_and_order(self, currents: Currents) -> tuple[Rotation, Order]:
        """What a command says of the field at its stamp, and of what the field does from then on."""
        c = currents
        state = Rotation(c.phase_rad, c.plane_rad, c.amplitude_mt)
        return state, Order(c.frequency_hz, c.heading_rad, c.amplitude_mt, c.limit_hz, self.ramp_mt_s)

    def field_mt(self, phase_rad: ArrayLike, plane_rad: ArrayLike, amplitude_mt: ArrayLike) -> NDArray[np.float64]:
        """(..., 3) the field at a phase, in a plane, with an amplitude; these of any one shape (...)."""
        phase, plane, amplitude = np.broadcast_arrays(phase_rad, plane_rad, amplitude_mt)
        across = amplitude * np.sin(phase) * self._sense
        c, s = np.cos(plane), np.sin(plane)
        x, y = (c, s) if self.mode == "roller" else (s, -c)
        return np.stack([across * x, across * y, amplitude * np.cos(phase)], -1)

    def currents_a(self, field_mt: NDArray[np.float64], amplitude_mt: ArrayLike) -> NDArray[np.float64]:
        """(..., 3) coil currents for a field (..., 3) of an amplitude (...): i = A^-1 (B - b).

        Below a tenth of the full amplitude the bias is compensated less and less, so that no field means no
        currents, and nothing jumps on the way there.
        """
        reach = reach_of(self)
        share = np.minimum(np.asarray(amplitude_mt) / (_FADE_SHARE * self.amplitude_mt), 1.0)
        currents: NDArray[np.float64] = field_mt @ reach.inverse.T - share[..., None] * reach.bias_a
        return currents

    def sampled(
        self, state: Rotation, order: Order, count: int, rate_hz: float | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Currents (count + 1, 3) at the samples from now on, and the voltages (count, 3) held from each to the next.

        `rate_hz` samples per second, those of the amplifier's outputs by default.
        """
        rate = self.amplifier.output_hz if rate_hz is None else rate_hz
        time, way = np.arange(count + 1) / rate, course(state, order)
        amplitude = way.amplitude(time)
        currents = self.currents_a(self.field_mt(way.phase(time), way.plane(time), amplitude), amplitude)
        return currents, self.amplifier.held_v(currents, 1.0 / rate)

    def check(self, where: str) -> None:
        """Refuse settings, each within its range, that together make no field; `where` names their origin.

        Raises
        ------
        UsageError : one line, the key first.
        """
        amplifier = self.amplifier
        _, strength, across = np.linalg.svd(np.array(self.mt_per_a).T)
        if strength[-1] * WORST_CONDITION <= strength[0]:
            raise UsageError(
                f"{where}: coils.mt_per_a: no currents make a field along {named(across[-1])} "
                f"({strength[-1]:.3g} mT/A, {strength[0]:.3g} in the best direction); three coils must span the room; "
                "flowrec calibrate measures it"
            )
        if amplifier.kind == "voltage" and self.ramp_s == 0.0:
            raise UsageError(f"{where}: coils.ramp_s = 0: a voltage amplifier needs time for a current; try 0.2")
        reach = reach_of(self)
        for left, of, limit in (
            (reach.left_a, "coils.max_current_a", f"{self.max_current_a:g} A"),
            (reach.left_v, "coils.amplifier.max_voltage_v", f"{amplifier.max_voltage_v:g} V"),
        ):
            coil = int(np.argmin(left))
            if left[coil] <= 0.0:
                raise UsageError(
                    f"{where}: {of} = {limit}: coil {'xyz'[coil]} needs all of it against coils.bias_mt "
                    f"({reach.bias_a[coil]:+.3g} A) and for the ramp; raise it, or shield the bias"
                )

    @property
    def _sense(self) -> float:
        """1, or -1 where the field turns the other way for the same heading."""
        return -1.0 if (self.surface == "ceiling" if self.mode == "roller" else self.handedness == "left") else 1.0

    def _ramped_mt(self, last_mt: float, dt_s: float, full_mt: float, off: bool) -> float:
        """The amplitude on its way to all or nothing."""
        step_mt = self.ramp_mt_s * dt_s if self.ramp_s > 0.0 else self.amplitude_mt
        goal_mt = 0.0 if off else full_mt
        return max(last_mt - step_mt, goal_mt) if last_mt > goal_mt else min(last_mt + step_mt, goal_mt)


def _followed_hz(robot: Robot) -> float:
    """Up to where the robot follows the wanted amplitude, with the margin."""
    assert robot.step_out_hz is not None, "robot is resolved with the chip"
    return robot.step_out_margin * robot.step_out_hz


@lru_cache(maxsize=16)
def reach_of(coils: Coils) -> Reach:
    """What is the same in every frame."""
    inverse = np.linalg.inv(np.array(coils.mt_per_a))
    bias_a = inverse @ np.array(coils.bias_mt)
    row = np.linalg.norm(inverse, axis=1)
    ohm, henry = coils.amplifier.ohm, coils.amplifier.henry
    # While the amplitude ramps, and the compensation of the bias with it, L di/dt is more by at most this.
    ramp_a_s = np.zeros(3)
    if coils.ramp_s > 0.0:
        ramp_a_s = coils.ramp_mt_s * (row + np.abs(bias_a) / (_FADE_SHARE * coils.amplitude_mt))
    return Reach(
        inverse=inverse,
        bias_a=bias_a,
        row_a_per_mt=row,
        left_a=coils.max_current_a - np.abs(bias_a),
        left_v=coils.amplifier.max_voltage_v - ohm * np.abs(bias_a) - henry * ramp_a_s,
        ohm=ohm,
        henry=henry,
        wanted_mt=coils.amplitude_mt,
    )
