"""`flowrec import`: a movie and a log of the coils become a session, as if the run had been recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flowrec.chip import load_chip
from flowrec.commands.align import aligned
from flowrec.commands.calibrate_image import walls_state
from flowrec.commands.interactive import Unattended
from flowrec.commands.record import record
from flowrec.commands.run_summary import Recorded
from flowrec.config import Config, registration_of
from flowrec.errors import MovieError
from flowrec.movies import ReadOptions, open_movie
from flowrec.resolve import resolve
from flowrec.rig_settings import MOVIE
from flowrec.rigs.movie.rig import fitted_to_movie
from flowrec.terminal import warn


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
    align: bool = True,
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
    align : fit offset and rate of the log's clock to the motion of the robot, see commands/align.py; False: they are
        those of the settings movie.clock_offset_s and clock_rate.

    Raises
    ------
    FlowrecError : in one line: what can not be read, what does not fit together, what is not told.
    """
    asked = asked_import(movie, config, coils=coils, times=times, fps=fps, partial=partial)
    facts = dict(_walls(asked))
    if align:
        asked, found = aligned(asked)
        facts |= found
    path = None if out is None else Path(out)
    return record(
        asked, path, overwrite=overwrite, control=control, inputs=inputs, keep_failed=False, given_facts=facts
    )


def _walls(asked: Config) -> dict[str, str]:
    """A warning, also for the head of the session, if the walls in the movie are not where its registration says.

    Nothing where the movie does not show enough of the walls, or can not be read everywhere: the import tells that.
    """
    fitted, *_ = fitted_to_movie(asked)
    chip, movie = load_chip(fitted.chip), asked.movie
    try:
        with open_movie(movie.path, movie.reader, ReadOptions(movie.channel, movie.bits, movie.partial)) as opened:
            image = opened.median_image()
    except MovieError:
        return {}
    found = walls_state(image, chip, registration_of(resolve(fitted, chip).camera, chip))
    if found is None or found[0]:
        return {}
    warn(found[1])
    return {"source_walls": found[1]}
