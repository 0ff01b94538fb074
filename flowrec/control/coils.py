"""The coil stage: a velocity to a rotating field, and the three currents that make it (science.md, section 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.messages import Currents, Demand
from flowrec.robot import Robot
from flowrec.units import seconds

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
_TURN_RAD = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Coils:
    """A field that turns once per revolution of the robot: f = |u| / um_per_rev, heading that of u.

    roller: B = B0 (z cos theta + h sin theta) about the horizontal axis across the heading h, so that a robot on the
    floor rolls along h. helix: B = B0 (z cos theta + (h x z) sin theta) about h itself.
    """

    mode: Literal["roller", "helix"] = "roller"
    amplitude_mt: float = 4.0  # B0
    mt_per_a: Matrix3 = ((2.1, 0.0, 0.0), (0.0, 1.9, 0.0), (0.0, 0.0, 1.5))  # field at the robot by coil currents
    bias_mt: tuple[float, float, float] = (0.0, 0.0, 0.0)  # field without currents: the earth's, the microscope's
    max_current_a: float = 5.0  # of each coil
    ramp_s: float = 0.2  # from nothing to the full amplitude and back

    def drive(self, previous: Currents | None, demand: Demand, robot: Robot, finished: bool) -> Currents:
        """The field and the currents at the time of a demand.

        A robot that only rests keeps its field; when the run is finished, or no one knows where the robot is,
        the amplitude goes down to zero. The phase is one accumulator over all changes of frequency and heading.
        """
        if previous is not None and previous.stamp_ns == demand.stamp_ns:
            return previous
        dt_s = seconds(demand.stamp_ns - previous.stamp_ns) if previous is not None else 0.0
        speed_um_s = math.hypot(demand.velocity_um_s[0], demand.velocity_um_s[1])
        heading = previous.heading_rad if previous is not None else 0.0
        if speed_um_s > 1e-6:
            heading = math.atan2(demand.velocity_um_s[1], demand.velocity_um_s[0])
        phase = (previous.phase_rad + _TURN_RAD * previous.frequency_hz * dt_s) % _TURN_RAD if previous else 0.0
        inverse, axes = np.linalg.inv(np.array(self.mt_per_a)), self._axes(heading)
        room_mt = self._room_mt(inverse, axes)
        ramped_mt = self._ramped_mt(previous, dt_s, finished or math.isnan(demand.error_um))
        amplitude_mt = min(ramped_mt, room_mt)
        field_mt = amplitude_mt * (axes @ np.array([math.cos(phase), math.sin(phase)]))
        return Currents(
            stamp_ns=demand.stamp_ns,
            frequency_hz=self._frequency_hz(speed_um_s, amplitude_mt, robot),
            heading_rad=heading,
            amplitude_mt=amplitude_mt,
            phase_rad=phase,
            currents_a=inverse @ (field_mt - np.array(self.bias_mt)) * (amplitude_mt > 0.0),
            saturated=room_mt < ramped_mt,
        )

    def _axes(self, heading_rad: float) -> NDArray[np.float64]:
        """(3, 2) the directions of the field at theta = 0 and a quarter turn later."""
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        return np.array(
            [[0.0, c], [0.0, s], [1.0, 0.0]] if self.mode == "roller" else [[0.0, s], [0.0, -c], [1.0, 0.0]]
        )

    def _room_mt(self, inverse: NDArray[np.float64], axes: NDArray[np.float64]) -> float:
        """The largest amplitude whose whole circle every coil can drive: one scale for all, so that it stays round."""
        per_mt = np.hypot(*(inverse @ axes).T)
        left_a = self.max_current_a - np.abs(inverse @ np.array(self.bias_mt))
        return float(np.min(np.maximum(left_a, 0.0) / np.maximum(per_mt, 1e-12)))

    def _ramped_mt(self, previous: Currents | None, dt_s: float, off: bool) -> float:
        """The amplitude on its way to all or nothing."""
        last_mt = previous.amplitude_mt if previous is not None else 0.0
        step_mt = self.amplitude_mt * dt_s / self.ramp_s if self.ramp_s > 0.0 else self.amplitude_mt
        return max(last_mt - step_mt, 0.0) if off else min(last_mt + step_mt, self.amplitude_mt)

    def _frequency_hz(self, speed_um_s: float, amplitude_mt: float, robot: Robot) -> float:
        """Revolutions for the speed, held below the step-out of this amplitude: the torque goes with the field."""
        assert robot.step_out_hz is not None, "robot is resolved with the chip"
        share = amplitude_mt / self.amplitude_mt if self.amplitude_mt > 0.0 else 0.0
        return min(speed_um_s / robot.um_per_rev, robot.step_out_margin * robot.step_out_hz * share)
