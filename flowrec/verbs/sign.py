"""`flowrec sign`: sign a session with one's own SSH key."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flowrec.verbs.command import verb
from flowrec.verbs.options import Overwrite, SessionFile


class Signed(list[Path]):
    """The signatures that were made, one for each file of the session."""

    def as_json(self) -> dict[str, Any]:
        return {"signatures": [str(path) for path in self]}

    def lines(self) -> list[str]:
        return [f"{path} written" for path in self]


@verb("flowrec sign a.mcap --key ~/.ssh/id_ed25519")
def sign(
    session: SessionFile,
    key: Annotated[Path, typer.Option("--key", metavar="FILE", help="SSH key: a private one, or a .pub of the agent.")],
    overwrite: Overwrite = False,
) -> Signed:
    """Sign every file of a session; the signature lies beside it, and `flowrec check --signers` verifies it.

    Raises
    ------
    SessionError : there is no such session, or it has no end yet.
    FlowrecError : the key can not be used, or OpenSSH is not installed.
    """
    from flowrec.store import Session, on_this_machine, sign_file

    path = on_this_machine(Session.of(session).path, "nothing is signed of")
    return Signed(sign_file(file.path, key, overwrite=overwrite) for file in Session(path).run.files)
