"""DuckDB with one file and nothing else: an expression is parsed as one, and runs without files, network and settings.

What an expression may do is decided twice: its syntax tree is that of a condition over the catalog, and the connection
can open no other file, load no extension, change no setting, and is ended when it takes too long.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flowrec.cataloguing.format import KEY, PLACE, RELATIONS, SIGNATURE, About
from flowrec.commands.listed import LISTS, unknown_name
from flowrec.errors import UsageError

try:
    import duckdb
except ModuleNotFoundError as error:
    raise UsageError("find needs DuckDB, which is not installed: pip install 'flowrec[catalog]'") from error

TIMEOUT_S = 10.0
_MEMORY = "1GB"
_TABLE = "sessions"
AS_LIST = "[]"  # behind the name of a column of LISTS: its list rather than its text
_FUNCTIONS = ("unnest", "range", "generate_series")  # that an expression may have as a table
_PLAIN = ("modifiers", "group_expressions", "having", "qualify", "sample")  # that a condition does not have
_UNKNOWN_COLUMN = re.compile(r'Referenced (?:column|table) "([^"]+)" not found')
_UNKNOWN_MEMBER = re.compile(r'Could not find key "([^"]+)" in struct')
_TEXT_LIMIT = 200  # characters of what DuckDB says


class CatalogQuery:
    """A catalog, open for expressions; use it as a context manager.

    Attributes
    ----------
    about : what the file states of itself.
    columns : names of the columns of a session.
    members : names of the members of each of RELATIONS.

    Raises
    ------
    UsageError : it is no catalog, or of another format; from `rows`, if the expression is refused.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        file = str(path.absolute())
        self._connection = duckdb.connect(
            config={
                "threads": 1,
                "memory_limit": _MEMORY,
                "temp_directory": "",
                "max_temp_directory_size": "0KB",
                "autoinstall_known_extensions": False,
                "autoload_known_extensions": False,
                "allow_community_extensions": False,
                "python_enable_replacements": False,
            }
        )
        quoted = file.replace("'", "''")
        self._from = f"read_parquet('{quoted}')"
        try:
            self._connection.execute(
                f"SET allowed_paths = ['{quoted}']; SET enable_external_access = false; SET lock_configuration = true"
            )
            self.about = self._about()
            described = self._connection.execute(f"DESCRIBE FROM {self._from}").fetchall()
            types = {name: kind for name, kind, *_ in described}
            self.columns = [name for name in types if name not in (*RELATIONS, SIGNATURE, PLACE)]
            self.members = {name: self._members(name, types[name]) for name in RELATIONS}
            lists = [name for name in LISTS if name in types]
            texts = ", ".join(f"array_to_string({name}, ', ') AS {name}" for name in lists)
            raw = "".join(f', {name} AS "{name}{AS_LIST}"' for name in lists)
            star = f"* EXCLUDE ({SIGNATURE})" + (f" REPLACE ({texts})" if texts else "") + raw
            self._connection.execute(f"CREATE TEMP VIEW {_TABLE} AS SELECT {star} FROM {self._from}")  # noqa: S608
        except duckdb.Error as error:
            self.close()
            text = _first_line(error)
            raise UsageError(f"{path}: is no catalog ({text}); flowrec catalog makes one") from error
        except BaseException:
            self.close()
            raise

    def rows(self, where: str, sort: str, limit: int | None) -> tuple[list[str], list[dict[str, Any]]]:
        """Names of the columns that an expression mentions, and the rows that fulfil it, a dict of all columns each.

        A row has each mentioned column; RELATIONS are mentioned by a member, as in `sweep.refine`, and a session then
        has a row for each of its replays or events; one without any has one row, in which they are unknown.

        Parameters
        ----------
        where : SQL condition over the columns; '' chooses all.
        sort : a column, with a leading `-` from the largest; unknown values come last.
        limit : of the number of rows.
        """
        mentioned = self._mentioned(where) if where else []
        key = sort.removeprefix("-").strip().lower()
        order = ""
        if key:
            order = f"{self._sorted_by(key)} {'DESC' if sort.startswith('-') else 'ASC'} NULLS LAST, "
            mentioned.append(key)
        unnested = [name for name in RELATIONS if any(one.startswith(f"{name}.") for one in mentioned)]
        source = _TABLE
        for name in unnested:
            # One row for a session without members: it may be what is asked for.
            each = f"unnest(CASE WHEN len({name}) > 0 THEN {name} ELSE [NULL] END) AS {name}"
            source = f"(SELECT * REPLACE ({each}) FROM {source}) AS {_TABLE}"  # noqa: S608 - names of RELATIONS
        dropped = ", ".join(name for name in RELATIONS if name not in unnested)
        star = f"* EXCLUDE ({dropped})" if dropped else "*"
        # The expression is the user's own, and what it can do is bounded. A comment in it ends with its line.
        query = f"SELECT {star} FROM {source} WHERE (\n{where or 'true'}\n) ORDER BY {order} {PLACE}"  # noqa: S608
        if limit is not None:
            query += f" LIMIT {limit}"
        names, found = self._answer(query, where)
        shown = list(dict.fromkeys(name for name in mentioned if self._is_known(name)))
        return shown, [dict(zip(names, row, strict=True)) for row in found]

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def __enter__(self) -> CatalogQuery:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _about(self) -> About:
        query = f"SELECT value FROM parquet_kv_metadata(?) WHERE key = '{KEY}'"  # noqa: S608
        found = self._connection.execute(query, [str(self.path.absolute())]).fetchone()
        if found is None:
            raise UsageError(f"{self.path}: is no catalog of flowrec; flowrec catalog makes one")
        about = About.of(bytes(found[0]).decode(errors="replace"))
        if about is None:
            raise UsageError(f"{self.path}: is a catalog of another version of flowrec; flowrec catalog makes it anew")
        return about

    def _members(self, name: str, kind: str) -> list[str]:
        """Names of the members of a list of structures."""
        if not kind.endswith("[]"):
            raise UsageError(f"{self.path}: is a damaged catalog ({name}); flowrec catalog makes it anew")
        query = f"SELECT unnest(CAST(NULL AS {kind.removesuffix('[]')}), max_depth := 1) LIMIT 0"
        return [name for name, *_ in self._connection.execute(query).description or ()]

    def _mentioned(self, where: str) -> list[str]:
        """The columns that an expression mentions; UsageError if it is no condition over the catalog."""
        query = f"SELECT 1 FROM {_TABLE} WHERE (\n{where}\n)"  # noqa: S608 - parsed, not run
        tree = json.loads(self._connection.execute("SELECT json_serialize_sql(?)", [query]).fetchall()[0][0])
        if tree["error"]:
            # Only SELECT can be written as a tree: that message is about other statements.
            raise _refused(where, tree["error_message"])
        (statement,) = tree["statements"]
        node = statement["node"]
        is_condition = node["type"] == "SELECT_NODE" and node["from_table"].get("table_name") == _TABLE
        if not is_condition or any(node.get(part) for part in _PLAIN):
            raise _refused(where, "is more than a condition")
        names = []
        for each in _nodes(node["where_clause"]):
            kind = each.get("type")
            if kind == "TABLE_FUNCTION" and each["function"].get("function_name") not in _FUNCTIONS:
                raise _refused(where, f"{each['function'].get('function_name')} reads something else than the catalog")
            if kind == "COLUMN_REF":
                names.append(".".join(each["column_names"]).lower())
        return names

    def _sorted_by(self, key: str) -> str:
        relation, dot, member = key.partition(".")
        if not self._is_known(key):
            if dot and relation in RELATIONS:
                raise UsageError(unknown_name("--sort", key, _full(relation, self.members), RELATIONS[relation]))
            raise UsageError(unknown_name("--sort", key, self.columns))
        return f'{_TABLE}.{relation}."{member}"' if dot else f'{_TABLE}."{key}"'

    def _is_known(self, name: str) -> bool:
        relation, _, member = name.partition(".")
        return name in self.columns or member in (each.lower() for each in self.members.get(relation, ()))

    def _answer(self, query: str, where: str) -> tuple[list[str], list[tuple[Any, ...]]]:
        """Names of the columns and rows of a query; UsageError if it fails or takes too long."""
        timer = threading.Timer(TIMEOUT_S, self._connection.interrupt)
        timer.daemon = True
        timer.start()
        try:
            found = self._connection.execute(query)
            return [name for name, *_ in found.description or ()], found.fetchall()
        except duckdb.InterruptException as error:
            raise too_slow(where) from error
        except (duckdb.Error, MemoryError) as error:
            raise self._complaint(where, error) from error
        finally:
            timer.cancel()

    def _complaint(self, where: str, error: Exception) -> UsageError:
        text = str(error)
        if (found := _UNKNOWN_COLUMN.search(text)) is not None:
            names = [*self.columns, *(one for name in RELATIONS for one in _full(name, self.members))]
            return UsageError(
                unknown_name("find", found[1], names) + f" (a text stands in single quotes: '{found[1]}')"
            )
        if (found := _UNKNOWN_MEMBER.search(text)) is not None:
            relation = next((name for name in RELATIONS if f"{name}.{found[1]}".lower() in where.lower()), "")
            names = _full(relation, self.members) if relation else []
            return UsageError(unknown_name("find", f"{relation}.{found[1]}", names, RELATIONS.get(relation, "no")))
        return _refused(where, _first_line(error))


def _full(relation: str, members: dict[str, list[str]]) -> list[str]:
    return [f"{relation}.{member}" for member in members[relation]]


def _nodes(tree: Any) -> Iterator[dict[str, Any]]:
    """All nodes of a syntax tree."""
    waiting = [tree]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict):
            yield each
            waiting += reversed(list(each.values()))
        elif isinstance(each, list):
            waiting += reversed(each)


def too_slow(where: str) -> UsageError:
    """The complaint about an expression that does not end."""
    return _refused(where, f"takes longer than {TIMEOUT_S:g} s")


def _refused(where: str, why: str) -> UsageError:
    return UsageError(f"find {where!r}: {why}; as in find \"outcome = 'reached' and refined_flow_error < 0.05\"")


def _first_line(error: Exception) -> str:
    """What DuckDB says, in a line and without the kind of the error, which its text begins with."""
    text = str(error).strip().partition("\n")[0]
    text = text.partition(" Error: ")[2] or text or "needs too much memory"
    return text[:_TEXT_LIMIT]
