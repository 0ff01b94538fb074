"""The ten measurements of a lab's first day, in order: `flowrec doctor --protocol` walks through this table.

Each is done by verbs that there are. A value is good if it is at most its limit; `why` is the reason of the limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flowrec.core import FlowrecError, Outcome
from flowrec.stages import LAB, flow_error
from flowrec.store import Session
from flowrec.verbs.check import check
from flowrec.verbs.session_replay import replay_session
from flowrec.verbs.user_flow import refine
from flowrec.verbs.ways_out import zero_on_ways

if TYPE_CHECKING:
    from flowrec.measure import MotionFit
    from flowrec.verbs.protocol_day import Day

_DRIVEN = 0.7  # share of the highest frequency that a run reaches, from which on it tells of step-out


class NotDoneError(FlowrecError):
    """A measurement can not be made; the text says why."""


class RowValue(NamedTuple):
    """A value, in the unit of its row."""

    value: float
    limit: float  # the largest value that is good
    text: str  # what was measured, for people
    session: Path | None = None  # from which it was read


class ProtocolRow(NamedTuple):
    """One measurement.

    Attributes
    ----------
    name, what : a word that identifies it, and what its value is.
    unit : of value and limit.
    mount : what a person does before it.
    command : what does it; PROTOCOL stands for the folder, CONFIG for the configuration.
    passes : the limit in words.
    why : its reason.
    measure : does it.
    """

    name: str
    what: str
    unit: str
    mount: str
    command: str
    passes: str
    why: str
    measure: Callable[[Day], RowValue]


def _still_session(day: Day) -> Session:
    return day.run("still", "mission.phases=observe", "mission.check_axes=false", "duration_s=2")


def _scale(day: Day) -> RowValue:
    from flowrec.measure import calibrate_image

    session = _still_session(day)
    found = calibrate_image(session.path, day.asked)
    stated = day.config.camera.um_per_px
    scales = [pose.calibration.um_per_px for pose in found.poses]
    scale = max(scales, key=lambda each: abs(each - stated))  # of a chip that looks the same in several ways
    text = f"{scale:.5g} um per pixel, {stated:.5g} stated"
    return RowValue(100.0 * abs(scale / stated - 1.0), 1.0, text, session.path)


def _motion_session(day: Day) -> Session:
    return day.run("motion", "mission.phases=survey", "duration_s=40")


def _motion_fit(session: Session) -> MotionFit:
    from flowrec.measure import calibrate_motion

    return calibrate_motion(session.path).fit


def _axes(day: Day) -> RowValue:
    from flowrec.measure import orientation_by_image

    still = _still_session(day)
    seen_image = orientation_by_image(next(still.messages("frame")).image, still.chip, still.calibration)
    if seen_image.contradiction:
        return RowValue(180.0, 5.0, seen_image.text, still.path)
    session = _motion_session(day)
    seen = session.last.axes
    if seen is not None and session.outcome.get("axes_check") == "contradicts":
        return RowValue(180.0, 5.0, seen.text, session.path)
    fit = _motion_fit(session)
    off_deg = 180.0 if fit.mirrored else abs(math.degrees(fit.heading_offset_rad))
    text = (
        "the y axes of coils and image are opposed" if fit.mirrored else f"the robot travels {off_deg:.1f} degrees off"
    )
    return RowValue(off_deg, 5.0, text, session.path)


def _latency(day: Day) -> RowValue:
    session = _motion_session(day)
    fit = _motion_fit(session)
    found_ms, stated_ms = -1e3 * fit.offset_s, 1e3 * day.config.robot.delay_s
    text = f"{found_ms:.1f} ± {1e3 * fit.offset_std_s:.1f} ms from command to motion, {stated_ms:g} stated"
    return RowValue(abs(found_ms - stated_ms), 1e3 / day.config.camera.rate_hz, text, session.path)


def _um_per_rev(day: Day) -> RowValue:
    session = _motion_session(day)
    fit, stated = _motion_fit(session), day.config.robot.um_per_rev
    text = f"{fit.um_per_rev:.2f} ± {fit.um_per_rev_std:.2f} um per revolution, {stated:g} stated"
    return RowValue(100.0 * abs(fit.um_per_rev / stated - 1.0), 10.0, text, session.path)


def _step_out(day: Day) -> RowValue:
    session, robot = day.run("fast", "mission.phases=plan,navigate"), day.config.robot
    driven_hz = max((each.frequency_hz for each in session.messages("currents")), default=0.0)
    limits = [each.limit_hz for each in session.messages("health") if each.limit_hz is not None]
    highest_hz = min(
        robot.step_out_margin * robot.step_out_hz, robot.frequency_hz(robot.max_speed_um_s / robot.um_per_rev)
    )
    if limits:
        text = f"the robot follows up to {min(limits):.3g} Hz, robot.step_out_hz = {robot.step_out_hz:g} is stated"
        return RowValue(100.0 * max(1.0 - min(limits) / highest_hz, 0.0), 0.0, text, session.path)
    if driven_hz < _DRIVEN * highest_hz:
        raise NotDoneError(f"{session.path.name}: it was driven at {driven_hz:.3g} Hz at most, of {highest_hz:.3g}")
    return RowValue(0.0, 0.0, f"the robot follows up to {driven_hz:.3g} Hz, the fastest of this run", session.path)


def _field(day: Day) -> RowValue:
    from flowrec.measure import calibrate_coils

    given = day.hand.read("field_table", "File of the readings (CSV: i_x_a,i_y_a,i_z_a,b_x_mt,b_y_mt,b_z_mt)")
    if not given:
        raise NotDoneError("no table of a Hall probe: flowrec calibrate coils --help describes it")
    found, stated = calibrate_coils(Path(given)).fit.mt_per_a, np.array(day.config.coils.mt_per_a)
    if found.shape != stated.shape:
        raise NotDoneError(f"{given}: {found.shape[1]} coils, where coils.mt_per_a has {stated.shape[1]}")
    off = np.linalg.norm(found - stated, axis=0) / np.linalg.norm(stated, axis=0)
    size = np.linalg.norm(found, axis=0) / np.linalg.norm(stated, axis=0)
    shares = ", ".join(f"{100.0 * each:.0f}" for each in size)
    return RowValue(100.0 * float(off.max()), 5.0, f"the coils make {shares} % of the stated field per ampere")


def _flow(day: Day) -> RowValue:
    session = day.run("tracers", "mission.phases=observe", "tracker.tracers=true", "duration_s=15")
    beads = session.last.tracer_flow
    if beads is None:
        raise NotDoneError(f"{session.path.name}: no bead was followed; more of them, or tracker.tracer.radius_um")
    config, chip, assumed = session.config, session.chip, session.fields["assumed"]
    refined = refine(chip, beads, refiner=replace(config.refine, adopt="always"), solver=config.flow)
    off, share = flow_error(chip, refined, assumed), assumed.error_share or refined.error_share
    if refined.refused or off is None or share is None:
        raise NotDoneError(f"{session.path.name}: the beads do not tell the flow: {refined.refused or refined.note}")
    text = f"{len(beads.position_um)} stretches of beads change the assumed flow by {100.0 * off:.0f} %"
    return RowValue(100.0 * off, 200.0 * share, text, session.path)


def _zero(day: Day) -> RowValue:
    if day.config.rig != LAB:
        raise NotDoneError(f"rig = {day.config.rig!r} has no coils that could stay on")
    return RowValue(*zero_on_ways(day))


def _mission(day: Day) -> RowValue:
    session = day.run("mission")
    outcome = session.outcome
    ended, took_s, planned_s = (outcome.get(key) for key in ("outcome", "navigation_s", "planned_s"))
    if ended != Outcome.REACHED or not took_s or not planned_s:
        why = "; ".join(str(outcome[key]) for key in ("outcome", "note") if outcome.get(key))
        return RowValue(math.inf, 150.0, f"the goal was not reached: {why}", session.path)
    text = f"reached in {float(took_s):.1f} s, planned {float(planned_s):.1f}"
    return RowValue(100.0 * float(took_s) / float(planned_s), 150.0, text, session.path)


def _replay(day: Day) -> RowValue:
    session = day.run("mission")
    verdict, again = check(session.path), replay_session(session.path, verify=True)
    text = f"flowrec check: {verdict.word}; replay: {again.lines()[-1]}"
    return RowValue(0.0 if again.same and verdict.word != "bad" else 1.0, 0.0, text, session.path)


_MOTION = "flowrec record CONFIG -o PROTOCOL/motion.mcap --set mission.phases=survey, then flowrec calibrate motion"
ROWS = (
    ProtocolRow(
        *("scale", "error of um per pixel", "%"),
        "The chip, filled, in focus, as it will lie in the missions; light and exposure as in them. No field is made.",
        "flowrec record CONFIG -o PROTOCOL/still.mcap --set mission.phases=observe, then flowrec calibrate image",
        "camera.um_per_px is right to 1 %",
        "an error of 3 % makes one of 6 % of the flow",
        _scale,
    ),
    ProtocolRow(
        *("axes", "angle between heading and motion", "degrees"),
        "A robot at its start, the pump on; a hand on the emergency stop: the coils make a field from here on.",
        _MOTION,
        "not mirrored, and at most 5 degrees off",
        "5 degrees put a robot a tenth of its way aside before the loop has seen it",
        _axes,
    ),
    ProtocolRow(
        *("latency", "error of the time from command to motion", "ms"),
        "As before: the same run is read.",
        _MOTION,
        "robot.delay_s is right to the time between two images",
        "commands come once an image: what is finer changes none of them",
        _latency,
    ),
    ProtocolRow(
        *("um_per_rev", "error of the way per revolution", "%"),
        "As before: the same run is read.",
        _MOTION,
        "robot.um_per_rev is right to 10 %",
        "an error of 10 % makes one of 8 % of the flow, and a refinement finds what is left",
        _um_per_rev,
    ),
    ProtocolRow(
        *("step_out", "part of the frequencies that the robot does not follow", "%"),
        "The robot at its start again.",
        "flowrec record CONFIG -o PROTOCOL/fast.mcap --set mission.phases=plan,navigate",
        "the health of the run has found no frequency above which the robot does not follow",
        "a robot that steps out is slower than planned, where the flow is fastest",
        _step_out,
    ),
    ProtocolRow(
        *("field", "error of the field of a coil per ampere", "%"),
        "A Hall probe where the robot will be, no robot. Drive each coil alone, both ways; note currents and field.",
        "flowrec calibrate coils TABLE.csv",
        "each column of coils.mt_per_a is right to 5 %",
        "step-out falls with the field, and robot.step_out_margin leaves 10 % for it and all else",
        _field,
    ),
    ProtocolRow(
        *("flow", "change of the assumed flow by beads", "%"),
        "Beads of a fifth of the channel or less in the fluid, the pump on, no robot in the channel. No field is made.",
        "flowrec record CONFIG -o PROTOCOL/tracers.mcap --set mission.phases=observe --set tracker.tracers=true",
        "at most twice the error that the assumed map states of itself",
        "beyond it pump, depth or chip are not those of the configuration",
        _flow,
    ),
    ProtocolRow(
        *("zero", "time until the coils are off, of the time that is allowed", "%"),
        "An ammeter or a clamp in the line of a coil. The robot may be left out.",
        "flowrec record CONFIG -o PROTOCOL/zero_WAY.mcap, ended in five ways: its end, Ctrl-C, zero by the operator, "
        "kill -9, the camera unplugged",
        "the coils are off in time on each way out",
        "what heats a coil or holds a robot after the run is not under control",
        _zero,
    ),
    ProtocolRow(
        *("mission", "time to the goal, of the planned time", "%"),
        "A robot at its start, the pump on.",
        "flowrec record CONFIG -o PROTOCOL/mission.mcap",
        "the goal is reached within 1.5 times the planned time",
        "a robot that takes longer meets another flow than that of the map",
        _mission,
    ),
    ProtocolRow(
        *("replay", "sessions that are damaged or replay otherwise", "sessions"),
        "Nothing.",
        "flowrec check PROTOCOL/mission.mcap, then flowrec replay PROTOCOL/mission.mcap --verify",
        "the file is whole, and each tick is computed again as it was",
        "what differs was not recorded, or not computed from what was",
        _replay,
    ),
)
