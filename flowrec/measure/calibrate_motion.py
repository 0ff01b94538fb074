"""`flowrec calibrate motion`: um per revolution, latency and axes of the heading, from the robot's own motion."""

from __future__ import annotations

import math
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowrec.core import (
    NS_PER_S,
    Z95,
    Coverage,
    Currents,
    Floats,
    FlowField,
    Ints,
    UsageError,
    __version__,
    say,
    seconds,
    table,
)
from flowrec.measure.motion_fit import (
    LEAST_EXPLAINED,
    LEAST_EXPLAINED_WITH_RATE,
    LEAST_FRAMES,
    MotionFit,
    fit_motion,
    refusal_of,
)
from flowrec.measure.motion_regression import Turns
from flowrec.measure.motion_search import SearchRange
from flowrec.measure.proposal import as_sets, as_toml, check_outputs, write_outputs
from flowrec.measure.speed_table import fit_speed_table, proportional_log, propose_table
from flowrec.physics import Robot
from flowrec.stages import LAB, MOVIE, FieldCommand, FieldLog, FieldState, field_motion, read_coil_log
from flowrec.store import Session, files_behind

# A log on another clock: any offset, and rates of 30 % to either side.
ANYWHERE = SearchRange(least_rate=0.7, largest_rate=1.0 / 0.7)
_ONE_CLOCK = SearchRange(-2.0, 2.0)  # from command to motion
_SIGNIFICANT = 3.0  # standard errors from which on an angle is stated as wrong
_LEAST_RAD = math.radians(2.0)  # by which the axes of the heading differ at least before a setting is proposed
# Times the interval of the images by which rows of a log are too far apart for quick commands; ratio of the intervals
# up to which its rows are samples, and the least number of them.
_SPARSE, _EVEN, _LEAST_SAMPLES = 2.0, 3.0, 10
_POOR_OFFSET_S = 0.01  # larger errors cost the refined flow about a percent


class MotionCalibration(NamedTuple):
    """The fit of a session, and the settings that it proposes."""

    fit: MotionFit
    log: str  # what the motion was compared with
    shared_clock: bool  # of the log and the session
    sets: dict[str, Any]  # settings by key
    advice: tuple[str, ...]
    covered: Coverage  # images in which the robot was seen, of all
    path: Path  # of the session
    camera_delay_s: tuple[float, float] | None  # of a lab's camera, and its standard error; None: not known
    out: Path | None  # that the settings were written to

    def as_json(self) -> dict[str, Any]:
        """The fit as plain numbers; None where the movie does not determine one."""
        return figures_of(self.fit) | {
            "log": self.log,
            "shared_clock": self.shared_clock,
            "camera_delay_s": None if self.camera_delay_s is None else self.camera_delay_s[0],
            "camera_delay_standard_error_s": None if self.camera_delay_s is None else self.camera_delay_s[1],
            "advice": list(self.advice),
            "set": as_sets(self.sets),
            "covered": self.covered.as_json(),
        }

    def show(self) -> None:
        """Print the fit as a table, advice and settings."""
        rows = rows_of(self.fit, shared_clock=self.shared_clock)
        if self.camera_delay_s is not None:
            delay_ms, error_ms = (1e3 * each for each in self.camera_delay_s)
            rows.append(("delay of the camera beyond its exposure", f"{delay_ms:.1f} ± {error_ms:.1f} ms"))
        table(f"{self.path.name} against {self.log}", ("", "value and standard error"), rows)
        for sentence in self.advice:
            say(f"- {sentence}")
        say(self.covered.amount)
        if self.out is not None:
            say(f"{self.out} written")
        say("With any configuration: " + " ".join(f"--set {text}" for text in as_sets(self.sets)))


