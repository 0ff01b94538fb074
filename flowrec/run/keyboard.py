"""Keys during a run. They are read from the terminal, so they need no display server and work over SSH.

What each key does is in operator_commands.py. Only a terminal is read, and only in the foreground: piped input belongs
to the program that started the run.
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

from flowrec.run.control import RunControl
from flowrec.run.operator_commands import BY_KEY, COMMANDS, LONGEST_NOTE, NOTE

assert sys.platform != "win32"  # there is no termios

_POLL_S = 0.25
_SEQUENCE = re.compile("\x1b(\\[[0-?]*[ -/]*[@-~]|O.)")  # arrows and function keys, which are ignored
_ESCAPE, _ENTER, _RUBOUT, _KILL_LINE = "\x1b", ("\r", "\n"), ("\x7f", "\x08"), "\x15"


class Keyboard:
    """Meaning of the keys, independent of the terminal.

    `note`: the note that is being typed; None without one.
    """

    def __init__(self, control: RunControl) -> None:
        self.note: str | None = None
        self._control = control

    def take(self, typed: str) -> None:
        """Handle the characters of one read."""
        for character in _SEQUENCE.sub("", typed):
            if self.note is None:
                self._command(character)
            else:
                self._edit_note(self.note, character)

    def _command(self, character: str) -> None:
        command = BY_KEY.get(character)
        if command is None:
            return
        if command.name == NOTE:
            self.note = ""
        else:
            command.give(self._control, "", character)

    def _edit_note(self, note: str, character: str) -> None:
        if character in _ENTER:
            self.note = None
            COMMANDS[NOTE].give(self._control, note, "n")
        elif character == _ESCAPE:
            self.note = None
        elif character in _RUBOUT:
            self.note = note[:-1]
        elif character == _KILL_LINE:
            self.note = ""
        elif character.isprintable() and len(note) < LONGEST_NOTE:
            self.note = note + character


@contextmanager
def keyboard_of(control: RunControl) -> Iterator[tuple[Keyboard, Callable[[], None]] | None]:
    """Context in which keys are read; None if stdin is no terminal. The terminal is left as it was found.

    The function that comes with the keyboard leaves the terminal at once, from any thread.
    """
    descriptor = _terminal()
    if descriptor is None:
        yield None
        return
    keyboard, terminal, over = Keyboard(control), _Terminal(descriptor), threading.Event()
    reader = threading.Thread(target=_read, args=(terminal, keyboard.take, over), name="keys", daemon=True)
    try:
        terminal.take_over()
        reader.start()
        yield keyboard, terminal.leave
    finally:
        over.set()
        if reader.ident is not None:
            reader.join(2 * _POLL_S)
        terminal.leave()


def _terminal() -> int | None:
    try:
        descriptor = sys.stdin.fileno()
        return descriptor if os.isatty(descriptor) else None
    except (AttributeError, OSError, ValueError):  # no stdin, or one without a descriptor
        return None


class _Terminal:
    """Hands over keys without Enter and without echo while this process is in the foreground."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._found: list[Any] | None = None
        self._lock = threading.RLock()
        self._left = False

    def leave(self) -> None:
        """Restore the terminal for good: at the end of the run, or at Ctrl-Z, which ends it."""
        with self._lock:
            self._left = True
            # TCSANOW, because TCSADRAIN waits for ever on a frozen terminal.
            if self._found is not None and self._in_foreground():
                with contextlib.suppress(termios.error), _sigttou_blocked():
                    termios.tcsetattr(self.descriptor, termios.TCSANOW, self._found)

    def take_over(self) -> bool:
        """Make it hand over keys; False in the background. Called before every read: a shell may have restored it."""
        with self._lock:
            if self._left or not self._in_foreground():
                return False
            with contextlib.suppress(termios.error), _sigttou_blocked():
                now = termios.tcgetattr(self.descriptor)
                if now[tty.LFLAG] & termios.ICANON:
                    self._found = now
                    tty.setcbreak(self.descriptor, termios.TCSANOW)
            return True

    def _in_foreground(self) -> bool:
        """True if this process is in the foreground; in the background, reading the terminal would stop the run."""
        try:
            return os.tcgetpgrp(self.descriptor) == os.getpgrp()
        except OSError:
            return False


def _read(terminal: _Terminal, take: Callable[[str], None], over: threading.Event) -> None:
    # A shell may send this process to the background between any two lines; that must not stop the run.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN, signal.SIGTTOU})
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    while not over.is_set():
        if not terminal.take_over():
            over.wait(_POLL_S)
            continue
        try:
            ready, _, _ = select.select([terminal.descriptor], [], [], _POLL_S)
            if not ready or over.is_set():
                continue
            typed = os.read(terminal.descriptor, 1024)
        except OSError:
            if not os.isatty(terminal.descriptor):
                return  # it is closed; SIGHUP ends the run
            over.wait(_POLL_S)
            continue
        if not typed:
            return
        take(decoder.decode(typed))


@contextmanager
def _sigttou_blocked() -> Iterator[None]:
    """A change of the terminal must not stop this process if the shell has just sent it to the background."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
