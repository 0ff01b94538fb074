"""Who attends a run: nobody, or a person at the terminal with signals, keys, a status line and progress bars."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from flowrec.messages import Tick
from flowrec.run.control import Desk
from flowrec.run.disk_monitor import DiskWatch
from flowrec.run.keyboard import HELP, KeyBoard, listening
from flowrec.run.signals import Signals
from flowrec.run.watchdog import Guard
from flowrec.store import SessionWriter
from flowrec.terminal import StatusLine, progress, say


class Unattended:
    """A run that is a function call, in any thread: it takes no signals and no keys and prints no progress.

    Attributes
    ----------
    desk : what the run is asked, for example `desk.stop("enough")` from another thread.
    """

    def __init__(self, desk: Desk | None = None) -> None:
        self.desk = desk if desk is not None else Desk()

    def armed(
        self, guard: Guard | None = None, give_up: Callable[[], str] = lambda: ""
    ) -> AbstractContextManager[None]:
        """While something is open that has to be ended in good order; see Signals."""
        return nullcontext()

    def shown(self, writer: SessionWriter, disk: DiskWatch) -> AbstractContextManager[Callable[[Tick], None]]:
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
        self._board: KeyBoard | None = None
        self._leave_terminal: Callable[[], None] = lambda: None

    def armed(
        self, guard: Guard | None = None, give_up: Callable[[], str] = lambda: ""
    ) -> AbstractContextManager[None]:
        return Signals(self.desk, guard, give_up, lambda: self._leave_terminal()).armed()

    @contextmanager
    def shown(self, writer: SessionWriter, disk: DiskWatch) -> Iterator[Callable[[Tick], None]]:
        with listening(self.desk) as terminal:
            if terminal is not None:
                self._board, self._leave_terminal = terminal
            status = StatusLine(lambda: writer.bytes_written, lambda: disk.text, lambda: self.note)
            with status.shown():
                if terminal is not None:
                    say(HELP)
                yield status

    def progress(self, what: str, total: float) -> AbstractContextManager[Callable[[float], None]]:
        return progress(what, total)

    @property
    def note(self) -> str | None:
        return self._board.note if self._board is not None else None
