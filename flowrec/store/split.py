"""A run in files that follow each other, each to be read alone; or in one.

Part n + 1 begins with the tick at which part n ended, everything known at it; that and the last image before it are
told once more, at their own stamps. A part is ended beside the writer's thread, which must not wait for a disk.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from flowrec.errors import SessionError
from flowrec.messages import Frame
from flowrec.store.metadata import Part
from flowrec.store.paths import part_path
from flowrec.store.recorder import Recorder
from flowrec.store.segments import Open, Stretches, Tally, carried
from flowrec.store.session_file import Making
from flowrec.store.viewer_topics import Mirrors
from flowrec.store.write_queue import Entry
from flowrec.units import nanoseconds


@dataclass(frozen=True, slots=True)
class Split:
    """When a part has come to its end. With neither, a run is in one file.

    Attributes
    ----------
    megabytes : about the size of a part, in MB. One whose beginning alone is as large becomes twice as large.
    seconds : how much of a run is in it, in s of stamps.
    """

    megabytes: float | None = None
    seconds: float | None = None

    def __bool__(self) -> bool:
        return bool(self.megabytes or self.seconds)


class _Part:
    """One part as the stretch of the run that is in it."""

    def __init__(self, parts: Parts, number: int, recorder: Recorder) -> None:
        self.number = number
        self.recorder = recorder
        self.raw_bytes = 1  # of what went in
        self.image_bytes = 0  # of the one that is told once more
        self._parts = parts

    def add(self, entry: Entry) -> None:
        self.raw_bytes += entry.nbytes
        self.recorder.add(entry)

    def carry_image(self, stamp_ns: int, image: Frame) -> None:
        before = self.size
        self.recorder.add(Entry(stamp_ns, {"frame": image}, 0))
        self.image_bytes += self.size - before

    def complete(self, tally: Tally) -> None:
        self._parts.end(self, tally)

    @property
    def size(self) -> int:
        return self.recorder.size + self.recorder.waiting_bytes

    @property
    def first_bytes(self) -> int:
        """What does not count as its own."""
        return self.recorder.first_bytes + self.image_bytes

    def news_bytes(self, awaited_bytes: int) -> float:
        """What is in it besides, with the images that are still to come, if they pack as the ones before."""
        news = self.size - self.first_bytes
        return news + awaited_bytes * min(1.0, news / self.raw_bytes)


class Parts:
    """Writes entries to one file after the other.

    Parameters
    ----------
    making : what they are made with.
    split : when to go on to the next.

    Attributes
    ----------
    files : the finished ones, in order.

    Raises
    ------
    SessionError : from any method, when the disk refuses, or a message can not be encoded.
    """

    def __init__(self, making: Making, split: Split, run: str) -> None:
        self.files: list[Path] = []
        self._making = making
        self._split = split
        self._run = run
        self._mirrors = Mirrors(making.unwanted, making.header.start_unix_ns)
        self._until_ns: int | None = None
        self._ended_bytes = 0
        self._ending: deque[tuple[Recorder, Future[None]]] = deque()
        self._beside = ThreadPoolExecutor(1, "session-finish")
        self._stretches = Stretches(self._next(1, None))

    @property
    def partial_path(self) -> Path:
        """The file that is written just now."""
        return self._stretches.current.stretch.recorder.partial_path

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        ending = sum(recorder.size for recorder, _ in tuple(self._ending))
        return self._ended_bytes + ending + sum(recorder.size for recorder in self._recorders())

    @property
    def patience_s(self) -> float | None:
        """For how long one may wait for the next entry; None: for ever."""
        return min((s for recorder in self._recorders() if (s := recorder.patience_s) is not None), default=None)

    @property
    def flushed_ns(self) -> int | None:
        """Stamp up to which all state is with the operating system; None before the first flush."""
        stretches = self._stretches
        flushed_ns = stretches.current.stretch.recorder.flushed_ns
        # A part begins when the one before has been flushed.
        return stretches.current.carried_ns if flushed_ns is None else flushed_ns

    def add(self, entry: Entry) -> None:
        """Write one entry, to the part that it belongs to."""
        self._hear_of_ended(wait=False)
        if entry.ticks and self._is_due(entry.stamp_ns):
            self._go_on()
        self._stretches.add(entry)

    def flush_if_due(self) -> None:
        """Have the disk keep what has waited for long enough."""
        for recorder in self._recorders():
            recorder.flush_if_due()

    def flush(self) -> None:
        """Write what waits."""
        self._stretches.current.stretch.recorder.flush()

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None:
        """End the last part; everything is on the disk then. `why` a run ended badly is for snapshots alone."""
        last, recorder = self._stretches.current, self._stretches.current.stretch.recorder
        try:
            recorder.finish({**outcome, **self._making.said(last.tally)})
        finally:
            self._hear_of_ended(wait=True)
        self.files.append(recorder.path)

    def close(self, reason: str = "") -> None:
        """Close all files. After a failure, with its `reason`, the sound ones are finished and those before them."""
        self._beside.shutdown()
        with contextlib.suppress(SessionError):
            self._hear_of_ended(wait=True)
        places = self._stretches.open
        for place in places:
            recorder = place.stretch.recorder
            if reason and not recorder.broken and self._numbered:
                last = place is places[-1]
                ended = {"outcome": "failed", "reason": reason} if last else self._continued(place.stretch)
                place.tally.dropped_frames += place.awaited
                with contextlib.suppress(SessionError):  # the first failure matters more
                    recorder.finish({**ended, **self._making.said(place.tally)})
                    self.files.append(recorder.path)
            recorder.close()

    def end(self, part: _Part, tally: Tally) -> None:
        """Give a part that is not the last its end, in a thread of its own."""
        part.recorder.flush()
        outcome = {**self._continued(part), **self._making.said(tally)}
        self._ending.append((part.recorder, self._beside.submit(part.recorder.finish, outcome)))

    @property
    def _numbered(self) -> bool:
        return bool(self._split)

    def _recorders(self) -> Iterator[Recorder]:
        return (place.stretch.recorder for place in self._stretches.open)

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether a tick is the first one of another part."""
        place = self._stretches.current
        if place.begin_ns is None or not self._split:
            return False
        if self._split.seconds:
            every_ns = max(1, nanoseconds(self._split.seconds))
            if self._until_ns is None:
                self._until_ns = place.begin_ns + every_ns
            if stamp_ns >= self._until_ns:
                # The parts of an hour begin on the hour, whatever was lost in between.
                self._until_ns += ((stamp_ns - self._until_ns) // every_ns + 1) * every_ns
                return True
        if self._split.megabytes and self._is_large(place):
            # It has to be known what a part begins with before it can be said how much of it is its own.
            place.stretch.recorder.wait_for_beginning()
            return self._is_large(place)
        return False

    def _is_large(self, place: Open[_Part]) -> bool:
        part = place.stretch
        enough = max(1e6 * (self._split.megabytes or 0.0) - part.first_bytes, part.first_bytes)
        return part.news_bytes(place.awaited_bytes) >= enough

    def _go_on(self) -> None:
        last, last_ns = self._stretches.current.stretch, self._stretches.last_ns
        assert last_ns is not None
        last.recorder.flush()  # before anything of the next part: a kill must not leave a hole between them
        part = self._next(last.number + 1, last_ns)
        part.recorder.begin_with(carried(last_ns, self._stretches.known))
        self._stretches.cut(part)

    def _next(self, number: int, carried_ns: int | None) -> _Part:
        making = self._making
        path, header = making.path, making.header
        if self._numbered:
            path = part_path(path, number)
            header = replace(header, part=Part(self._run, number, carried_ns=carried_ns))
        recorder = Recorder(path, header, making, self._mirrors, wait=carried_ns is None)
        return _Part(self, number, recorder)

    def _continued(self, part: _Part) -> dict[str, str]:
        return {"outcome": "continued", "next": part_path(self._making.path, part.number + 1).name}

    def _hear_of_ended(self, *, wait: bool) -> None:
        while self._ending and (wait or self._ending[0][1].done()):
            recorder, ended = self._ending.popleft()
            try:
                ended.result()
                self.files.append(recorder.path)
                self._ended_bytes += recorder.size
            finally:
                recorder.close()
