"""A module of flowrec as a process that is sent objects and answers with objects, both pickled: its two ends."""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from flowrec.core.system.processes import start_child

_PRINTED_BYTES = 65_536  # the last part of what the process printed
_JOIN_S = 5.0


class ChildProcess:
    """The process, as its parent sees it; it ends with `close`, or with the parent.

    Parameters
    ----------
    inherited : file descriptors that it gets, too.

    Attributes
    ----------
    process : that of the system.
    printed : the last part of what it has printed.

    Raises
    ------
    OSError : it does not start.
    """

    def __init__(
        self,
        module: str,
        *words: str,
        environment: Mapping[str, str] | None = None,
        inherited: Sequence[int] = (),
    ) -> None:
        self.process = start_child(module, *words, environment=environment, stderr=subprocess.PIPE, pass_fds=inherited)
        self.printed = b""
        self._collector = threading.Thread(target=self._collect, name=module, daemon=True)
        self._collector.start()

    def send(self, order: object) -> None:
        """Send an object. OSError : the process has ended; what pickle raises: the object can not be sent."""
        assert self.process.stdin is not None
        self.process.stdin.write(pickle.dumps(order, pickle.HIGHEST_PROTOCOL))
        self.process.stdin.flush()

    def receive(self) -> Any:
        """Wait for the next answer. OSError, EOFError, UnpicklingError : the process has ended."""
        assert self.process.stdout is not None
        return pickle.load(self.process.stdout)  # noqa: S301 - from our own process

    def cause(self) -> str:
        """The way in which it has ended, as "killed by SIGKILL" or "exit status 1"."""
        try:
            status = self.process.wait(_JOIN_S)
        except subprocess.TimeoutExpired:
            return "its pipe is closed"
        self._collector.join(_JOIN_S)
        return f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    @property
    def last_line(self) -> str:
        """The last line that it has printed; '' if there is none."""
        return self.printed.decode(errors="replace").strip().rpartition("\n")[2]

    def finish(self) -> None:
        """Close its stdin, and wait until it has ended by itself."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):  # the unread part of an order
            self.process.stdin.close()
        self.process.wait()
        self.close()

    def close(self) -> None:
        """End the process at once."""
        self.process.kill()
        self.process.wait()
        self._collector.join(_JOIN_S)
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert pipe is not None
            with contextlib.suppress(OSError):  # the unread part of an order
                pipe.close()

    def _collect(self) -> None:
        assert self.process.stderr is not None
        while printed := os.read(self.process.stderr.fileno(), _PRINTED_BYTES):
            self.printed = (self.printed + printed)[-_PRINTED_BYTES:]


class Parent:
    """The parent, as the process sees it, which ends with it: also during an order, because nobody reads its answer.

    To be made once. From then on what is printed goes to stderr, so that it does not get between the answers.
    """

    def __init__(self) -> None:
        self._answers = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)
        self._orders: queue.SimpleQueue[Any] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()

    def order(self) -> Any:
        """Wait for the next order."""
        return self._orders.get()

    @property
    def is_idle(self) -> bool:
        """True while no order waits."""
        return self._orders.empty()

    def answer(self, pickled: bytes) -> None:
        """Send an answer."""
        try:
            self._answers.write(pickled)
            self._answers.flush()
        except BrokenPipeError:
            os._exit(0)

    def _listen(self) -> None:
        try:
            while True:
                self._orders.put(pickle.load(sys.stdin.buffer))  # noqa: S301 - from our own parent
        except (OSError, EOFError):
            os._exit(0)
        except BaseException:  # noqa: BLE001  an order that can not be read
            traceback.print_exc()
            os._exit(1)
