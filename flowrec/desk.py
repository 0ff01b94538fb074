"""What a run is asked from outside while it goes on: keys, signals, a disk that runs full; and ending it in time.

Anybody may ask, from any thread; the loop takes one event a tick, so that every one of them is recorded. A run that is
to end does so by ticks: coils down their ramp, all of it on file. Where no tick comes any more, or a slow stage is at
work in the loop's own thread, the desk interrupts the loop by a signal: the end must not wait for either.
"""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

from flowrec.messages import OperatorEvent

Result = TypeVar("Result")

RAMP_PATIENCE_S = 0.8  # for the coils to come down their ramp by ticks; the next tick then takes all of the field away
_TICK_PATIENCE_S = 0.3  # for that tick to come; then the loop is left, and the rig switches the coils off
_PROD_S = 0.1
_REASONS = {
    signal.SIGINT: "stopped by SIGINT: Ctrl-C",
    signal.SIGTERM: "stopped by SIGTERM",
    signal.SIGHUP: "stopped by SIGHUP: the terminal was closed",
}


class Interrupted(BaseException):
    """The run is to end and the loop must not wait any longer. No Exception: nobody but the loop catches it."""


class Desk:
    """Events that wait for their tick, and the wish that the run end.

    Attributes
    ----------
    reason : why the run is to end; empty as long as it is not.
    ticking : whether the loop has begun; before, nothing is driven, and the end need not wait for anything.
    """

    def __init__(self) -> None:
        self.reason = ""
        self.ticking = False
        self._since_s = 0.0
        self._by: int | None = None  # the signal that asked for the end
        self._waiting: deque[tuple[str, str]] = deque()
        self._armed = self._cut = False
        self._leave_when_late = self._at_work = False

    # ---- for those who ask, from any thread

    def ask(self, action: str, text: str = "") -> None:
        """An event for the record: mark, note, or hold, which is pause or resume."""
        self._waiting.append((action, text))

    def stop(self, reason: str, *, zero: bool = False) -> None:
        """The run is to end; with `zero` the field is gone on the next tick, before anything else that was asked."""
        if zero:
            self._waiting.appendleft(("zero", reason))
        elif not self.reason:
            self._waiting.append(("stop", reason))
        if not self.reason:
            self._since_s = time.monotonic()
            self.reason = reason
            if self._armed:
                signal.setitimer(signal.ITIMER_REAL, 1e-3, _PROD_S)

    # ---- for the loop

    def next(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
        """The event of the tick of this stamp."""
        if self._late() > RAMP_PATIENCE_S and not self._cut:
            self._cut = True
            return OperatorEvent(stamp_ns, "zero", self.reason)
        if not self._waiting:
            return None
        action, text = self._waiting.popleft()
        if action == "hold":
            action = "resume" if held else "pause"
        return OperatorEvent(stamp_ns, action, text)

    @property
    def pending(self) -> bool:
        """Whether events wait for a tick."""
        return bool(self._waiting)

    @property
    def overdue(self) -> bool:
        """The run should have ended by now, and its field is gone."""
        return self._cut

    @contextmanager
    def left_when_late(self) -> Iterator[None]:
        """The loop, or what leads to it: it is left when the end is overdue, whatever it waits for."""
        self._leave_when_late = True
        try:
            yield
        except Interrupted:
            pass
        finally:
            self._leave_when_late = False

    def unless_stopped(self, work: Callable[[], Result], otherwise: Result) -> Result:
        """What slow work gives, or the other thing as soon as the run is to end."""
        try:
            self._at_work = True
            try:
                return work() if not self.reason else otherwise
            finally:
                self._at_work = False
        except Interrupted:
            self._at_work = False
            return otherwise

    def _late(self) -> float:
        """For how long the run has been asked to end, in s; 0: it has not."""
        return time.monotonic() - self._since_s if self.reason else 0.0

    # ---- signals

    @contextmanager
    def armed(self) -> Iterator[Desk]:
        """Take Ctrl-C, SIGTERM and the closing of the terminal as the wish to end; a second Ctrl-C gets through."""
        wanted = dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), self._signalled)
        if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:  # nohup
            del wanted[signal.SIGHUP]
        before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._prodded)
        self._armed = True
        if self.reason:
            signal.setitimer(signal.ITIMER_REAL, 1e-3, _PROD_S)
        try:
            yield self
        finally:
            self._armed = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            for number, handler in before.items():
                signal.signal(number, handler)

    def _signalled(self, number: int, _frame: FrameType | None) -> None:
        # A closed terminal comes twice, from the kernel and from the shell, and a shutdown sends whatever it knows.
        insists = number == signal.SIGINT or (number == signal.SIGTERM and self._by == signal.SIGTERM)
        if self._by is not None and insists:
            raise KeyboardInterrupt
        self._by = number if self._by is None else self._by
        self.stop(_REASONS[signal.Signals(number)])

    def _prodded(self, _number: int, _frame: FrameType | None) -> None:
        late = self._late() > RAMP_PATIENCE_S + _TICK_PATIENCE_S or not self.ticking
        if self.reason and (self._at_work or (self._leave_when_late and late)):
            raise Interrupted
