"""Watchdog of the control loop: a thread that switches the field off when no tick ends any more.

The loop sends its commands through the watchdog. When no tick ends for a stated time while a field is on, or when
another thread requests it, the watchdog calls `rig.zero()` in its own thread and lets no field pass afterwards. It
works while the main thread waits or computes in C, as long as that code releases the interpreter's lock: drivers called
through ctypes.CDLL or cffi, NumPy, OpenCV and file access do. It can not work while C code keeps the lock
(ctypes.PyDLL, an extension that does not release it), nor when the process is stopped or gone (SIGKILL, SIGSTOP, a
crash of the interpreter): for these, hardware needs a watchdog in another process.

Only `field_off` and `wait_off` wait.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from flowrec.core import Currents, Priority, RigError, realtime_priority
from flowrec.rigs import Resting, Rig

ZERO_PATIENCE_S = 2.0  # time for zero() to succeed, with all its repetitions; then the run fails
_RETRY_S = 0.02  # between two tries of zero() that fail
_POLL_S = 0.002  # of who waits for zero()
_IDLE_S = 0.5  # between checks without a timer


class Watchdog:
    """Between the loop and the coils.

    Parameters
    ----------
    rig : of it only `apply` and `zero` are used; `zero` in the watchdog's thread only, where no signal handler of
        Python runs.
    timeout_s : longest time without the end of a tick while a field is on; None: no timer, the field is switched off on
        request only.
    tripped : called with the reason when the field is switched off; in any thread, must return at once.
    alarm : called with one line for a person, in a thread of its own.
    clock : monotonic time in s.

    Attributes
    ----------
    reason : why the field was switched off; empty while it was not.
    hung : whether the timer did it.
    failures : how often zero() has raised.
    ticked_s : time of the end of the last tick, by `clock`.
    """

    def __init__(
        self,
        rig: Rig,
        timeout_s: float | None = None,
        tripped: Callable[[str], None] = lambda _reason: None,
        alarm: Callable[[str], None] = lambda _text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.reason = ""
        self.hung = False
        self.failures = 0
        self.timeout_s = timeout_s
        self.clock = clock
        self.ticked_s = clock()
        self._rig = rig
        self._tripped = tripped
        self._alarm = alarm
        self._error: Exception | None = None
        # Shared by the loop, the watchdog's thread and those who trip it, without a lock that a stuck loop could hold.
        # Each flag is one attribute, set before it takes effect: `_latched` before zero(), `_energised` before a field
        # is sent. So a command that is under way when the watchdog trips is followed by a zero() in either order.
        self._energised = self._latched = self._over = self._reported = False
        self._resting = False  # by `rest`, until the loop has taken that in; set and looked at as `_latched` is
        self._numbers = itertools.count(1)
        self._requested = self._zeroed = 0  # numbers of the last request for zero(), and of the last fulfilled one
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None

    # ---- for the loop

    def apply(self, currents: Currents) -> None:
        """Send a command to the coils; after the field was switched off, none that would bring it back."""
        field = currents.amplitude_mt > 0.0
        if field and self._latched:
            return
        if field and self._resting:
            currents, field = _without_field(currents), False
        if field and not self._energised:
            self.ticked_s = self.clock()
            self._energised = True
        self._rig.apply(currents)
        if not field:
            self._energised = False
        elif self._latched:
            self.take_away()
        elif self._resting:
            self.apply(currents)

    def go_on(self) -> None:
        """Let commands pass again: the loop knows why the field was taken away."""
        self._resting = False

    def tick_ended(self) -> None:
        """Note that the loop has completed a tick."""
        self.ticked_s = self.clock()

    @contextmanager
    def running(self) -> Iterator[Watchdog]:
        """Context in which the thread runs; to be entered before the rig.

        Raises RigError: the block ends by an exception, of the rig or its driver too, while zero() still fails.
        """
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()
        try:
            yield self
        except Exception as error:
            if self.off:
                raise
            raise self._left_on() from error
        finally:
            self._over = True
            self._wake.set()
            if self.off:
                self._thread = None

    def field_off(self) -> None:
        """Switch the field off and wait until it is; an exception of a signal handler is raised when that is done.

        Raises RigError: zero() has failed for two seconds; it is still repeated.
        """
        self.take_away()
        interrupted: BaseException | None = None
        end_s = self.clock() + ZERO_PATIENCE_S
        while not self.off and self.clock() < end_s:
            try:
                time.sleep(_POLL_S)
            except BaseException as error:  # noqa: BLE001  Ctrl-C in a user's program: raised below
                interrupted = error
        if not self.off:
            raise self._left_on()
        if interrupted is not None:
            raise interrupted

    # ---- for every thread

    def trip(self, reason: str) -> None:
        """Switch the field off at once and end the run; returns at once."""
        self.reason = self.reason or reason
        self.take_away()
        self._tripped(reason)

    def take_away(self) -> None:
        """Request zero() from the watchdog's thread; no field passes from now on."""
        self._latched = True
        if self._thread is not None:  # before and after, nothing is driven
            self._requested = next(self._numbers)
            self._wake.set()

    def rest(self) -> None:
        """Take the field away, and let none pass until `go_on`; returns at once.

        A rig that is `Resting` does it now, any other one with the next command.
        """
        self._resting = True
        if isinstance(self._rig, Resting):
            self._rig.rest()

    @property
    def off(self) -> bool:
        """True if every request for zero() is fulfilled."""
        return self._zeroed == self._requested

    def wait_off(self, timeout_s: float) -> bool:
        """Wait until every request for zero() is fulfilled, at most so many seconds; whether it is."""
        end_s = self.clock() + timeout_s
        while not self.off and self.clock() < end_s:
            time.sleep(_POLL_S)
        return self.off

    @property
    def failure(self) -> str:
        """Error text: zero() has failed, how often, and how."""
        return f"zero() raised {self.failures} times: {self._error}" if self._error else "zero() does not return"

    def _left_on(self) -> RigError:
        return RigError(f"the coils may still carry a field: {self.failure}; switch the amplifiers off by hand")

    # ---- the thread

    def check(self) -> float:
        """Switch the field off if it is time to. Returns the time until the next check, in s."""
        left_s = _IDLE_S
        if self.timeout_s is not None and not self._latched:
            left_s = self.timeout_s
            if self._energised:
                left_s = self.ticked_s + self.timeout_s - self.clock()
            if left_s <= 0.0:
                self.hung = True
                self.trip(f"guard: no tick for {self.timeout_s:g} s")
        requested = self._requested
        if self._zeroed == requested:
            return max(left_s, 0.0)
        try:
            self._rig.zero()
        except Exception as error:  # noqa: BLE001  zero() is called again after any error of a driver
            self.failures += 1
            self._error = error
            if self.failures == 1:
                self._warn(f"the coils' zero() failed ({error!r}); it is repeated every {1e3 * _RETRY_S:.0f} ms")
            return _RETRY_S
        self._zeroed = requested
        if (self.hung or self.failures) and not self._reported:
            self._reported = True
            after = f" after {self.failures} failures of zero()" if self.failures else ""
            self._warn(f"{self.reason or 'the run ends'}: the field is off{after}")
        return left_s

    def _watch(self) -> None:
        # At a higher priority than the loop, which may be what uses all of the processor.
        with realtime_priority(Priority.DEVICE):
            while not self._over or not self.off:
                self._wake.wait(self.check())
                self._wake.clear()

    def _warn(self, text: str) -> None:
        threading.Thread(target=self._alarm, args=(text,), name="alarm", daemon=True).start()


def _without_field(currents: Currents) -> Currents:
    """The command with no field."""
    nothing = np.zeros_like(currents.currents_a)
    return replace(currents, frequency_hz=0.0, amplitude_mt=0.0, limit_hz=0.0, currents_a=nothing)