def calibrate_motion(
    path: Path, coils: Path | None = None, out: Path | None = None, overwrite: bool = False
) -> MotionCalibration:
    """Compare the track of a session with what its coils did, and write the settings found to `out` if it is given.

    `coils`: another log, on any clock; None: the session's own.

    Raises
    ------
    UsageError : the log does not explain the motion, or there is too little of it; in one line, with what to do.
    OutputError, SessionError : see `Output.check` and `Session`.
    """
    session = Session(path)
    outputs = check_outputs(out, tuple(files_behind(path)), overwrite)
    every = list(session.messages("track"))
    tracks = [track for track in every if track.seen]
    stamps_ns = np.array([track.stamp_ns for track in tracks], np.int64)
    positions = np.array([track.position_um for track in tracks]).reshape(-1, 2)
    # The flow that was assumed: that of a refinement has seen the um per revolution of the settings.
    flow = session.fields.get("assumed")
    imported, robot = session.config.rig == MOVIE, session.config.robot
    if coils is not None:
        log = read_coil_log(coils, session.config.movie.columns, session.config.coils)
        turned = _turns_of(log)
        fit, name = fit_log(stamps_ns, positions, proportional_log(log, robot), ANYWHERE, flow), coils.name
    elif imported:
        turned = _applied_turns(session)[0]
        turns, span_s = _applied_turns(session, robot)
        fit = fit_motion(stamps_ns / NS_PER_S, positions, turns, span_s, _ONE_CLOCK, flow)
        name = "the session's log"
    else:
        log = commanded_field(list(session.messages("currents")))
        turned, as_moved = _turns_of(log), proportional_log(log, robot)
        fit = fit_log(stamps_ns, positions, as_moved, _ONE_CLOCK, flow, exact_log=True, own_log=True)
        name = "the session's commands"
    if fit.refusal:
        raise UsageError(f"{path}: {fit.refusal}")
    shared = coils is None and not imported
    if shared and -fit.offset_s < -_SIGNIFICANT * fit.offset_std_s:
        raise UsageError(
            f"{path}: the robot moves {1e3 * fit.offset_s:.0f} ms before the commands, so it does not follow "
            "them; does the track follow another particle?"
        )
    camera_delay = None
    if shared and session.config.rig == LAB:
        camera_delay = _camera_delay(session, stamps_ns / NS_PER_S, positions, flow)
    sets, advice = _propose_settings(fit, session, shared_clock=shared, own_log=coils is None)
    table_found = fit_speed_table(stamps_ns / NS_PER_S, positions, turned, fit, flow)
    advice = (*propose_table(table_found, robot, sets), *advice)
    if camera_delay is not None and camera_delay[1] < _POOR_OFFSET_S:
        sets["lab.camera_delay_s"] = round(max(camera_delay[0], 0.0), 4)
    covered = Coverage(len(tracks), len(every), "images", "show the robot")
    if outputs:
        source = f"By flowrec {__version__} calibrate motion from {path.name} and {name}."
        comments = (source, *(f"{key}: {value}" for key, value in rows_of(fit)))
        write_outputs(outputs, (as_toml(comments, dict(sorted(sets.items()))).encode(),))
    return MotionCalibration(fit, name, shared, sets, advice, covered, path, camera_delay, out)


def _camera_delay(
    session: Session, times_s: Floats, positions_um: Floats, flow: FlowField | None
) -> tuple[float, float] | None:
    """Time from the end of an exposure to the arrival of its image, and its standard error; None: not determined.

    The amplifier reports when the field turned, on the host's clock. An image shows the robot as it rolled with the
    field; that its stamp is later is the camera's delay, beyond what the stamps had been corrected by.
    """
    turns, span_s = _applied_turns(session, session.config.robot)
    fit = fit_motion(times_s, positions_um, turns, span_s, _ONE_CLOCK, flow, exact_log=True, own_log=True)
    return None if fit.refusal else (session.config.lab.camera_delay_s - fit.offset_s, fit.offset_std_s)


