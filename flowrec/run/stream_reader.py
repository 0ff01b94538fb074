"""One stream of another program: read in a thread of its own, queued, its losses and the steps of its clock counted.

- The queue is bounded; of samples that the loop does not take the oldest are lost, and counted.
- A stamp a tenth of a second before its predecessor, or in the future, is a step of the sender's clock. From there on
  the stamps are shifted so that the samples are as old on arrival as before the step. Smaller steps stay.
- A gap in the stamps of a regular stream counts as missing samples, less those that then come closer together.
- A sender that has ended is looked for again.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrec.core import NS_PER_S, Floats, Ints, RigError, nanoseconds, seconds
from flowrec.rigs import Chunk, NoStreamError, SampleStream, StreamHead
from flowrec.stages import StreamSettings

_SLICE_S = 0.02  # longest wait for samples
_GATHER_S = 0.01  # samples that come within this time are handled together, so that the loop is seldom interrupted
_DRAIN_S = 0.2  # longest time for samples from before the run to be thrown away
_AGAIN_S = 0.5  # between two looks for a sender that has ended
_JOIN_S = 1.5
_STEP_NS = NS_PER_S // 10
_LEAST_GAP_S = 0.1  # shorter pauses are those of a busy sender
_USUAL = 0.05  # weight of a chunk in the running mean of its age


class Taken(NamedTuple):
    """Samples that the loop takes: places of their channels in the head, stamps on the stream's clock, values."""

    channel: NDArray[np.int32]
    times_ns: Ints
    values: Floats


@dataclass(frozen=True, slots=True)
class StreamCounts:
    """Counts of a stream at a moment; see core.messages.streams.StreamStates."""

    samples: int = 0
    lost: int = 0
    missing: int = 0
    steps: int = 0
    restarts: int = 0
    correction_s: float = math.nan
    age_s: float = math.nan
    jitter_s: float = math.nan
    gone: bool = False  # its sender has ended


