"""The step of `flowrec import` that finds the clock of a log in the robot's own motion, before anything is recorded.

The robot is tracked once through the movie, and its track is fitted to the log (estimation/motion_fit.py). What is
found become settings: movie.clock_rate and movie.clock_offset_s, and movie.heading_mirrored and heading_offset_deg if
the axes of the log are turned or mirrored. So the session holds them, and a replay does not depend on the fit.

The um per revolution that are found are used where they differ from the stated ones by more than three of their
standard errors, because 10 % cost as much in the refined flow as no refinement at all. The flow that is assumed is part
of the fit, with a scale of its own: without it the error is twice as large.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.orientation import AS_STATED
from flowrec.commands.axes import may_be_image, orientation_of_heading, orientation_of_log, turned_log
from flowrec.commands.calibrate_motion import (
    ANYWHERE,
    figures_of,
    fit_log,
    heading_settings,
    remarks,
    rows_of,
)
from flowrec.commands.misfit import Evidence, why_still, why_unexplained
from flowrec.commands.record import Prepared, prepare
from flowrec.config import Config
from flowrec.control.coil_log import is_of_session, read_coil_log
from flowrec.control.field_log import FieldLog
from flowrec.errors import UsageError
from flowrec.estimation.motion_fit import UNEXPLAINED, MotionFit
from flowrec.messages import FlowField, Track
from flowrec.pipeline import Sight, look
from flowrec.rigs.movie.exported import session_of_log
from flowrec.rigs.movie.source import MovieSource
from flowrec.terminal import say, table, warn
from flowrec.units import NS_PER_S, seconds
from flowrec.vision.track_quality import TrackQuality

_FAR = 0.3  # relative difference of um_per_rev from which it is doubtful whether the log is of this run
_Z95 = 1.96
_SIGNIFICANT = 3.0  # standard errors
_WITHOUT = "import it as it is with --no-align, and set movie.clock_offset_s and movie.clock_rate yourself"


@dataclass(frozen=True, slots=True, eq=False)
class MovieTracks:
    """Where the robot is in each image of a movie, before anything is recorded.

    Attributes
    ----------
    stamps_ns : (n,) session stamps, by the settings movie.clock_rate and clock_offset_s.
    positions_um : (n, 2) on the chip; meaningless where `seen` is False.
    seen : (n,)
    log : what the coils did on the same clock, without the robot's delay; None: there is no log.
    assumed : the flow by the chip and its boundary values.
    evidence : what the images show besides, for a log that does not explain the track.
    prepared : the settings of the run, its chip, and what its images say about the axes.
    """

    stamps_ns: NDArray[np.int64]
    positions_um: NDArray[np.float64]
    seen: NDArray[np.bool_]
    log: FieldLog | None
    assumed: FlowField
    evidence: Evidence
    prepared: Prepared


def tracks_of(asked: Config) -> MovieTracks:
    """Track the robot through the movie of a configuration; FlowrecError as `import_movie`."""
    prepared = prepare(asked, aloud=False)  # the import says it, of the settings that are used
    config, chip, pipeline, *_ = prepared
    sight, tracks, shifts = Sight(), list[Track](), list[NDArray[np.float64]]()
    quality = TrackQuality(pipeline.calibration, pipeline.image_shape, pipeline.robot)
    stabilised, measures = bool(config.stabilise.on), replace(config.stabilise, on=True)
    shift, background = None, None  # measured, too, where they are not taken out of the track
    with MovieSource(config.movie, config.coils) as source:
        for frame in source.frames():
            sight = look(pipeline, sight, frame)
            assert sight.track is not None, "the tracker says of every image whether it shows the robot"
            tracks.append(sight.track)
            quality.take(sight.track, sight.appearance, sight.shift)
            if stabilised:
                shift, background = sight.shift, sight.background
            else:
                shift, background = measures.register(
                    shift, background, sight.track, frame, chip, pipeline.calibration, config.robot
                )
            shifts += [shift.shift_px] if shift is not None else []
        seen = np.array([each.seen for each in tracks], np.bool_)
        stamps_ns = np.array([each.stamp_ns for each in tracks], np.int64)
        positions_um = np.array([each.position_um for each in tracks]).reshape(-1, 2)
        known = background is not None and len(background.pixels) > 0
        evidence = Evidence(
            stamps_ns[seen] / NS_PER_S,
            positions_um[seen],
            float(np.sqrt(np.array(shifts).var(axis=0).sum())) if known else None,
            stabilised,
            pipeline.calibration.um_per_px,
            quality.doubts(),
        )
        return MovieTracks(stamps_ns, positions_um, seen, source.log, config.flow.solve(chip), evidence, prepared)


def refuse_turned(asked: Config) -> None:
    """Raise ChipError where the robot of a movie moves in another orientation than its log says, on the log's clock."""
    if not (asked.movie.coils and asked.mission.check_axes):
        return
    tracks = tracks_of(asked)
    config, chip, image = tracks.prepared.config, tracks.prepared.chip, tracks.prepared.image
    if tracks.log is None or image is None:
        return
    seen = tracks.seen
    found = orientation_of_log(tracks.stamps_ns[seen], tracks.positions_um[seen], tracks.log, config)
    if found != AS_STATED:
        raise turned_log(found, image, config, chip)


