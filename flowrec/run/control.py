"""Control of a run from outside: operator events, the request to stop, and stopping in time.

Keys, signals, the disk monitor and the watchdog call it from any thread. The loop takes one event a tick, so every
event is recorded. A run normally stops by ticks: the coils ramp down and all of it is in the file. If no tick comes, or
if a slow stage is at work in the loop's own thread, `Interrupted` is raised in that thread: the end must not wait for
either. It is raised only inside the blocks that the loop marks as `interruptible` or `unless_stopped`, where the loop
holds no lock.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np

from flowrec.core import BY_STREAM, NS_PER_S, Action, Coverage, OperatorEvent, UsageError
from flowrec.run.hand import HandSteering

Result = TypeVar("Result")

LONGEST_TEXT = 500  # characters of an event; what is longer is cut
RAMP_PATIENCE_S = 0.8  # time for the coils to ramp down by ticks; the next tick then takes all of the field away
_TICK_PATIENCE_S = 0.3  # time for that tick to come; then the loop is interrupted, and the rig switches the coils off
_SWALLOWED_S = 0.5  # for work to end after `Interrupted`; then it has swallowed it
_STUCK_S = 5.0  # time for the loop to be interrupted; then its thread is stuck

_MOST_WAITING = 100  # events; each takes a tick, so more would be recorded seconds after they were asked for
_STEERING_NS = NS_PER_S // 5  # of the session, from a goal or speed limit to the next one that is taken
_FARTHEST_UM, _SPEEDS_UM_S = 1e9, (0.01, 1e6)  # as the ranges of mission.goal and robot.max_speed_um_s

_STOPPED = 130  # exit status, as after Ctrl-C
_HOLD = "hold"  # becomes pause or resume when the loop takes it


class Interrupted(BaseException):
    """The run must end and the loop must not wait any longer. No Exception, so that only the loop catches it."""


class RunControl:
    """Events that wait for their tick, and the request to end the run.

    `clock`: monotonic time in s.

    Attributes
    ----------
    reason : why the run must end; empty before.
    stop_status : exit status of a program that judges and was stopped by that (Ctrl-C and a key are the same).
    ticking : whether the loop has begun; before, nothing is driven, and the end need not wait for anything.
    hand : steering by hand.
    interruptible : context for the loop: inside it an overdue shutdown raises `Interrupted`.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.reason = ""
        self.stop_status = _STOPPED
        self.ticking = False
        self.interruptible = _Block()
        self._clock = clock
        self._since_s = 0.0
        self._waiting: deque[tuple[str, str]] = deque()
        self._marks = itertools.count(1)
        # Of those the latest counts; append and popleft of a deque need no lock, which a signal handler could not take.
        self._steering: dict[Action, deque[OperatorEvent]] = {
            action: deque(maxlen=1) for action in (Action.GOAL, Action.SPEED)
        }
        self._steered_ns = -_STEERING_NS
        self._held_by_stream = False  # and by no person
        self.hand = HandSteering(clock)
        self.outputs: dict[str, Callable[[float], None]] = {}  # beside the coils, by stream/channel; each sets it
        self._zero_sent = self._at_work = self._looping = False
        self._working = False  # in `unless_stopped`, also on the way out of it
        self._raised_s = math.inf  # time of the last `Interrupted`

    # ---- for those who control the run, from any thread

    def request(self, action: Action, text: str = "") -> bool:
        """Ask for an event in the record; False, and nothing is done, while too many wait."""
        if len(self._waiting) >= _MOST_WAITING:
            return False
        self._waiting.append((action, text[:LONGEST_TEXT]))
        return True

    def set_goal(self, x_um: float, y_um: float) -> None:
        """Send the robot to another place on the chip. Of several that wait for their tick the latest counts.

        The mission decides, and records, whether a route leads there; if none does, the goal before stays. Raises
        UsageError: not a place that a chip could have.
        """
        if not (abs(x_um) <= _FARTHEST_UM and abs(y_um) <= _FARTHEST_UM):  # false for NaN
            raise UsageError(f"goal {x_um:g}, {y_um:g} um: both are numbers of at most {_FARTHEST_UM:g} um")
        text, goal_um = f"{x_um:.0f}, {y_um:.0f} um", np.array([x_um, y_um])
        self._steering[Action.GOAL].append(OperatorEvent(0, Action.GOAL, text, goal_um=goal_um))

    def limit_speed(self, speed_um_s: float | None) -> None:
        """Limit the robot's speed through the fluid, or with None no longer. Of several that wait the latest counts.

        Raises UsageError: not a speed of a robot; to make it stand still, hold it.
        """
        least, most = _SPEEDS_UM_S
        if speed_um_s is not None and not least <= speed_um_s <= most:
            raise UsageError(f"speed limit {speed_um_s:g} um/s: it is {least:g} to {most:g} um/s, or none")
        text, limit_um_s = ("no limit", None) if speed_um_s is None else (f"{speed_um_s:g} um/s", float(speed_um_s))
        self._steering[Action.SPEED].append(OperatorEvent(0, Action.SPEED, text, speed_limit_um_s=limit_um_s))

    def set_output(self, name: str, value: float) -> None:
        """Set an output beside the coils, such as a lamp; its stream records the value, and a note says so.

        Raises
        ------
        UsageError : the run has no such output, or it must not have this value.
        """
        if name not in self.outputs:
            raise UsageError(f"{name!r} is no output of this run; its outputs are {', '.join(self.outputs) or 'none'}")
        self.outputs[name](value)
        self.request(Action.NOTE, f"{name} set to {value:g}")

    def mark(self) -> bool:
        """Ask for the next numbered mark; keys and console share the numbers. False as of `request`."""
        return self.request(Action.MARK, str(next(self._marks)))

    def toggle_hold(self) -> None:
        """Hold the robot, or let it go on if it is held; where a stream alone holds it, hold it, too."""
        self._waiting.append((_HOLD, ""))

    def stop(self, reason: str, *, zero: bool = False, status: int = _STOPPED) -> None:
        """End the run; with `zero` the field is switched off on the next tick, before every other event."""
        if zero:
            self._waiting.appendleft((Action.ZERO, reason))
        elif not self.reason:
            self._waiting.append((Action.STOP, reason))
        if not self.reason:
            self._since_s = self._clock()
            self.stop_status, self.reason = status, reason

    def skip_ramp(self) -> None:
        """Leave no time for a ramp."""
        self._since_s = min(self._since_s, self._clock() - RAMP_PATIENCE_S)

    def with_stop(self, covered: Coverage) -> Coverage:
        """The coverage, with the stop that ended it; itself if there was none."""
        if not self.reason:
            return covered
        return replace(covered, stopped=self.reason.removeprefix("stopped by "), status=self.stop_status)

    # ---- for the loop

    def next_event(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
        """The event of the tick of this stamp."""
        if self._late_s() > RAMP_PATIENCE_S and not self._zero_sent:
            self._zero_sent = True
            return OperatorEvent(stamp_ns, Action.ZERO, self.pending_zero or self.reason)
        if not self._waiting:
            return self._next_steering(stamp_ns)
        action, text = self._waiting.popleft()
        by_stream = text.startswith(BY_STREAM)
        if action == _HOLD:  # of a robot that a stream holds, a person keeps it held, whether the stream is back or not
            action = Action.RESUME if held and not self._held_by_stream else Action.PAUSE
        if action == Action.RESUME and by_stream and not self._held_by_stream:
            action = Action.NOTE  # a person holds it, or has let it go
        if action in (Action.PAUSE, Action.RESUME):
            self._held_by_stream = action == Action.PAUSE and by_stream and (self._held_by_stream or not held)
        return OperatorEvent(stamp_ns, action, text)

    def _next_steering(self, stamp_ns: int) -> OperatorEvent | None:
        """A goal or a speed limit, unless one was taken a moment ago or the run ends."""
        if self.reason or stamp_ns < self._steered_ns + _STEERING_NS:
            return None
        for waiting in self._steering.values():
            with suppress(IndexError):
                event = replace(waiting.popleft(), stamp_ns=stamp_ns)
                self._steered_ns = stamp_ns
                return event
        return None

    @property
    def pending(self) -> bool:
        """True if events wait for a tick."""
        return bool(self._waiting)

    @property
    def pending_zero(self) -> str:
        """The reason of a zero that no tick has taken; empty if there is none."""
        return next((text for action, text in list(self._waiting) if action == Action.ZERO), "")

    @property
    def overdue(self) -> bool:
        """True if the run should have ended by now, and its field is off."""
        return self._zero_sent

    @contextmanager
    def interrupted_when_overdue(self) -> Iterator[None]:
        """Context of the loop: an overdue shutdown ends it by `Interrupted` from an `interruptible` block in it."""
        self._looping = True
        try:
            yield
        except Interrupted:
            pass
        finally:
            self._looping = self.interruptible.entered = False

    def interrupt(self) -> None:
        """In the loop's thread, for example in a signal handler: raise `Interrupted` if the loop must and can end."""
        if self.must_interrupt:
            self._raised_s = self._clock()
            self._at_work = self.interruptible.entered = False  # so that nothing raises again on the way out
            raise Interrupted

    def interrupt_again(self) -> None:
        """In the loop's thread: allow another `Interrupted` after one that Python has swallowed, in a finalizer say."""
        self._at_work = self._working

    def unless_stopped(self, work: Callable[[], Result], otherwise: Result) -> Result:
        """The result of slow work, or `otherwise` as soon as the run must end."""
        try:
            self._at_work = self._working = True
            try:
                return work() if not self.reason else otherwise
            finally:
                self._at_work = self._working = False
        except Interrupted:
            self._at_work = self._working = False
            return otherwise

    # ---- for those who interrupt the loop, from any thread

    @property
    def must_interrupt(self) -> bool:
        """True if the loop must end and can: `Interrupted` may be raised in its thread."""
        if not self.reason:
            return False
        late = self._late_s() > RAMP_PATIENCE_S + _TICK_PATIENCE_S or not self.ticking
        swallowed = self._working and self._clock() > self._raised_s + _SWALLOWED_S
        return self._at_work or swallowed or (self.interruptible.entered and late)

    @property
    def stuck(self) -> bool:
        """True if the loop's thread is in a call that does not return: the loop should have ended long ago."""
        return self._looping and self._late_s() > _STUCK_S

    def _late_s(self) -> float:
        """Time since the request to end the run, in s; 0 without one."""
        return self._clock() - self._since_s if self.reason else 0.0


class _Block:
    """True if a thread is in a block; entered and left a few times a tick."""

    def __init__(self) -> None:
        self.entered = False

    def __enter__(self) -> None:
        self.entered = True

    def __exit__(self, *error: object) -> None:
        self.entered = False
