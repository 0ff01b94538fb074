"""The verb import: it parses, calls and prints, with late imports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

import flowrec
from flowrec.bench.verbs import AsJson, Overwrite, Sets


def import_movie(
    movie: Annotated[
        Path, typer.Argument(help="Movie: AVI, MP4, MKV, MOV, TIFF, ND2, OME-Zarr, or a folder of images.")
    ],
    config: Annotated[Path | None, typer.Argument(help="Configuration (TOML).")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Session file; by default named by date and sample.")
    ] = None,
    coils: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="What the coils did (CSV, Excel); columns: section movie.columns."),
    ] = None,
    times: Annotated[
        Path | None, typer.Option(metavar="FRAMES.csv", help="Times of the images: columns frame, time_s.")
    ] = None,
    fps: Annotated[float | None, typer.Option(metavar="F", help="Images per second, where no times are known.")] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Take a movie that breaks off up to there.")] = False,
    align: Annotated[
        bool,
        typer.Option("--align/--no-align", help="Fit the clock of the log to the motion of the robot."),
    ] = True,
    robot: Annotated[
        str,
        typer.Option(metavar="WHICH", help="Which body is the robot: number of the picture, X,Ypx, or X,Y in um."),
    ] = "",
    sets: Sets = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Make a session of a movie and a log of the coils: track the robot, observe and refine the flow."""
    from flowrec.system.toml_file import read_toml

    if config is not None:
        read_toml(config)  # a file that is no TOML is refused before the imports below, which take a second
    from flowrec.commands.interactive import AtTerminal
    from flowrec.commands.run_summary import print_summary
    from flowrec.config import load_config

    given = [] if fps is None else [f"movie.rate_hz={fps}"]
    chosen = load_config(config, [*(sets or []), *given], dict.fromkeys(["movie.rate_hz"] if given else [], "--fps"))
    recorded = flowrec.import_movie(
        movie,
        out,
        chosen,
        coils=coils,
        times=times,
        fps=fps,
        partial=partial,
        overwrite=overwrite,
        control=AtTerminal(),
        inputs=[config] if config is not None else [],
        align=align,
        robot=robot,
    )
    if as_json:
        files = [str(file) for file in recorded.files]
        aligned = json.loads(recorded.source.get("alignment", "null"))
        covered = recorded.covered.as_json() if recorded.covered is not None else None
        found = {"path": str(recorded.path), **recorded.facts, "files": files, "alignment": aligned}
        typer.echo(json.dumps(found | {"covered": covered}))
    else:
        print_summary(recorded)
    raise typer.Exit(recorded.exit_status)
