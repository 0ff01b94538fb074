"""`flowrec catalog --serve`: Rerun's own catalog server shows the sessions that a condition finds.

The server takes .rrd files only. They are made before it starts, kept beside the catalog in a hidden folder, and
removed when a later call serves others: the folder holds what was served last.
"""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

from flowrec.archive.catalog.find import find
from flowrec.archive.catalog.format import PLACE, path_of
from flowrec.core import RRD, FlowrecError, Output, SessionError, UsageError, say
from flowrec.exports import RrdExport
from flowrec.store import Session, input_blamed
from flowrec.view import DATASET, is_made_from, serve_recordings

FOLDER = ".flowrec-rrd"
SERVED_LIMIT = 50  # sessions; each takes seconds to convert, and twice its size on the disk


def serve(catalog: Path, where: str, port: int | None) -> None:
    """Serve the sessions of a catalog until Ctrl-C or a signal to end; parameters and errors as of `recordings_of`."""
    recordings = recordings_of(catalog, where)
    with serve_recordings(recordings, port) as url:
        ended = threading.Event()
        before = {each: signal.signal(each, lambda *_: ended.set()) for each in (signal.SIGINT, signal.SIGTERM)}
        say(f"{url}: dataset {DATASET} of {len(recordings)}; open it with: rerun {url}")
        say("Ctrl-C ends the server")
        ended.wait()
        for each, handler in before.items():
            signal.signal(each, handler)


def recordings_of(catalog: Path, where: str) -> list[Path]:
    """The .rrd files of the sessions that a condition finds, made where they are not there yet.

    Raises
    ------
    UsageError : no session is found, or too many; as of `find`.
    SessionError : the folder can not be made.
    """
    found = {os.fsdecode(row[PLACE]): row for row in find(where, catalog).rows if row["duration_s"] is not None}
    if not 0 < len(found) <= SERVED_LIMIT:
        raise UsageError(
            f"--serve: {len(found)} whole sessions are found, and 1 to {SERVED_LIMIT} are served at a time; choose "
            "them, as in --where \"outcome = 'reached' and refined_flow_error < 0.05\""
        )
    folder = catalog.parent / FOLDER
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise SessionError(f"{folder}: can not be made ({error.strerror}); choose another place with --out") from error
    made: list[Path] = []
    for path in found:
        try:
            made.append(_rrd_of(Session(path_of(path, catalog.parent)), folder))
        except FlowrecError as error:
            say(f"{error}; it is not served")
    if not made:
        raise SessionError(f"none of {len(found)} sessions can be shown by Rerun")
    for other in folder.glob(f"*{RRD[0]}"):
        if other not in made:
            other.unlink(missing_ok=True)
    return made


def _rrd_of(session: Session, folder: Path) -> Path:
    """The .rrd of a session: an earlier one of the same session, or a new one."""
    path = folder / f"{session.path.stem}-{session.key[:8]}{RRD[0]}"
    if not is_made_from(path, session.key):
        say(f"{session.path.name}: making {path}")
        with input_blamed(session, None, "exported"), Output(path, RRD, overwrite=True).new_file() as part:
            RrdExport().write(session, part, lambda _: None)
    session.close()
    return path
