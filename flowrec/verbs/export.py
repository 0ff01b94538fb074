"""A session in other files: `flowrec export` and `view`, and `report`, one page about it, or about a sweep."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from flowrec.core import FlowrecError, UsageError
from flowrec.verbs.command import MethodsOf, Told, verb
from flowrec.verbs.options import AnySession, Asked, Overwrite, SessionFile, from_above


def export_json(session: AnySession, made: Path, file_format: str = "rrd") -> dict[str, Any]:
    """The file or the folder of an export for JSON, with its size."""
    files = [made] if made.is_file() else [file for file in made.rglob("*") if file.is_file()]
    return {"session": str(session), file_format: str(made), "bytes": sum(file.stat().st_size for file in files)}


def _export_told(asked: Asked, made: Path) -> Told:
    from flowrec.core import looked_at

    covered = {"covered": looked_at()[-1].as_json()}
    return Told(lambda: export_json(asked["session"], made, asked["file_format"]) | covered)


@verb("flowrec export a.mcap", "flowrec export a.mcap tables --format parquet", result=_export_told)
def export(
    session: SessionFile,
    out: Annotated[
        Path | str | None,
        typer.Option(
            "--out",
            "-o",
            help="The same as OUT; by default beside the session, where it replaces an export of that session.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    file_format: Annotated[
        str,
        typer.Option("--format", metavar="FORMAT", help="Format of the output."),
        MethodsOf("flowrec.exports.formats:EXPORTS"),
    ] = "rrd",
    beside: AnySession | None = None,
    directory: Annotated[
        Path | str | None, typer.Argument(metavar="[OUT]", help="File or folder to write, or a folder for the file.")
    ] = None,
) -> Path:
    """Convert a session to another format, such as a recording for Rerun (.rrd).

    Parameters
    ----------
    beside : of rrd: another session of the same chip and camera, shown on the same timeline and scale.

    Returns
    -------
    The file or folder. A format whose name has a suffix is also written into an existing folder, under the session's
    name. An earlier export of the same session is replaced if nothing in it was changed since, by its hash; a file only
    under the default name. `overwrite` replaces any existing file, and any folder that an export made, but nothing that
    is read.

    Raises
    ------
    UsageError : there is no such format, or what it needs is not installed.
    SessionError : the session can not be read, or the output not be written; OutputError if it may not be.
    """
    if out is not None and directory is not None:
        raise UsageError(f"{directory} and --out {out}: name the output once")
    from flowrec.exports import export as write

    return write(session, out if out is not None else directory, overwrite, file_format, beside)


@verb(
    "flowrec view a.mcap",
    "flowrec view a.mcap --screenshot a.png --time 12",
    "flowrec view a.mcap --layout .",
)
def view(
    session: Annotated[Path, typer.Argument(help="Session (.mcap) or recording for Rerun (.rrd).")],
    beside: Annotated[
        Path | None, typer.Argument(metavar="[OTHER]", help="Another session of the same chip, in the same view.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="File to write; by default beside the session, where it replaces an .rrd of that session.",
        ),
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Save a picture of the viewer instead of opening it.")
    ] = None,
    time: Annotated[float | None, typer.Option(metavar="S", help="Session time of the screenshot.")] = None,
    layout: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write layouts into this folder by which Foxglove (.json) and Rerun (.rbl) show the .mcap itself.",
        ),
    ] = None,
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the .rrd.")] = False,
    overwrite: Overwrite = False,
) -> Told:
    """Write the .rrd of a session and open it in Rerun.

    Raises
    ------
    UsageError : outputs that do not go together.
    SessionError : the session can not be read, or an output not be written; OutputError if it may not be.
    """
    from flowrec.core import PICTURE, Output
    from flowrec.store import files_behind
    from flowrec.view import open_viewer
    from flowrec.view import screenshot as take

    if session.suffix == ".rrd" and not session.exists():
        raise FlowrecError(f"{session}: no such file; flowrec export makes one of a session")
    if beside is not None and ".rrd" in (session.suffix, beside.suffix):
        raise UsageError(f"{session} and {beside}: two sessions (.mcap) are shown in one view, not .rrd files")
    if layout is not None:
        if session.suffix == ".rrd" or any(value is not None for value in (beside, out, screenshot, time)):
            raise UsageError(f"--layout {layout}: is for one session (.mcap) and goes with no other output")
        from flowrec.exports import write_layouts

        made = write_layouts(session, layout, overwrite)
        found = {"session": session, "foxglove": made.foxglove, "rerun": made.rerun}
        return Told(lambda: {key: str(path) for key, path in found.items()}, remarks=lambda: made.advice)
    if screenshot is not None:
        Output(screenshot, PICTURE, tuple(files_behind(session)), overwrite).check()
    rrd = session if session.suffix == ".rrd" else export(session, out, overwrite, beside=beside)
    told: list[str] = []
    if screenshot is not None:
        told += [*take(rrd, screenshot, time_s=time, overwrite=overwrite), f"{screenshot} written"]
    elif not no_open:
        told += filter(None, [open_viewer(rrd)])
    return Told(lambda: export_json(session, rrd), remarks=lambda: told)


def _report_told(asked: Asked, page: Path) -> Told:
    figures = {"figures": str(asked["figures"])} if asked["figures"] is not None else {}
    return Told(lambda: {"session": str(asked["session"]), "html": str(page), "bytes": page.stat().st_size} | figures)


@verb(
    "flowrec report a.mcap",
    "flowrec report a.mcap a_replay_001.mcap -o report.html --figures figures",
    "flowrec report sweep.parquet -o sweep.html",
    result=_report_told,
)
def report(
    session: SessionFile,
    replays: Annotated[
        list[Path] | Sequence[AnySession] | None,
        typer.Argument(metavar="[REPLAY]...", help="Replays of it (.mcap), compared with it."),
    ] = None,
    out: Annotated[
        Path | str | None, typer.Option("--out", "-o", help="Page to write (.html); SESSION_report.html by default.")
    ] = None,
    figures: Annotated[
        Path | str | None, typer.Option(metavar="DIR", help="Write the figures, too, as SVG and PDF of 88 and 180 mm.")
    ] = None,
    overwrite: Overwrite = False,
) -> Path:
    """Write one page (HTML) about a session, to read, print or send: outcome, path, flow before and after, losses.

    Of a table of flowrec sweep (.parquet): the ranking of its settings.

    Returns
    -------
    The path of the page, which needs no network and no script.

    Raises
    ------
    UsageError : a package of the extra `report` is not installed, or a replay is not one of this session.
    SessionError : a session can not be read, or an output not be written; OutputError if it may not be.
    """
    if isinstance(session, Path | str) and Path(session).suffix == ".parquet":
        if replays or figures is not None:
            raise UsageError(f"{session}: the page of a sweep goes without replays and --figures")
        page: Path = from_above("report_sweep")(Path(session), None if out is None else Path(out), overwrite)
        return page
    from flowrec.verbs.report_page import write_report

    return write_report(session, replays or (), out, figures, overwrite)
