"""Preparation of a run before its rig is touched: its files, its resolved settings, and a mission that is feasible."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flowrec.core import (
    ChipError,
    FlowField,
    Image,
    MovieError,
    Phase,
    SessionError,
    UnreachableError,
    UsageError,
    say,
    warn,
)
from flowrec.measure import ImageVerdict, WallsState, as_pictured, orientation_by_image, walls_state
from flowrec.physics import Chip, load_chip, median_width_um, sample
from flowrec.rigs import fitted_to_movie, open_source
from flowrec.run import refuse_below
from flowrec.stages import (
    MOVIE,
    SAMPLERS,
    Config,
    Pipeline,
    ResolvedConfig,
    assemble,
    derived_values,
    no_room,
    registration_of,
    resolve,
    swept_out,
    too_swift,
)
from flowrec.store import Session, files_behind, run_files, run_path, runs_in
from flowrec.verbs.auto_recovery import recover_leftovers

_LEAST_FRAMES = 3.0  # of the camera within the watchdog's timeout
UNCHECKED = "; mission.check_axes = false records without this check"


class Prepared(NamedTuple):
    """Inputs of a run except its rig.

    Attributes
    ----------
    derived : settings that were derived because they were not given, by key.
    facts : about the source of a movie, for the head of the session.
    image, walls : what the images of a movie say about the axes and the registration; None: not looked at, or nothing.
    picture : the median (h, w) of images of a movie.
    """

    config: ResolvedConfig
    chip: Chip
    pipeline: Pipeline
    derived: dict[str, float]
    facts: Mapping[str, str]
    image: ImageVerdict | None = None
    walls: WallsState | None = None
    picture: Image | None = None


def prepare(asked: Config, aloud: bool = True, known: Prepared | None = None) -> Prepared:
    """Resolve a configuration and check that the mission is feasible; warn, if `aloud`, where it is likely to fail.

    `known` is what was prepared before for the same movie, chip and registration, whose images are not read again.

    Raises
    ------
    UsageError : the method of the sampler needs a recording; tracker.robots_px names one robot alone.
    UnreachableError : see `refuse_adrift`.
    ChipError : the images of a movie show the chip in another orientation than stated, or at another scale.
    """
    _refuse_unfit(asked)
    tell, caution = (say, warn) if aloud else (_unsaid, _unsaid)
    given, facts = asked, dict[str, str]()
    if asked.rig == MOVIE:
        asked, found, remarks = fitted_to_movie(given)
        facts |= found
        tell(f"{given.movie.path}: {facts['source_images']}, {facts['source_codec']}, times: {facts['source_times']}")
        for remark in remarks:
            caution(remark)
    chip = load_chip(asked.chip)
    config = resolve(asked, chip)
    image = walls = picture = None
    if asked.rig == MOVIE:
        picture = _picture_of(config) if known is None else known.picture
        image, walls = _looked_at(config, chip, picture) if known is None else (known.image, known.walls)
        if image is not None:
            facts["source_axes"] = image.text
        config, chip, shown = _as_pictured(config, chip, picture)
        if shown:
            facts["source_walls"] = shown
            tell(f"{config.movie.path}: {shown}")
        if shown and walls is not None and not walls.other_scale:
            walls = None  # of another scale, mask or registration may be wrong; all else is mended
        if walls is not None and not walls.good:
            caution(walls.text)
            facts["source_walls"] = walls.text
    made = derived_values(given, config)
    if made:
        what = "derived to fit the movie and the chip" if asked.rig == MOVIE else "derived to fit the chip"
        told = [f"{key} = {value:g}" for key, value in made.items() if key.startswith(("robot.", "camera."))]
        tell(f"{what}: {', '.join(told or made)} (record --dry-run lists all settings)")
    refuse_adrift(config, chip)
    full_mt = config.coils.full_mt(config.robot)
    if full_mt < config.coils.amplitude_mt:
        caution(
            f"coils and amplifiers make {full_mt:.2g} of {config.coils.amplitude_mt:g} mT: the robot follows it up to "
            f"{config.robot.max_speed_um_s:.0f} um/s; see coils.max_current_a and coils.amplifier"
        )
    for opening in chip.openings:
        if opening.kind == "inlet" and opening.value > config.robot.max_speed_um_s:
            caution(
                f"inlet {opening.side} {opening.first}-{opening.last}: mean speed {opening.value:.0f} um/s is faster "
                f"than the robot's {config.robot.max_speed_um_s:.0f} um/s; it can be carried there but not come back"
            )
    blind_um = config.robot.delay_s * config.robot.max_speed_um_s
    if blind_um > 0.5 * median_width_um(chip):
        caution(
            f"in the {1e3 * config.robot.delay_s:.0f} ms from command to motion a robot at "
            f"{config.robot.max_speed_um_s:.0f} um/s goes {blind_um:.0f} um, more than half a channel: expect it to be "
            "swept into walls; set a smaller robot.delay_s or a slower flow (chip.inlet_speed_um_s)"
        )
    return Prepared(config, chip, assemble(config, chip), made, facts, image, walls, picture)


def _refuse_unfit(asked: Config) -> None:
    """Raise UsageError for settings with which nothing can be run, see `prepare`."""
    if "recording" in SAMPLERS[asked.sampler.method].needs:
        able = " or ".join(f"'{row.name}'" for row in SAMPLERS.values() if "recording" not in row.needs)
        raise UsageError(
            f"sampler.method = {asked.sampler.method!r} needs the whole recording: use it in flowrec replay --refine; "
            f"a run takes {able}"
        )
    if asked.tracker.count == 1 and asked.tracker.robots_px:  # nothing would read it
        (x, y), *_ = asked.tracker.robots_px
        raise UsageError(
            f"tracker.robots_px is for several robots, and names one; for one robot give tracker.click_px = [{x:g}, "
            f"{y:g}]"
        )


def _looked_at(
    config: ResolvedConfig, chip: Chip, image: Image | None
) -> tuple[ImageVerdict | None, WallsState | None]:
    """Verdict of a movie's image (h, w) on the axes, and that of its walls on the registration."""
    if image is None:
        return None, None
    verdict = checked_image(image, config, chip, config.movie.path)
    return verdict, walls_state(image, chip, registration_of(config.camera, chip))


