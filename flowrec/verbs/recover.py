"""`flowrec recover`: make a complete session of one that was killed or cut off.

From Python, `flowrec.recover` makes one session.
"""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.verbs.command import Told, verb
from flowrec.verbs.options import Asked, known_session

if TYPE_CHECKING:
    from flowrec.store import Recovered


def _recover_told(_asked: Asked, saved: "list[Recovered]") -> Told:
    return Told(
        lambda: [asdict(done) | {"path": str(done.path)} for done in saved],
        exit_status=0 if all(done.complete for done in saved) else 3,
        remarks=lambda: [f"{done.path}: {done.summary}" for done in saved],
    )


@verb("flowrec recover a.mcap.partial", result=_recover_told)
def recover(
    session: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            callback=known_session,
            help="Unfinished (.mcap.partial), cut-off or damaged file, or a run.",
        ),
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
