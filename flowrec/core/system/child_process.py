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
_LINE_LETTERS = 300  # of its last line
_JOIN_S = 5.0  # for its threads, and for a process that has closed its pipe


class ChildEndedError(Exception):
    """The process has ended without an answer.

    Attributes
    ----------
    how : as "killed by SIGKILL" or "exit status 1".
    last_line : the last one that it has printed; '' if there is none.
    """

    def __init__(self, how: str, last_line: str) -> None:
        super().__init__(how + (f": {last_line[:_LINE_LETTERS]}" if last_line else ""))
        self.how, self.last_line = how, last_line


class ChildProcess:
    """The process, as its parent sees it; it ends with `close`, or with the parent.

    `inherited`: file descriptors that it gets, too. Raises OSError: it does not start.

    Attributes
    ----------
    process : that of the system.
    printed : the last part of what it has printed.
    """

    def __init__(
        self, module: str, *words: str, environment: Mapping[str, str] | None = None, inherited: Sequence[int] = ()
    ) -> None:
        self.process = start_child(module, *words, environment=environment, stderr=subprocess.PIPE, pass_fds=inherited)
        self.printed = b""
        self._answers: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()
        self._collector, self._receiver = (
            threading.Thread(target=target, name=module, daemon=True) for target in (self._collect, self._receive)
        )
        self._collector.start()
        self._receiver.start()

    def send(self, order: object) -> None:
        """Send an object. To a process that has ended nothing is sent: its answer says so.

        What pickle raises: the object can not be sent.
        """
        assert self.process.stdin is not None
        pickled = pickle.dumps(order, pickle.HIGHEST_PROTOCOL)
        with contextlib.suppress(OSError):
            self.process.stdin.write(pickled)
            self.process.stdin.flush()

    def receive(self, timeout_s: float | None = None) -> Any:
        """Wait for the next answer.

        Raises
        ------
        queue.Empty : there is none in that time.
        ChildEndedError : there will be none. What pickle raises: it can not be read.
        """
        answer, error = self._answers.get(timeout=timeout_s)
        if error is not None:
            self._answers.put((None, error))  # for the next call, too
            raise error
        return answer

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
        self._receiver.join(_JOIN_S)
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert pipe is not None
            with contextlib.suppress(OSError):  # the unread part of an order
                pipe.close()

    def _receive(self) -> None:
        assert self.process.stdout is not None
        try:
            while True:
                self._answers.put((pickle.load(self.process.stdout), None))  # noqa: S301 - from our own process
        except (OSError, EOFError, pickle.UnpicklingError):
            self._answers.put((None, self._end()))
        except Exception as error:  # noqa: BLE001  nobody may wait for ever
            self._answers.put((None, error))

    def _end(self) -> ChildEndedError:
        try:
            status = self.process.wait(_JOIN_S)
        except subprocess.TimeoutExpired:
            return ChildEndedError("its pipe is closed", "")
        self._collector.join(_JOIN_S)
        how = f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
        return ChildEndedError(how, self.printed.decode(errors="replace").strip().rpartition("\n")[2])

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
