"""`flowrec find`: sessions of a catalog by an SQL condition."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import printable
from flowrec.verbs import Asked, MisuseError, Told, verb

if TYPE_CHECKING:
    from flowrec.archive.catalog.find import FoundSessions

_SHOWN_ROWS = 200  # of a table that find prints, unless more are asked for


def _output_of(asked: Asked, found: "FoundSessions") -> Told:
    def as_json() -> Any:
        if asked["paths"]:
            raise MisuseError("--paths and --json: name one")
        return found.as_json()

    if asked["paths"]:
        return Told(as_json, lambda: _print_paths(found.paths(), null=asked["null"]))
    return Told(as_json, lambda: _show(found, asked["limit"]))


def _show(found: "FoundSessions", limit: int | None) -> None:
    from flowrec.core import say, table, width

    title, count = found.title(), len(found.rows)
    found = replace(found, rows=found.rows[: limit or _SHOWN_ROWS])  # a table of thousands takes seconds
    doubtful = [number for number, row in enumerate(found.rows) if row.get("doubts")]
    columns, cells = found.cells(width())
    table(title, columns, cells, text="notes", amber=doubtful)
    for line in found.remarks():
        say(line)
    if count > len(found.rows):
        say(f"{count - len(found.rows)} rows more: --limit {count}, --paths and --json have all of them")


@verb(
    "flowrec find \"outcome = 'reached' and refined_flow_error < 0.05\" --sort -duration_s",
    "flowrec find \"sweep.place = 1 and sweep.refine = 'pi_unet'\" --paths",
    result=_output_of,
)
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
    limit: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Only the first N rows; a table has 200 unless stated.")
    ] = None,
    paths: Annotated[
        bool, typer.Option("--paths", help="Only the paths, one a line, as for xargs -d '\\n' flowrec check.")
    ] = False,
    null: Annotated[
        bool, typer.Option("--null", "-0", help="With --paths: a zero byte after each, as for xargs -0.")
    ] = False,
) -> "FoundSessions":
    """Find sessions in a catalog by an SQL condition (DuckDB); reads the catalog and no other file."""
    if null and not paths:
        raise MisuseError("--null goes with --paths")
    from flowrec.archive.catalog.find import find as search

    return search(where, catalog, sort, limit)


def _print_paths(paths: Sequence[str], *, null: bool) -> None:
    """Print the bytes of paths; on a terminal what it shows, because a name could hold its commands."""
    shown, end = sys.stdout.isatty(), b"\0" if null else b"\n"
    for path in paths:
        typer.echo(printable(path) if shown else os.fsencode(path) + end, nl=shown)
    if not null and any("\n" in path for path in paths):
        from flowrec.core import warn

        warn("a path holds a line feed: --null separates them by zero bytes, for xargs -0")
