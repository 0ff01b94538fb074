"""Sessions as a table of DuckDB that an SQL condition chooses from: `flowrec ls --where` and `flowrec find`.

The table is in memory. Once it is filled, DuckDB opens no file, reaches no network, loads no extension and changes no
setting, whatever a condition says. How long a condition takes is up to its author: Ctrl-C ends it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from flowrec.core import UsageError, needs
from flowrec.verbs.listed import unknown_name

with needs("a condition of find or ls --where", "catalog", "DuckDB"):
    import duckdb

AS_LIST = "[]"  # behind the name of a column of LISTS: its list rather than its text
SqlError = duckdb.Error
_UNKNOWN_COLUMN = re.compile(r'Referenced (?:column|table) "([^"]+)" not found')
_UNKNOWN_MEMBER = re.compile(r'Could not find key "([^"]+)" in struct')
_TEXT_LIMIT = 200  # characters of what DuckDB says


def connect() -> Any:
    """A connection with an empty database in memory, which is a context manager; fill its table `sessions`."""
    return duckdb.connect(
        config={
            "threads": 1,  # Ctrl-C would wait for the work of others
            "temp_directory": "",
            "autoinstall_known_extensions": False,
            "python_enable_replacements": False,
        }
    )


class SessionTable:
    """The filled table `sessions` of a connection, closed to all else from now on.

    `columns`: names that a condition can use.

    Parameters
    ----------
    option : of the command line that holds the condition, for complaints.
    key : column that tells the rows apart and orders them; a condition need not know it.
    relations : columns that are lists of structures, and what a complaint says of a member that they do not have.
    """

    def __init__(self, connection: Any, option: str, key: str, relations: Mapping[str, str] | None = None) -> None:
        self.connection, self._option, self._key, self._relations = connection, option, key, relations or {}
        connection.execute("SET enable_external_access = false; SET lock_configuration = true")
        own = (key, *self._relations)
        self.columns = [name for name in self._names("*") if name not in own and not name.endswith(AS_LIST)]
        self._members = {
            each: [f"{each}.{name}" for name in self._names(f"unnest({each}[1])")] for each in self._relations
        }

    def rows(self, where: str, sort: str = "", limit: int | None = None) -> tuple[list[str], list[dict[str, Any]]]:
        """Names of the columns that a condition mentions, and the rows that fulfil it, a dict of all columns each.

        A row has each mentioned column; relations are mentioned by a member, as in `sweep.refine`, and a session then
        has a row for each of its replays or events; one without any has one row, in which they are unknown. Raises
        UsageError: DuckDB refuses the condition, or no column has the name of `sort`.

        Parameters
        ----------
        where : SQL condition over the columns; '' chooses all.
        sort : a column, with a leading `-` from the largest; unknown values come last.
        limit : of the number of rows.
        """
        mentioned = self._columns_in(where) if where else []
        key = sort.removeprefix("-").strip().lower()
        order = ""
        if key:
            order = f"{self._sorted_by(key)} {'DESC' if sort.startswith('-') else 'ASC'} NULLS LAST, "
            mentioned.append(key)
        unnested = [name for name in self._relations if any(one.startswith(f"{name}.") for one in mentioned)]
        source = "sessions"
        for name in unnested:
            # One row for a session without members: it may be what is asked for.
            each = f"unnest(CASE WHEN len({name}) > 0 THEN {name} ELSE [NULL] END) AS {name}"
            source = f"(SELECT * REPLACE ({each}) FROM {source}) AS sessions"  # noqa: S608 - names of relations
        dropped = ", ".join(name for name in self._relations if name not in unnested)
        star = f"* EXCLUDE ({dropped})" if dropped else "*"
        # A comment in the condition ends with its line.
        query = f"SELECT {star} FROM {source} WHERE (\n{where or 'true'}\n) ORDER BY {order} {self._key}"  # noqa: S608
        try:
            found = self.connection.execute(query if limit is None else f"{query} LIMIT {limit}")
            names, rows = [name for name, *_ in found.description], found.fetchall()
        except (SqlError, MemoryError) as error:
            raise self._complaint(where, error) from error
        shown = list(dict.fromkeys(name for name in mentioned if self._is_known(name)))
        return shown, [dict(zip(names, row, strict=True)) for row in rows]

    def _names(self, what: str) -> list[str]:
        return [name for name, *_ in self.connection.execute(f"SELECT {what} FROM sessions LIMIT 0").description]  # noqa: S608

    def _columns_in(self, where: str) -> list[str]:
        """The columns that a condition mentions; none if it can not be parsed."""
        names: list[str] = []

        def look(node: dict[str, Any]) -> None:
            if "column_names" in node:
                names.append(".".join(node["column_names"]).lower())

        query = f"SELECT 1 FROM sessions WHERE (\n{where}\n)"  # noqa: S608 - parsed, not run
        json.loads(self.connection.execute("SELECT json_serialize_sql(?)", [query]).fetchone()[0], object_hook=look)
        return names

    def _sorted_by(self, key: str) -> str:
        relation, dot, member = key.partition(".")
        if not self._is_known(key):
            if dot and relation in self._relations:
                raise UsageError(unknown_name("--sort", key, self._members[relation], self._relations[relation]))
            raise UsageError(unknown_name("--sort", key, self.columns))
        return f'sessions.{relation}."{member}"' if dot else f'sessions."{key}"'

    def _is_known(self, name: str) -> bool:
        members = self._members.get(name.partition(".")[0], ())
        return name in self.columns or name in (each.lower() for each in members)

    def _complaint(self, where: str, error: Exception) -> UsageError:
        text = str(error)
        if (found := _UNKNOWN_COLUMN.search(text)) is not None:
            names = [*self.columns, *(one for each in self._members.values() for one in each)]
            quotes = f" (a text stands in single quotes: '{found[1]}')"
            return UsageError(unknown_name(self._option, found[1], names) + quotes)
        if (found := _UNKNOWN_MEMBER.search(text)) is not None:
            for relation, says in self._relations.items():
                if (name := f"{relation}.{found[1]}").lower() in where.lower():
                    return UsageError(unknown_name(self._option, name, self._members[relation], says))
        example = f"{self._option} \"outcome = 'reached' and refined_flow_error < 0.05\""
        return UsageError(f"{self._option} {where!r}: {first_line(error)}; as in {example}")


def first_line(error: Exception) -> str:
    """First line of an error of DuckDB, without the kind of the error, which its text begins with."""
    text = str(error).strip().partition("\n")[0]
    return (text.partition(" Error: ")[2] or text or "needs too much memory")[:_TEXT_LIMIT]