class StreamReader:
    """Reads a stream from `start` to `close`.

    `tell`: called with one line when the stream ends, comes back, or its clock steps.
    """

    def __init__(self, name: str, stream: SampleStream, settings: StreamSettings, tell: Callable[[str], None]) -> None:
        self.name, self.settings = name, settings
        self.head = StreamHead((), ())
        self._stream, self._tell = stream, tell
        self._queue: deque[Taken] = deque()
        self._counts = StreamCounts()
        self._ages_s: list[float] = []  # of the chunks since the counts were taken
        self._changed = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._open = False
        self._refused = ""
        # Of the present sender: the sum of the steps of its clock, its last stamp, the usual age of a sample on its
        # arrival, and the missing samples that may still come.
        self._shift_ns, self._credit = 0, 0
        self._last_ns: int | None = None
        self._usual_ns: int | None = None

    @property
    def silence_s(self) -> float:
        """Time without a sample after which the stream is silent; inf: never, unless its sender ends."""
        if self.settings.silence_s is not None:
            return self.settings.silence_s
        return max(1.0, 3.0 / self.head.rate_hz) if self.head.rate_hz > 0.0 else math.inf

    def connect(self) -> None:
        """Find the sender within `wait_s`.

        Raises RigError: one line; it is not there and the run must not go on without it, or it can not be used.
        """
        end_s = time.monotonic() + self.settings.wait_s
        while True:
            try:
                self.head = self._stream.open()
                self._open = True
                return
            except NoStreamError as error:
                if time.monotonic() < end_s:
                    self._closing.wait(0.1)
                    continue
                if self.settings.on_silence == "note":
                    self._tell(f"streams.{self.name}: {error}; the run begins without it")
                    self._set(gone=True)
                    return
                raise RigError(f"streams.{self.name}: {error}, within {self.settings.wait_s:g} s (wait_s)") from error
            except RigError as error:
                raise RigError(f"streams.{self.name}: {error}") from error

    def start(self) -> None:
        """Begin to queue what comes from now on."""
        if self._stream.polled:
            return
        end_s = time.monotonic() + _DRAIN_S
        try:
            while self._open and self._stream.read(0.0) is not None and time.monotonic() < end_s:
                pass  # of the time before the run
        except Exception as error:  # noqa: BLE001 - the code of others; it is told
            self._lose_sender(error)
        self._thread = threading.Thread(target=self._read, name=f"stream {self.name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading; a stream that does not return is left behind."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
        if self._thread is None or not self._thread.is_alive():
            self._stream.close()

    def take(self) -> list[Taken]:
        """The samples since the last call; never waits."""
        if self._stream.polled:
            chunk = self._stream.read(0.0)
            if chunk is not None:
                self._accept(chunk)
        if not self._queue:
            return []
        with self._changed:
            taken = list(self._queue)
            self._queue.clear()
        return taken

    def counts(self) -> StreamCounts:
        """The counts so far, with age and jitter since the last call."""
        with self._changed:
            ages, self._ages_s = self._ages_s, []
            counts = replace(self._counts, correction_s=self._stream.correction_s() if self._open else math.nan)
        return replace(counts, age_s=float(np.mean(ages)), jitter_s=float(np.std(ages))) if ages else counts

    @property
    def state(self) -> StreamCounts:
        """The counts so far; age and jitter go on."""
        return self._counts

    # ---- in the stream's thread

    def _set(self, **changes: object) -> None:
        self._counts = replace(self._counts, **changes)  # type: ignore[arg-type]

    def _read(self) -> None:
        gathered_s = -math.inf
        while not self._closing.is_set():
            try:
                if not self._open and not self._reopen():
                    continue
                chunk = self._stream.read(_SLICE_S)
                if chunk is not None and len(chunk.times_ns):
                    self._accept(chunk)
                    self._closing.wait(max(0.0, gathered_s + _GATHER_S - time.monotonic()))
                    gathered_s = time.monotonic()
            except Exception as error:  # noqa: BLE001 - the code of others; it is told
                self._lose_sender(error)

    def _lose_sender(self, error: Exception) -> None:
        why = str(error)
        if not isinstance(error, NoStreamError):
            why = f"{type(error).__name__}: {why.partition(chr(10))[0]}"
        self._tell(f"streams.{self.name}: {why}; it is looked for again")
        self._stream.close()
        self._open = False
        with self._changed:
            self._set(gone=True)

    def _reopen(self) -> bool:
        """Look for a sender that has ended; True if it is back, with the same channels."""
        try:
            head = self._stream.open()
        except RigError as error:
            if not isinstance(error, NoStreamError) and str(error) != self._refused:
                self._refused = str(error)
                self._tell(f"streams.{self.name}: {error}; until then it is silent")
            self._closing.wait(_AGAIN_S)
            return False
        if self.head.channels and head.channels != self.head.channels:
            self._stream.close()
            text = f"is back with other channels ({', '.join(head.channels)})"
            if text != self._refused:
                self._refused = text
                self._tell(f"streams.{self.name}: {text}; it stays silent, record it in another run")
            self._closing.wait(_AGAIN_S)
            return False
        self._refused = ""
        self._shift_ns, self._credit, self._last_ns, self._usual_ns = 0, 0, None, None
        with self._changed:
            self.head, self._open = head, True
            self._set(gone=False, restarts=self._counts.restarts + 1)
        return True

    def _accept(self, chunk: Chunk) -> None:
        times_ns = self._without_steps(chunk.times_ns, chunk.arrival_ns)
        missing = self._missing(times_ns) if self.head.rate_hz > 0.0 else 0
        age_ns = chunk.arrival_ns - int(times_ns[-1])
        usual = self._usual_ns
        self._usual_ns = age_ns if usual is None else round((1.0 - _USUAL) * usual + _USUAL * age_ns)
        self._last_ns = int(times_ns[-1])
        if chunk.channel is None:
            count, channels = chunk.values.shape
            taken = Taken(
                np.tile(np.arange(channels, dtype=np.int32), count),
                np.repeat(times_ns, channels),
                np.ravel(chunk.values),
            )
        else:
            count, channels = len(times_ns), 1
            taken = Taken(chunk.channel, times_ns, chunk.values)
        with self._changed:
            if chunk.head is not None:
                self.head = chunk.head
            self._queue.append(taken)
            self._ages_s.append(seconds(age_ns))
            lost = 0
            most = self.settings.queue_samples * channels
            while sum(len(each.values) for each in self._queue) > most and len(self._queue) > 1:
                lost += len(self._queue.popleft().values) // channels
            known = self._counts
            self._set(samples=known.samples + count, lost=known.lost + lost, missing=known.missing + missing)

    def _without_steps(self, times_ns: Ints, arrival_ns: int) -> Ints:
        """Stamps without the steps of the sender's clock."""
        shifted = times_ns + self._shift_ns
        before_ns = shifted[0] if self._last_ns is None else self._last_ns
        steps = np.diff(shifted, prepend=before_ns) < -_STEP_NS
        steps |= shifted > arrival_ns + _STEP_NS
        if not steps.any():
            return shifted
        first = int(np.argmax(steps))
        step_ns = arrival_ns - (self._usual_ns or 0) - int(shifted[-1])
        self._shift_ns += step_ns
        self._set(steps=self._counts.steps + 1)
        self._tell(
            f"streams.{self.name}: the sender's clock has stepped by {-seconds(step_ns):+.3f} s; its stamps are shifted"
        )
        shifted[first:] += step_ns
        return shifted

    def _missing(self, times_ns: Ints) -> int:
        """Samples that gaps in the stamps tell of; negative for those that have come closer together after a gap."""
        period_ns = nanoseconds(1.0 / self.head.rate_hz)
        before_ns = times_ns[0] - period_ns if self._last_ns is None else self._last_ns
        between = np.diff(times_ns, prepend=before_ns)
        gaps = between[between > 1.5 * period_ns + nanoseconds(_LEAST_GAP_S)]
        missing = int((np.rint(gaps / period_ns) - 1).sum())
        self._credit += missing
        made_up = min(int((between < period_ns // 2).sum()), self._credit)
        self._credit -= made_up
        return missing - made_up
