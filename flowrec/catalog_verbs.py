"""The verbs catalog and find: arguments in, exit status out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from flowrec.bench.verbs import AsJson


def catalog(
    places: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PLACE]...",
            help="Directories with all below them, sessions, URLs; by default those of the catalog, or this directory.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Catalog to write (.parquet); by default flowrec-catalog.parquet in the directory."
        ),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option("--serve", help="Then serve sessions to Rerun's viewer and catalog clients of this machine."),
    ] = False,
    where: Annotated[str, typer.Option(metavar="SQL", help="With --serve: of which sessions, as of find.")] = "",
    port: Annotated[
        int | None, typer.Option(metavar="PORT", min=1, max=65535, help="With --serve; by default a free one.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write one table about all sessions of some places, which find searches; only what has changed is read again."""
    if not serve and (where or port is not None):
        raise typer.BadParameter("--where and --port go with --serve; flowrec find searches a catalog")
    from flowrec.cataloguing.refresh import refresh
    from flowrec.terminal import progress, say

    with progress("reading sessions", 1.0) as done:
        refreshed = refresh(places or (), out, done)
    if as_json:
        typer.echo(json.dumps(refreshed.as_json()))
    for line in refreshed.lines():
        say(line)
    if refreshed.left:
        raise typer.Exit(130)
    if serve:
        _serve(refreshed.path, where, port)


def find(
    where: Annotated[
        str,
        typer.Argument(
            metavar="[SQL]",
            help="What must hold, of the facts of flowrec info, of sweep.* and events.*; by default all.",
        ),
    ] = "",
    catalog: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Catalog; by default that of this directory or the next above.")
    ] = None,
    sort: Annotated[str, typer.Option(metavar="FACT", help="Sort by this fact; -FACT: the largest first.")] = "",
    limit: Annotated[int | None, typer.Option(metavar="N", min=1, help="Only the first N rows.")] = None,
    paths: Annotated[
        bool, typer.Option("--paths", help="Only the paths, one a line, as for xargs -d '\\n' flowrec check.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Find sessions in a catalog by an SQL condition (DuckDB); reads the catalog and no other file."""
    if paths and as_json:
        raise typer.BadParameter("--paths and --json: name one")
    from flowrec.cataloguing.bounds import process_bounds
    from flowrec.cataloguing.find import find as search
    from flowrec.cataloguing.sql import TIMEOUT_S, too_slow

    with process_bounds(TIMEOUT_S + 2.0, str(too_slow(where))):
        found = search(where, catalog, sort, limit)
    if as_json:
        typer.echo(json.dumps(found.as_json()))
    elif paths:
        for path in found.paths():
            typer.echo(path)
    else:
        from flowrec.terminal import say, table, width

        table(found.title(), *found.cells(width()), text="notes")
        for line in found.remarks():
            say(line)


def _serve(catalog: Path, where: str, port: int | None) -> None:
    """Serve until Ctrl-C or a signal to end."""
    import signal
    import threading

    from flowrec.cataloguing.serve import recordings_of
    from flowrec.terminal import say
    from flowrec.view.catalog_server import DATASET, served

    recordings = recordings_of(catalog, where, say)
    with served(recordings, port) as url:
        ended = threading.Event()
        before = {each: signal.signal(each, lambda *_: ended.set()) for each in (signal.SIGINT, signal.SIGTERM)}
        say(f"{url}: dataset {DATASET} of {len(recordings)}; open it with: rerun {url}")
        say("Ctrl-C ends the server")
        ended.wait()
        for each, handler in before.items():
            signal.signal(each, handler)
