"""`flowrec ls`: the sessions of files and folders, one row each, chosen and sorted by their facts.

Reads heads and indexes only, however large the sessions are. A choice is an SQL expression over the facts that
`flowrec info` shows, evaluated by SQLite in memory; `flowrec find` has the same columns.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from flowrec.commands.info import info
from flowrec.commands.listed import ALWAYS, LISTS, Listed, columns_of, joined, unknown_name
from flowrec.errors import SessionError, UsageError
from flowrec.session import Session
from flowrec.store.run_files import PARTIAL_SUFFIX, SUFFIX, part_number, run_files, run_path
from flowrec.store.session_path import UrlPath, session_path
from flowrec.system.locks import is_growing

_TOGETHER = 16  # sessions at URLs that are read at a time
NAMES = (SUFFIX, SUFFIX + PARTIAL_SUFFIX)  # ends of the names of sessions, finished or not
T = TypeVar("T")
R = TypeVar("R")
_EXACT = 2**53  # integers below are exact as floating-point numbers
# What an expression of --where may do: read the table and call functions, nothing else.
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION)


def list_sessions(*places: Path, where: str = "", sort: str = "") -> list[Listed]:
    """The sessions in folders and files by name, unfinished and unreadable ones included.

    Parameters
    ----------
    places : folders and session files.
    where : SQL expression over the facts that a session must fulfil, such as `refined_flow_error < 0.05`.
    sort : a fact by which the rows are sorted, with a leading `-` from the largest; unknown values come last.

    Raises
    ------
    SessionError : there is no such folder or file.
    UsageError : the expression is not valid, or names a fact that no session has.
    """
    rows = runs_of(path for place in places for path in _files(place))
    apart = len({path.parent for path in rows}) > 1

    def read(path: Path) -> Listed:
        return describe(path, rows[path], str(path) if apart else path.name)[0]

    with read_each(read, rows, far=any(isinstance(path, UrlPath) for path in rows)) as listed:
        found = dict(zip(rows, listed, strict=True))
    return _chosen(found, where, sort) if where or sort else list(found.values())


@contextmanager
def read_each(read: Callable[[T], R], sessions: Iterable[T], far: bool) -> Iterator[Iterator[R]]:
    """Context with what `read` returns of each session, in their order.

    What has not begun when the context is left is not read: a person who interrupts does not wait for it.

    Parameters
    ----------
    far : some are at URLs, where each waits for its server: many are read at a time.
    """
    if not far:
        yield map(read, sessions)
        return
    threads = ThreadPoolExecutor(_TOGETHER, "sessions")
    try:
        yield threads.map(read, sessions)
    finally:
        threads.shutdown(wait=False, cancel_futures=True)


def runs_of(files: Iterable[Path]) -> dict[Path, list[Path]]:
    """The sessions that files make up, in order of name: each file, or a run with its parts."""
    rows: dict[Path, list[Path]] = {}
    named = set(files)
    for path in sorted(named):
        run = path
        if ".part" in path.name and part_number(path):
            # Beside a file of that name the parts are not what opens under it: each is a session of its own.
            run = run_path(path) if run_path(path) not in named else path
        rows.setdefault(run, []).append(path)
    return rows


def describe(path: Path, files: Sequence[Path], name: str) -> tuple[Listed, Session | SessionError]:
    """The row of a session, and the session or why it can not be opened.

    Parameters
    ----------
    files : its own, as `runs_of` returns them.
    name : which the row has.
    """
    try:
        session = Session(path)
        facts = info(session)
        row = Listed(
            name,
            facts["outcome"],
            facts["note"],
            facts["size_bytes"],
            facts["duration_s"],
            facts["chip"],
            facts["recorded"],
            facts["parts"] or (len(files) if list(files) != [path] else 0),
            {**facts, "operator_events": session.topics.get("/operator/events", 0)},
        )
    except SessionError as error:
        size = sum(file.stat().st_size for file in files if file.is_file())
        unfinished = any(file.name.endswith(PARTIAL_SUFFIX) for file in files)
        what = "recording" if any(map(is_growing, files)) else "unfinished" if unfinished else "unreadable"
        parts = len(files) if list(files) != [path] else 0
        return Listed(name, what, str(error).removeprefix(f"{path}: "), size, parts=parts), error
    return row, session


def _files(place: Path) -> list[Path]:
    place = session_path(place)
    if isinstance(place, UrlPath):
        from flowrec.store.remote_folder import files_at  # late: an extra

        return files_at(place, NAMES)
    if not place.is_dir():
        files = [place] if place.is_file() else run_files(place)
        if not files or not place.name.endswith(NAMES):
            raise SessionError(f"{place}: no such directory or session; flowrec ls lists directories and .mcap files")
        return files
    try:
        return [path for path in place.iterdir() if path.is_file() and path.name.endswith(NAMES)]
    except OSError as error:
        raise SessionError(f"{place}: can not be listed ({error.strerror}); check its permissions") from error


def _chosen(rows: dict[Path, Listed], where: str, sort: str) -> list[Listed]:
    """The rows that fulfil an SQL expression, in order of a fact."""
    facts = [columns_of(row, path.as_posix()) for path, row in rows.items()]
    names = sorted({*ALWAYS, *(name for one in facts for name in one)})
    key = sort.removeprefix("-").strip().lower()
    if key and key not in names:
        raise UsageError(unknown_name("--sort", key, names))
    columns = ", ".join(map(_quoted, names))
    connection = sqlite3.connect(":memory:")
    try:
        connection.execute(f"CREATE TABLE sessions (row_number, {columns})")
        connection.execute("PRAGMA case_sensitive_like = ON")  # as in `flowrec find`
        insert = f"INSERT INTO sessions VALUES ({', '.join('?' * (len(names) + 1))})"  # noqa: S608 - marks only
        connection.executemany(
            insert, [(k, *(_sql_value(name, one.get(name)) for name in names)) for k, one in enumerate(facts)]
        )
        connection.commit()
        connection.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in _ALLOWED else sqlite3.SQLITE_DENY)
        order = f"{_quoted(key)} IS NULL, {_quoted(key)} {'DESC' if sort.startswith('-') else 'ASC'}, " if key else ""
        # The expression is the user's own; it can read this table in memory and nothing else. A comment in it ends with
        # its line.
        query = f"SELECT row_number FROM sessions WHERE (\n{where or 1}\n) ORDER BY {order} row_number"  # noqa: S608
        listed = list(rows.values())
        return [listed[number] for (number,) in connection.execute(query)]
    except sqlite3.Error as error:
        text = str(error)
        if text.startswith("no such column: "):
            text = unknown_name("--where", text.removeprefix("no such column: "), names)
            raise UsageError(text) from error
        raise UsageError(f'--where {where!r}: {text}; as in --where "refined_flow_error < 0.05"') from error
    finally:
        connection.close()


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _sql_value(name: str, value: Any) -> str | int | float | None:
    """A value for SQLite; whole numbers are floating-point ones, so that a quotient is what `flowrec find` makes it."""
    if name in LISTS:
        return joined(value or ())
    return float(value) if isinstance(value, int) and abs(value) < _EXACT else value
