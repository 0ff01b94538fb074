"""The step of `flowrec import` that finds the clock of a log in the robot's own motion, before anything is recorded.

The robot is tracked once through the movie, and its track is fitted to the log (measure/motion_fit.py). What is
found become settings: movie.clock_rate and movie.clock_offset_s, and movie.heading_mirrored and heading_offset_deg if
the axes of the log are turned or mirrored. So the session holds them, and a replay does not depend on the fit.

The um per revolution that were found replace the stated ones if they differ by more than three standard errors: an
error of 10 % spoils the refined flow as much as no refinement at all. The assumed flow is part of the fit, with a scale
of its own: without it the error is twice as large.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flowrec.core import NS_PER_S, Z95, AxesVerdict, UsageError, say, seconds, table, warn
from flowrec.measure import (
    ANYWHERE,
    UNEXPLAINED,
    MotionFit,
    figures_of,
    fit_log,
    fit_samples,
    heading_settings,
    remarks,
    rows_of,
)
from flowrec.physics import AS_STATED
from flowrec.rigs import MovieSource, session_of_log, with_exported
from flowrec.stages import MOVIE, Config, is_of_session, read_coil_log
from flowrec.verbs.first_pass import Looked, first_pass
from flowrec.verbs.misfit import (
    may_be_image,
    motion_by_log,
    orientation_of_heading,
    turned_log,
    why_still,
    why_unexplained,
)
from flowrec.verbs.preparation import Prepared

_FAR = 0.3  # relative difference of um_per_rev from which it is doubtful whether the log is of this run
_SIGNIFICANT = 3.0  # standard errors
_WITHOUT = "import it as it is with --no-align, and set movie.clock_offset_s and movie.clock_rate yourself"


def asked_import(
    movie: Path | str,
    config: Config | None = None,
    *,
    coils: Path | str | None = None,
    times: Path | str | None = None,
    fps: float | None = None,
    partial: bool = False,
) -> Config:
    """The configuration of an import: what is given here goes before section [movie] of `config`.

    What flowrec wrote into the movie, or beside the log, of a session goes before default values; it is printed.
    """
    config = config if config is not None else Config()
    given: dict[str, object] = {"path": str(movie)}
    if coils is not None:
        given["coils"] = str(coils)
    if times is not None or fps is not None:  # one of them replaces both
        given |= {"times": str(times or ""), "rate_hz": fps}
    if partial:
        given["partial"] = True
    asked, taken = with_exported(replace(config, rig=MOVIE, movie=replace(config.movie, **given)))  # type: ignore[arg-type]
    if taken:
        say(f"taken from the export of the session: {', '.join(taken)}")
    return asked


def fit_import(asked: Config, folder: Path, robots: Sequence[str] = (), *, align: bool = True) -> Looked:
    """Look through the movie once: which body is the robot, and how the clock of the log lies to that of the movie.

    Parameters and errors are those of `import_movie`; a picture of the candidates goes into `folder`.
    """
    fits = align and bool(asked.movie.coils) and not on_one_clock(asked)
    looked = first_pass(asked, overlapping(asked) if fits else asked, robots, folder)
    return align_log(looked) if fits else looked._replace(doubts=refuse_turned(looked))


def refuse_turned(looked: Looked) -> list[str]:
    """Reasons to doubt the axes of a log on the clock of its movie; none if they fit, or are not to be checked.

    Raises ChipError where the robot moves in another orientation than the log says.
    """
    config, tracks, image = looked.prepared.config, looked.tracks, looked.prepared.image
    if tracks is None or image is None:  # None: mission.check_axes is off
        return []
    found = motion_by_log(tracks, config)
    if found.verdict == AxesVerdict.CONTRADICTS:
        raise turned_log(found.orientation, image, config, looked.prepared.chip)
    text = f"{config.movie.coils}: the axes of the log are not confirmed: the motion of the robot tells too little"
    return [] if found.verdict == AxesVerdict.AGREES else [text]


def _refuse_doubtful(fit: MotionFit, prepared: Prepared) -> None:
    """Raise ChipError where a log fits in another orientation, and the image does not tell that it is the log's."""
    found, image = orientation_of_heading(fit.heading_offset_rad, mirrored=fit.mirrored), prepared.image
    if found == AS_STATED or image is None:
        return
    if may_be_image(found, image, prepared.config, prepared.chip):
        raise turned_log(found, image, prepared.config, prepared.chip)
    warn(
        f"the headings of the log are read {found.name}: so the robot moves, and {image.text}; nothing is to be done, "
        "and movie.columns can state it (flowrec settings movie.columns)"
    )


