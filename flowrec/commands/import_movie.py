"""`flowrec import`: a movie and a log of the coils become a session, as if the run had been recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flowrec.commands.align import aligned, overlapping, refuse_turned
from flowrec.commands.first_pass import first_pass
from flowrec.commands.interactive import Unattended
from flowrec.commands.record import record
from flowrec.commands.run_summary import Recorded
from flowrec.config import Config
from flowrec.rig_settings import MOVIE
from flowrec.rigs.movie.exported import with_exported
from flowrec.terminal import say


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
    given |= {"coils": str(coils)} if coils is not None else {}
    given |= {"times": str(times), "rate_hz": None} if times is not None else {}
    given |= {"rate_hz": fps} if fps is not None else {}
    given |= {"times": ""} if fps is not None and times is None else {}
    given |= {"partial": True} if partial else {}
    asked, taken = with_exported(replace(config, rig=MOVIE, movie=replace(config.movie, **given)))  # type: ignore[arg-type]
    if taken:
        say(f"taken from the export of the session: {', '.join(taken)}")
    return asked


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
    robot: str | int = "",
) -> Recorded:
    """Make a session of a movie, as fast as it can be read. A failure leaves no file.

    Parameters
    ----------
    movie : a file, or a folder of images.
    out : the session (.mcap); None: named by date and sample.
    config : settings; it must give camera.um_per_px, robot.radius_um and chip.path, which no file tells but one that
        flowrec exported: such a movie, or else the folder of tables around `coils`, gives these and what else is known
        of robot, camera and coils. It is used where a setting has its default value.
    coils : log of the coils (CSV or Excel), see control/coil_log.py. Without one only movie.drifts refines the flow.
    times : CSV with the time of each image in time_s, on the clock of the log.
    fps : images per second, instead.
    partial : a movie that breaks off is used up to there.
    control : as in `record`.
    inputs : files that were read besides these; the output may be none of them.
    align : fit offset and rate of the log's clock to the motion of the robot, see commands/align.py; False: they are
        those of the settings movie.clock_offset_s and clock_rate.
    robot : which body is the robot, where several look alike: a number of the picture with which such a movie is
        refused, a place in the first image as in "320,256px", or one on the chip in um as in "1250,840".

    Raises
    ------
    FlowrecError : in one line: what can not be read, what does not fit together, what is not told.
    """
    asked = asked_import(movie, config, coils=coils, times=times, fps=fps, partial=partial)
    path = None if out is None else Path(out)
    looked_at = overlapping(asked) if align else asked
    asked, facts = first_pass(asked, looked_at, str(robot), path.parent if path is not None else Path())
    if align:
        asked, found = aligned(asked)
        facts = {**facts, **found}
    else:
        refuse_turned(asked)
    return record(
        asked, path, overwrite=overwrite, control=control, inputs=inputs, keep_failed=False, given_facts=facts
    )
