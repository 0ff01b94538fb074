"""The sessions of files and folders, one row each, chosen and sorted by their facts.

Reads heads and indexes only, however large the sessions are. A choice is an SQL condition over the facts that
`flowrec info` shows, for DuckDB, an extra; `flowrec find` has the same columns and the same dialect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from flowrec.core import SessionError, UsageError, is_growing
from flowrec.store import PARTIAL_SUFFIX, SESSION_SUFFIX, Session, UrlPath, part_number, run_files, run_path
from flowrec.verbs.info import info
from flowrec.verbs.listed import ALWAYS, LISTS, ListedSession, columns_of, kind_of, text_of_list, unknown_name

_TOGETHER = 16  # sessions at URLs that are read at a time
NAMES = (SESSION_SUFFIX, SESSION_SUFFIX + PARTIAL_SUFFIX)  # ends of the names of sessions, finished or not
T = TypeVar("T")
R = TypeVar("R")
_SQL_TYPES = {int: "BIGINT", float: "DOUBLE", bool: "BOOLEAN", str: "VARCHAR"}


def list_sessions(places: Iterable[Path], where: str, sort: str) -> list[ListedSession]:
    """The sessions of some places as rows; parameters and errors as of `ls`."""
    rows = runs_of(path for place in places for path in _files(place))
    apart = len({path.parent for path in rows}) > 1

    def read(path: Path) -> ListedSession:
        return describe(path, rows[path], str(path) if apart else path.name)[0]

    with read_each(read, rows, far=any(isinstance(path, UrlPath) for path in rows)) as listed:
        found = dict(zip(rows, listed, strict=True))
    return _select_rows(found, where, sort) if where or sort else list(found.values())


@contextmanager
def read_each(read: Callable[[T], R], sessions: Iterable[T], far: bool) -> Iterator[Iterator[R]]:
    """Context with what `read` returns of each session, in their order.

    What has not begun when the context is left is not read: a person who interrupts does not wait for it. `far`: some
    are at URLs, where each waits for its server: many are read at a time.
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
            # Where there is a file of that name, it is what opens under it, and each part is a session of its own.
            run = run_path(path) if run_path(path) not in named else path
        rows.setdefault(run, []).append(path)
    return rows


def describe(path: Path, files: Sequence[Path], name: str) -> tuple[ListedSession, Session | SessionError]:
    """The row of a session, and the session or why it can not be opened.

    Parameters
    ----------
    files : its own, as `runs_of` returns them.
    name : which the row has.
    """
    parts = len(files) if list(files) != [path] else 0
    try:
        session = Session(path)
        facts = info(session)
        own = {key: facts[key] for key in ("outcome", "note", "size_bytes", "duration_s", "chip", "recorded")}
        events = session.topics.get("/operator/events", 0)
        row = ListedSession(name, **own, parts=facts["parts"] or parts, facts={**facts, "operator_events": events})
    except SessionError as error:
        size = sum(file.stat().st_size for file in files if file.is_file())
        unfinished = any(file.name.endswith(PARTIAL_SUFFIX) for file in files)
        what = "recording" if any(map(is_growing, files)) else "unfinished" if unfinished else "unreadable"
        why = str(error).removeprefix(f"{path}: ") if what != "recording" else "`flowrec view --live` shows it"
        return ListedSession(name, what, why, size, parts=parts), error
    return row, session


def _files(place: Path) -> list[Path]:
    if isinstance(place, UrlPath):
        from flowrec.store import files_at  # late: an extra

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


def _select_rows(rows: dict[Path, ListedSession], where: str, sort: str) -> list[ListedSession]:
    """The rows that fulfil an SQL condition, in order of a fact."""
    facts = [columns_of(row, path.as_posix()) for path, row in rows.items()]
    facts = [{name: text_of_list(value) if name in LISTS else value for name, value in one.items()} for one in facts]
    names = sorted({*ALWAYS, *(name for one in facts for name in one)})
    key = sort.removeprefix("-").strip().lower()
    if key and key not in names:
        raise UsageError(unknown_name("--sort", key, names))
    numbers = _fulfilling(facts, names, where) if where else list(range(len(facts)))
    if key:
        # Unknown values and NaN, which is not itself, come last.
        known = [k for k in numbers if (value := facts[k].get(key)) is not None and value == value]
        known.sort(key=lambda k: facts[k][key], reverse=sort.startswith("-"))
        numbers = [*dict.fromkeys((*known, *numbers))]
    listed = list(rows.values())
    return [listed[k] for k in numbers]


def _fulfilling(facts: Sequence[Mapping[str, Any]], names: Sequence[str], where: str) -> list[int]:
    """The numbers of the rows that fulfil an SQL condition."""
    from flowrec.verbs.session_table import SessionTable, connect  # late: an extra

    with connect() as connection:
        columns = ", ".join(f'"{name}" {_SQL_TYPES[kind_of(name)]}' for name in names)
        connection.execute(f"CREATE TABLE sessions (row_number INTEGER, {columns})")
        marks = ", ".join("?" * (len(names) + 1))
        values = [(k, *map(one.get, names)) for k, one in enumerate(facts)]
        connection.executemany(f"INSERT INTO sessions VALUES ({marks})", values)  # noqa: S608 - marks only
        return [row["row_number"] for row in SessionTable(connection, "--where", "row_number").rows(where)[1]]