def _as_pictured(config: ResolvedConfig, chip: Chip, picture: Image | None) -> tuple[ResolvedConfig, Chip, str]:
    """`as_pictured` by the image (h, w) of a movie, where that is asked for; '': it is not, or there is none.

    Of a movie that shakes, the registration is that of the mean place, which a median image need not show.
    """
    asked = config.camera.trace_walls and not any(config.stabilise.first_px)
    return as_pictured(config, chip, picture) if asked and picture is not None else (config, chip, "")


def _picture_of(config: ResolvedConfig) -> Image | None:
    """The median (h, w) of images of a movie; None if they can not be read, which the run tells."""
    try:
        with open_source(config.movie) as movie:
            return movie.median_image()
    except MovieError:
        return None


def checked_image(image: Image, config: ResolvedConfig, chip: Chip, where: str) -> ImageVerdict | None:
    """Compare an image (h, w) with the stated registration; None if mission.check_axes is off.

    Raises ChipError, in one line with the settings to paste, where it contradicts.
    """
    if not config.mission.check_axes:
        return None
    verdict = orientation_by_image(image, chip, registration_of(config.camera, chip))
    if verdict.contradiction:
        raise ChipError(f"{where}: {verdict.contradiction}{UNCHECKED}")
    return verdict


def _unsaid(_text: str) -> None:
    """In place of `say`."""


