"""`flowrec catalog`: one file about all sessions of some places, in which only what has changed is read again."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flowrec.archive.catalog import catalog_file  # first: it says which extra is missing
from flowrec.archive.catalog.format import EVENTS, NAME, PLACE, SIGNATURE, About, path_of, path_text
from flowrec.archive.catalog.places import Found, contents_of
from flowrec.archive.catalog.sweeps import lists_of, sweep_rows
from flowrec.archive.sweep.tasks import content_of
from flowrec.core import Ended, FlowrecError, SessionError, UsageError, __version__, pool, printable, seconds
from flowrec.store import RefusedError, Session, TransientError, UrlPath, session_path
from flowrec.verbs import TEXT_LIMIT, columns_of, describe, read_each

_BROKEN = ("unreadable", "unfinished", "recording")
_TEMPORARY = (OSError, TransientError, RefusedError)  # errors of a disk, a network or a server
_TOGETHER = 32  # sessions that a process is given at a time
_EVENTS_LIMIT = 10_000  # of a session; no person makes more


@dataclass(frozen=True, slots=True)
class Refreshed:
    """Result of a refresh."""

    path: Path
    sessions: int  # in the catalog, of which `new`, `changed` and `broken`, that is unreadable, unfinished or recording
    new: int
    changed: int
    gone: int  # sessions that were in the catalog and are no longer there
    broken: int
    replays: int  # of sweeps
    left: int = 0  # sessions that were not read before an interruption
    stop_status: int = 0  # exit status of that interruption
    remarks: tuple[str, ...] = ()  # lines about what could not be used

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"path": str(self.path), "remarks": list(self.remarks)}

    def lines(self) -> list[str]:
        same = self.sessions - self.new - self.changed
        counts = {
            f"{self.new} new": self.new,
            f"{self.changed} changed": self.changed,
            f"{same} as before": same,
            f"{self.gone} gone": self.gone,
        }
        parts = [", ".join(text for text, count in counts.items() if count)]
        if self.broken:
            parts.append(f"{self.broken} unreadable, unfinished or being recorded")
        if self.replays:
            parts.append(f"{self.replays} replays of sweeps")
        told = "; ".join(part for part in parts if part)
        lines = [*self.remarks, f"{self.path}: {_count_text(self.sessions)}{': ' if told else ''}{told}"]
        if self.left:
            lines.append(f"interrupted before {_count_text(self.left)} were read; the same command goes on")
        return lines


def refresh(
    places: Sequence[Path | str],
    out: Path | None = None,
    progress: Callable[[float], None] = lambda _: None,
    jobs: int = 1,
) -> Refreshed:
    """Write or refresh the catalog of some places.

    Parameters
    ----------
    places : folders, with all below them, sessions and URLs of either; none: those of the catalog as it is, or this
        folder.
    out : the catalog; by default in the folder, if one is named, or in this one.
    progress : takes the share of the work that is done.
    jobs : processes that read the sessions of this machine; 0: one for each core.

    Raises
    ------
    SessionError : a place is not there, or holds none of the sessions that it held.
    OutputError : the catalog may not be written.
    UsageError : no session is there.
    """
    given = [session_path(place) for place in places]
    path = (out if out is not None else _default(given)).absolute()
    if path.is_dir():
        path /= NAME
    base = path.parent
    with catalog_file.lock_catalog(path):
        known = catalog_file.read(path)
        remarks = [known.remark] if known.remark else []
        if not given and known.about is not None:
            given = [path_of(text, base) for text in known.about.places]
        given = given or [base if out is None else Path()]
        found, tables = contents_of(given, path)
        if not found:
            raise _empty_error(given, len(known.sessions))
        named = {path_text(each.path, base): each for each in found}
        places_before, signatures = (known.sessions[name].to_pylist() for name in (PLACE, SIGNATURE))
        before = dict(zip(map(os.fsdecode, places_before), signatures, strict=True))
        due = {text: each for text, each in named.items() if before.get(text) != each.signature}
        rows, stop_status = _read(due, progress, jobs or os.cpu_count() or 1)
        left = len(due) - len(rows)
        read = {os.fsdecode(row[PLACE]) for row in rows}
        # A changed session that was not read before an interruption is left out: what is known of it is out of date.
        kept = [text in named and text not in due for text in before]
        sessions = catalog_file.join_rows(known.sessions, kept, rows)
        replays = sweep_rows(tables, lambda table: printable(path_text(table, base)), remarks.append)
        lists, verdicts = lists_of(sessions["content"].to_pylist(), replays)
        made = datetime.now(UTC).isoformat(timespec="seconds")
        stated = [path_text(place, base) for place in given]
        about = About(stated, len(sessions), made, __version__, left)
        catalog_file.write(path, sessions, lists, verdicts, about)
    outcomes = Counter(sessions["outcome"].to_pylist())
    return Refreshed(
        path,
        len(sessions),
        new=sum(text not in before for text in read),
        changed=sum(text in before for text in read),
        gone=len(before.keys() - named.keys()),
        broken=sum(outcomes[word] for word in _BROKEN),
        replays=len(lists.flatten()),
        left=left,
        stop_status=stop_status,
        remarks=tuple(remarks),
    )


def _default(places: Sequence[Path]) -> Path:
    """Default path of the catalog of these places: in the folder, if it is one folder."""
    first = places[0] if len(places) == 1 else None
    return first / NAME if first is not None and not isinstance(first, UrlPath) and first.is_dir() else Path(NAME)


def _empty_error(places: Sequence[Path], known: int) -> SessionError | UsageError:
    """The refusal of places without a session: a disk that is not mounted must not empty the catalog."""
    where = ", ".join(map(str, places))
    if known:
        return SessionError(
            f"{where}: holds no session any more, {known} were there; is the disk mounted? The catalog "
            "stays as it is; remove it if they are gone for good"
        )
    return UsageError(f"{where}: no session (.mcap) is there, nor in a folder below; name directories and sessions")


def _read(due: dict[str, Found], progress: Callable[[float], None], jobs: int) -> tuple[list[dict[str, Any]], int]:
    """The rows of sessions, and the exit status of an interruption before all were read; 0 without one."""
    rows: list[dict[str, Any]] = []
    stop_status = 0
    try:
        with ExitStack() as stack:
            far = any(isinstance(found.path, UrlPath) for found in due.values())
            if far or jobs == 1:
                read = stack.enter_context(read_each(lambda text: row_of(due[text], text), due, far))
            else:
                executor = stack.enter_context(pool(jobs))
                read = executor.map(row_of, due.values(), due, chunksize=_TOGETHER)
            for row in read:
                rows.append(row)
                progress(len(rows) / len(due))
    except BrokenProcessPool as error:
        raise SessionError("a process that read sessions was killed; try fewer --jobs") from error
    except KeyboardInterrupt as error:
        if not rows:
            raise
        stop_status = Ended.of(error).status
    return rows, stop_status


def row_of(found: Found, path: str) -> dict[str, Any]:
    """Values by column. A session that can not be opened is a row, too, with the reason as its note.

    `path`: as the catalog states it.
    """
    try:
        listed, opened = describe(found.path, found.files, found.path.name)
    except OSError as error:  # it went away meanwhile
        reason = SessionError(f"{found.path}: can not be read ({error.strerror or error})")
        unread = {"path": printable(path), "name": printable(found.path.name), "outcome": "unreadable"}
        return unread | {"note": str(reason), SIGNATURE: "", PLACE: os.fsencode(path)}
    row = columns_of(listed, printable(path)) | {EVENTS: [], "content": None, SIGNATURE: found.signature}
    row[PLACE] = os.fsencode(path)
    if isinstance(opened, SessionError):
        # Without a signature the next refresh reads the file again: the error may pass without a change of the file.
        temporary = listed.outcome == "recording" or isinstance(opened.__cause__, _TEMPORARY)
        return row | ({SIGNATURE: ""} if temporary else {})
    try:
        row["content"] = content_of(opened)
        if listed.facts.get("operator_events"):
            row[EVENTS] = _events(opened)
    except FlowrecError as error:  # its messages are damaged; what its head says is known
        row["note"] = printable(f"{row['note']} {error}".strip())
    finally:
        opened.close()
    return row


def _events(session: Session) -> list[dict[str, Any]]:
    """Operator events with their times; no other message is read."""
    return [
        {"time_s": seconds(each.stamp_ns), "action": each.action, "text": printable(each.text[:TEXT_LIMIT])}
        for each, _ in zip(session.messages("operator"), range(_EVENTS_LIMIT), strict=False)
    ]


def _count_text(number: int) -> str:
    return f"{number} session{'s' * (number != 1)}"
