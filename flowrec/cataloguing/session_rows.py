"""The row of a session in a catalog: its facts as `flowrec ls` has them, the hash of its content, the events."""

from __future__ import annotations

import os
from typing import Any

from flowrec.cataloguing.format import EVENTS, PLACE, SIGNATURE
from flowrec.cataloguing.places import Found
from flowrec.commands.listed import TEXT_LIMIT, columns_of
from flowrec.commands.ls import describe
from flowrec.errors import FlowrecError, SessionError, printable
from flowrec.session import Session
from flowrec.store.traffic import RefusedError, TransientError
from flowrec.sweeping.tasks import content_of
from flowrec.units import seconds

_PASSING = (OSError, TransientError, RefusedError)  # of a disk, a network or a server
_EVENTS_LIMIT = 10_000  # of a session; more are not by a person


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
        told = {"path": printable(path), "name": printable(found.path.name), "outcome": "unreadable"}
        return told | {"note": str(reason), SIGNATURE: "", PLACE: os.fsencode(path)}
    row = columns_of(listed, printable(path)) | {EVENTS: [], "content": None, SIGNATURE: found.signature}
    row[PLACE] = os.fsencode(path)
    if isinstance(opened, SessionError):
        # What may pass without a change of the file is asked for again the next time.
        passing = listed.outcome == "recording" or isinstance(opened.__cause__, _PASSING)
        return row | ({SIGNATURE: ""} if passing else {})
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
    """What the operator did, with its time; of the messages only theirs are read."""
    return [
        {"time_s": seconds(each.stamp_ns), "action": each.action, "text": printable(each.text[:TEXT_LIMIT])}
        for each, _ in zip(session.messages("operator"), range(_EVENTS_LIMIT), strict=False)
    ]