def align_log(looked: Looked) -> Looked:
    """Look at the log: its clock as the motion shows it, the fit for the head of the session, doubts.

    Raises UsageError: the log does not explain the motion, in one line with what to do; ChipError: it does in another
    orientation, and the image does not tell that it is the log's.
    """
    asked, rough, tracks = looked.asked, looked.prepared.config, looked.tracks
    assert tracks is not None, "there is a log"
    at, log, flow = (tracks.stamps_ns, tracks.positions_um), tracks.log, rough.flow.solve(looked.prepared.chip)
    between_rows = rough.movie.between_rows
    try:
        fit = fit_log(*at, log, ANYWHERE, flow)
        if UNEXPLAINED in fit.refusal and between_rows == "holds":
            samples = fit_samples(*at, log, ANYWHERE, flow)
            if samples is not None and not samples.refusal:
                fit, between_rows = samples, "linear"
    except UsageError as error:
        raise UsageError(f"{asked.movie.coils}: the log can not be aligned: {error}; {_WITHOUT}") from error
    if fit.refusal:
        refusal = fit.refusal
        if UNEXPLAINED in refusal:
            why = why_unexplained(tracks, flow, rough.robot.um_per_rev)
            refusal = refusal.replace(UNEXPLAINED, why)
        else:
            refusal = why_still(tracks, rough.robot.um_per_rev) or refusal
        raise UsageError(f"{asked.movie.coils}: the log can not be aligned: {refusal}; or {_WITHOUT}")
    _refuse_doubtful(fit, looked.prepared)
    movie = rough.movie
    # The rig applies a log of commands robot.delay_s late; the offset that is found has that latency in it.
    latency_s = 0.0 if is_of_session(Path(movie.coils)) else asked.robot.delay_s or 0.0
    offset_s = movie.clock_offset_s + fit.offset_s + latency_s
    heading = heading_settings(fit, movie.heading_offset_deg, movie.heading_mirrored)
    changed = replace(
        movie,
        clock_rate=movie.clock_rate * fit.rate,
        clock_offset_s=round(offset_s, 6),
        between_rows=between_rows,
        **{key.partition(".")[2]: value for key, value in heading.items()},  # type: ignore[arg-type]
    )
    stated = asked.robot.um_per_rev
    robot = replace(asked.robot, um_per_rev=float(f"{fit.um_per_rev:.4g}")) if _refutes(stated, fit) else asked.robot
    _tell(asked, fit, changed.clock_offset_s)
    doubts: list[str] = []
    if between_rows != asked.movie.between_rows:
        row_s = float(np.median(np.diff(log.times_ns))) / NS_PER_S
        doubts.append(
            f"the log has a row every {row_s:.2g} s only: the field is taken to change evenly from row to row "
            f"(movie.between_rows = 'linear') and the clock is known to {1e3 * fit.offset_std_s:.0f} ms, which costs "
            "the flow some percent, so log every command"
        )
    figures = figures_of(fit) | {"um_per_rev_stated": stated, "um_per_rev_used": robot.um_per_rev}
    facts = {**looked.facts, "alignment": json.dumps(figures)}
    return looked._replace(asked=replace(asked, movie=changed, robot=robot), facts=facts, doubts=doubts)


def on_one_clock(asked: Config) -> bool:
    """True if movie and log are exports of one session, whose clock both have."""
    log = Path(asked.movie.coils)
    if not is_of_session(log):
        return False
    with MovieSource(replace(asked.movie, coils=""), asked.coils) as source:
        notes = source.facts.notes
    return notes is not None and session_of_log(log) in ("", notes.session_key)


def _refutes(um_per_rev: float, fit: MotionFit) -> bool:
    """True if the motion shows that it is another value."""
    return abs(fit.um_per_rev - um_per_rev) > _SIGNIFICANT * fit.um_per_rev_std


def overlapping(asked: Config) -> Config:
    """The configuration with the log at the movie, wherever its clock begins: a log that is elsewhere is refused."""
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
    if _refutes(stated, fit):
        doubt = "; or is this the log of another run?" if abs(fit.um_per_rev / stated - 1.0) > _FAR else ""
        warn(
            f"{found}: this is used, not robot.um_per_rev = {stated:g}; to keep that, import with --no-align and the "
            f"settings movie.* of this session{doubt}"
        )
    elif abs(fit.um_per_rev - stated) > Z95 * fit.um_per_rev_std:
        warn(
            f"{found}; robot.um_per_rev = {stated:g} is used; to use what was found: --set "
            f"robot.um_per_rev={fit.um_per_rev:.4g}"
        )
    for sentence in remarks(fit):
        warn(sentence)
