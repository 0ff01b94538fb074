"""What a run is asked from outside while it goes on: keys, signals, a disk that runs full; and ending it in time.

Anybody may ask, from any thread; the loop takes one event a tick, so that every one of them is recorded. A run that is
to end does so by ticks: coils down their ramp, all of it on file. Where no tick comes any more, or a slow stage is at
work in the loop's own thread, the loop is left by an exception: the end must not wait for either. That exception is
raised in the blocks that the loop has marked as `interruptible` or `unless_stopped` only, where it holds no lock.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from flowrec.messages import OperatorEvent

Result = TypeVar("Result")

RAMP_PATIENCE_S = 0.8  # for the coils to come down their ramp by ticks; the next tick then takes all of the field away
_TICK_PATIENCE_S = 0.3  # for that tick to come; then the loop is left, and the rig switches the coils off
_STUCK_S = 5.0  # for the loop to be left; then its thread is stuck


class Interrupted(BaseException):
    """The run is to end and the loop must not wait any longer. No Exception: nobody but the loop catches it."""


class Desk:
    """Events that wait for their tick, and the wish that the run end.

    Parameters
    ----------
    clock : monotonic time in s.

    Attributes
    ----------
    reason : why the run is to end; empty as long as it is not.
    ticking : whether the loop has begun; before, nothing is driven, and the end need not wait for anything.
    interruptible : a context, for the loop: in this block it may be left when the end is overdue.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.reason = ""
        self.ticking = False
        self.interruptible = _Region()
        self._clock = clock
        self._since_s = 0.0
        self._waiting: deque[tuple[str, str]] = deque()
        self._cut = self._at_work = self._looping = False

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
            self._since_s = self._clock()
            self.reason = reason

    def hurry(self) -> None:
        """There is no time for a ramp any more."""
        self._since_s = min(self._since_s, self._clock() - RAMP_PATIENCE_S)

    # ---- for the loop

    def next(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
        """The event of the tick of this stamp."""
        if self._late() > RAMP_PATIENCE_S and not self._cut:
            self._cut = True
            return OperatorEvent(stamp_ns, "zero", self.zero_waiting or self.reason)
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
    def zero_waiting(self) -> str:
        """The reason of a zero that no tick has taken; empty where there is none."""
        return next((text for action, text in list(self._waiting) if action == "zero"), "")

    @property
    def overdue(self) -> bool:
        """The run should have ended by now, and its field is gone."""
        return self._cut

    @contextmanager
    def left_when_late(self) -> Iterator[None]:
        """The loop: it is left from an `interruptible` block in it when the end is overdue."""
        self._looping = True
        try:
            yield
        except Interrupted:
            pass
        finally:
            self._looping = self.interruptible.entered = False

    def interrupt(self) -> None:
        """In the loop's thread, for example in a signal handler: leave the loop if it is to be left and can be."""
        if self.leave_now:
            self._at_work = self.interruptible.entered = False  # so that nothing raises again on the way out
            raise Interrupted

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

    # ---- for who interrupts it, from any thread

    @property
    def leave_now(self) -> bool:
        """Whether the loop is to be left and can be: `Interrupted` may be raised in its thread."""
        if not self.reason:
            return False
        late = self._late() > RAMP_PATIENCE_S + _TICK_PATIENCE_S or not self.ticking
        return self._at_work or (self.interruptible.entered and late)

    @property
    def stuck(self) -> bool:
        """The loop should have been left long ago and was not: its thread is in a call that does not return."""
        return self._looping and self._late() > _STUCK_S

    def _late(self) -> float:
        """For how long the run has been asked to end, in s; 0: it has not."""
        return self._clock() - self._since_s if self.reason else 0.0


class _Region:
    """Whether a thread is in a block; entered and left a few times a tick."""

    def __init__(self) -> None:
        self.entered = False

    def __enter__(self) -> None:
        self.entered = True

    def __exit__(self, *error: object) -> None:
        self.entered = False