def _refuse_doubtful(fit: MotionFit, prepared: Prepared) -> None:
    """Raise ChipError where a log fits in another orientation, and the image does not tell that it is the log's."""
    found, image = orientation_of_heading(fit.heading_offset_rad, mirrored=fit.mirrored), prepared.image
    if found == AS_STATED or image is None:
        return
    if may_be_image(found, image, prepared.config, prepared.chip):
        raise turned_log(found, image, prepared.config, prepared.chip)
    warn(f"the robot moves {found.name}, relative to the log, whose axes are adapted: {image.text}")


def aligned(asked: Config) -> tuple[Config, Mapping[str, str]]:
    """The configuration with the clock of the log as the motion shows it, and the fit for the head of the session.

    A configuration without a log comes back as it is.

    Raises
    ------
    UsageError : the log does not explain the motion, in one line with what to do.
    FlowrecError : as `import_movie`.
    """
    if not asked.movie.coils:
        return asked, {}
    if _on_one_clock(asked):
        refuse_turned(asked)
        return asked, {}
    rough = overlapping(asked)
    tracks = tracks_of(rough)
    assert tracks.log is not None, "there is a log"
    seen = tracks.seen
    try:
        fit = fit_log(tracks.stamps_ns[seen], tracks.positions_um[seen], tracks.log, ANYWHERE, tracks.assumed)
    except UsageError as error:
        raise UsageError(f"{asked.movie.coils}: the log can not be aligned: {error}; {_WITHOUT}") from error
    if fit.refusal:
        refusal = fit.refusal
        if UNEXPLAINED in refusal:
            why = why_unexplained(tracks.evidence, tracks.log, tracks.assumed, rough.robot.um_per_rev)
            refusal = refusal.replace(UNEXPLAINED, why)
        else:
            refusal = why_still(tracks.evidence, tracks.log, rough.robot.um_per_rev) or refusal
        raise UsageError(f"{asked.movie.coils}: the log can not be aligned: {refusal}; or {_WITHOUT}")
    _refuse_doubtful(fit, tracks.prepared)
    movie = rough.movie
    # The rig applies a log of commands robot.delay_s late; the offset that is found has that latency in it.
    latency_s = 0.0 if is_of_session(Path(movie.coils)) else asked.robot.delay_s or 0.0
    offset_s = movie.clock_offset_s + fit.offset_s + latency_s
    heading = heading_settings(fit, movie.heading_offset_deg, movie.heading_mirrored)
    changed = replace(
        movie,
        clock_rate=movie.clock_rate * fit.rate,
        clock_offset_s=round(offset_s, 6),
        **{key.partition(".")[2]: value for key, value in heading.items()},  # type: ignore[arg-type]
    )
    stated = asked.robot.um_per_rev
    robot = replace(asked.robot, um_per_rev=float(f"{fit.um_per_rev:.4g}")) if _refuted(stated, fit) else asked.robot
    _tell(asked, fit, changed.clock_offset_s)
    facts = figures_of(fit) | {"um_per_rev_stated": stated, "um_per_rev_used": robot.um_per_rev}
    return replace(asked, movie=changed, robot=robot), {"alignment": json.dumps(facts)}


def _on_one_clock(asked: Config) -> bool:
    """Whether movie and log are exports of one session, whose clock both have."""
    log = Path(asked.movie.coils)
    if not is_of_session(log):
        return False
    with MovieSource(replace(asked.movie, coils=""), asked.coils) as source:
        notes = source.facts.notes
    return notes is not None and session_of_log(log) in ("", notes.session_key)


def _refuted(um_per_rev: float, fit: MotionFit) -> bool:
    """Whether the motion shows that it is another value."""
    return abs(fit.um_per_rev - um_per_rev) > _SIGNIFICANT * fit.um_per_rev_std


def overlapping(asked: Config) -> Config:
    """The configuration with the log at the movie, wherever its clock begins: a log that is elsewhere is refused.

    Without a log it is as it is.
    """
    if not asked.movie.coils:
        return asked
    with MovieSource(replace(asked.movie, coils=""), asked.coils) as source:
        first_s = seconds(source.first_ns)
    movie = asked.movie
    log = read_coil_log(Path(movie.coils), movie.columns, asked.coils)
    begin_s = seconds(int(log.times_ns[0]))
    return replace(asked, movie=replace(movie, clock_offset_s=begin_s - first_s))


def _tell(asked: Config, fit: MotionFit, offset_s: float) -> None:
    # The offset from the beginning of the log, which is fitted, is no setting.
    offset = ("movie.clock_offset_s", f"{offset_s:.4f} ± {fit.offset_std_s:.4f} s")
    rows = rows_of(fit, offset)
    table(f"{asked.movie.coils} against the motion of the robot", ("", "value and standard error"), rows, sys.stderr)
    say("movie.clock_offset_s and the rate are recorded; --no-align takes the log as it is")
    stated = asked.robot.um_per_rev
    found = f"the robot moves {fit.um_per_rev:.4g} ± {fit.um_per_rev_std:.2g} um per revolution"
    if _refuted(stated, fit):
        doubt = "; or is this the log of another run?" if abs(fit.um_per_rev / stated - 1.0) > _FAR else ""
        warn(
            f"{found}: this is used, not robot.um_per_rev = {stated:g}; to keep that, import with --no-align and the "
            f"settings movie.* of this session{doubt}"
        )
    elif abs(fit.um_per_rev - stated) > _Z95 * fit.um_per_rev_std:
        warn(
            f"{found}; robot.um_per_rev = {stated:g} is used; to use what was found: --set "
            f"robot.um_per_rev={fit.um_per_rev:.4g}"
        )
    for sentence in remarks(fit):
        warn(sentence)
