"""`flowrec find`: the sessions of a catalog that fulfil an SQL expression. Reads the catalog and nothing else."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowrec.archive.catalog.format import KEY, PLACE, RELATIONS, SIGNATURE, About, catalog_above, path_of
from flowrec.core import UsageError, printable, text_of_figure
from flowrec.store import UrlPath
from flowrec.verbs import (
    AS_LIST,
    LISTS,
    ListedSession,
    SessionTable,
    SqlError,
    columns_for_people,
    connect,
    first_line,
    text_of_list,
)

_SHOWN_ALWAYS = ("name", "outcome", "duration_s", "size_bytes", "chip", "recorded", "path", "tags", "notes_added")
_IN_FLOW_ERROR = ("assumed_flow_error", "refined_flow_error")


@dataclass(frozen=True, slots=True)
class FoundSessions:
    """Rows of a catalog that match an expression."""

    catalog: Path  # the file
    about: About
    # values by column, of the session and, where the expression mentions them, of a replay or an event each
    rows: list[dict[str, Any]]
    mentioned: list[str]  # columns that the expression names

    def paths(self) -> list[str]:
        """The sessions, each once, as they are named from this folder; `os.fsencode` makes the bytes of their names."""
        return list(dict.fromkeys(self._place_text(row) for row in self.rows))

    def as_json(self) -> dict[str, Any]:
        """All known values of the rows, and what they are from."""
        rows = [
            # A list takes the place of its text.
            {name.removesuffix(AS_LIST): value for name, value in row.items() if value is not None and name != PLACE}
            | {"path": self._path(row)}
            for row in self.rows
        ]
        return {"catalog": str(self.catalog), "made": self.about.made, "of": self.about.sessions, "sessions": rows}

    def remarks(self) -> list[str]:
        """Reasons why sessions are incomplete, a line each."""
        broken = {self._path(row): row["note"] for row in self.rows if row["duration_s"] is None}
        return [f"{path}: {note}" for path, note in broken.items()]

    def title(self) -> str:
        """Number of matches, the catalog that was searched, and its age."""
        number = len({row[PLACE] for row in self.rows})
        left = f", {self.about.left} not read yet" if self.about.left else ""
        made = self.about.made[:16].replace("T", " ")
        catalog = printable(self._relative(self.catalog))
        return f"{number} of {self.about.sessions} sessions, as of {made} UTC{left} ({catalog})"

    def cells(self, width: int) -> tuple[list[str], list[list[str]]]:
        """Names of the columns and the cells as `flowrec ls` has them, and what else the expression mentions."""
        own = ("notes", "doubts", "replay_of", *_IN_FLOW_ERROR)
        listed = [
            ListedSession(
                self._path(row),
                row["outcome"] or "",
                row["note"] or "",
                row["size_bytes"] or 0,
                row["duration_s"],
                row["chip"] or "",
                row["recorded"] or "",
                row["parts"] or 0,
                {name: row.get(name) for name in own} | {name: row.get(name + AS_LIST) or () for name in LISTS},
            )
            for row in self.rows
        ]
        more = [name for name in self.mentioned if name not in (*_SHOWN_ALWAYS, *_IN_FLOW_ERROR, *RELATIONS)]
        values = {name: [_cell(name, row) for row in self.rows] for name in more}
        taken = sum(3 + max(map(len, (name, *column))) for name, column in values.items())
        names, lines = columns_for_people(listed, width - taken)
        at = names.index("notes") if "notes" in names else len(names)  # the notes are last
        names[at:at] = more
        for number, line in enumerate(lines):
            line[at:at] = [column[number] for column in values.values()]
        return names, lines

    def _place_text(self, row: Mapping[str, Any]) -> str:
        return self._relative(path_of(os.fsdecode(row[PLACE]), self.catalog.parent))

    def _path(self, row: Mapping[str, Any]) -> str:
        return printable(self._place_text(row))

    @staticmethod
    def _relative(path: Path) -> str:
        """A path as it is named from this folder, if it is below it."""
        here = Path().absolute()
        below = not isinstance(path, UrlPath) and path.is_relative_to(here)
        return os.path.relpath(path, here) if below else str(path)


def find(where: str = "", catalog: Path | None = None, sort: str = "", limit: int | None = None) -> FoundSessions:
    """The sessions of a catalog for which an SQL expression holds, of the columns of `flowrec ls --where` and more.

    `sweep.refine`, `sweep.replayed_refined_flow_error` and so on are of the session's replays in tables of `flowrec
    sweep`, `sweep.place` is 1 for the best of them; `events.time_s`, `events.action` and `events.text` are of what the
    operator did. A session then has a row for each replay or event. Raises UsageError: there is no catalog, or the
    expression is refused.

    Parameters
    ----------
    catalog : the file, or its folder; None: the one of this folder, or of the next one above that has one.
    sort : a column, with a leading `-` from the largest.
    limit : of the number of rows.
    """
    path = catalog_above(catalog).absolute()
    with open_catalog(path) as (about, table):
        mentioned, rows = table.rows(where, sort, limit)
        return FoundSessions(path, about, rows, mentioned)


@contextmanager
def open_catalog(path: Path) -> Iterator[tuple[About, SessionTable]]:
    """Context with what a catalog states of itself, and its sessions; UsageError: no catalog, or of another format."""
    with connect() as connection:
        try:
            about = _about(connection, path)
            described = connection.execute("DESCRIBE FROM read_parquet(?)", [str(path)]).fetchall()
            lists = [name for name, *_ in described if name in LISTS]
            texts = ", ".join(f"array_to_string({name}, ', ') AS {name}" for name in lists)
            raw = "".join(f', {name} AS "{name}{AS_LIST}"' for name in lists)
            star = f"* EXCLUDE ({SIGNATURE})" + (f" REPLACE ({texts})" if texts else "") + raw
            query = f"CREATE TABLE sessions AS SELECT {star} FROM read_parquet(?)"  # noqa: S608 - names of LISTS
            connection.execute(query, [str(path)])
            table = SessionTable(connection, "find", PLACE, RELATIONS)
        except SqlError as error:
            raise UsageError(f"{path}: is no catalog ({first_line(error)}); flowrec catalog makes one") from error
        yield about, table


def _about(connection: Any, path: Path) -> About:
    query = "SELECT value FROM parquet_kv_metadata(?) WHERE key = ?"
    found = connection.execute(query, [str(path), KEY.encode()]).fetchone()
    if found is None:
        raise UsageError(f"{path}: is no catalog of flowrec; flowrec catalog makes one")
    about = About.of(bytes(found[0]).decode(errors="replace"))
    if about is None:
        raise UsageError(f"{path}: is a catalog of another version of flowrec; flowrec catalog makes it anew")
    return about


def _cell(name: str, row: Mapping[str, Any]) -> str:
    relation, _, member = name.partition(".")
    value = row.get(name)
    if member:
        found = {key.lower(): each for key, each in (row.get(relation) or {}).items()}
        value = found.get(member)
    return text_of_figure(member or name, text_of_list(map(str, value)) if isinstance(value, list) else value)
