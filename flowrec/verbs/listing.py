"""The sessions of files and folders, one row each, chosen and sorted by their facts.

Reads heads and indexes only, however large the sessions are. A choice is an SQL condition over the facts that
`flowrec info` shows, for DuckDB, an extra; `flowrec find` has the same columns and the same dialect.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from flowrec.core import (
    DOUBTS,
    Outcome,
    SessionError,
    UsageError,
    is_count,
    is_growing,
    is_numeric,
    printable,
    text_of_figure,
)
from flowrec.store import (
    PARTIAL_SUFFIX,
    SESSION_SUFFIX,
    Session,
    UrlPath,
    part_number,
    run_files,
    run_path,
)
from flowrec.verbs.info import info
from flowrec.verbs.options import unknown_name

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


def describe(path: Path, files: Sequence[Path], name: str) -> tuple[ListedSession, Session | SessionError]:
    """The row of a session, and the session or why it can not be opened.

    Parameters
    ----------
    files : its own, as `runs_of` returns them.
    name : which the row has.
    """
    try:
        session = Session(path)
        facts = info(session)
        row = ListedSession(
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
        return ListedSession(name, what, str(error).removeprefix(f"{path}: "), size, parts=parts), error
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
        known = [k for k in numbers if (value := facts[k].get(key)) is not None and value == value]
        known.sort(key=lambda k: facts[k][key], reverse=sort.startswith("-"))
        numbers = known + [k for k in numbers if k not in set(known)]
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


INT_LIMIT = 2**63  # of the integers of DuckDB and Parquet
TEXT_LIMIT = 20_000  # characters of a value; a longer text in a file is damage
_NOTE_SHOWN = 60  # characters of a note in the table
_NOTE_FOLDED = 20  # characters of a line of it
_ALWAYS = ("name", "outcome", "duration")
_LESS_IMPORTANT = ("size", "chip", "recorded", "replay of", "duration")  # first the one that is left out first
# Columns that every session has, whatever it states. Of the others `kind_of` knows the kind.
ALWAYS = ("name", "path", "outcome", "note", "duration_s", "size_bytes", "parts", "chip", "recorded", "tags")
_KINDS: Mapping[str, type] = {"parts": int, "chip_openings": int, "operator_events": int, "local_changes": bool}
LISTS = ("phases", "notes_added", "tags")  # of texts; one text, with ", " between them, in an expression
_FACTS_LIMIT = 200  # of a session; flowrec writes some 60, and a file can state any number
_NAME_LIMIT = 60  # characters of a name; a longer one in a file is damage


@dataclass(frozen=True, slots=True)
class ListedSession:
    """One session, or one run with all its parts; unknown values are None or empty.

    Attributes
    ----------
    name : of the file; with its folder where several folders are listed.
    outcome : how the run ended, or: recording, unfinished, unreadable.
    note : why.
    parts : of a run that was split; finished or not.
    facts : of `flowrec info`, with the notes and tags that were added later.
    """

    name: str
    outcome: str
    note: str
    size_bytes: int
    duration_s: float | None = None
    chip: str = ""
    recorded: str = ""
    parts: int = 0
    facts: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """All facts by name."""
        own = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "facts"}
        return {**self.facts, **own}


def kind_of(name: str) -> type:
    """Kind of the values of a column: int, float, bool, or str; what a session states otherwise is unknown."""
    if name in _KINDS:
        return _KINDS[name]
    if not is_numeric(name):
        return str
    return int if is_count(name) else float


def columns_of(listed: ListedSession, path: str) -> dict[str, Any]:
    """Values by column, each of the kind of its column, None if unknown; LISTS are lists of texts.

    Parameters
    ----------
    path : of the session, as the column of that name states it.
    """
    stated = ((key.lower(), value) for key, value in listed.as_json().items() if _is_name(key))
    facts = dict(itertools.islice(stated, _FACTS_LIMIT))
    own = {name: getattr(listed, name) for name in ALWAYS if name in listed.__dataclass_fields__}
    facts |= own | {"path": path, "name": path.rpartition("/")[2]}
    return {name: _value(name, facts.get(name)) for name in dict.fromkeys((*ALWAYS, *facts))}


def text_of_list(texts: Iterable[str]) -> str:
    """The texts of a list as an expression sees them."""
    return ", ".join(texts)


def columns_for_people(rows: Sequence[ListedSession], width: int) -> tuple[list[str], list[list[str]]]:
    """Names of the columns and the cells, as many as fit into a width in characters; empty columns are left out."""
    cells = {
        "name": [row.name + (f" ({row.parts} parts)" if row.parts else "") for row in rows],
        "outcome": [_outcome(row) + ", doubtful" * is_doubtful(row) for row in rows],
        "duration": ["" if row.duration_s is None else f"{row.duration_s:.1f} s" for row in rows],
        "size": [f"{row.size_bytes / 1e6:.1f} MB" for row in rows],
        "chip": [row.chip for row in rows],
        "recorded": [row.recorded[:16].replace("T", " ") for row in rows],
        "flow error": [_errors(row.facts) for row in rows],
        "replay of": [str(row.facts.get("replay_of") or "") for row in rows],
        "notes": [_notes(row.facts) for row in rows],
    }
    kept = {name: column for name, column in cells.items() if any(column) or name in _ALWAYS}
    for name in _LESS_IMPORTANT:
        if sum(_width(column, values) for column, values in kept.items()) + 1 > width:
            kept.pop(name, None)
    return list(kept), [list(line) for line in zip(*kept.values(), strict=True)]


def is_doubtful(row: ListedSession) -> bool:
    """True if the session states that its result is doubtful."""
    return bool(row.facts.get(DOUBTS))


def _width(name: str, column: Sequence[str]) -> int:
    """Characters of a column with its border; notes are folded."""
    return 3 + max(map(len, [name, *(cell[:_NOTE_FOLDED] if name == "notes" else cell for cell in column)]))


def _is_name(key: str) -> bool:
    return key.isidentifier() and key.isascii() and len(key) <= _NAME_LIMIT


def _value(name: str, value: Any) -> Any:
    if name in LISTS:
        return [_text(each) for each in value] if isinstance(value, list | tuple) else []
    if value is None:
        return None
    kind = kind_of(name)
    if kind is str:
        return _text(value)
    if kind is bool:
        return value if isinstance(value, bool) else None
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None  # sentences of older files
    if kind is float:
        return float(value) if abs(value) < float(INT_LIMIT) ** 2 else None
    return int(value) if abs(value) < INT_LIMIT and value == int(value) else None


def _text(value: Any) -> str:
    if isinstance(value, dict):
        text = json.dumps(value)
    else:
        text = text_of_list(map(str, value)) if isinstance(value, list | tuple) else str(value)
    return printable(text[:TEXT_LIMIT])


def _outcome(row: ListedSession) -> str:
    """Outcome as text; of a replay or an import that was stopped, with the amount that was done."""
    covered = row.facts.get("covered")
    return f"{row.outcome}, {covered}" if covered and row.outcome == Outcome.STOPPED else row.outcome


def _errors(facts: Mapping[str, Any]) -> str:
    """Error of the assumed and of the refined flow, where the truth is known."""
    errors = [facts.get("assumed_flow_error"), facts.get("refined_flow_error")]
    texts = [text_of_figure("flow_error", error).removesuffix(" %") for error in errors if isinstance(error, float)]
    return " -> ".join(texts) + " %" * bool(texts)


def _notes(facts: Mapping[str, Any]) -> str:
    """Tags, then the latest note, or the one of the recording."""
    tags = " ".join(f"#{tag}" for tag in facts.get("tags", ()))
    added = facts.get("notes_added", ())
    text = str(added[-1] if added else facts.get("notes") or "")
    text = " ".join(text.split())
    short = text if len(text) <= _NOTE_SHOWN else text[: _NOTE_SHOWN - 3] + "..."
    return f"{tags} {short}".strip()
