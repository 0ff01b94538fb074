"""Resolve the settings of a run on its chip: choose the settings that are None, turn named places into points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from typing import Any, TypeVar

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up

from flowrec.core import Phase, UnreachableError, UsageError, faults, nearest_pixel
from flowrec.physics import (
    USUAL_DELAY_S,
    Calibration,
    Chip,
    FlowSolver,
    Robot,
    check_point,
    median_width_um,
    named_opening,
    opening_point_um,
)
from flowrec.stages.config import Config, ResolvedConfig, check_config
from flowrec.stages.control.mission import Place, PlacedMission, Point
from flowrec.stages.outside_settings import like
from flowrec.stages.planning.feasibility import swept_out, too_swift
from flowrec.stages.planning.free_space import CourseError, FastFlowMargin
from flowrec.stages.planning.survey import SURVEYS
from flowrec.stages.rig_settings import MOVIE, SIMULATED, ResolvedCamera

_FASTEST_CAMERA_HZ = 500.0  # about what the loop keeps up with: a tick takes 1.5 ms
_MAY_BE_NONE = ("camera.centre_um", "camera.residual_um")  # None is a value
_ONLY_FOR_DRIVING = ("robot.max_speed_um_s", "robot.step_out_hz", "robot.delay_s")
_USUAL_UM_S = 600.0  # top speed of a robot of which none is stated
_HOLD_START_S = 1.0  # the ramp of the coils and the first solution of the flow take less
_LEAST_RADIUS_PX = 0.3  # a smaller bead may show as a spot of its blur, but is more often one of a wrong scale
_PLACE_RADII = 5.0  # from a named opening into the chip
_OUTLET_START_RADII = (_PLACE_RADII, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0)

_Section = TypeVar("_Section")


def resolve(config: Config, chip: Chip) -> ResolvedConfig:
    """Choose the settings that are None to fit the chip, place the camera, and turn named places into points.

    A robot that is not described fits the chip: radius 50 um, or a fifth of the median channel width if that is
    narrower, but at least three camera pixels; v_max 600 um/s, of a body in a movie its radius per image if that is
    less, or 1.3 times the fastest assumed flow; a delay of 40 ms, or the time through a fifth of a channel at v_max if
    that is shorter. On another rig these numbers have to be given, but for those that only matter for driving the robot
    where it is only observed. Walls that may lie elsewhere by an
    amount that is not stated may do so by more than any margin. `derived` lists the numbers.

    Raises
    ------
    UsageError : settings outside of their ranges; on a real rig also a missing setting that has to be measured.
    UnreachableError : start and goal lie in channels that do not meet.
    """
    check_config(config)
    _refuse_simulated(config)
    _refuse_unmeasured(config)
    refuse_unseen(config)
    _refuse_survey_share(config)
    robot, camera = _fit_to_chip(config, chip)
    for fault in (*faults(robot, "robot."), *faults(camera, "camera.")):  # else the session could not be read again
        raise UsageError(f"{fault}; it follows from other settings of robot, camera, coils and chip: correct those")
    swift = {"frame_s": round(1.0 / camera.rate_hz, 6), "latency_s": robot.delay_s}
    plan = replace(config.plan, swift=_with_times(config.plan.swift, swift))
    if plan.wall_error_um is None:
        plan = replace(plan, wall_error_um=max(robot.radius_um, plan.clearance_margin_um or 0.0))
    survey = replace(config.survey, swift=_with_times(config.survey.swift, swift))
    course_error = plan.swift.course_error(robot, robot.speed_limit_um_s)
    if config.mission.observes and config.rig != SIMULATED:  # which needs to know where the robot starts
        nowhere = 0.5 * chip.size_um[0], 0.5 * chip.size_um[1]
        mission = _narrow(PlacedMission, config.mission, start=nowhere, goal=nowhere, hold_start_s=0.0)
    else:
        hold_s = _hold_s(config, chip)
        ramp_s = 0.0 if hold_s else config.coils.ramp_s
        start = _start(config.mission.start, chip, robot, course_error, config.flow, ramp_s)
        usual = start if Phase.SURVEY in config.mission.phases else "outlet"
        goal = _point(chip, usual if config.mission.goal is None else config.mission.goal, "goal", robot)
        mission = _narrow(PlacedMission, config.mission, start=start, goal=goal, hold_start_s=hold_s)
        _refuse_apart(chip, mission)
    tracker = replace(config.tracker, polarity=config.tracker.polarity or "auto")
    simulated = config.simulated.with_preset() if config.rig == SIMULATED else config.simulated
    shaky = config.rig != SIMULATED and config.recording.region == "whole"  # it reads the walls in every image
    stabilise = replace(config.stabilise, on=shaky if config.stabilise.on is None else config.stabilise.on)
    sections = {"stabilise": stabilise, "tracker": tracker, "plan": plan, "survey": survey, "simulated": simulated}
    kind: type[ResolvedConfig] = like(ResolvedConfig, config)
    return _narrow(kind, config, robot=robot, camera=camera, mission=mission, **sections)


def derived_values(asked: Config, resolved: ResolvedConfig) -> dict[str, float]:
    """The numbers that resolving a configuration has filled in or changed, by key; without those of a named world."""
    was, now = _flat(asdict(asked), ""), _flat(asdict(replace(resolved, simulated=asked.simulated)), "")
    numbers = {key: value for key, value in now.items() if type(value) in (int, float)}
    return {key: value for key, value in numbers.items() if value != was[key]}


def _flat(tree: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _narrow(kind: type[_Section], settings: Any, **changed: Any) -> _Section:
    """The settings as the type that excludes None, with some of them changed."""
    return kind(**{each.name: getattr(settings, each.name) for each in fields(settings)} | changed)


def not_measured(config: Config) -> list[str]:
    """Keys of the settings that are not given, and that somebody has to measure on a real rig."""
    given = _flat({"robot": asdict(config.robot), "camera": asdict(config.camera)}, "")
    needless = (*_MAY_BE_NONE, *(_ONLY_FOR_DRIVING if config.mission.observes else ()))
    return [key for key, value in given.items() if value is None and key not in needless]


def refuse_unseen(config: Config) -> None:
    """Raise UsageError where the images of a real rig can not show its robot; often the scale is upside down."""
    um_per_px, radius_um, camera = config.camera.um_per_px, config.robot.radius_um, config.camera
    if config.rig == SIMULATED or um_per_px is None or radius_um is None:
        return
    radius_px, most_px = radius_um / um_per_px, 0.5 * max(camera.width_px, camera.height_px)
    if not _LEAST_RADIUS_PX <= radius_px <= most_px:
        why = "an image can not show it" if radius_px < 1.0 else "it is larger than the image"
        raise UsageError(
            f"robot.radius_um = {radius_um:g} is {radius_px:.2g} px at camera.um_per_px = {um_per_px:g}: {why}; "
            f"correct one of them (if a um is {um_per_px:g} px, camera.um_per_px is {1.0 / um_per_px:.4g})"
        )


def _refuse_unmeasured(config: Config) -> None:
    """Only a simulated robot and camera can be made to fit the chip."""
    missing = not_measured(config)
    if config.rig != SIMULATED and missing:
        raise UsageError(
            f"rig = {config.rig!r}: {', '.join(missing)} not given; measure them and set each: only the robot and the "
            "camera of the simulated rig are made to fit the chip"
        )


def _refuse_simulated(config: Config) -> None:
    """A setting of the simulated rig has no effect on another one, which whoever sets it should know."""
    if config.rig == SIMULATED:
        return
    given, usual = _flat(asdict(config), ""), _flat(asdict(Config()), "")
    changed = [key for key in usual if key.startswith("simulated.") and given[key] != usual[key]]
    if changed:
        raise UsageError(
            f"rig = {config.rig!r}: {', '.join(changed)} is of the simulated rig only and has no effect here; leave it "
            "out"
        )


def _refuse_survey_share(config: Config) -> None:
    """A limit that the method of the survey does not read would have no effect, which whoever sets it should know."""
    method = SURVEYS[config.survey.method]
    if config.survey.share is not None and "share" not in method.options:
        raise UsageError(
            f"survey.share = {config.survey.share:g} has no effect on survey.method = {method.name!r}: limit it by "
            "survey.distance_um or mission.survey_limit_s, or set survey.method = 'downstream'"
        )


def _fit_to_chip(config: Config, chip: Chip) -> tuple[Robot, ResolvedCamera]:
    """The robot and the camera, with the settings that are None chosen to fit the chip."""
    asked, camera, coils = config.robot, config.camera, config.coils
    channel_um = median_width_um(chip)
    width_um, height_um = chip.size_um
    um_per_px, radius_um, speed_um_s = camera.um_per_px, asked.radius_um, asked.max_speed_um_s
    delay_s, step_out_hz, rate_hz = asked.delay_s, asked.step_out_hz, camera.rate_hz
    if asked.speed_at_hz:
        (first_hz, first_um_s), (last_hz, last_um_s) = asked.speed_at_hz[0], asked.speed_at_hz[-1]
        asked = replace(asked, um_per_rev=first_um_s / first_hz)
        speed_um_s = min(speed_um_s or math.inf, last_um_s)
        step_out_hz = step_out_hz or last_hz
    if um_per_px is None:
        right_um, down_um = np.abs(Calibration(1.0, (0.0, 0.0), camera.angle_deg).axes) @ (width_um, height_um)
        um_per_px = float(max(right_um / camera.width_px, down_um / camera.height_px))
    if radius_um is None:
        radius_um = round(min(max(min(50.0, 0.2 * channel_um), 3.0 * um_per_px), 0.25 * channel_um), 2)
    if speed_um_s is None:
        peak = float(np.linalg.norm(config.flow.solve(chip).velocity_um_s, axis=-1).max())
        usual = _USUAL_UM_S
        if config.rig == MOVIE and rate_hz is not None:  # a small body that nobody drives goes its radius in an image
            usual = min(usual, round(radius_um * rate_hz, 1))
        speed_um_s = max(usual, round(1.3 * peak, 1))
    if delay_s is None:
        delay_s = round(min(USUAL_DELAY_S, 0.2 * channel_um / speed_um_s), 5)
    if step_out_hz is None:
        step_out_hz = 1.2 * speed_um_s / asked.um_per_rev
    known = {"radius_um": radius_um, "step_out_hz": step_out_hz, "delay_s": delay_s}
    robot = _narrow(Robot, asked, **known, max_speed_um_s=speed_um_s)
    # Coils that can not generate the full field can not make the robot as fast either; plans must know.
    if coils.full_mt(robot) < coils.amplitude_mt:
        robot = replace(robot, max_speed_um_s=min(speed_um_s, round(coils.fastest_um_s(robot), 1)))
    if rate_hz is None:
        rate_hz = round(min(max(30.0, robot.max_speed_um_s / (0.5 * radius_um)), _FASTEST_CAMERA_HZ), 1)
    return robot, _narrow(ResolvedCamera, camera, um_per_px=um_per_px, rate_hz=rate_hz)


def _with_times(swift: FastFlowMargin, times: Mapping[str, float]) -> FastFlowMargin:
    return replace(swift, **{key: value for key, value in times.items() if getattr(swift, key) is None})


def _hold_s(config: Config, chip: Chip) -> float:
    """Duration for which the robot is held at its start, in s."""
    start, stated = config.mission.start, config.mission.hold_start_s
    if stated is not None:
        return stated
    held = isinstance(start, str) and not config.mission.observes and config.rig == SIMULATED
    return _HOLD_START_S if held and named_opening(chip, str(start)).kind == "outlet" else 0.0


def _start(
    place: Place, chip: Chip, robot: Robot, course_error: CourseError, solver: FlowSolver, ramp_s: float
) -> Point:
    """The start; for a named outlet the place nearest to it where the robot can be held.

    That is five radii inside, as elsewhere, or farther if the assumed flow carries the robot out before the field is
    up, which it is within `ramp_s`. Without such a place: the first one, which is refused with the reason before
    anything is driven.
    """
    if not isinstance(place, str) or named_opening(chip, place).kind != "outlet":
        return _point(chip, place, "start", robot)
    field = solver.solve(chip)
    for radii in _OUTLET_START_RADII:
        point = opening_point_um(chip, place, radii * robot.radius_um)
        start_um = np.array(point)
        if not (
            swept_out(chip, field, start_um, course_error, ramp_s)
            or too_swift(chip, field, start_um, start_um, course_error)
        ):
            return point
    return _point(chip, place, "start", robot)


def _point(chip: Chip, place: Place, what: str, robot: Robot) -> Point:
    if isinstance(place, str):
        return opening_point_um(chip, place, _PLACE_RADII * robot.radius_um)
    check_point(chip, place, what, robot.radius_um)
    return place


def _refuse_apart(chip: Chip, mission: PlacedMission) -> None:
    """Start and goal must lie in one connected channel."""
    channels, count = scipy.ndimage.label(chip.mask)
    start, goal = (
        channels[nearest_pixel(x / chip.um_per_px, y / chip.um_per_px, chip.mask.shape)]
        for x, y in (mission.start, mission.goal)
    )
    if start != goal:
        raise UnreachableError(
            f"unreachable: mission.goal = {mission.goal} lies in another channel than the start {mission.start}; the "
            f"mask of {chip.name} has {count} channels that do not meet; choose a goal in the same one"
        )
