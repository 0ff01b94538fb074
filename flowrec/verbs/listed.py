"""A session as a row: of the table of `flowrec ls` and `flowrec find`, and of what their expressions choose from.

Both verbs have the same columns, kinds and values, which are declared here. Light to import: opens nothing.
"""

from __future__ import annotations

import difflib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from flowrec.core import DOUBTS, Outcome, is_count, is_numeric, printable, text_of_figure

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
    """One session, or one run with all its parts; unknown values are None or empty."""

    name: str  # of the file; with its folder where several folders are listed
    outcome: str  # how the run ended, or: recording, unfinished, unreadable
    note: str  # why
    size_bytes: int
    duration_s: float | None = None
    chip: str = ""
    recorded: str = ""
    parts: int = 0  # of a run that was split; finished or not
    # of `flowrec info`, with the notes and tags that were added later
    facts: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
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

    `path`: of the session, as the column of that name states it.
    """
    stated = ((key.lower(), value) for key, value in listed.as_json().items() if _is_name(key))
    facts = dict(itertools.islice(stated, _FACTS_LIMIT))
    own = {name: getattr(listed, name) for name in ALWAYS if name in listed.__dataclass_fields__}
    facts |= own | {"path": path, "name": path.rpartition("/")[2]}
    return {name: _value(name, facts.get(name)) for name in dict.fromkeys((*ALWAYS, *facts))}


def text_of_list(texts: Iterable[str]) -> str:
    """The texts of a list as an expression sees them."""
    return ", ".join(texts)


def unknown_name(option: str, name: str, names: Iterable[str], what: str = "no session states") -> str:
    """The complaint about a name that no column has."""
    known = sorted(names)
    near = difflib.get_close_matches(name, known, 3, 0.5)
    meant = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(known)}"
    return f"{option}: {what} {name}; {meant}"


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
