"""Steering by hand: a person's samples of direction and speed, while a dead-man's button is held.

Samples come from the pages of consoles, in their threads; the loop takes the latest one at each tick. Steering ends
when the button is released, the page is closed, or no sample has come for `SILENCE_S`. Then the field is taken away at
once, before any tick (`Watchdog.rest`), and the next tick records why. After that only another press of the button
steers, so a page that was frozen does not steer again by itself. One page steers at a time.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, Hand

# Pages send 50 samples a second, so seven in a row are missing by then; a busy browser or a tunnel delays them less. A
# robot at 0.5 mm/s moves 75 um in this time.
SILENCE_S = 0.15
DEVICES = ("gamepad", "keys")
_LONGEST = 1.0 + 1e-6  # of the share
_NOTHING = np.zeros(2)
_MOST_LETTERS = 100  # of a reason


@dataclass(frozen=True, slots=True, eq=False)
class _HandSample:
    page: str
    press: int
    share: Floats
    by: str
    came_s: float


class HandSteering:
    """The latest sample, and who steers.

    `clock`: monotonic time in s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._changed = threading.Condition()  # no signal handler takes its lock, and nobody holds it for long
        self._sample: _HandSample | None = None
        self._ended: Hand | None = None  # that the loop has still to take
        self._over: dict[str, tuple[int, str]] = {}  # by page, the last press that has ended, and why
        self._closed = False
        self._rest: Callable[[], None] = _nothing
        self._go_on: Callable[[], None] = _nothing

    @contextmanager
    def connection(self, rest: Callable[[], None], go_on: Callable[[], None]) -> Iterator[None]:
        """Context of a run: `rest` takes the field away, from any thread, and `go_on` ends that, from the loop's."""
        self._rest, self._go_on, self._closed = rest, go_on, False
        threading.Thread(target=self._watch, name="hand", daemon=True).start()
        try:
            yield
        finally:
            with self._changed:
                self._closed = True
                self._rest = self._go_on = _nothing
                self._changed.notify_all()

    # ---- for those who steer, from any thread

    def steer(self, page: str, press: int, x: float, y: float, by: str) -> str:
        """Take a sample; why it does not steer, '' where it does.

        Parameters
        ----------
        page : which it is, of all pages of all consoles.
        press : number of the press of the button, as the page counts them.
        x, y : velocity over the robot's speed limit along x and y of the chip; together of a length up to 1.
        by : a word of `DEVICES`.
        """
        if not math.hypot(x, y) <= _LONGEST or by not in DEVICES:  # false for NaN
            self.let_go(page, "a sample with impossible numbers")
            return f"a share of {x:g}, {y:g} by {by!r}: its length is at most 1, and {' or '.join(DEVICES)} steers"
        with self._changed:
            self._end_if_silent()
            held = self._sample
            if held is not None and held.page != page:
                return "another page steers by hand"
            over, why = self._over.get(page, (-1, ""))
            if press <= over:
                return f"{why}: let go of the button, then hold it again"
            self._sample = _HandSample(page, press, np.array([x, y]), by, self._clock())
            if held is None:
                self._changed.notify_all()
        return ""

    def let_go(self, page: str, why: str) -> None:
        """End steering by a page, if it steers."""
        with self._changed:
            if self._sample is not None and self._sample.page == page:
                self._end(self._sample, why[:_MOST_LETTERS])

    # ---- for the loop

    def message(self, stamp_ns: int) -> Hand | None:
        """The message of the tick of this stamp: the sample that it uses, or why steering has ended; None: neither."""
        with self._changed:
            self._end_if_silent()
            ended, held = self._ended, self._sample
            if ended is not None:  # before what came since: a tick without field lies between
                self._ended = None
                self._go_on()
                return Hand(stamp_ns, False, ended.share, ended.age_s, ended.by, ended.why)
            if held is None:
                return None
            return Hand(stamp_ns, True, held.share, self._clock() - held.came_s, held.by)

    # ---- the thread

    def check(self) -> float | None:
        """End steering if it is time to. Returns the time until the next check, in s; None: when a sample comes."""
        with self._changed:
            self._end_if_silent()
            return None if self._sample is None else self._sample.came_s + SILENCE_S - self._clock()

    def _watch(self) -> None:
        while not self._closed:
            left_s = self.check()
            with self._changed:
                if not self._closed and (left_s is not None or self._sample is None):
                    self._changed.wait(left_s)

    def _end_if_silent(self) -> None:
        if self._sample is not None and self._clock() - self._sample.came_s > SILENCE_S:
            self._end(self._sample, f"no sample for {SILENCE_S:g} s")

    def _end(self, held: _HandSample, why: str) -> None:
        # First the field, then the sample: a tick that still takes the sample does not get its field to the coils.
        self._rest()
        self._sample, self._over[held.page] = None, (held.press, why)
        self._ended = Hand(0, False, _NOTHING, self._clock() - held.came_s, held.by, why)


def _nothing() -> None:
    """Do nothing: no run is connected."""
