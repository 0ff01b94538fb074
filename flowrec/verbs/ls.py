"""`flowrec ls`: the sessions of files and folders, one row each."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from flowrec.core import UsageError
from flowrec.store import session_path
from flowrec.verbs.command import verb
from flowrec.verbs.listed import ListedSession, columns_for_people, is_doubtful


class Listing(list[ListedSession]):
    """Sessions as rows; `places` are those that were asked for."""

    places: Sequence[Path]

    def as_json(self) -> list[dict[str, Any]]:
        return [row.as_json() for row in self]

    def show(self) -> None:
        """Print the rows as a table, and why some can not be read."""
        from flowrec.core import say, table, width

        if not self.places:
            say("no run is being recorded")
            return
        doubtful = [number for number, row in enumerate(self) if is_doubtful(row)]
        title = ", ".join(map(str, self.places))
        if not self:
            say(f"{title}: no session (.mcap) is there, or none that is asked for")
            return
        table(title, *columns_for_people(self, width()), text="notes", amber=doubtful)
        for row in self:
            if row.duration_s is None:
                say(f"{row.name}: {row.note}")


@verb(
    "flowrec ls runs",
    "flowrec ls --live",
    "flowrec ls s3://lab/runs/",
    'flowrec ls runs/*.mcap --where "refined_flow_error < 0.05" --sort -duration_s',
)
def ls(
    places: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[PLACE]...",
            help="Directories and sessions, also in a bucket (s3://lab/runs/); by default this one.",
        ),
    ] = None,
    where: Annotated[
        str, typer.Option(metavar="SQL", help="Only sessions for which this holds, of the facts of flowrec info.")
    ] = "",
    sort: Annotated[str, typer.Option(metavar="FACT", help="Sort by this fact; -FACT: the largest first.")] = "",
    live: Annotated[bool, typer.Option("--live", help="Those that are being recorded on this machine.")] = False,
) -> Listing:
    """List sessions, unfinished and unreadable ones included.

    Returns
    -------
    The sessions by name, or as they were sorted: unknown values come last.

    Raises
    ------
    SessionError : there is no such folder or file.
    UsageError : the expression is not valid, or names a fact that no session has; DuckDB is not installed; `live` goes
        with no place.
    """
    from flowrec.verbs.listing import list_sessions

    if live:
        if places:
            raise UsageError(f"{places[0]}: --live lists the runs of this machine, wherever they are")
        from flowrec.store import live_runs

        places = [run.path for run in live_runs()]
    places = [session_path(place) for place in places or ([] if live else [Path()])]
    listing = Listing(list_sessions(places, where, sort))
    listing.places = places
    return listing
