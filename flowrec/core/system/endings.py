"""The end of a program by a signal: work is left as by Ctrl-C, then one line and the status of the signal.

SIGTERM and SIGHUP end Python at once, and what is being written stays behind. Here they raise what Ctrl-C raises, so
all that cleans up after Ctrl-C cleans up after them. A run that must end in order handles signals itself
(run/signals.py) while it is under way.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn, Self

from flowrec.core.coverage import Coverage
from flowrec.core.errors import FlowrecError

_AGAIN_S = 0.02  # after an interruption that Python could not raise
_STATUS = 128  # plus the number of the signal, as shells count it
_WORDS = {"SIGINT": "SIGINT: Ctrl-C", "SIGTERM": "SIGTERM", "SIGHUP": "SIGHUP: the terminal was closed"}


class Ended(KeyboardInterrupt):
    """A signal ends the program. A kind of KeyboardInterrupt, so that whatever makes way for Ctrl-C makes way for it.

    Attributes
    ----------
    number : of the signal.
    covered : how far the work was; None: it had not begun.
    result : what is known by then, of the type that the work returns; None: nothing.
    """

    def __init__(self, number: int = signal.SIGINT, covered: Coverage | None = None, result: Any = None) -> None:
        super().__init__(stopped_by(number))
        self.number = number
        self.covered = covered
        self.result = result

    @classmethod
    def of(cls, error: KeyboardInterrupt) -> Self:
        """The interrupt as an Ended; itself if it is one."""
        return error if isinstance(error, cls) else cls()

    @property
    def why(self) -> str:
        """The signal, as "SIGINT: Ctrl-C"."""
        return stopped_by(self.number)

    @property
    def status(self) -> int:
        """The exit status."""
        return status_of(self.number)


class StoppedError(FlowrecError):
    """A verb that a signal has ended, as one line. Exit status 130, or 143 after SIGTERM."""

    def __init__(self, ended: Ended, left: str = "") -> None:
        covered = ended.covered
        after = f" after {covered.amount}" if covered is not None and covered.done else ""
        super().__init__(f"stopped{after} ({ended.why}){f'; {left}' if left else ''}")
        self.exit_status = ended.status
        self.covered = covered

    def as_json(self) -> dict[str, Any]:
        """The error for --json, of a verb that has no result."""
        covered = self.covered.as_json() if self.covered is not None else None
        return {"stopped": str(self), "exit_status": self.exit_status, "covered": covered}


@contextmanager
def stopped_in_one_line() -> Iterator[None]:
    """Context of a verb: Ctrl-C or a signal leaves it as StoppedError."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise StoppedError(Ended.of(error)) from error


def status_of(number: int) -> int:
    """The exit status of a program that a signal has ended: 130 for SIGINT, 143 for SIGTERM."""
    return _STATUS + number


def stopped_by(number: int) -> str:
    """Text about a signal for people."""
    name = signal.Signals(number).name
    return _WORDS.get(name, name)


@contextmanager
def one_line_at_the_end() -> Iterator[None]:
    """Context of a whole program, from before its imports: a signal that ends it ends it in one line.

    An exception that an import makes of an interruption counts as one, and an interruption that is swallowed where
    Python can not raise it (the end of an object, a callback from C) is sent again a moment later. Once the work is
    done, a signal can not undo it: the status stays its own.
    """
    atexit.register(_set_all, signal.SIG_IGN)  # the first that is registered is the last that is called
    arrived: list[int] = []

    def handle(number: int, _frame: FrameType | None) -> NoReturn:
        arrived.append(number)
        raise Ended(number)

    def unraisable(found: Any) -> None:
        if isinstance(found.exc_value, KeyboardInterrupt) and arrived:
            again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), arrived[-1]))
            again.daemon = True
            again.start()
        else:
            sys.__unraisablehook__(found)

    sys.unraisablehook = unraisable
    _set_all(handle)
    try:
        yield
    except SystemExit as done:
        status = done.code if isinstance(done.code, int) else int(done.code is not None)
        if arrived and status == status_of(arrived[-1]):  # its line is printed
            _end_now(status)
        _set_all(lambda *_: os._exit(status))  # the rest of Python may wait for threads
        raise
    except BaseException as error:
        if not arrived and not isinstance(error, KeyboardInterrupt):
            raise
        ended = Ended.of(error) if isinstance(error, KeyboardInterrupt) else Ended(arrived[0])
        _exit(ended)


def _set_all(handler: Any) -> None:
    for name in _WORDS:
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, handler)


def _exit(ended: Ended) -> NoReturn:
    """One line, and the end of the process without the rest of Python: nothing is open, and atexit may take long."""
    _set_all(signal.SIG_DFL)
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    with suppress(OSError, ValueError):
        sys.stderr.write(f"flowrec: {StoppedError(ended)}\n")
    _end_now(ended.status)


def _end_now(status: int) -> NoReturn:
    """The end of the process; the rest of Python would wait for threads, as one that asks a server."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)
