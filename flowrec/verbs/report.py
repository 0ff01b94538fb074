"""`flowrec report`: one page about a session and its replays, or about a sweep."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from flowrec.core import UsageError
from flowrec.verbs.command import Told, verb
from flowrec.verbs.options import AnySession, Asked, Overwrite, SessionFile, from_above, require_packages


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
        return from_above("report_sweep")(Path(session), None if out is None else Path(out), overwrite)
    require_packages()
    from flowrec.verbs.report_page import write_report

    return write_report(session, replays or (), out, figures, overwrite)
