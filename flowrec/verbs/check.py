"""`flowrec check`: whether a session is whole, what it lacks, whether it can be replayed. `flowrec recover`: mend one.

From Python, `flowrec.recover` makes one session.
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import FlowrecError
from flowrec.store import session_path
from flowrec.verbs.command import Told, verb
from flowrec.verbs.options import BAR, AnySession, Asked, Bar

if TYPE_CHECKING:
    from flowrec.store import Recovered
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
) -> "Verdict":
    """Validate a session; exit status 0: good, 3: usable with losses or anomalies, 1: not usable.

    It finds damage, and edits that leave the digest as it was. Sessions are not signed: whoever can edit the file can
    edit the digest.

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
    from flowrec.verbs.check_run import check_session, files_to_check

    path = session_path(session) if isinstance(session, Path | str) else session.path
    files = files_to_check(path)
    nbytes = sum(map(size_of, files))
    with nullcontext(progress) if bar is None else bar(f"reading {path.name}", max(nbytes, 1), "bytes") as done:
        return check_session(path, files, done)


def _recover_told(_asked: Asked, saved: "list[Recovered]") -> Told:
    return Told(
        lambda: [asdict(done) | {"path": str(done.path)} for done in saved],
        exit_status=0 if all(done.complete for done in saved) else 3,
        remarks=lambda: [f"{done.path}: {_summary(done)}" for done in saved],
    )


@verb("flowrec recover a.mcap.partial", result=_recover_told)
def recover(
    session: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Unfinished (.mcap.partial), cut-off or damaged file, or a run."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Session file to make; X.mcap or X_recovered.mcap by default.")
    ] = None,
) -> "list[Recovered]":
    """Make a complete session from one that was killed or cut off; exit status 3 if something was lost.

    Temporary files that killed processes have left beside it are removed.

    Raises
    ------
    SessionError : nothing can be recovered, or the result not be written.
    """
    from flowrec.core import remove_leftovers, say
    from flowrec.store import on_this_machine, recover_run

    for left in remove_leftovers(on_this_machine(session, "nothing is recovered from").absolute().parent):
        say(f"{left}: removed, a killed process has left it")
    return recover_run(session, out)


def _summary(done: "Recovered") -> str:
    lost = f"; lost: {done.lost}" if done.lost else ""
    return f"{done.ticks} ticks, {done.duration_s:.1f} s{lost}" if done.changed else "is whole; nothing to do"
