"""Keys of the terminal during a run: no display server, works over SSH.

q stops, m marks, n opens a note, space holds the robot and lets it go on, ! takes the field away at once. Only a
terminal is read, and only in the foreground: input that is piped in belongs to whoever started the run.
"""

from __future__ import annotations

import codecs
import contextlib
import os
import re
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from flowrec.run.control import Desk

HELP = "keys: q stop   m mark   n note   space hold, go on   ! zero field at once"
_LOOK_S = 0.25
_LONGEST_NOTE = 500
_SEQUENCE = re.compile("\x1b(\\[[0-?]*[ -/]*[@-~]|O.)")  # arrows and function keys: none of ours
_ESCAPE, _ENTER, _RUBOUT, _KILL_LINE = "\x1b", ("\r", "\n"), ("\x7f", "\x08"), "\x15"


class KeyBoard:
    """What the keys mean; knows nothing of terminals.

    Attributes
    ----------
    note : the note that is being typed; None: none is.
    """

    def __init__(self, desk: Desk) -> None:
        self.note: str | None = None
        self._desk = desk
        self._marks = 0

    def take(self, typed: str) -> None:
        """What one look at the terminal has brought."""
        for character in _SEQUENCE.sub("", typed):
            if self.note is None:
                self._command(character)
            else:
                self._into_note(self.note, character)

    def _command(self, character: str) -> None:
        if character == "q":
            self._desk.stop("stopped by the operator (q)")
        elif character == "!":
            self._desk.stop("operator: zero field (!)", zero=True)
        elif character == " ":
            self._desk.ask("hold")
        elif character == "m":
            self._marks += 1
            self._desk.ask("mark", str(self._marks))
        elif character == "n":
            self.note = ""

    def _into_note(self, note: str, character: str) -> None:
        if character in _ENTER:
            self.note = None
            if note.strip():
                self._desk.ask("note", note.strip())
        elif character == _ESCAPE:
            self.note = None
        elif character in _RUBOUT:
            self.note = note[:-1]
        elif character == _KILL_LINE:
            self.note = ""
        elif character.isprintable() and len(note) < _LONGEST_NOTE:
            self.note = note + character


@contextmanager
def listening(desk: Desk) -> Iterator[tuple[KeyBoard, Callable[[], None]] | None]:
    """Read keys for the length of the context; None where stdin is no terminal. It is left as it was found.

    The function that comes with the keys leaves it at once, in any thread.
    """
    descriptor = _terminal()
    if descriptor is None:
        yield None
        return
    board = KeyBoard(desk)
    with _Terminal(descriptor) as terminal:
        over = threading.Event()
        reader = threading.Thread(target=_read, args=(terminal, board.take, over), name="keys", daemon=True)
        reader.start()
        try:
            yield board, terminal.leave
        finally:
            over.set()
            reader.join(2 * _LOOK_S)


def _terminal() -> int | None:
    try:
        descriptor = sys.stdin.fileno()
        return descriptor if os.isatty(descriptor) else None
    except (AttributeError, OSError, ValueError):  # no stdin at all, or one that a test has put there
        return None


class _Terminal:
    """Keys without Enter and without echo while we are in the foreground, and as it was otherwise."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._found: list[Any] | None = None
        self._lock = threading.RLock()
        self._left = False

    def __enter__(self) -> _Terminal:
        self.take_over()
        return self

    def __exit__(self, *error: object) -> None:
        self.leave()

    def leave(self) -> None:
        """As it was found, for good: the end of the run, or Ctrl-Z, which ends it."""
        with self._lock:
            self._left = True
            self._give_back()

    def take_over(self) -> bool:
        """Have it hand over keys; False where it is not ours just now. Again after every look: a shell may differ."""
        with self._lock:
            if self._left or not self._ours():
                return False
            with contextlib.suppress(termios.error), _not_stopped_for_it():
                now = termios.tcgetattr(self.descriptor)
                if now[tty.LFLAG] & termios.ICANON:
                    self._found = now
                    tty.setcbreak(self.descriptor, termios.TCSANOW)
            return True

    def _give_back(self) -> None:
        # TCSANOW: to wait until a frozen terminal has shown everything would be to wait for ever.
        if self._found is not None and self._ours():
            with contextlib.suppress(termios.error), _not_stopped_for_it():
                termios.tcsetattr(self.descriptor, termios.TCSANOW, self._found)

    def _ours(self) -> bool:
        """Whether we are in the foreground; in the background a look at the terminal would stop the run."""
        try:
            return os.tcgetpgrp(self.descriptor) == os.getpgrp()
        except OSError:
            return False


def _read(terminal: _Terminal, take: Callable[[str], None], over: threading.Event) -> None:
    # Whoever sends us to the background between two lines of this must not stop the run by it.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN, signal.SIGTTOU})
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    while not over.is_set():
        if not terminal.take_over():
            over.wait(_LOOK_S)
            continue
        try:
            ready, _, _ = select.select([terminal.descriptor], [], [], _LOOK_S)
            if not ready or over.is_set():
                continue
            typed = os.read(terminal.descriptor, 1024)
        except OSError:
            if not os.isatty(terminal.descriptor):
                return  # it has vanished; SIGHUP tells the run
            over.wait(_LOOK_S)
            continue
        if not typed:
            return
        take(decoder.decode(typed))


@contextmanager
def _not_stopped_for_it() -> Iterator[None]:
    """Between our look and the change the shell may have taken the terminal back: then the change must not stop us."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
