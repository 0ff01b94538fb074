"""Signals to a run of the command line. A thread handles them, also while the main thread is stuck in C code.

Python runs signal handlers between two steps of the main thread, but writes the number of a signal to a pipe at once
(signal.set_wakeup_fd); the thread reads that pipe. The handlers themselves do nothing, so no signal interrupts the
coils' zero() or leaves a lock taken. The exception is SIGALRM: the thread sends it to the main thread, where it raises
`Interrupted` inside the blocks that RunControl allows.

| signal | effect |
|---|---|
| SIGINT, SIGTERM, SIGHUP | the run ends: the coils ramp down by ticks |
| SIGINT again, SIGTERM twice, SIGQUIT, SIGUSR1, SIGUSR2 | zero() at once; the file is finished if 3 s suffice |
| SIGTSTP (Ctrl-Z) | zero() at once; then the process stops, and ends the run after `fg` |

This thread ends the process if a signal or the watchdog has ended the run and its loop is stuck for 5 s, or if the run
was stopped at once and has not ended 3 s later: the field off, the file closed if its thread answers, os._exit(1). A
replay, which drives nothing, ends with the status of its signal.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any

from flowrec.core import Priority, realtime_priority, said_within, status_of, stopped_by
from flowrec.run.control import Interrupted, RunControl
from flowrec.run.watchdog import ZERO_PATIENCE_S, Watchdog

assert sys.platform != "win32"  # there is no SIGHUP, SIGTSTP or pthread_kill

_ENDING = {number: f"stopped by {stopped_by(number)}" for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
_AT_ONCE = {
    signal.SIGTSTP: "operator: zero field (SIGTSTP: Ctrl-Z)",
    signal.SIGQUIT: "operator: zero field (SIGQUIT)",
    signal.SIGUSR1: "operator: zero field (SIGUSR1)",
    signal.SIGUSR2: "operator: zero field (SIGUSR2)",
}
_POLL_S = 0.1
_AT_ONCE_S = 3.0  # time for the main thread to end the run
_TICK_S = 0.3  # time for the tick that records Ctrl-Z
_PRINT_S = 0.3  # time to print the last line


class Signals:
    """Turns signals into requests to a run's control and watchdog.

    Parameters
    ----------
    watchdog : of the coils; None for a replay, which has none: then only the signals that end a run are handled.
    give_up : closes what is open, within a second; returns what a person must know of the file.
    leave_terminal : restores the terminal.
    clock : monotonic time in s.
    """

    def __init__(
        self,
        control: RunControl,
        watchdog: Watchdog | None = None,
        give_up: Callable[[], str] = lambda: "",
        leave_terminal: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._control = control
        self._watchdog = watchdog
        self._give_up = give_up
        self._leave_terminal = leave_terminal
        self._main = threading.get_ident()
        self._by: int | None = None  # the signal that ended the run
        self._deadline_s: float | None = None  # for the process to end
        self._over = False

    @contextmanager
    def handle(self) -> Iterator[None]:
        """Context in which signals are handled; to be entered in the main thread."""
        wanted: list[int] = [*_ENDING, *(_AT_ONCE if self._watchdog is not None else ())]
        # An ignored signal stays ignored (nohup), except those that a shell without job control ignores in background.
        always = [signal.SIGINT, signal.SIGTERM]
        wanted = [one for one in wanted if one in always or signal.getsignal(one) != signal.SIG_IGN]
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        os.set_blocking(writing, False)
        with ExitStack() as stack:
            stack.callback(os.close, reading)
            stack.callback(os.close, writing)
            stack.callback(self._take_late, reading)
            # The pipe outlasts the handlers: it holds a signal that the former handlers do not see.
            stack.callback(signal.set_wakeup_fd, signal.set_wakeup_fd(-1))
            signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
            handlers = dict.fromkeys(wanted, _leave_to_pipe) | {signal.SIGALRM: self._interrupt}
            for number, handler in handlers.items():
                # Restoring is registered first: a signal may raise between any two of these lines.
                stack.callback(signal.signal, number, signal.getsignal(number))
                signal.signal(number, handler)
            stack.callback(setattr, sys, "unraisablehook", sys.unraisablehook)
            sys.unraisablehook = partial(self._take_swallowed, sys.unraisablehook)
            thread = threading.Thread(target=self._listen, args=(reading,), name="signals", daemon=True)
            thread.start()
            try:
                yield
            finally:
                self._over = True
                os.write(writing, b"\0")
                thread.join()  # it may have to stop the process

    def _take_late(self, pipe: int) -> None:
        """Handle the signals that came after the thread had ended: they end what follows the run."""
        with suppress(BlockingIOError):
            for number in os.read(pipe, 64):
                if number in _ENDING:
                    self._handle(number)

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        self._control.interrupt()

    def _take_swallowed(self, before: Callable[[Any], object], found: Any) -> None:
        """Hook for exceptions that Python can not raise: after an `Interrupted` the thread sends another signal."""
        if isinstance(found.exc_value, Interrupted):
            self._control.interrupt_again()
        else:
            before(found)

    # ---- the thread

    def _listen(self, pipe: int) -> None:
        with realtime_priority(Priority.DEVICE):  # as the watchdog
            while True:
                ready, _, _ = select.select([pipe], [], [], _POLL_S)
                for number in os.read(pipe, 64) if ready else b"":
                    self._handle(number)
                if self._over:
                    return
                if self._control.must_interrupt:
                    signal.pthread_kill(self._main, signal.SIGALRM)
                driven = self._watchdog is not None and self._watchdog.timeout_s is not None
                late = self._deadline_s is not None and self._clock() > self._deadline_s
                if late or (driven and self._control.stuck):
                    self._end_process()

    def _handle(self, number: int) -> None:
        if number in _ENDING:
            # A closed terminal sends SIGHUP twice, by the kernel and the shell, and a shutdown sends several signals.
            insists = number == signal.SIGINT or (number == signal.SIGTERM and self._by == signal.SIGTERM)
            if self._by is None or not insists:
                self._by = number if self._by is None else self._by
                self._control.stop(_ENDING[signal.Signals(number)], status=status_of(number))
                return
            self._at_once(f"{signal.Signals(number).name} again: zero field")
        elif number == signal.SIGTSTP:
            self._suspend()
        elif number in _AT_ONCE:
            self._at_once(_AT_ONCE[signal.Signals(number)])

    def _at_once(self, reason: str) -> None:
        if self._watchdog is not None:
            self._watchdog.trip(reason)
        self._control.skip_ramp()
        if self._deadline_s is None:
            self._deadline_s = self._clock() + _AT_ONCE_S

    def _suspend(self) -> None:
        """Stop the process, but never with a field on."""
        assert self._watchdog is not None
        self._watchdog.trip(_AT_ONCE[signal.SIGTSTP])
        if not self._watchdog.wait_off(ZERO_PATIENCE_S):
            return  # a stopped process would not repeat zero()
        end_s = time.monotonic() + _TICK_S
        while self._control.pending and time.monotonic() < end_s:
            time.sleep(0.01)
        self._leave_terminal()
        os.kill(os.getpid(), signal.SIGSTOP)

    def _end_process(self) -> None:
        """End the process without the main thread, which does not answer."""
        watchdog = self._watchdog
        if watchdog is not None:
            watchdog.take_away()
        lines = ["the main thread does not answer, the process ends without it"]
        if watchdog is not None and not watchdog.wait_off(ZERO_PATIENCE_S):
            lines.append(f"the coils may still carry a field: {watchdog.failure}; switch the amplifiers off by hand")
        lines.append(self._give_up())
        self._leave_terminal()
        said_within(_PRINT_S, lambda: print(f"flowrec: {'; '.join(filter(None, lines))}", file=sys.stderr))
        os._exit(1 if watchdog is not None or self._by is None else status_of(self._by))


def _leave_to_pipe(_number: int, _frame: FrameType | None) -> None:
    """Do nothing: the number of the signal is in the pipe."""
