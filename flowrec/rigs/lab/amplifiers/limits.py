"""The limits of current, voltage, slew and time, in one place between the loop and every amplifier.

What the coils can do is bounded by one pair (amplitude, rate of rotation): below both, no coil exceeds its limits at
any heading, phase, turn of the plane or ramp, in any order of commands. The pair is the operating point of the coil
stage, field_limits(coils).operating_amplitude_mt, so a command of that stage is never changed. `admit` holds commands
to it; `check_samples` refuses output samples beyond the limits, however they were made.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from flowrec.core import Currents, Floats, Measured, RigError, UsageError, coil_names, seconds, wrap_rad
from flowrec.physics import Robot
from flowrec.rigs.lab.amplifiers.amplifier import AmplifierInfo
from flowrec.stages import Coils, FieldCommand, OutputLimits, field_limits

_ROUNDING = 1e-9  # relative


class CommandLimits:
    """Limits of one rig. It remembers for how long the coils were energised.

    Parameters
    ----------
    coils, robot, output : the settings that set the limits.
    tell : called with one line when a command is changed; once for each cause.

    Attributes
    ----------
    amplitude_mt, rotation_hz : the largest field, and the fastest change of its direction.
    on_left_s : time for which the coils may still be energised.
    """

    def __init__(
        self, coils: Coils, robot: Robot, output: OutputLimits, tell: Callable[[str], None] = lambda _text: None
    ) -> None:
        self.coils, self.output, self.tell = coils, output, tell
        self.amplitude_mt = coils.full_mt(robot)
        self.rotation_hz = coils.fastest_hz(robot)
        self.on_left_s = output.longest_on_s
        self._resting = False
        self._last: tuple[int, bool] | None = None  # time of the last command; with a field?
        self._told: set[str] = set()
        need = self.slew_a_s
        if self.output.slew_a_s is not None and need > self.output.slew_a_s:
            raise UsageError(
                f"lab.output.slew_a_s = {self.output.slew_a_s:g}: {self.amplitude_mt:.3g} mT at "
                f"{self.rotation_hz:.3g} Hz and the ramp need {need:.3g} A/s; lower coils.amplitude_mt or "
                "robot.step_out_hz, or raise coils.ramp_s"
            )

    @property
    def slew_a_s(self) -> float:
        """Largest rate of change of a coil's current that an admitted command can cause."""
        return float((self._turning_a_s + field_limits(self.coils).a_per_mt_ramp * self.ramp_mt_s).max())

    @property
    def ramp_mt_s(self) -> float:
        """Rate of the ramp of a command."""
        slew = self.output.slew_a_s
        if math.isfinite(self.coils.ramp_mt_s) or slew is None:
            return self.coils.ramp_mt_s
        return max(float(((slew - self._turning_a_s) / field_limits(self.coils).a_per_mt_ramp).min()), 0.0)

    @property
    def off_ramp_mt_s(self) -> float:
        """Rate at which a field that no longer rotates is taken away: at once, or as voltage and slew allow."""
        if self.coils.amplifier.kind == "voltage":
            return self.ramp_mt_s
        slew = self.output.slew_a_s
        return math.inf if slew is None else float((slew / field_limits(self.coils).a_per_mt_ramp).min())

    def check(self, info: AmplifierInfo) -> None:
        """Refuse limits that are beyond those of the amplifier.

        Raises
        ------
        UsageError : one line; nothing has been energised.
        """
        amplifier = self.coils.amplifier
        for key, asked, offered, unit in (
            ("coils.max_current_a", self.coils.max_current_a, info.max_current_a, "A"),
            ("coils.amplifier.max_voltage_v", amplifier.max_voltage_v, info.max_voltage_v, "V"),
            ("coils.amplifier.output_hz", amplifier.output_hz, info.max_output_hz, "Hz"),
        ):
            if asked > offered * (1.0 + _ROUNDING):
                raise UsageError(
                    f"{key} = {asked:g} {unit}: {info.model} makes at most {offered:g} {unit}; set it to that or less"
                )
        if self.output.measured_within_a is not None and not info.measures:
            raise UsageError(
                f"lab.output.measured_within_a = {self.output.measured_within_a:g}: {info.model} measures no currents; "
                "leave it out"
            )

    def admit(self, currents: Currents, now_ns: int) -> FieldCommand:
        """The command that the amplifier gets; within all limits, and finite, whatever it is given.

        A command with a number that is not finite, a negative frequency or a negative amplitude becomes zero field. So
        does every command when the coils have been energised for `longest_on_s`, until they have rested for `rest_s`.
        """
        given = (currents.frequency_hz, currents.heading_rad, currents.amplitude_mt, currents.limit_hz)
        frequency, heading, amplitude, limit = given
        heading = wrap_rad(heading) if math.isfinite(heading) else heading
        if not all(map(math.isfinite, given)) or frequency < 0.0 or amplitude < 0.0 or limit < 0.0:
            self._say("invalid", f"a command with impossible numbers (Hz, rad, mT, Hz: {given}) is taken as zero field")
            frequency = heading = amplitude = limit = 0.0
        if amplitude > self.amplitude_mt * (1.0 + _ROUNDING) or frequency > self.rotation_hz * (1.0 + _ROUNDING):
            self._say(
                "beyond",
                f"a command of {amplitude:.3g} mT at {frequency:.3g} Hz is held to the limits, {self.amplitude_mt:.3g} "
                f"mT and {self.rotation_hz:.3g} Hz",
            )
        amplitude = min(amplitude, self.amplitude_mt)
        if not self._permits(now_ns, amplitude > 0.0):
            return FieldCommand(0.0, heading, 0.0, 0.0, self.off_ramp_mt_s)
        frequency = min(frequency, self.rotation_hz)
        return FieldCommand(frequency, heading, amplitude, min(limit, self.rotation_hz), self.ramp_mt_s)

    def rest(self, now_ns: int) -> FieldCommand:
        """The command that takes the field away."""
        self._permits(now_ns, wanted=False)
        return FieldCommand(ramp_mt_s=self.off_ramp_mt_s)

    @property
    def off_s(self) -> float:
        """Longest time that a field takes to go."""
        return self.amplitude_mt / self.off_ramp_mt_s

    def check_samples(self, currents_a: Floats, voltages_v: Floats) -> None:
        """Refuse output samples beyond a limit.

        Parameters
        ----------
        currents_a : (n + 1, coils), the first one that of the sample before.
        voltages_v : (n, coils)

        Raises
        ------
        RigError : which limit, and by how much. None of the samples may be put out.
        """
        _refuse_beyond("current", currents_a, self.coils.max_current_a, "A")
        _refuse_beyond("voltage", voltages_v, self.coils.amplifier.max_voltage_v, "V")
        if self.output.slew_a_s is not None:
            rate = np.diff(currents_a, axis=0) * self.coils.amplifier.output_hz
            _refuse_beyond("slew", rate, self.output.slew_a_s, "A/s")

    @property
    def _turning_a_s(self) -> Floats:
        """(coils,) largest rate of change of the currents while the amplitude is constant."""
        turning: Floats = field_limits(self.coils).row_a_per_mt * self.amplitude_mt * math.tau * self.rotation_hz
        return turning

    def _permits(self, now_ns: int, wanted: bool) -> bool:
        """True if the coils may be energised from now on; counts for how long they were."""
        longest_s, rest_s = self.output.longest_on_s, self.output.rest_s
        if self._last is not None:
            elapsed_s = max(seconds(now_ns - self._last[0]), 0.0)
            gained_s = -elapsed_s if self._last[1] else elapsed_s * longest_s / rest_s
            self.on_left_s = min(self.on_left_s + gained_s, longest_s)
        if wanted and self.on_left_s <= 0.0 and not self._resting:
            self._resting = True
            self.tell(f"the coils were on for {longest_s:g} s and rest for {rest_s:g} s (lab.output.longest_on_s)")
        elif self.on_left_s >= longest_s:
            self._resting = False
        on = wanted and not self._resting
        self._last = (now_ns, on)
        return on

    def _say(self, cause: str, text: str) -> None:
        if cause not in self._told:
            self._told.add(cause)
            self.tell(text)