def fit_log(
    stamps_ns: Ints,
    positions_um: Floats,
    log: FieldLog,
    within: SearchRange,
    flow: FlowField | None = None,
    *,
    exact_log: bool = False,
    window: int = 1,
    log_error_s: float = 0.0,
    own_log: bool = False,
) -> MotionFit:
    """Fit arrays (n,) and (n, 2), averaged over `window` frames in turn; frames left at the end are not used.

    The time of the log may be the time of day: a float of seconds holds it to 0.2 us.
    """
    if not len(log) or not (log.amplitude_mt > 0.0).any():
        raise UsageError("the log holds no field, so there is nothing to compare the motion with")
    begin_ns = int(log.times_ns[0])
    around_ns = np.zeros(1)
    if window > 1:
        stamps_ns, positions_um, around_ns = _means(stamps_ns, positions_um, window)

    def turns(time_s: Floats) -> Floats:
        at_ns = (time_s - begin_s) * NS_PER_S + begin_ns
        return np.asarray(np.mean([log.turns_until(at_ns + each) for each in around_ns], axis=0), np.float64)

    begin_s = seconds(begin_ns)
    span_s = (begin_s, seconds(int(log.times_ns[-1])))
    times_s = stamps_ns / NS_PER_S
    errors: dict[str, Any] = {"exact_log": exact_log, "log_error_s": log_error_s, "own_log": own_log}
    return fit_motion(times_s, positions_um, turns, span_s, within, flow, **errors)


def sampled_s(log: FieldLog, image_s: float) -> float | None:
    """The interval in s of a log whose rows come evenly and more seldom than images do; None for other logs.

    A log with a row for each command has long intervals as well, but uneven ones, and tells all.
    """
    if len(log) < _LEAST_SAMPLES:
        return None
    short, row_s, long = (np.quantile(np.diff(log.times_ns), (0.1, 0.5, 0.9)) / NS_PER_S).tolist()
    return float(row_s) if row_s > _SPARSE * image_s and long < _EVEN * short else None


def fit_samples(
    stamps_ns: Ints, positions_um: Floats, log: FieldLog, within: SearchRange, flow: FlowField | None = None
) -> MotionFit | None:
    """The fit to a log whose rows are samples of a field that changes between them; None: they are not, or too few.

    When it changed within an interval is not known, so means over two intervals are compared: with frame after frame
    each change would be two jumps that the other does not have.
    """
    image_s = float(np.median(np.diff(stamps_ns))) / NS_PER_S
    row_s = sampled_s(log, image_s)
    window = 1 if row_s is None else round(2.0 * row_s / image_s)
    if row_s is None or len(stamps_ns) < (LEAST_FRAMES + 1) * window:
        return None
    error_s = row_s / math.sqrt(12.0)
    fit = fit_log(stamps_ns, positions_um, log.interpolate(), within, flow, window=window, log_error_s=error_s)
    if not fit.refusal and fit.explained < LEAST_EXPLAINED_WITH_RATE:
        fit = fit._replace(refusal=refusal_of(fit, LEAST_EXPLAINED_WITH_RATE))
    return fit


def _means(stamps_ns: Ints, positions_um: Floats, window: int) -> tuple[Ints, Floats, Floats]:
    """Mean stamps (m,) and positions (m, 2) of so many frames in turn, and when those are around the mean, in ns."""
    used = len(stamps_ns) // window * window
    stamps, places = stamps_ns[:used].reshape(-1, window), positions_um[:used].reshape(-1, window, 2)
    image_ns = float(np.median(np.diff(stamps_ns)))
    whole = np.ptp(stamps, axis=1) < (window - 0.5) * image_ns  # no frame lacks within
    around_ns = (np.arange(window) - 0.5 * (window - 1)) * image_ns
    means_ns = np.rint(stamps[whole].mean(axis=1)).astype(np.int64)
    return means_ns, np.asarray(places[whole].mean(axis=1)), around_ns.astype(np.float64)


def _turns_of(log: FieldLog) -> Turns:
    """The turns of a log by its times in s."""
    return lambda time_s: log.turns_until(time_s * NS_PER_S)


