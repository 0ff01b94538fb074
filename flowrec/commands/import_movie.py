"""`flowrec import`: a movie and a log of the coils become a session, as if the run had been recorded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrec.commands.interactive import Unattended
from flowrec.commands.record import prepare, record
from flowrec.commands.run_summary import Recorded
from flowrec.config import Config
from flowrec.control.field_log import FieldLog
from flowrec.messages import Appearance, Track
from flowrec.rig_settings import MOVIE
from flowrec.rigs.movie.source import MovieSource

# A step between reading the settings and recording: it may look at the movie, and returns the settings to record with.
Alignment = Callable[[Config], Config]


@dataclass(frozen=True, slots=True, eq=False)
class MovieTracks:
    """Where the robot is in each image of a movie, before anything is recorded.

    Attributes
    ----------
    stamps_ns : (n,) session stamps, by the settings movie.clock_rate and clock_offset_s.
    positions_um : (n, 2) on the chip; meaningless where `seen` is False.
    seen : (n,)
    log : what the coils did on the same clock, without the robot's delay; None: there is no log.
    """

    stamps_ns: NDArray[np.int64]
    positions_um: NDArray[np.float64]
    seen: NDArray[np.bool_]
    log: FieldLog | None


def tracks_of(asked: Config) -> MovieTracks:
    """Track the robot through the movie of a configuration; FlowrecError as `import_movie`."""
    config, chip, pipeline, *_ = prepare(asked)
    track: Track | None = None
    appearance: Appearance | None = None
    tracks: list[Track] = []
    with MovieSource(config.movie, config.coils) as source:
        for frame in source.frames():
            found = config.tracker.follow(track, appearance, frame, chip, pipeline.calibration, config.robot)
            track, appearance = found
            tracks.append(track)
        return MovieTracks(
            np.array([each.stamp_ns for each in tracks], np.int64),
            np.array([each.position_um for each in tracks]).reshape(-1, 2),
            np.array([each.seen for each in tracks], np.bool_),
            source.log,
        )


def asked_import(
    movie: Path | str,
    config: Config | None = None,
    *,
    coils: Path | str | None = None,
    times: Path | str | None = None,
    fps: float | None = None,
    partial: bool = False,
) -> Config:
    """The configuration of an import: what is given here goes before section [movie] of `config`."""
    config = config if config is not None else Config()
    given: dict[str, object] = {"path": str(movie)}
    given |= {"coils": str(coils)} if coils is not None else {}
    given |= {"times": str(times), "rate_hz": None} if times is not None else {}
    given |= {"rate_hz": fps} if fps is not None else {}
    given |= {"times": ""} if fps is not None and times is None else {}
    given |= {"partial": True} if partial else {}
    return replace(config, rig=MOVIE, movie=replace(config.movie, **given))  # type: ignore[arg-type]


def import_movie(
    movie: Path | str,
    out: Path | str | None = None,
    config: Config | None = None,
    *,
    coils: Path | str | None = None,
    times: Path | str | None = None,
    fps: float | None = None,
    partial: bool = False,
    overwrite: bool = False,
    control: Unattended | None = None,
    inputs: Sequence[Path] = (),
    align: Alignment | None = None,
) -> Recorded:
    """Make a session of a movie, as fast as it can be read. A failure leaves no file.

    Parameters
    ----------
    movie : a file, or a folder of images.
    out : the session (.mcap); None: named by date and sample.
    config : settings; it must give camera.um_per_px, robot.radius_um and chip.path, which no file tells.
    coils : log of the coils (CSV or Excel), see control/coil_log.py. Without one the motion of the robot is its flow.
    times : CSV with the time of each image in time_s, on the clock of the log.
    fps : images per second, instead.
    partial : a movie that breaks off is used up to there.
    control : as in `record`.
    inputs : files that were read besides these; the output may be none of them.
    align : makes the settings to record with; None: they are recorded as they are given.

    Raises
    ------
    FlowrecError : in one line: what can not be read, what does not fit together, what is not told.
    """
    asked = asked_import(movie, config, coils=coils, times=times, fps=fps, partial=partial)
    if align is not None:
        asked = align(asked)
    path = None if out is None else Path(out)
    return record(asked, path, overwrite=overwrite, control=control, inputs=inputs, keep_failed=False)
