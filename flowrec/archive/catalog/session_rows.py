"""Row of a session in a catalog: facts as `flowrec ls` lists them, the hash of its content, operator events."""

from __future__ import annotations

import os
from typing import Any

from flowrec.archive.catalog.format import EVENTS, PLACE, SIGNATURE
from flowrec.archive.catalog.places import Found
from flowrec.archive.sweep.tasks import content_of
from flowrec.core import FlowrecError, SessionError, printable, seconds
from flowrec.store import RefusedError, Session, TransientError
from flowrec.verbs import TEXT_LIMIT, columns_of, describe

_TEMPORARY = (OSError, TransientError, RefusedError)  # errors of a disk, a network or a server
_EVENTS_LIMIT = 10_000  # of a session; no person makes more


def row_of(found: Found, path: str) -> dict[str, Any]:
    """Values by column. A session that can not be opened is a row, too, with the reason as its note.

    Parameters
    ----------
    path : as the catalog states it.
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