def refuse_adrift(config: ResolvedConfig, chip: Chip) -> None:
    """Check before the run that the assumed flow lets the robot reach the goal; a robot that is observed has none.

    Raises
    ------
    UnreachableError : the flow at the start is too fast to hold the robot there; the flow carries it out of an outlet
        before the ramp of the coils is complete; every route to the goal is too narrow, or too fast to be steered on;
        a robot that is to come back to its start is slower than the flow there.
    """
    if config.mission.observes:
        return
    robot, field = config.robot, config.flow.solve(chip)
    start = np.asarray(config.mission.start, np.float64)
    course_error = config.plan.swift.course_error(robot, robot.speed_limit_um_s)
    reason = too_swift(chip, field, start, start, course_error)
    if reason:
        raise UnreachableError(f"unreachable: the robot can not be held at the start: {reason}")
    if {Phase.PLAN, Phase.NAVIGATE} & set(config.mission.phases):
        goal = np.asarray(config.mission.goal, np.float64)
        reason = no_room(chip, field, start, goal, robot)
        reason = reason or too_swift(chip, field, start, goal, course_error)
        if reason:
            raise UnreachableError(f"unreachable: {reason}")
        flow_um_s = float(np.hypot(*sample(field, goal)))
        if Phase.SURVEY in config.mission.phases and np.array_equal(start, goal) and flow_um_s > robot.speed_limit_um_s:
            raise UnreachableError(
                f"unreachable: from the survey the robot can not come back to its start {goal[0]:.0f},{goal[1]:.0f} "
                f"um: the flow there is {flow_um_s:.0f} um/s, and it swims at {robot.speed_limit_um_s:.0f} um/s at "
                "most; give another goal, as in --goal outlet"
            )
    reason = swept_out(chip, field, start, course_error, 0.0 if config.mission.hold_start_s else config.coils.ramp_s)
    if reason:
        raise UnreachableError(f"unreachable: {reason}")


def files_of(config: Config) -> list[Path]:
    """The files that a configuration names, and those that are read with them."""
    files: list[Path] = []
    chip = Path(config.chip.path)
    if chip.name:
        files += [chip, chip.with_suffix(".png"), chip.with_suffix(".toml")]
    if config.start.field:
        files += files_behind(Path(config.start.field))
    movie = config.movie
    return [*files, *(Path(name) for name in (movie.path, movie.times, movie.coils) if name)]


def field_of_session(path: Path, chip: Chip) -> dict[str, FlowField]:
    """Assumed and refined flow at the end of an earlier session, on the same chip."""
    fields = {name: field for name, field in Session(path).fields.items() if name != "true"}
    if "assumed" not in fields:
        raise UsageError(f"start.field = {path}: that session holds no flow field; survey and refine first")
    shape = fields["assumed"].velocity_um_s.shape[:2]
    if shape != chip.mask.shape or not math.isclose(fields["assumed"].um_per_px, chip.um_per_px):
        raise UsageError(f"start.field = {path}: its field is for another chip ({shape[1]} x {shape[0]} pixels)")
    return fields


def place_of_session(config: Config, out: Path | None, overwrite: bool) -> Path:
    """The path of the session, after unfinished sessions in its folder are recovered and the free space is checked."""
    folder = out.parent if out is not None else Path()
    made: dict[Path, str] = {}
    if config.recording.recover_leftovers:
        excluded = frozenset(run_files(out.resolve())) if out is not None and overwrite else frozenset()
        made = recover_leftovers(folder, excluded)
    path = out if out is not None else default_path(config)
    same = next((file for file in made if run_path(file) == path), None)
    if same is not None and not overwrite:
        raise SessionError(
            f"{same}: was left by a run that did not finish and has just been recovered ({made[same]}); "
            "choose another name for this run with --out"
        )
    refuse_below(config.recording.disk_floor_gb, path.resolve().parent)
    return path


def default_path(config: Config) -> Path:
    """The path date_operator_sample_number.mcap with the first free number, in this folder."""
    sample = config.recording.sample or Path(config.chip.path).stem or config.chip.name
    words = [datetime.now().astimezone().strftime("%Y-%m-%d"), config.recording.operator, sample]
    stem = "_".join(word.replace(" ", "-") for word in words if word)
    names = runs_in(Path())
    for number in range(1, 10_000):
        path = Path(f"{stem}_{number:03d}.mcap")
        if path not in names:
            return path
    raise SessionError(f".: 9999 sessions named {stem} are here; name one with --out")


def guard_timeout_s(config: ResolvedConfig) -> float:
    """The timeout of the watchdog in s; UsageError if it is shorter than a few frames of the camera."""
    timeout_s, rate_hz = config.safety.guard_timeout_s, config.camera.rate_hz
    if timeout_s * rate_hz < _LEAST_FRAMES:
        raise UsageError(
            f"safety.guard_timeout_s = {timeout_s:g}: shorter than {_LEAST_FRAMES:g} frames at camera.rate_hz = "
            f"{rate_hz:g}; the nearest that works is {_LEAST_FRAMES / rate_hz:.3g}"
        )
    return timeout_s
