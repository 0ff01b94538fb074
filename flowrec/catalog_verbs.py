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
    as_json: AsJson = False,
) -> None:
    """Write one table about all sessions of some places, which find searches; only what has changed is read again."""
    from flowrec.cataloguing.refresh import refresh
    from flowrec.terminal import progress, say

    with progress("reading sessions", 1.0) as done:
        refreshed = refresh(places or (), out, done)
    if as_json:
        typer.echo(json.dumps(refreshed.as_json()))
    for line in refreshed.lines():
        say(line)
    raise typer.Exit(130 if refreshed.left else 0)


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
