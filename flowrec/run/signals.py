"""Signals to a run: the command line's. A thread of its own hears them, also while the main thread is stuck in C.

Python runs signal handlers between two steps of the main thread; the number of a signal is in a pipe at once
(signal.set_wakeup_fd), and the thread at its other end does what is to be done. The handlers themselves do nothing, so
that no signal interrupts the coils' zero() or leaves a lock taken. One exception: SIGALRM, which the thread sends to
the main thread, raises `Interrupted` in the blocks that the desk allows.

| signal | what is done |
|---|---|
| SIGINT, SIGTERM, SIGHUP | the run is to end: down the ramp, by ticks |
| SIGINT again, SIGTERM twice, SIGQUIT, SIGUSR1, SIGUSR2 | zero() at once; the file is finished if 3 s suffice |
| SIGTSTP (Ctrl-Z) | zero() at once; then the process stops, and ends the run after `fg` |

A run that was told to end by a signal or by the guard and whose loop is stuck for 5 s, or that was told twice and is
still there 3 s later, is ended by this thread: the field off, the file closed if its thread answers, os._exit(1).
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from flowrec.run.control import Desk
from flowrec.run.watchdog import ZERO_PATIENCE_S, Guard
from flowrec.system.realtime_priority import first_of_all
from flowrec.system.stderr import said_within

_ENDING = {
    signal.SIGINT: "stopped by SIGINT: Ctrl-C",
    signal.SIGTERM: "stopped by SIGTERM",
    signal.SIGHUP: "stopped by SIGHUP: the terminal was closed",
}
_AT_ONCE = {
    signal.SIGTSTP: "operator: zero field (SIGTSTP: Ctrl-Z)",
    signal.SIGQUIT: "operator: zero field (SIGQUIT)",
    signal.SIGUSR1: "operator: zero field (SIGUSR1)",
    signal.SIGUSR2: "operator: zero field (SIGUSR2)",
}
_LOOK_S = 0.1
_TOLD_TWICE_S = 3.0  # for the main thread to end the run
_TICK_S = 0.3  # for the tick that records Ctrl-Z
_SAID_S = 0.3  # for the last line to be printed


class Signals:
    """Hears signals for a desk and a guard.

    Parameters
    ----------
    guard : of the coils; None for a replay, which has none: then only the signals that end a run are taken.
    give_up : closes what is open, within a second; returns what a person is to know of the file.
    leave_terminal : gives the terminal back to the shell.
    """

    def __init__(
        self,
        desk: Desk,
        guard: Guard | None = None,
        give_up: Callable[[], str] = lambda: "",
        leave_terminal: Callable[[], None] = lambda: None,
    ) -> None:
        self._desk = desk
        self._guard = guard
        self._give_up = give_up
        self._leave_terminal = leave_terminal
        self._main = threading.get_ident()
        self._by: int | None = None  # the signal that asked for the end
        self._gone_s: float | None = None  # when the process must be
        self._over = False

    @contextmanager
    def armed(self) -> Iterator[None]:
        """Take signals for the length of the context; in the main thread."""
        wanted: list[int] = [*_ENDING, *(_AT_ONCE if self._guard is not None else ())]
        kept = [signal.SIGINT, signal.SIGTERM]  # a shell without job control starts what is in the background so
        wanted = [one for one in wanted if one in kept or signal.getsignal(one) != signal.SIG_IGN]  # nohup
        heard, told = os.pipe()
        os.set_blocking(told, False)
        before: dict[int, Any] = {number: signal.signal(number, _nothing) for number in wanted}
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._leave_loop)
        pipe_before = signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        thread = threading.Thread(target=self._listen, args=(heard,), name="signals", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._over = True
            os.write(told, b"\0")
            thread.join()  # it may have to stop the process
            signal.set_wakeup_fd(pipe_before)
            for number, handler in before.items():
                signal.signal(number, handler)
            os.close(heard)
            os.close(told)

    def _leave_loop(self, _number: int, _frame: FrameType | None) -> None:
        self._desk.interrupt()

    # ---- the thread

    def _listen(self, heard: int) -> None:
        with first_of_all(2):  # as the guard
            while True:
                ready, _, _ = select.select([heard], [], [], _LOOK_S)
                for number in os.read(heard, 64) if ready else b"":
                    self._hear(number)
                if self._over:
                    return
                if self._desk.leave_now:
                    signal.pthread_kill(self._main, signal.SIGALRM)
                driven = self._guard is not None and self._guard.timeout_s is not None
                if (driven and self._desk.stuck) or (self._gone_s is not None and time.monotonic() > self._gone_s):
                    self._end()

    def _hear(self, number: int) -> None:
        if number in _ENDING:
            # A closed terminal comes twice, from the kernel and the shell, and a shutdown sends whatever it knows.
            insists = number == signal.SIGINT or (number == signal.SIGTERM and self._by == signal.SIGTERM)
            if self._by is None or not insists:
                self._by = number if self._by is None else self._by
                self._desk.stop(_ENDING[signal.Signals(number)])
                return
            self._at_once(f"{signal.Signals(number).name} again: zero field")
        elif number == signal.SIGTSTP:
            self._suspend()
        elif number in _AT_ONCE:
            self._at_once(_AT_ONCE[signal.Signals(number)])

    def _at_once(self, reason: str) -> None:
        if self._guard is not None:
            self._guard.trip(reason)
        self._desk.hurry()
        if self._gone_s is None:
            self._gone_s = time.monotonic() + _TOLD_TWICE_S

    def _suspend(self) -> None:
        """Stop the process, but not with a field on."""
        assert self._guard is not None
        self._guard.trip(_AT_ONCE[signal.SIGTSTP])
        if not self._guard.wait_off(ZERO_PATIENCE_S):
            return  # who stops now stops the repetitions as well
        end_s = time.monotonic() + _TICK_S
        while self._desk.pending and time.monotonic() < end_s:
            time.sleep(0.01)
        self._leave_terminal()
        os.kill(os.getpid(), signal.SIGSTOP)

    def _end(self) -> None:
        """The main thread does not come: end the process without it."""
        guard = self._guard
        if guard is not None:
            guard.take_away()
        said = ["the main thread does not answer, the process ends without it"]
        if guard is not None and not guard.wait_off(ZERO_PATIENCE_S):
            said.append(f"the coils may still carry a field: {guard.trouble}; switch the amplifiers off by hand")
        said.append(self._give_up())
        self._leave_terminal()
        said_within(_SAID_S, lambda: print(f"flowrec: {'; '.join(filter(None, said))}", file=sys.stderr))
        os._exit(1)


def _nothing(_number: int, _frame: FrameType | None) -> None:
    """The number is in the pipe."""
