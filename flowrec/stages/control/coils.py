"""The coil stage: from a demanded velocity to a rotating field and the currents of the coils."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import Currents, Demand, Floats, Range, UsageError, coil_names
from flowrec.physics import Robot
from flowrec.stages.control.amplifier import (
    WORST_CONDITION,
    AmplifierSettings,
    FieldLimits,
    direction_name,
    shared_inverse,
)
from flowrec.stages.control.field_rotation import FieldCommand, FieldState, field_motion

_Row = tuple[float, ...]
_Matrix = tuple[_Row, _Row, _Row]
_AXES = 3  # of the field
_LEAST_ROW = 1e-9  # A per mT of a coil that makes no field, such as a Maxwell pair
_PER_COIL = ("a_per_v", "v_per_v", "resistance_ohm", "inductance_mh")  # settings of [coils.amplifier]
_FADE_FRACTION = 0.1  # below this fraction of the full amplitude the bias compensation fades with the field


@dataclass(frozen=True, slots=True)
class Coils:
    """A field that turns once per revolution of the robot: f = |u| / um_per_rev, with the heading of u.

    x and y are those of the chip, z points up from the floor. roller: B = B0 (z cos theta + h sin theta) rotates about
    the horizontal axis perpendicular to the heading h (up, forward, down), so a robot on the floor rolls along h, and
    one under the ceiling along -h unless `surface` is ceiling. helix: B = B0 (z cos theta + (h x z) sin theta) rotates
    about h itself, right-handed in these axes. Seen from above y points down in the image, so x, y, z are a left-handed
    triple and a right-handed screw has handedness `left`.
    """

    # roller: the field turns about an axis across the heading; helix: about the heading
    mode: Literal["roller", "helix"] = "roller"
    surface: Literal["floor", "ceiling"] = "floor"  # surface on which a roller rolls
    handedness: Literal["right", "left"] = "right"  # handedness of a helix
    amplitude_mt: Annotated[float, Range(1e-3, 1e3)] = 4.0  # amplitude B0 of the rotating field
    # field at the robot (rows: along x, y, z) per coil current (columns: three coils or more, in the order of outputs)
    mt_per_a: Annotated[_Matrix, Range(-1e4, 1e4)] = ((2.1, 0.0, 0.0), (0.0, 1.9, 0.0), (0.0, 0.0, 1.5))
    # field without currents: of the earth and the microscope
    bias_mt: Annotated[tuple[float, float, float], Range(-1e3, 1e3)] = (0.0, 0.0, 0.0)
    max_current_a: Annotated[float, Range(1e-3, 1e3)] = 5.0  # largest current of a coil
    ramp_s: Annotated[float, Range(0.0, 60.0)] = 0.2  # time from zero to the full amplitude and back
    amplifier: AmplifierSettings = field(default_factory=AmplifierSettings)

    def drive(
        self, previous: Currents | None, demand: Demand, robot: Robot, finished: bool, cut: bool = False
    ) -> Currents:
        """Field and currents at the time of a demand, and the motion of the field from then on.

        A resting robot keeps its field. When the run is finished, or the position of the robot is unknown, the
        amplitude ramps to zero; with `cut` it is zero at once. field_rotation.py describes the transition.
        """
        if previous is not None and previous.stamp_ns == demand.stamp_ns:
            return previous
        dt_s = demand.since_s(previous)
        now = field_motion(*self.state_and_command(previous)).after(dt_s) if previous is not None else FieldState()
        full_mt, follow_hz = self.full_mt(robot), _follow_hz(robot)
        amplitude_mt = self._ramp(now.amplitude_mt, dt_s, 0.0 if finished or math.isnan(demand.error_um) else full_mt)
        if cut:
            amplitude_mt = 0.0
        # The torque is proportional to the field, and so is the frequency up to which the robot follows it.
        limit_hz = follow_hz * min(amplitude_mt / self.amplitude_mt, 1.0)
        speed_um_s = math.hypot(*demand.velocity_um_s)
        heading = previous.heading_rad if previous is not None else 0.0
        if speed_um_s > 1e-6:
            heading = math.atan2(demand.velocity_um_s[1], demand.velocity_um_s[0])
        frequency_hz = min(robot.frequency_hz(speed_um_s / robot.um_per_rev), limit_hz)
        state = FieldState(now.phase_rad, now.plane_rad if now.amplitude_mt > 0.0 else heading, amplitude_mt)
        command = FieldCommand(frequency_hz, heading, amplitude_mt, limit_hz, self.ramp_mt_s)
        currents_a, voltages_v = self._outputs_now(state, command)
        return Currents(
            stamp_ns=demand.stamp_ns,
            frequency_hz=frequency_hz,
            heading_rad=heading,
            amplitude_mt=amplitude_mt,
            phase_rad=now.phase_rad,
            currents_a=currents_a,
            saturated=full_mt < self.amplitude_mt,
            plane_rad=state.plane_rad,
            limit_hz=limit_hz,
            voltages_v=voltages_v,
            unmet_mt=max(self.amplitude_mt - full_mt, 0.0),
        )

    def full_mt(self, robot: Robot) -> float:
        """The amplitude to run at: the nominal one, or what currents and voltages permit for this robot."""
        return _operating_mt(self, _follow_hz(robot))

    def fastest_um_s(self, robot: Robot) -> float:
        """Speed of the robot at the highest frequency at which it follows that amplitude."""
        if not robot.speed_at_hz:
            return robot.um_per_rev * _follow_hz(robot) * min(self.full_mt(robot) / self.amplitude_mt, 1.0)
        return robot.um_per_rev * robot.proportional_hz(self.fastest_hz(robot))

    def fastest_hz(self, robot: Robot) -> float:
        """The highest frequency of the field at which the robot follows that amplitude."""
        return _follow_hz(robot) * min(self.full_mt(robot) / self.amplitude_mt, 1.0)

    @property
    def count(self) -> int:
        """Number of coils."""
        return len(self.mt_per_a[0])

    @property
    def ramp_mt_s(self) -> float:
        """Rate at which the amplitude may change."""
        return self.amplitude_mt / self.ramp_s if self.ramp_s > 0.0 else math.inf

    @property
    def fade_mt(self) -> float:
        """Amplitude below which the compensation of the bias fades with the field."""
        return _FADE_FRACTION * self.amplitude_mt

    def state_and_command(self, currents: Currents) -> tuple[FieldState, FieldCommand]:
        """State of the field at the stamp of a message, and what the field does from then on."""
        c = currents
        state = FieldState(c.phase_rad, c.plane_rad, c.amplitude_mt)
        return state, FieldCommand(c.frequency_hz, c.heading_rad, c.amplitude_mt, c.limit_hz, self.ramp_mt_s)

    def field_mt(self, phase_rad: ArrayLike, plane_rad: ArrayLike, amplitude_mt: ArrayLike) -> Floats:
        """(..., 3) field for phases, planes and amplitudes of one shape (...), or that broadcast to it."""
        phase, plane, amplitude = np.broadcast_arrays(phase_rad, plane_rad, amplitude_mt)
        horizontal = amplitude * np.sin(phase) * self._sense
        c, s = np.cos(plane), np.sin(plane)
        x, y = (c, s) if self.mode == "roller" else (s, -c)
        return np.stack([horizontal * x, horizontal * y, amplitude * np.cos(phase)], -1)

    def currents_a(self, field_mt: Floats, amplitude_mt: ArrayLike) -> Floats:
        """(..., n) currents of n coils for a field (..., 3) of an amplitude (...): i = A^-1 (B - b).

        Below a tenth of the full amplitude the compensation of the bias b is reduced in proportion, so that zero field
        means zero currents, without a step.
        """
        limits = field_limits(self)
        weight = np.minimum(np.asarray(amplitude_mt) / self.fade_mt, 1.0)
        return field_mt @ limits.inverse.T - weight[..., None] * limits.bias_a

    def output_samples(self, state: FieldState, command: FieldCommand, count: int) -> tuple[Floats, Floats]:
        """Currents (count + 1, n) at the output samples from now on, and the voltages (count, n) held in between."""
        rate = self.amplifier.output_hz
        time, motion = np.arange(count + 1) / rate, field_motion(state, command)
        amplitude = motion.amplitude(time)
        currents = self.currents_a(self.field_mt(motion.phase(time), motion.plane(time), amplitude), amplitude)
        return currents, self.amplifier.sample_and_hold_v(currents, 1.0 / rate)

    def _outputs_now(self, state: FieldState, command: FieldCommand) -> tuple[Floats, Floats]:
        """Currents (n,) now and voltages (n,) of the first sample: `output_samples` of one, in plain numbers.

        Every tick asks for it, and NumPy takes ten times as long for as few numbers.
        """
        motion = field_motion(state, command)
        now, then = (self._currents_of(motion.after(time_s)) for time_s in (0.0, 1.0 / self.amplifier.output_hz))
        hold = zip(*_hold_ohm(self), now, then, strict=True)
        volts = [ohm * first + slope * (second - first) for ohm, slope, first, second in hold]
        return np.array(now), np.array(volts)

    def _currents_of(self, state: FieldState) -> list[float]:
        """Coil currents (n) of a state of the field, by the equations of `field_mt` and `currents_a`."""
        inverse, bias_a = _inverse_and_bias(self)
        amplitude, c, s = state.amplitude_mt, math.cos(state.plane_rad), math.sin(state.plane_rad)
        horizontal = self._sense * amplitude * math.sin(state.phase_rad)
        x, y = (c, s) if self.mode == "roller" else (s, -c)
        bx, by, bz = horizontal * x, horizontal * y, amplitude * math.cos(state.phase_rad)
        weight = min(amplitude / self.fade_mt, 1.0)
        return [p * bx + q * by + r * bz - weight * a for (p, q, r), a in zip(inverse, bias_a, strict=True)]

    @property
    def _sense(self) -> float:
        """1, or -1 where the field rotates the other way: for a roller under the ceiling and a left-handed helix."""
        return -1.0 if (self.surface == "ceiling" if self.mode == "roller" else self.handedness == "left") else 1.0

    def check(self, where: str) -> None:
        """Refuse settings that are each within their range but together produce no field.

        `where`: origin of the settings, for the message. Raises UsageError: one line, the key first.
        """
        amplifier = self.amplifier
        self._check_counts(where)
        _, gain, directions = np.linalg.svd(np.array(self.mt_per_a).T)
        if gain[-1] * WORST_CONDITION <= gain[0]:
            raise UsageError(
                f"{where}: coils.mt_per_a: no currents make a field along {direction_name(directions[-1])} "
                f"({gain[-1]:.3g} mT/A, {gain[0]:.3g} in the best direction); the fields of the "
                f"{_count_words(self.count)} coils must be linearly independent; flowrec calibrate coils measures them"
            )
        if amplifier.kind == "voltage" and self.ramp_s == 0.0:
            raise UsageError(f"{where}: coils.ramp_s = 0: a voltage amplifier needs time for a current; try 0.2")
        limits = field_limits(self)
        for available, key, limit in (
            (limits.available_a, "coils.max_current_a", f"{self.max_current_a:g} A"),
            (limits.available_v, "coils.amplifier.max_voltage_v", f"{amplifier.max_voltage_v:g} V"),
        ):
            coil = int(np.argmin(available))
            if available[coil] <= 0.0:
                name = coil_names(self.count)[coil]
                raise UsageError(
                    f"{where}: {key} = {limit}: coil {name} needs all of it against coils.bias_mt "
                    f"({limits.bias_a[coil]:+.3g} A) and for the ramp; raise it, or shield the bias"
                )

    def _check_counts(self, where: str) -> None:
        """Refuse numbers that are not one for each coil."""
        counts = [len(row) for row in self.mt_per_a]
        if min(counts) < _AXES or len(set(counts)) > 1:
            raise UsageError(
                f"{where}: coils.mt_per_a: rows of {', '.join(map(str, counts))} numbers; give three rows, for the "
                f"field along x, y and z, each with one number for each coil, of which a rotating field needs {_AXES}"
            )
        for key in _PER_COIL:
            given = getattr(self.amplifier, key)
            if isinstance(given, tuple) and len(given) != self.count:
                raise UsageError(
                    f"{where}: coils.amplifier.{key}: {len(given)} numbers, where coils.mt_per_a has {self.count} "
                    "columns; give one number for all coils, or one for each"
                )

    def _ramp(self, last_mt: float, dt_s: float, target_mt: float) -> float:
        """The amplitude after dt on its ramp to a target."""
        step_mt = self.ramp_mt_s * dt_s if self.ramp_s > 0.0 else self.amplitude_mt
        return max(last_mt - step_mt, target_mt) if last_mt > target_mt else min(last_mt + step_mt, target_mt)


def _follow_hz(robot: Robot) -> float:
    """Frequency up to which the robot follows the nominal amplitude, with the step-out margin."""
    return robot.step_out_margin * robot.step_out_hz


@lru_cache(maxsize=16)
def _operating_mt(coils: Coils, follow_hz: float) -> float:
    return field_limits(coils).operating_amplitude_mt(follow_hz)


@lru_cache(maxsize=16)
def _inverse_and_bias(coils: Coils) -> tuple[list[list[float]], list[float]]:
    limits = field_limits(coils)
    return limits.inverse.tolist(), limits.bias_a.tolist()


@lru_cache(maxsize=16)
def _hold_ohm(coils: Coils) -> tuple[list[float], list[float]]:
    """Volts of each coil per ampere at the beginning of an output sample, and per ampere of change within it."""
    amplifier = coils.amplifier
    held = amplifier.ohm, amplifier.slope_ohm(1.0 / amplifier.output_hz)
    ohm, slope_ohm = (np.broadcast_to(each, coils.count).tolist() for each in held)
    return ohm, slope_ohm


@lru_cache(maxsize=16)
def field_limits(coils: Coils) -> FieldLimits:
    """Limits of the field by coils and amplifier; constant during a run."""
    matrix = np.array(coils.mt_per_a)
    if coils.count == _AXES:
        return _limits_with(coils, np.linalg.inv(matrix))
    return _limits_with(coils, shared_inverse(matrix, partial(_limits_with, coils)))


def _limits_with(coils: Coils, inverse: Floats) -> FieldLimits:
    """The limits if the currents of a field are those of a matrix (n, 3), A per mT."""
    bias_a = inverse @ np.array(coils.bias_mt)
    row = np.maximum(np.linalg.norm(inverse, axis=1), _LEAST_ROW)
    ohm, henry = (np.broadcast_to(each, coils.count) for each in (coils.amplifier.ohm, coils.amplifier.henry))
    # While the amplitude ramps, and the bias compensation with it, L di/dt is larger by at most this.
    a_per_mt_ramp = row + np.abs(bias_a) / coils.fade_mt
    ramp_a_s = coils.ramp_mt_s * a_per_mt_ramp if coils.ramp_s > 0.0 else np.zeros(coils.count)
    return FieldLimits(
        inverse=inverse,
        bias_a=bias_a,
        row_a_per_mt=row,
        a_per_mt_ramp=a_per_mt_ramp,
        available_a=coils.max_current_a - np.abs(bias_a),
        available_v=coils.amplifier.max_voltage_v - ohm * np.abs(bias_a) - henry * ramp_a_s,
        ohm=ohm,
        henry=henry,
        nominal_mt=coils.amplitude_mt,
    )


def _count_words(count: int) -> str:
    return "three" if count == _AXES else str(count)
