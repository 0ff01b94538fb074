"""Takes the field away when the control loop no longer steers: a thread of its own beside the loop.

The loop sends its commands through the guard. When no tick ends for a stated time while a field is on, or when anybody
asks for it, the guard calls `rig.zero()` in its own thread and lets no field pass afterwards. It works while the main
thread waits or computes in C, as long as that code releases the interpreter's lock: drivers called through ctypes.CDLL
or cffi, NumPy, OpenCV and file access do. Python can not help where C code keeps the lock (ctypes.PyDLL, an extension
that does not release it), nor where the process is stopped or gone (SIGKILL, SIGSTOP, a crash of the interpreter):
hardware needs a guardian in a process of its own for these.

No method but `field_off` and `wait_off` ever waits.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from flowrec.errors import RigError
from flowrec.messages import Currents
from flowrec.system.realtime_priority import first_of_all

ZERO_PATIENCE_S = 2.0  # for zero() to succeed, with all its repetitions; then its failure is the end of the run
_RETRY_S = 0.02
_POLL_S = 0.002
_IDLE_S = 0.5  # between looks where there is no timer


class Coils(Protocol):
    """What the guard needs of a rig; see run.Rig."""

    def apply(self, currents: Currents) -> None: ...

    def zero(self) -> None: ...


class Guard:
    """Between the loop and the coils.

    Parameters
    ----------
    rig : its `zero` is called in the guard's thread only, where no signal handler of Python runs.
    timeout_s : for how long no tick may end while a field is on; None: no timer, the field goes when it is asked for.
    tripped : told the reason when the field is taken away; called in any thread, must return at once.
    alarm : takes one line for a person; called in a thread of its own.
    clock : monotonic time in s.

    Attributes
    ----------
    reason : why the field was taken away; empty as long as it was not.
    hung : the timer did it.
    failures : how often zero() has raised.
    ticked_s : when the last tick ended, by `clock`.
    """

    def __init__(
        self,
        rig: Coils,
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
        # Shared by the loop, the guard's thread and those who trip it, without a lock that a stuck loop could hold.
        # Each flag is one attribute, set before it is acted on: `_latched` before zero(), `_energised` before a field
        # is sent. So a command that is under way when the guard trips is followed by a zero(), whoever comes first.
        self._energised = self._latched = self._over = self._told = False
        self._numbers = itertools.count(1)
        self._asked = self._zeroed = 0  # numbers of the last request for zero(), and of the last one that was fulfilled
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None

    # ---- for the loop

    def apply(self, currents: Currents) -> None:
        """Send a command to the coils; after the field was taken away none passes that would bring it back."""
        field = currents.amplitude_mt > 0.0
        if field and self._latched:
            return
        if field and not self._energised:
            self.ticked_s = self.clock()
            self._energised = True
        self._rig.apply(currents)
        if not field:
            self._energised = False
        elif self._latched:
            self.take_away()

    def tick_ended(self) -> None:
        """The loop has done all of a tick."""
        self.ticked_s = self.clock()

    @contextmanager
    def running(self) -> Iterator[Guard]:
        """Watch for the length of the context; to be entered before the rig."""
        self._thread = threading.Thread(target=self._watch, name="guard", daemon=True)
        self._thread.start()
        try:
            yield self
        finally:
            self._over = True
            self._wake.set()
            if self.off:
                self._thread = None

    def field_off(self) -> None:
        """Take the field away and wait until it is; an exception of a signal handler is raised when that is done.

        Raises
        ------
        RigError : zero() has failed for two seconds; it is still repeated.
        """
        self.take_away()
        interrupted: BaseException | None = None
        end_s = self.clock() + ZERO_PATIENCE_S
        while not self.off and self.clock() < end_s:
            try:
                time.sleep(_POLL_S)
            except BaseException as error:  # noqa: BLE001  Ctrl-C in a program of the user's: raised below
                interrupted = error
        if not self.off:
            raise RigError(f"the coils may still carry a field: {self.trouble}; switch the amplifiers off by hand")
        if interrupted is not None:
            raise interrupted

    # ---- for anybody, from any thread

    def trip(self, reason: str) -> None:
        """Take the field away at once and end the run; returns at once."""
        self.reason = self.reason or reason
        self.take_away()
        self._tripped(reason)

    def take_away(self) -> None:
        """Have zero() called as soon as the guard's thread runs; no field passes from now on."""
        self._latched = True
        if self._thread is not None:  # before and after, nothing is driven
            self._asked = next(self._numbers)
            self._wake.set()

    @property
    def off(self) -> bool:
        """Whether every request for zero() is fulfilled."""
        return self._zeroed == self._asked

    def wait_off(self, timeout_s: float) -> bool:
        """Whether every request for zero() is fulfilled, or is within so many seconds."""
        end_s = self.clock() + timeout_s
        while not self.off and self.clock() < end_s:
            time.sleep(_POLL_S)
        return self.off

    @property
    def trouble(self) -> str:
        """What zero() has to say for itself, where it failed."""
        return f"zero() raised {self.failures} times: {self._error}" if self._error else "zero() does not return"

    # ---- the thread

    def look(self) -> float:
        """Take the field away if it is time to. Returns for how long there is nothing to do, in s."""
        left_s = _IDLE_S
        if self.timeout_s is not None and not self._latched:
            left_s = self.timeout_s
            if self._energised:
                left_s = self.ticked_s + self.timeout_s - self.clock()
            if left_s <= 0.0:
                self.hung = True
                self.trip(f"guard: no tick for {self.timeout_s:g} s")
        asked = self._asked
        if self._zeroed == asked:
            return max(left_s, 0.0)
        try:
            self._rig.zero()
        except Exception as error:  # noqa: BLE001  whatever a driver raises, it is tried again
            self.failures += 1
            self._error = error
            if self.failures == 1:
                self._say(f"the coils' zero() failed ({error!r}); it is repeated every {1e3 * _RETRY_S:.0f} ms")
            return _RETRY_S
        self._zeroed = asked
        if (self.hung or self.failures) and not self._told:
            self._told = True
            after = f" after {self.failures} failures of zero()" if self.failures else ""
            self._say(f"{self.reason or 'the run ends'}: the field is off{after}")
        return left_s

    def _watch(self) -> None:
        # Before the loop itself, which may be what uses all of the processor.
        with first_of_all(2):
            while not self._over or not self.off:
                self._wake.wait(self.look())
                self._wake.clear()

    def _say(self, text: str) -> None:
        threading.Thread(target=self._alarm, args=(text,), name="alarm", daemon=True).start()
