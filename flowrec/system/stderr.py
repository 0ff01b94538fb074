"""Where our lines for people go: to stderr, which during a run must not be able to stop it.

A terminal can freeze (Ctrl-S, a stopped emulator, a dead link) or vanish (EIO). During a run a thread does the
writing, what it can not write in time is left out, and errors end nothing.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO, cast

_LIMIT_CHARACTERS = 200_000  # that wait for a frozen terminal; what is older makes room
_GOODBYE_S = 0.3  # for the rest to be written when the run is over


class Outlet(io.TextIOBase):
    """The file that the console writes to: stderr as it is at that moment."""

    def __init__(self) -> None:
        self._pump: _Pump | None = None

    def write(self, text: str) -> int:
        """Write, or during a run hand over and return at once."""
        if self._pump is not None:
            self._pump.put(text)
        else:
            with _vanished_is_no_error():
                _stderr().write(text)
        return len(text)

    def flush(self) -> None:
        """Nothing waits here outside a run."""
        if self._pump is None:
            with _vanished_is_no_error():
                _stderr().flush()

    def isatty(self) -> bool:
        """Whether a person sees it."""
        return _stderr().isatty()

    def fileno(self) -> int:
        """Of stderr."""
        return _stderr().fileno()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Of stderr."""
        return _stderr().encoding

    @contextmanager
    def aside(self) -> Iterator[None]:
        """For the length of the context a thread does the writing."""
        pump = _Pump()
        self._pump = pump
        try:
            yield
        finally:
            self._pump = None
            pump.close()


def _stderr() -> TextIO:
    """Itself, not what rich puts in its place while a bar or a status line is shown: that prints through us."""
    return cast(TextIO, getattr(sys.stderr, "rich_proxied_file", sys.stderr))


class _Pump:
    """Text on its way to a descriptor that may block for ever; the oldest is left out when there is too much."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: list[str] = []
        self._size = 0
        self._closed = False
        self._descriptor: int | None
        try:
            _stderr().flush()
            # The descriptor itself: a thread that is stuck in sys.stderr would hold its lock at the interpreter's end.
            # A notebook or a test has put another object there, which knows better where its text goes.
            own = _stderr() is sys.__stderr__
            self._descriptor = os.dup(_stderr().fileno()) if own else None
        except (OSError, ValueError):
            self._descriptor = None
        self._thread = threading.Thread(target=self._work, name="terminal", daemon=True)
        self._thread.start()

    def put(self, text: str) -> None:
        with self._changed:
            self._waiting.append(text)
            self._size += len(text)
            while self._size > _LIMIT_CHARACTERS:
                self._size -= len(self._waiting.pop(0))
            self._changed.notify_all()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_GOODBYE_S)

    def _work(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._closed)
                    text = "".join(self._waiting)
                    self._waiting.clear()
                    self._size = 0
                    if not text:
                        return
                self._write(text)
        finally:
            if self._descriptor is not None:
                os.close(self._descriptor)

    def _write(self, text: str) -> None:
        if self._descriptor is None:
            with _vanished_is_no_error():
                _stderr().write(text)
            return
        left = text.encode(_stderr().encoding or "utf-8", "backslashreplace")
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:
                time.sleep(0.05)  # a terminal that some other program has set so
            except OSError:  # vanished: nobody reads this any more
                return


@contextmanager
def _vanished_is_no_error() -> Iterator[None]:
    with contextlib.suppress(OSError, ValueError):
        yield


def said_within(seconds: float, say: Callable[[], None]) -> bool:
    """Print something that may block or fail; False where the terminal did not take it in time."""

    def attempt() -> None:
        with _vanished_is_no_error():
            say()
            sys.stdout.flush()
            sys.stderr.flush()

    thread = threading.Thread(target=attempt, name="last words", daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()