class ReadBack:
    """Compares measured currents with those that were put out.

    Parameters
    ----------
    within_a, after_s : see OutputLimits; within_a None: nothing is compared.
    """

    def __init__(self, within_a: float | None, after_s: float) -> None:
        self._within_a, self._after_s = within_a, after_s
        self._since_ns: int | None = None

    def fault(self, measured: Measured | None) -> str:
        """Sentence on a difference that has lasted too long, by this measurement and those before; '' without one."""
        if self._within_a is None or measured is None:
            return ""
        difference_a = np.abs(measured.currents_a - measured.put_out_a)
        if (difference_a <= self._within_a).all():  # false for NaN
            self._since_ns = None
            return ""
        self._since_ns = measured.stamp_ns if self._since_ns is None else self._since_ns
        lasts_s = seconds(measured.stamp_ns - self._since_ns)
        if lasts_s < self._after_s:
            return ""
        coil = int(np.argmax(difference_a))
        return (
            f"coil {coil_names(len(difference_a))[coil]} has {measured.currents_a[coil]:.3g} A where "
            f"{measured.put_out_a[coil]:.3g} A are put out, for {1e3 * lasts_s:.0f} ms (lab.output.measured_within_a = "
            f"{self._within_a:g}): see to the coil, its amplifier and its sensor"
        )


def _refuse_beyond(name: str, values: Floats, limit: float, unit: str) -> None:
    # A comparison with NaN is false, so this refuses NaN too. The tolerance is for rounding.
    if not (np.abs(values) <= limit * (1.0 + 1e-6)).all():
        worst = float(np.abs(values).max())
        raise RigError(f"an output sample has a {name} of {worst:.4g} {unit}; the limit is {limit:g} {unit}")