def _applied_turns(session: Session, robot: Robot | None = None) -> tuple[Turns, tuple[float, float]]:
    """The turns from image to image that an imported session holds, and their span in s.

    With a robot they are those that its `proportional` would have taken as far, see physics/robot.py.
    """
    applied = list(session.messages("applied"))
    if robot is not None:
        before = [None, *applied[:-1]]
        applied = [robot.proportional_turns(*pair) for pair in zip(before, applied, strict=True)]
    stamps_s = np.array([each.stamp_ns for each in applied]) / NS_PER_S
    total = np.cumsum([each.turns for each in applied], axis=0)

    def turns(time_s: Floats) -> Floats:
        return np.column_stack([np.interp(time_s, stamps_s, total[:, axis]) for axis in (0, 1)])

    return turns, (float(stamps_s[0]), float(stamps_s[-1]))


def commanded_field(currents: list[Currents]) -> FieldLog:
    """The field that the commands of a session ask for, without delay: the plane turns as it is ordered."""
    log, state = FieldLog(), FieldState()
    changes = [(command, next(same)) for command, same in groupby(currents, _command)]
    ends_ns = [*(current.stamp_ns for _, current in changes[1:]), *(current.stamp_ns for current in currents[-1:])]
    for (command, current), end_ns in zip(changes, ends_ns, strict=True):
        motion = field_motion(state, command)
        duration_s = seconds(end_ns - current.stamp_ns)
        log.extend(current.stamp_ns, motion.segments(duration_s), command.amplitude_mt)
        if duration_s <= 0.0:
            log.append(current.stamp_ns, command.frequency_hz, command.heading_rad, command.amplitude_mt)
        state = motion.after(duration_s)
    return log


def _command(current: Currents) -> FieldCommand:
    return FieldCommand(current.frequency_hz, current.heading_rad, current.amplitude_mt, current.limit_hz)


def heading_settings(fit: MotionFit, offset_deg: float, mirrored: bool) -> dict[str, float | bool]:
    """Changes of the settings movie.heading_* that a fit makes to present ones; {} if they are as good."""
    changed: dict[str, float | bool] = {}
    if fit.mirrored:
        changed["movie.heading_mirrored"] = not mirrored
        offset_deg = -offset_deg
    turned = _is_turned(fit)
    if turned or fit.mirrored:
        total = offset_deg + (math.degrees(fit.heading_offset_rad) if turned else 0.0)
        changed["movie.heading_offset_deg"] = round((total + 180.0) % 360.0 - 180.0, 2) + 0.0
    return changed


def _is_turned(fit: MotionFit) -> bool:
    return abs(fit.heading_offset_rad) > max(_SIGNIFICANT * fit.heading_offset_std_rad, _LEAST_RAD)


