"""`flowrec check`: whether a session is whole, what it lacks, and whether it can be replayed."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import FlowrecError
from flowrec.store import session_path
from flowrec.verbs.command import verb
from flowrec.verbs.options import BAR, AnySession, Asked, Bar

if TYPE_CHECKING:
    from flowrec.verbs.verdict import Verdict


def _refusal_json(asked: Asked, error: FlowrecError) -> dict[str, Any]:
    finding = {"level": "bad", "about": "file", "text": str(error)}
    return {"session": str(asked["session"]), "verdict": "bad", "exit_status": 1, "findings": [finding]}


@verb("flowrec check a.mcap", refused=_refusal_json)
def check(
    session: Annotated[
        AnySession,
        typer.Argument(
            metavar="FILE", callback=session_path, help="Session (.mcap) or its URL, or an unfinished one (.partial)."
        ),
    ],
    progress: Callable[[int], None] | None = None,
    bar: Annotated[Bar | None, BAR] = None,
    signers: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Trusted keys, and whose: as ALLOWED SIGNERS of ssh-keygen.")
    ] = None,
) -> "Verdict":
    """Validate a session; exit status 0: good, 3: usable with losses or anomalies, 1: not usable.

    It finds damage, and edits that leave the digest as it was. Whoever can edit the file can edit the digest; a
    signature (`flowrec sign`) says whose it is.

    Parameters
    ----------
    progress : called with the number of bytes that have been read.
    bar : shows the same, as `core.progress`.

    Notes
    -----
    All of it is read; memory does not grow with the file. Each part of a split run is validated, and whether the parts
    are continuous.

    Raises
    ------
    SessionError : it is no session that this flowrec can read; the text says what it is.
    Ended : Ctrl-C or a signal; its `result` is the verdict on what had been read.
    """
    from flowrec.store import size_of

    path = session_path(session) if isinstance(session, Path | str) else session.path
    files = _files_to_check(path)
    nbytes = sum(map(size_of, files))
    from flowrec.verbs.check_run import check_session  # which takes a second, after a missing file is refused

    told = progress or (lambda _: None)
    with nullcontext(told) if bar is None else bar(f"reading {path.name}", max(nbytes, 1), "bytes") as done:
        return check_session(path, files, done, signers)


def _files_to_check(path: Path) -> list[Path]:
    """The file of that name or, if there is none, the existing parts of that run, finished or not."""
    from flowrec.store import is_there, part_number, run_files

    if is_there(path):
        return [path]
    return sorted(filter(part_number, run_files(path)), key=part_number) or [path]
