"""Who attends a run: nobody, or a person at the terminal with signals, keys, a status line and progress bars."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext

from flowrec.messages import Tick
from flowrec.run.control import RunControl
from flowrec.run.disk_monitor import DiskMonitor
from flowrec.run.watchdog import Watchdog
from flowrec.store.writer import SessionWriter
from flowrec.terminal import StatusLine, progress, say


class Unattended:
    """A run that is a function call, in any thread: it takes no signals and no keys and prints no progress.

    Attributes
    ----------
    run_control : controls the run from another thread, for example `run_control.stop("enough")`.
    """

    def __init__(self, run_control: RunControl | None = None) -> None:
        self.run_control = run_control if run_control is not None else RunControl()

    def armed(
        self, watchdog: Watchdog | None = None, give_up: Callable[[], str] = lambda: ""
    ) -> AbstractContextManager[None]:
        """While something is open that has to be ended in good order; see Signals."""
        return nullcontext()

    def shown(self, writer: SessionWriter, disk: DiskMonitor) -> AbstractContextManager[Callable[[Tick], None]]:
        """While the loop runs; what is yielded takes every tick."""
        return nullcontext(lambda _tick: None)

    def progress(self, what: str, total: float) -> AbstractContextManager[Callable[[float], None]]:
        """While long work goes on; what is yielded takes how much is done."""
        return nullcontext(lambda _done: None)

    @property
    def note(self) -> str | None:
        """A note that a person is typing."""
        return None


class AtTerminal(Unattended):
    """A run of the command line, in the main thread."""

    def __init__(self) -> None:
        super().__init__()
        self._typed_note: Callable[[], str | None] = lambda: None
        self._leave_terminal: Callable[[], None] = lambda: None

    def armed(
        self, watchdog: Watchdog | None = None, give_up: Callable[[], str] = lambda: ""
    ) -> AbstractContextManager[None]:
        handled: AbstractContextManager[None] = nullcontext()
        if sys.platform != "win32":
            from flowrec.run.signals import Signals

            handled = Signals(self.run_control, watchdog, give_up, lambda: self._leave_terminal()).handled()
        return handled

    @contextmanager
    def shown(self, writer: SessionWriter, disk: DiskMonitor) -> Iterator[Callable[[Tick], None]]:
        with ExitStack() as stack:
            help_text = ""
            if sys.platform != "win32":
                from flowrec.run.keyboard import HELP, keyboard_of

                terminal = stack.enter_context(keyboard_of(self.run_control))
                if terminal is not None:
                    keyboard, self._leave_terminal = terminal
                    self._typed_note = lambda: keyboard.note
                    help_text = HELP
            status = StatusLine(lambda: writer.bytes_written, lambda: disk.text, self._typed_note)
            stack.enter_context(status.shown())
            if help_text:
                say(help_text)
            yield status

    def progress(self, what: str, total: float) -> AbstractContextManager[Callable[[float], None]]:
        return progress(what, total)

    @property
    def note(self) -> str | None:
        return self._typed_note()
