"""`flowrec ls`: the sessions of files and folders, one row each, chosen and sorted by their facts.

Reads heads and indexes only, however large the sessions are. A choice is an SQL expression over the facts that
`flowrec info` shows, evaluated by SQLite in memory.
"""

from __future__ import annotations

import difflib
import json
import sqlite3
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from flowrec.commands.info import info
from flowrec.errors import SessionError, UsageError, printable
from flowrec.session import Session
from flowrec.store.run_files import PARTIAL_SUFFIX, SUFFIX, part_number, run_files, run_path
from flowrec.store.session_path import UrlPath, session_path
from flowrec.summary import shown
from flowrec.system.locks import is_growing

_TOGETHER = 16  # sessions at URLs that are read at a time
_NAMES = (SUFFIX, SUFFIX + PARTIAL_SUFFIX)
_SQL_LIMIT = 2**63  # of the integers of SQLite
_NOTE_SHOWN = 60  # characters of a note in the table
_NOTE_FOLDED = 20  # characters of a line of it
_ALWAYS = ("name", "outcome", "duration")
_LESS_IMPORTANT = ("size", "chip", "recorded", "replay of", "duration")  # first the one that is left out first
# What an expression of --where may do: read the table and call functions, nothing else.
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION)


@dataclass(frozen=True, slots=True)
class Listed:
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
    files = [(place, path) for place in places for path in _files(place)]
    rows: dict[Path, list[Path]] = {}
    named = {path for _, path in files}
    for path in sorted(named):
        run = run_path(path)
        # Beside a file of that name the parts are not what opens under it: each is a session of its own.
        rows.setdefault(run if part_number(path) and run not in named else path, []).append(path)
    apart = len({path.parent for path in rows}) > 1
    read = [partial(_listed, path, parts, str(path) if apart else path.name) for path, parts in rows.items()]
    if any(isinstance(path, UrlPath) for path in rows):
        with ThreadPoolExecutor(_TOGETHER) as threads:  # each waits for its server
            found = list(threads.map(lambda each: each(), read))
    else:
        found = [each() for each in read]
    return _chosen(found, where, sort) if where or sort else found


def columns_for_people(rows: Sequence[Listed], width: int) -> tuple[list[str], list[list[str]]]:
    """Names of the columns and the cells, as many as fit into a width in characters; empty columns are left out."""
    cells = {
        "name": [row.name + (f" ({row.parts} parts)" if row.parts else "") for row in rows],
        "outcome": [row.outcome for row in rows],
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


def _width(name: str, column: Sequence[str]) -> int:
    """Characters of a column with its border; notes are folded."""
    return 3 + max(map(len, [name, *(cell[:_NOTE_FOLDED] if name == "notes" else cell for cell in column)]))


def _files(place: Path) -> list[Path]:
    place = session_path(place)
    if isinstance(place, UrlPath):
        from flowrec.store.remote_folder import files_at  # late: an extra

        return files_at(place, _NAMES)
    if not place.is_dir():
        files = [place] if place.is_file() else run_files(place)
        if not files or not place.name.endswith(_NAMES):
            raise SessionError(f"{place}: no such directory or session; flowrec ls lists directories and .mcap files")
        return files
    try:
        return [path for path in place.iterdir() if path.is_file() and path.name.endswith(_NAMES)]
    except OSError as error:
        raise SessionError(f"{place}: can not be listed ({error.strerror}); check its permissions") from error


def _listed(path: Path, files: list[Path], name: str) -> Listed:
    size = sum(file.stat().st_size for file in files if file.is_file())
    parts = len(files) if files != [path] else 0
    try:
        session = Session(path)
        facts = info(session)
        return Listed(
            name,
            facts["outcome"],
            facts["note"],
            facts["size_bytes"],
            facts["duration_s"],
            facts["chip"],
            facts["recorded"],
            facts["parts"] or parts,
            {**facts, "operator_events": session.topics.get("/operator/events", 0)},
        )
    except SessionError as error:
        unfinished = any(file.name.endswith(PARTIAL_SUFFIX) for file in files)
        what = "recording" if any(map(is_growing, files)) else "unfinished" if unfinished else "unreadable"
        return Listed(name, what, str(error).removeprefix(f"{path}: "), size, parts=parts)


def _chosen(rows: Sequence[Listed], where: str, sort: str) -> list[Listed]:
    """The rows that fulfil an SQL expression, in order of a fact."""
    facts = [
        {key.lower(): _sql_value(value) for key, value in row.as_json().items() if key.isidentifier()} for row in rows
    ]
    names = sorted(
        {"name", "outcome", "duration_s", "size_bytes", "chip", "recorded", *(k for one in facts for k in one)}
    )
    key = sort.removeprefix("-").strip().lower()
    if key and key not in names:
        raise UsageError(_unknown("--sort", key, names))
    columns = ", ".join(map(_quoted, names))
    connection = sqlite3.connect(":memory:")
    try:
        connection.execute(f"CREATE TABLE sessions (row_number, {columns})")
        insert = f"INSERT INTO sessions VALUES ({', '.join('?' * (len(names) + 1))})"  # noqa: S608 - marks only
        connection.executemany(insert, [(k, *map(one.get, names)) for k, one in enumerate(facts)])
        connection.commit()
        connection.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in _ALLOWED else sqlite3.SQLITE_DENY)
        order = f"{_quoted(key)} IS NULL, {_quoted(key)} {'DESC' if sort.startswith('-') else 'ASC'}, " if key else ""
        # The expression is the user's own; it can read this table in memory and nothing else. A comment in it ends with
        # its line.
        query = f"SELECT row_number FROM sessions WHERE (\n{where or 1}\n) ORDER BY {order} row_number"  # noqa: S608
        return [rows[number] for (number,) in connection.execute(query)]
    except sqlite3.Error as error:
        text = str(error)
        if text.startswith("no such column: "):
            text = _unknown("--where", text.removeprefix("no such column: "), names)
            raise UsageError(text) from error
        raise UsageError(f'--where {where!r}: {text}; as in --where "refined_flow_error < 0.05"') from error
    finally:
        connection.close()


def _unknown(option: str, name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, 1, 0.5)
    meant = f"did you mean {near[0]}?" if near else f"known are {', '.join(names)}"
    return f"{option}: no session states {name}; {meant}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _sql_value(value: Any) -> str | int | float | None:
    if value is None or isinstance(value, float) or (isinstance(value, int) and abs(value) < _SQL_LIMIT):
        return value
    if isinstance(value, dict):
        return json.dumps(value)
    return printable(", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))


def _errors(facts: Mapping[str, Any]) -> str:
    """Error of the assumed and of the refined flow, where the truth is known."""
    errors = [facts.get("assumed_flow_error"), facts.get("refined_flow_error")]
    texts = [shown("flow_error", error).removesuffix(" %") for error in errors if isinstance(error, float)]
    return " -> ".join(texts) + " %" * bool(texts)


def _notes(facts: Mapping[str, Any]) -> str:
    """Tags, then the latest note, or the one of the recording."""
    tags = " ".join(f"#{tag}" for tag in facts.get("tags", ()))
    added = facts.get("notes_added", ())
    text = str(added[-1] if added else facts.get("notes") or "")
    text = " ".join(text.split())
    short = text if len(text) <= _NOTE_SHOWN else text[: _NOTE_SHOWN - 3] + "..."
    return f"{tags} {short}".strip()