def _propose_settings(
    fit: MotionFit, session: Session, *, shared_clock: bool, own_log: bool
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Settings, and sentences on what the fit says of the present ones."""
    config, advice = session.config, []
    sets: dict[str, Any] = {"robot.um_per_rev": float(f"{fit.um_per_rev:.4g}")}
    stated = config.robot.um_per_rev
    if abs(fit.um_per_rev - stated) > Z95 * fit.um_per_rev_std:
        advice.append(
            f"{fit.um_per_rev:.4g} um per revolution differ from robot.um_per_rev = {stated:g} by "
            f"{100.0 * (fit.um_per_rev / stated - 1.0):+.1f} %, more than the error allows"
        )
    else:
        advice.append(f"robot.um_per_rev = {stated:g} agrees with the motion")
    if shared_clock:
        delay_s = -fit.offset_s
        sets["robot.delay_s"] = round(max(delay_s, 0.0), 4)
        if abs(delay_s - config.robot.delay_s) > Z95 * fit.offset_std_s:
            advice.append(f"robot.delay_s = {config.robot.delay_s:g} differs from the latency by more than its error")
    else:
        movie = config.movie
        advice.append("log and movie have clocks of their own, so the offset holds the latency too")
        if own_log and abs(fit.offset_s) > Z95 * fit.offset_std_s:
            sets["movie.clock_offset_s"] = round(movie.clock_offset_s + fit.offset_s, 4)
            advice.append("the log is not aligned: import again with --align, or with this movie.clock_offset_s")
        sets |= heading_settings(fit, movie.heading_offset_deg, movie.heading_mirrored) if own_log else {}
    if fit.mirrored:
        advice.append("the y axis of the log's headings is opposed to that of the chip (image: y down)")
    if _is_turned(fit):
        degrees = math.degrees(fit.heading_offset_rad)
        where = "" if not shared_clock else "; see coils.mt_per_a (its axes) and camera.angle_deg"
        advice.append(f"the robot travels {degrees:+.1f} degrees off the heading{where}")
    return sets, (*advice, *remarks(fit))


def remarks(fit: MotionFit) -> list[str]:
    """Reasons why a fit is less certain than its errors suggest, in sentences."""
    sentences = []
    if fit.offset_std_s > _POOR_OFFSET_S:
        sentences.append(
            f"the offset is known to {1e3 * fit.offset_std_s:.0f} ms only; a longer movie with more changes of heading "
            "or frequency determines it better"
        )
    if fit.explained < LEAST_EXPLAINED:
        sentences.append(
            f"the commands explain {100.0 * fit.explained:.0f} % only of the changes of motion, as where each image is "
            "stamped late by another time: use a camera with a clock, or one that states when it exposed"
        )
    if fit.left_out > 0.02 * (fit.frames + fit.left_out):
        sentences.append(f"{fit.left_out} positions were left out because the robot can not have been there")
    return sentences


def rows_of(fit: MotionFit, offset: tuple[str, str] | None = None, shared_clock: bool = False) -> list[tuple[str, str]]:
    """The fit for people, each value with its standard error; `offset`: another row for the offset."""
    name, factor = ("latency", -1e3) if shared_clock else ("time of log less time of movie", 1e3)
    rows = [
        ("um per revolution", f"{fit.um_per_rev:.2f} ± {fit.um_per_rev_std:.2f}"),
        offset or (name, f"{factor * fit.offset_s:.1f} ± {1e3 * fit.offset_std_s:.1f} ms"),
        (
            "heading offset",
            f"{math.degrees(fit.heading_offset_rad):.1f} ± {math.degrees(fit.heading_offset_std_rad):.1f} degrees"
            + (", mirrored" if fit.mirrored else ""),
        ),
        (
            "changes of motion explained",
            f"{100.0 * fit.explained:.0f} %; at the best other place {100.0 * fit.second_explained:.0f} %",
        ),
        ("frames used", f"{fit.frames}" + (f", {fit.left_out} left out" if fit.left_out else "")),
    ]
    if fit.rate_std > 0.0:
        used = "" if fit.rate != 1.0 else "; 1 is used"
        rows.insert(2, ("s of the log per s of the movie", f"{fit.rate_estimate:.6f} ± {fit.rate_std:.6f}{used}"))
    return rows


def figures_of(fit: MotionFit) -> dict[str, Any]:
    """The fit as plain numbers."""
    values: dict[str, Any] = {
        "offset_s": fit.offset_s,
        "offset_standard_error_s": fit.offset_std_s,
        "rate": fit.rate,
        "rate_estimate": fit.rate_estimate,
        "rate_standard_error": fit.rate_std,
        "um_per_rev": fit.um_per_rev,
        "um_per_rev_standard_error": fit.um_per_rev_std,
        "heading_offset_deg": math.degrees(fit.heading_offset_rad),
        "heading_offset_standard_error_deg": math.degrees(fit.heading_offset_std_rad),
        "heading_mirrored": fit.mirrored,
        "explained": fit.explained,
        "second_explained": fit.second_explained,
        "p_value": fit.p_value,
        "frames": fit.frames,
        "frames_left_out": fit.left_out,
        "refusal": fit.refusal,
    }
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}
