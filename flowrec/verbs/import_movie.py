"""`flowrec import`: a movie and a log of the coils become a session, as if the run had been recorded."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.verbs.command import Told, verb
from flowrec.verbs.options import ATTENDED, AsConfig, Asked, Overwrite, SessionOut, Sets, readable_toml
from flowrec.verbs.record import config_of_call

if TYPE_CHECKING:
    from flowrec.verbs.interactive import Unattended
    from flowrec.verbs.run_summary import Recorded


def _import_told(_asked: Asked, done: "Recorded") -> Told:
    facts = {
        **{"path": str(done.path), **done.facts, "files": [*map(str, done.files)]},
        "alignment": json.loads(done.source.get("alignment", "null")),
        "covered": done.covered.as_json() if done.covered is not None else None,
    }
    return Told.of(done)._replace(as_json=lambda: facts)


@verb("flowrec import movie.avi lab.toml --coils coils.csv -o a.mcap", result=_import_told)
def import_movie(
    movie: Annotated[
        Path | str, typer.Argument(help="Movie: AVI, MP4, MKV, MOV, TIFF, ND2, OME-Zarr, or a folder of images.")
    ],
    out: SessionOut = None,
    config: Annotated[
        AsConfig, typer.Argument(callback=readable_toml, help="Configuration (TOML); else flowrec.toml here.")
    ] = None,
    *,
    coils: Annotated[
        Path | str | None,
        typer.Option(metavar="LOG", help="What the coils did (CSV, Excel); columns: section movie.columns."),
    ] = None,
    times: Annotated[
        Path | str | None, typer.Option(metavar="FRAMES.csv", help="Times of the images: columns frame, time_s.")
    ] = None,
    fps: Annotated[float | None, typer.Option(metavar="F", help="Images per second, where no times are known.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Take a movie that breaks off up to there.")] = False,
    align: Annotated[
        bool, typer.Option("--align/--no-align", help="Fit the clock of the log to the motion of the robot.")
    ] = True,
    robot: Annotated[
        list[str] | Sequence[str | int] | str | int,
        typer.Option(
            metavar="WHICH",
            help="Which body is the robot: number of the picture, X,Ypx, or X,Y in um; several times: robots, the "
            "mission's one first.",
        ),
    ] = (),
    sets: Sets = None,
    overwrite: Overwrite = False,
    control: Annotated["Unattended | None", ATTENDED] = None,
) -> "Recorded":
    """Make a session of a movie and a log of the coils: track the robot, observe and refine the flow.

    Parameters
    ----------
    control : as in `record`.

    Returns
    -------
    The session and its figures. A failure leaves no file.

    Notes
    -----
    The configuration must give camera.um_per_px, robot.radius_um and chip.path, which no file tells but one that
    flowrec exported: such a movie, or else the folder of tables around `coils`, gives these and what else is known of
    robot, camera and coils. It is used where a setting has its default value. Without a log of the coils, see
    control/coil_log.py, only movie.drifts refines the flow. Without `align`, see verbs/align.py, offset and rate of the
    log's clock are those of the settings movie.clock_offset_s and clock_rate.

    Raises
    ------
    FlowrecError : in one line: what can not be read, what does not fit together, what is not told.
    """
    from flowrec.core import MCAP, Output, say, settings_of

    given = {} if fps is None else {"movie.rate_hz": fps}
    flags = dict.fromkeys(given, "--fps")
    chosen, inputs = config_of_call(config, settings_of(sets or ()) | given, flags)
    from flowrec.verbs.align import asked_import, fit_import
    from flowrec.verbs.mission_run import run_mission

    asked = asked_import(movie, chosen, coils=coils, times=times, fps=fps, partial=partial)
    path = None if out is None else Path(out)
    if path is not None:  # before the whole movie is looked through
        Output(path, MCAP, (*inputs,), overwrite).check()
    robots = [str(each) for each in ([robot] if isinstance(robot, str | int) else robot)]
    looked = fit_import(asked, path.parent if path is not None else Path(), robots, align=align)
    if not asked.movie.coils and not asked.movie.drifts:
        say(f"{movie}: without --coils LOG the robot is tracked, and the flow is not refined")
    return run_mission(looked.asked, path, overwrite=overwrite, control=control, inputs=inputs, looked=looked)
