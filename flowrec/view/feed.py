"""Ticks on their way to a process that shows them. The run never waits for it.

`write` appends a tick to a bounded queue and returns. A thread sends what has accumulated, some times per second,
through a pipe. Only that thread can block, on a process that is stopped or slow; then the queue drops its oldest ticks.
The latest state is not lost with them, because each tick is sent as the difference from the last one that was sent.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowrec.core import Closing, Frame, Tick, start_child
from flowrec.view.viewer import last_line, leave, until

_QUEUE_TICKS = 600  # without images: small
_PREVIEW_PX = 720  # longer side of the images that are shown
_AFTER_TICK_S = 0.001  # for the loop to end it
_NO_IMAGE = np.zeros((0, 0), np.uint8)
_FIELDS = tuple(field.name for field in fields(Tick))


class Batch(NamedTuple):
    """Changes since the last batch."""

    step: int  # of the last tick's image only each `step`-th row and column is sent; the other ticks have no image
    changes: list[dict[str, Any]]  # the fields of each tick that differ from the tick before
    remarks: dict[str, Any]  # what the run tells besides its ticks


class Feed:
    """A process that reads pickled objects from its stdin: first `first`, then batches.

    Raises OSError: the process does not start.

    Parameters
    ----------
    command : module of flowrec, and its words.
    max_hz : of the batches.
    shown : the fields of a tick that are sent.
    remarks : asked for each batch, by the thread.
    answers : whether the process writes to a pipe, `process.stdout`; otherwise all its output goes to its log.
    """

    def __init__(
        self,
        command: Sequence[str],
        first: object,
        max_hz: float,
        shown: Sequence[str] = _FIELDS,
        remarks: Callable[[], dict[str, Any]] = dict,
        *,
        answers: bool = False,
    ) -> None:
        self._first, self._shown, self._remarks = first, shown, remarks
        self._last: object = None
        self._period_s = 1.0 / max_hz
        self._queue: deque[Tick] = deque(maxlen=_QUEUE_TICKS)
        self._frame: Frame | None = None  # the latest, with its image
        self._told: deque[object] = deque()  # besides ticks
        self.dropped = 0  # ticks that were not shown, because the process could not keep up or has ended
        self.ended = False
        self._closing, self._ticked = threading.Event(), threading.Event()
        with tempfile.NamedTemporaryFile(prefix="flowrec-view-", suffix=".log", delete=False) as log:
            self._log = Path(log.name)
            try:
                self.process = start_child(*command, stdout=subprocess.PIPE if answers else log, stderr=log)
            except OSError:
                self._log.unlink()
                raise
        self._thread = threading.Thread(target=self._send_all, name=command[0], daemon=True)
        self._thread.start()

    def write(self, tick: Tick) -> None:
        """Take one tick; a few microseconds."""
        if self.ended:
            self.dropped += 1
            return
        if tick.frame is not None:
            self._frame = tick.frame  # before the queue: the thread looks for the image of the tick that it takes last
            tick = replace(tick, frame=Frame(tick.frame.stamp_ns, tick.frame.index, _NO_IMAGE))
        if len(self._queue) == _QUEUE_TICKS:
            self.dropped += 1
        self._queue.append(tick)
        self._ticked.set()

    def tell(self, what: object) -> None:
        """Send something besides ticks, before those that wait; returns at once. Any thread."""
        self._told.append(what)
        self._ticked.set()

    @property
    def closing(self) -> bool:
        """True if `close` was called."""
        return self._closing.is_set()

    @property
    def last_words(self) -> str:
        """The last line that the process has written to its log."""
        return last_line(self._text()) or "it was killed"

    def has_logged(self, words: str) -> bool:
        """True if the process has written these words to its log."""
        return words in self._text()

    def close(self, timeout_s: float, stays: str = "", last: object = None) -> bool:
        """Send the last ticks and `last` within a time limit, then end the process; whether it stays instead.

        `stays`: words by which the process says that it will end by itself.
        """
        self._last = last
        self._closing.set()
        self._ticked.set()
        end = time.monotonic() + timeout_s
        self._thread.join(timeout_s)
        until(lambda: self.process.poll() is not None or self._stays(stays) or None, end - time.monotonic())
        staying = self.process.poll() is None and self._stays(stays)
        if not staying:
            self.process.kill()  # SIGKILL also ends a stopped process, which unblocks the thread
            self.process.wait()
        self._thread.join(1.0)
        with contextlib.suppress(OSError):  # Windows, while the process has it open
            self._log.unlink(missing_ok=True)
        return staying

    def _stays(self, words: str) -> bool:
        return bool(words) and self.has_logged(words)

    def _text(self) -> str:
        try:
            return self._log.read_text(errors="replace")
        except OSError:
            return ""

    def _send_all(self) -> None:
        """Send until the feed is closed or its process ends: the thread."""
        pipe = self.process.stdin
        assert pipe is not None
        sent = Tick()
        try:
            _send(pipe, self._first)
            while not self.ended:
                if not self._closing.wait(self._period_s):
                    # Just after a tick, while the loop waits for the camera: to pickle holds the interpreter's lock.
                    self._ticked.clear()
                    self._ticked.wait(self._period_s)
                    time.sleep(_AFTER_TICK_S)
                closing = self._closing.is_set()
                while self._told:
                    _send(pipe, self._told.popleft())
                if closing or self._queue:
                    batch, sent = self._batch(sent)
                    _send(pipe, batch)
                elif self.process.poll() is not None:
                    break
                if closing:
                    if self._last is not None:
                        _send(pipe, self._last)
                    break
        except OSError:  # the process has ended
            pass
        finally:
            self.ended = True
            self.dropped += len(self._queue)
            self._queue.clear()
            with contextlib.suppress(OSError):
                pipe.close()

    def _batch(self, sent: Tick) -> tuple[Batch, Tick]:
        """All ticks in the queue, each as its changes, the last with its image; and the last tick itself."""
        changes: list[dict[str, Any]] = []
        step = 1
        while self._queue:
            tick = self._queue.popleft()
            changes.append({"stamp_ns": tick.stamp_ns, **tick.news(sent, self._shown)})
            sent = tick
        frame = self._frame
        if changes and frame is not None and sent.frame is not None and frame.index == sent.frame.index:
            step = max(1, -(-max(frame.image.shape) // _PREVIEW_PX))
            changes[-1]["frame"] = replace(frame, image=frame.image[::step, ::step])
        return Batch(step, changes, self._remarks()), sent


class FeedSink(Closing):
    """A sink that hands ticks to a process, if that has started.

    Whatever happens to the process, `write` neither waits nor raises.
    """

    def __init__(self) -> None:
        self._feed: Feed | None = None
        self._missed = 0

    @property
    def pid(self) -> int | None:
        """The process; None if it did not start."""
        return None if self._feed is None else self._feed.process.pid

    @property
    def dropped(self) -> int:
        """Ticks that were not shown, because the process could not keep up, has ended, or is not there."""
        return self._missed + (0 if self._feed is None else self._feed.dropped)

    def write(self, tick: Tick) -> None:
        """Take one tick; a few microseconds."""
        if self._feed is None:
            self._missed += 1
        else:
            self._feed.write(tick)

    def _end(self, timeout_s: float, stays: str, last: object = None) -> bool:
        """Close the feed, once; whether its process stays, as `Feed.close` says."""
        feed = self._feed
        if feed is None or feed.closing or not feed.close(timeout_s, stays, last):
            return False
        leave(feed.process)
        return True


def read_feed() -> Iterator[Any]:
    """In the process: what it is sent at stdin, until the run has ended, or was killed while it wrote."""
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        while True:
            yield pickle.load(sys.stdin.buffer)  # noqa: S301 - from our own parent


def _send(pipe: Any, what: object) -> None:
    pickle.dump(what, pipe, pickle.HIGHEST_PROTOCOL)
    pipe.flush()
