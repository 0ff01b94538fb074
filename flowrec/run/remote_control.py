"""A run is steered from another process of the same user: its commands come through a local socket.

So a console can be opened for a run that was started without one. The socket lies in a folder of temporary files
that only the user can enter, under a name that follows from the session's path; on Windows it is a named pipe. A
connection carries one command, as JSON, and its answer.
"""

from __future__ import annotations

import hashlib
import json
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Client, Listener
from pathlib import Path
from typing import Any, Self

from flowrec.core import FlowrecError, make_own_folder, own_temporary_folder
from flowrec.run.control import RunControl
from flowrec.run.operator_commands import obey

_LONGEST_BYTES = 4096  # of a command, and of its answer
_PATIENCE_S = 1.0  # for a connection to send its command; then it is closed
_ANSWER_S = 5.0  # for the run's answer: it takes a command between two ticks
_PAUSE_S = 0.1
_BACKLOG = 16  # connections that wait to be accepted


def _address(session: Path) -> str:
    """Address at which the run that records a session takes commands."""
    name = hashlib.sha256(str(session.resolve()).encode()).hexdigest()[:16]
    address = str(own_temporary_folder() / "runs" / f"{name}.sock")
    if sys.platform == "win32":
        address = rf"\\.\pipe\flowrec-{name}"
    return address


class CommandSocket:
    """Context in which other processes of the user can give commands to a run; it costs the run nothing until one does.

    Parameters
    ----------
    session : X.mcap of the run; one run at a time records it.
    tell : prints a line for the operator where nobody can steer the run from outside; it goes on.
    """

    def __init__(self, session: Path, control: RunControl, tell: Callable[[str], None]) -> None:
        self._address, self._control, self._tell = _address(session), control, tell
        self._listener: Listener | None = None
        self._closing = threading.Event()

    def __enter__(self) -> Self:
        try:
            if sys.platform != "win32":
                folder = Path(self._address).parent
                make_own_folder(folder.parent)
                make_own_folder(folder)
                Path(self._address).unlink(missing_ok=True)  # of a run that was killed
            self._listener = Listener(self._address, backlog=_BACKLOG)
        except OSError as error:
            self._tell(f"no console can be opened onto this run later: {error}")
        else:
            threading.Thread(target=self._listen, args=(self._listener,), name="commands", daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._closing.set()
        if self._listener is not None:
            with suppress(OSError):  # `accept` returns only for a connection
                Client(self._address).close()
            self._listener.close()

    def _listen(self, listener: Listener) -> None:
        """Take one command after the other, until the run ends: the thread."""
        while not self._closing.is_set():
            try:
                with listener.accept() as connection:
                    if not self._closing.is_set() and connection.poll(_PATIENCE_S):
                        connection.send_bytes(self._answer(connection).encode()[:_LONGEST_BYTES])
            except (OSError, EOFError):  # the other end has gone; or no descriptor is left, which may pass
                self._closing.wait(_PAUSE_S)

    def _answer(self, connection: Any) -> str:
        try:
            words = json.loads(connection.recv_bytes(_LONGEST_BYTES))
        except ValueError as error:
            return f"not understood: {error}"
        return obey(self._control, words) if isinstance(words, dict) else "not understood: no command"


class RemoteControl:
    """Commands to a run that another process records.

    `session`: X.mcap of the run. Raises FlowrecError: it can not be steered: it has ended, is of another user or
    machine, or was begun by an older flowrec.
    """

    def __init__(self, session: Path) -> None:
        self._session = session
        self._connection().close()

    def obey(self, words: dict[str, Any]) -> str:
        """Give a command to the run; why it does not take it, '' where it does. As `operator_commands.obey`."""
        try:
            with self._connection() as connection:
                connection.send_bytes(json.dumps(words).encode())
                if not connection.poll(_ANSWER_S):
                    return f"the run has not answered for {_ANSWER_S:g} s; it may have taken the command"
                return str(connection.recv_bytes(_LONGEST_BYTES), "utf-8", "replace")
        except (OSError, EOFError):
            return "the run has ended, or ends, and takes no command"
        except FlowrecError as error:
            return str(error)

    def _connection(self) -> Any:
        """A `multiprocessing.connection.Connection`; on Windows a PipeConnection."""
        try:
            return Client(_address(self._session))
        except OSError as error:
            raise FlowrecError(
                f"{self._session}: its run takes no commands here ({error.strerror or error}); "
                "they are given by the user and on the machine that record it"
            ) from error
