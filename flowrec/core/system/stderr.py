"""Output to stderr that can not stop a run.

A terminal can freeze (Ctrl-S, a stopped emulator, a dead link) or vanish (EIO). During a run a thread does the
writing, text that it can not write in time is dropped, and errors are ignored.
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

_LIMIT_CHARACTERS = 200_000  # queued for a frozen terminal; then the oldest text is dropped
_CLOSE_TIMEOUT_S = 0.3  # for the rest to be written after the run


class Outlet(io.TextIOBase):
    """The file that the console writes to: the current stderr."""

    def __init__(self) -> None:
        self._pump: _Pump | None = None

    def write(self, text: str) -> int:
        """Write; during a run queue the text and return at once."""
        if self._pump is not None:
            self._pump.put(text)
        else:
            with _vanished_is_no_error():
                _stderr().write(text)
        return len(text)

    def flush(self) -> None:
        """Flush stderr; during a run the thread does."""
        if self._pump is None:
            with _vanished_is_no_error():
                _stderr().flush()

    def close(self) -> None:
        """Do nothing: stderr stays open. At its end, the interpreter closes what nothing is left to flush with."""

    def isatty(self) -> bool:
        """True if a person sees it."""
        return _stderr().isatty()

    def fileno(self) -> int:
        """File descriptor of stderr."""
        return _stderr().fileno()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Text encoding of stderr."""
        return _stderr().encoding

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Context in which a thread does the writing."""
        pump = _Pump()
        self._pump = pump
        try:
            yield
        finally:
            self._pump = None
            pump.close()


def _stderr() -> TextIO:
    """The real stderr, not the proxy that rich installs while it shows a bar, which prints through Outlet."""
    return cast(TextIO, getattr(sys.stderr, "rich_proxied_file", sys.stderr))


class _Pump:
    """Writes queued text to a descriptor that may block for ever; drops the oldest if there is too much."""

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
        self._thread.join(_CLOSE_TIMEOUT_S)

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
            except OSError:  # the terminal has vanished
                return


def _vanished_is_no_error() -> contextlib.suppress:
    return contextlib.suppress(OSError, ValueError)


def said_within(seconds: float, say: Callable[[], None]) -> bool:
    """Print something that may block or fail; False if the terminal did not accept it in time."""

    def attempt() -> None:
        with _vanished_is_no_error():
            say()
            sys.stdout.flush()
            sys.stderr.flush()

    thread = threading.Thread(target=attempt, name="last words", daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()
