"""`flowrec view`: open a session in the Rerun viewer, take a picture of it, or write layouts for viewers."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import typer

from flowrec.core import FlowrecError, UsageError
from flowrec.verbs.command import Told, verb
from flowrec.verbs.export import export, export_json
from flowrec.verbs.options import Overwrite

_RRD = b"RRF"  # with which a recording of Rerun begins


@verb(
    "flowrec view a.mcap",
    "flowrec view a.mcap --screenshot a.png --time 12",
    "flowrec view a.mcap --layout .",
    "flowrec view --live",
    "flowrec view --live --console",
)
def view(
    session: Annotated[
        Path | None, typer.Argument(help="Session (.mcap) or recording for Rerun (.rrd); with --live a run.")
    ] = None,
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
    live: Annotated[
        bool, typer.Option("--live", help="Show a run that is being recorded; the only one need not be named.")
    ] = False,
    console: Annotated[
        bool,
        typer.Option("--console", help="With --live: serve the page that steers the run, as record --console does."),
    ] = False,
    overwrite: Overwrite = False,
) -> Told:
    """Write the .rrd of a session and open it in Rerun, or show a run that is being recorded.

    Raises
    ------
    UsageError : outputs that do not go together; no session is named, or with `live` not one of several runs.
    SessionError : the session can not be read, or an output not be written; OutputError if it may not be.

    Notes
    -----
    Long because its parameters are the options of the verb.
    """
    from flowrec.core import PICTURE, Output
    from flowrec.store import existing_session, files_behind

    if live:
        return _watch(session, "serve" if no_open else "spawn", console, (beside, out, screenshot, time, layout))
    if console:
        raise UsageError("--console: steers a run that is being recorded; say --live, too")
    if session is None:
        raise UsageError("SESSION: name a session (.mcap), or --live for a run that is being recorded")
    if session.suffix == ".rrd" and not session.exists():
        raise FlowrecError(f"{session}: no such file; flowrec export makes one of a session")
    if session.suffix == ".rrd":
        _check_recording(session)
    else:
        existing_session(session)
    if beside is not None and ".rrd" in (session.suffix, beside.suffix):
        raise UsageError(f"{session} and {beside}: two sessions (.mcap) are shown in one view, not .rrd files")
    if layout is not None:
        if session.suffix == ".rrd" or any(value is not None for value in (beside, out, screenshot, time)):
            raise UsageError(f"--layout {layout}: is for one session (.mcap) and goes with no other output")
        return _write_layouts(session, layout, overwrite)
    if screenshot is not None:
        Output(screenshot, PICTURE, tuple(files_behind(session)), overwrite).check()
    if time is not None:
        _check_time(session, time, screenshot)
    from flowrec.view import open_viewer
    from flowrec.view import screenshot as take

    rrd, told = _recording(session, beside, out, overwrite)
    if screenshot is not None:
        told += [*take(rrd, screenshot, time_s=time, overwrite=overwrite), f"{screenshot} written"]
    elif not no_open:
        told += filter(None, [open_viewer(rrd)])
    return Told(lambda: export_json(session, rrd), remarks=lambda: told)


def _check_recording(file: Path) -> None:
    """Refuse what is no recording of Rerun: its viewer would be waited for."""
    try:
        with file.open("rb") as opened:
            begins = opened.read(len(_RRD))
    except OSError as error:
        raise FlowrecError(f"{file}: can not be read ({error.strerror or error}); check its permissions") from error
    if begins != _RRD:
        raise FlowrecError(f"{file}: is no recording of Rerun; flowrec export makes one of a session")


def _check_time(session: Path, time_s: float, screenshot: Path | None) -> None:
    from flowrec.store import Session

    if screenshot is None:
        raise UsageError(f"--time {time_s:g}: is the time of a picture; say --screenshot PNG, too")
    if session.suffix != ".rrd":
        Session.of(session).stamp_ns(time_s, "--time")


def _recording(session: Path, beside: Path | None, out: Path | None, overwrite: bool) -> tuple[Path, list[str]]:
    """The .rrd of a session, made unless these files already have one; and a remark."""
    if session.suffix == ".rrd":
        return session, []
    from flowrec.exports import kept_rrd
    from flowrec.store import Session

    opened, second = Session.of(session), None if beside is None else Session.of(beside)
    kept = None if overwrite else kept_rrd(opened, out, second)
    if kept is not None:
        return kept, [f"{kept} is as it was made of this session"]
    return export(opened, out, overwrite, "rrd", second), []


def _watch(session: Path | None, mode: Literal["spawn", "serve"], console: bool, outputs: Iterable[object]) -> Told:
    if any(value is not None for value in outputs):
        raise UsageError("--live: shows a run that is being recorded, and writes no file")
    from flowrec.verbs.watching import watch

    return Told(after=lambda: watch(session, mode, console=console))


def _write_layouts(session: Path, folder: Path, overwrite: bool) -> Told:
    from flowrec.exports import write_layouts

    made = write_layouts(session, folder, overwrite)
    found = {"session": session, "foxglove": made.foxglove, "rerun": made.rerun}
    return Told(lambda: {key: str(path) for key, path in found.items()}, remarks=lambda: made.advice)
