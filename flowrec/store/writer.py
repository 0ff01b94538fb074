"""Ticks -> session file, without holding up the control loop."""

from __future__ import annotations

import contextlib
import itertools
import operator
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from flowrec.declarations import Message, array_fields
from flowrec.errors import SessionError
from flowrec.messages import Drops, Frame, Tick, Track
from flowrec.store.channels import FRAME_PATH
from flowrec.store.frame_decimation import Thinning
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.metadata import SessionHeader
from flowrec.store.paths import pieces as pieces_of
from flowrec.store.ring_buffer import Snapshot, Snapshots
from flowrec.store.roi import Region, Window, Windows
from flowrec.store.session_file import Making, refuse_if_taken
from flowrec.store.split import Parts, Split
from flowrec.store.topic_filter import left_out
from flowrec.store.write_queue import Backlog, Entry, News
from flowrec.system.locks import remove_idle
from flowrec.topics import TOPICS
from flowrec.units import NS_PER_S, nanoseconds

_NICE = 5  # where there are too few cores for all, the control loop goes first
_TELL_DROPS_NS = NS_PER_S // 2
_MESSAGE_BYTES = 500  # about what a message weighs besides its pixels
_FIELDS = tuple(topic.field for topic in TOPICS)
_messages_of: Callable[[Tick], tuple[Any, ...]] = operator.attrgetter(*_FIELDS)


def _pixels(message_type: Any) -> tuple[str, ...]:
    return tuple(name for name, dtype in array_fields(message_type) if dtype != np.float64)


# Only images and rasters are weighed; the vectors of all other messages are too short to matter.
_PIXELS = {topic.type: _pixels(topic.type) for topic in TOPICS}


class _Output(Protocol):
    """Where entries go; all in the writer's thread but for `size`, and `finish` and `close` after its end."""

    files: list[Path]

    @property
    def partial_path(self) -> Path: ...

    @property
    def size(self) -> int: ...

    @property
    def patience_s(self) -> float | None: ...

    @property
    def flushed_ns(self) -> int | None: ...

    def add(self, entry: Entry) -> None: ...

    def flush_if_due(self) -> None: ...

    def flush(self) -> None: ...

    def finish(self, outcome: Mapping[str, str], why: str = "") -> None: ...

    def close(self, reason: str = "") -> None: ...


class SessionWriter:
    """Records ticks in a new session file; `write` returns at once, a thread encodes, compresses and writes.

    Until `close` the file is named `PATH.partial`; then it gets its name in one step. A message is written in
    the first tick that holds it, with the tick's stamp as log time; the arrays of a message must not change
    afterwards. To be used as a context manager: an exception that leaves the block becomes the outcome.

    Parameters
    ----------
    path : file to make.
    header : what goes first into the file and is on the disk when the constructor returns.
    frames : how images travel, a name of frames.py: raw, zstd, png, delta, or jpeg, which alone loses something.
    flush_s : at most this much of a run is lost when the process is killed, in s, of stamps; without `block` also of
        wall time, and besides the images that wait for a slow disk, at most `queue_limit_bytes` of them.
    sync_s : the same when the power fails, as long as an fsync takes less than half of it.
    overwrite : replace whatever there is of the run, once the new one is whole.
    block : what to do when the disk is slower than the run. True: `write` waits (simulation), also while more than
        `flush_s` of stamps is not yet with the operating system.
        False: images are thinned out (thinning.py) and counted, nothing else ever is dropped (live run).
    queue_limit_bytes : how much may wait for the disk.
    pieces : a Split, after which the run X.mcap is in the files X.part001.mcap, X.part002.mcap, ..., each of which can
        be read alone; or a Snapshot: nothing is written but X.snap001.mcap, ... around events.
    leave_out : topics that are not recorded (choice.py), in patterns such as `/view/*`.
    inputs : files that the run reads; it is refused where it would replace one of them.
    region : keep of most images only the window around the robot (region.py); None: all of all images.

    Attributes
    ----------
    remarks : on snapshots, for a person, as they are taken.

    Raises
    ------
    SessionError : the path can not be written, or is taken.
    """

    def __init__(
        self,
        path: Path | str,
        header: SessionHeader,
        *,
        frames: str = "zstd",
        flush_s: float = 0.5,
        sync_s: float = 1.0,
        overwrite: bool = False,
        block: bool = False,
        queue_limit_bytes: int = 256 << 20,
        pieces: Split | Snapshot | None = None,
        region: Region | None = None,
        leave_out: Iterable[str] = (),
        inputs: Iterable[Path] = (),
    ) -> None:
        self.path = Path(path)
        self.ticks = 0  # written so far
        self.dropped_frames = 0  # for want of a faster disk
        self.missing_frames = 0  # live: those that the camera counted and never delivered
        self._thinning = Thinning()
        self._windows = Windows(region) if region is not None else None
        self._next_index: int | None = None
        self._said: Drops | None = None
        self._carried_ns = header.part.carried_ns if header.part is not None else None
        self._block = block
        self._flush_ns = nanoseconds(flush_s)
        self._last: tuple[Any, ...] = (None,) * len(_FIELDS)
        self._first_ns: int | None = None
        self._last_ns = -1
        self._failure: BaseException | None = None
        self._closed = False
        unwanted = left_out(leave_out)
        self._unwanted = [topic.field for topic in TOPICS if topic.path in unwanted]
        refuse_if_taken(self.path, overwrite=overwrite, inputs=inputs)
        # Only what was there before this run may be removed after it.
        self._replaced = {file: file.stat().st_ino for file in pieces_of(self.path)} if overwrite else {}
        making = Making(self.path, header, ENCODINGS[frames], flush_s, sync_s, overwrite, region, unwanted)
        run = os.urandom(8).hex()  # the same in all pieces, and in no other run
        self.remarks: deque[str] = deque()
        self._output: _Output
        if isinstance(pieces, Snapshot):
            self._output = Snapshots(making, pieces, run, self.remarks)
        else:
            self._output = Parts(making, pieces or Split(), run)
        self._backlog = Backlog(queue_limit_bytes)
        self._thread = threading.Thread(target=self._work, name="session-writer", daemon=True)
        self._thread.start()

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait for the disk."""
        return self._backlog.nbytes

    @property
    def bytes_written(self) -> int:
        """Size of the files so far."""
        return self._output.size

    @property
    def files(self) -> list[Path]:
        """Those that are whole, in order."""
        return list(self._output.files)

    @property
    def partial_path(self) -> Path:
        """What is written just now."""
        return self._output.partial_path

    def write(self, tick: Tick) -> None:
        """Record what is new in this tick.

        Raises
        ------
        SessionError : the disk has failed, a message does not fit its declaration (both are told on a later
            call than the one that they concern), the session is closed, or the stamp does not grow.
        """
        self._raise_failure()
        if self._closed:
            raise SessionError(f"{self.path}: the session is closed; nothing more can be written to it")
        if tick.stamp_ns <= self._last_ns:
            raise SessionError(
                f"{self.path}: the tick at {tick.stamp_ns} ns does not come after the one at {self._last_ns} ns;"
                " stamps of a session must grow, check the clock of the rig"
            )
        if self._first_ns is None:
            self._first_ns = tick.stamp_ns
        elif self._block and tick.stamp_ns - self._flush_ns >= self._first_ns:
            self._backlog.wait_for_flush(min(self._last_ns, tick.stamp_ns - self._flush_ns))
            self._raise_failure()
        self._last_ns = tick.stamp_ns
        news = self._news_of(tick)
        # A tick that another part has recorded counts there; one of which recovery has found the image alone is none.
        counted = int(tick.stamp_ns != self._carried_ns and news.keys() != {"frame"})
        self.ticks += counted
        for field in self._unwanted:
            news.pop(field, None)
        if self._block:
            window = self._window_of(news.get("frame"), tick.track)
            entry = Entry(tick.stamp_ns, news, _weight(news), counted, window=window)
            if not self._backlog.has_room(entry.nbytes):
                self._backlog.wait_for_room(entry.nbytes)
                self._raise_failure()
            self._backlog.put(entry)
            return
        frame = news.pop("frame", None)
        dropped, missing = self.dropped_frames, self.missing_frames
        image: Entry | None = None
        if isinstance(frame, Frame) and self._takes(frame):
            window = self._window_of(frame, tick.track)
            image = Entry(tick.stamp_ns, {"frame": frame}, _nbytes(frame), late=True, window=window)
        self._tell_drops(news, tick.stamp_ns)
        entry = Entry(
            tick.stamp_ns,
            news,
            _weight(news),
            counted,
            image_bytes=image.nbytes if image is not None else 0,
            dropped=self.dropped_frames - dropped,
            missing=self.missing_frames - missing,
        )
        self._backlog.put(entry, image)

    def close(
        self, outcome: Mapping[str, str] | None = None, patience_s: float | None = None, *, why: str = ""
    ) -> None:
        """Finish the file and give it its name; a second call does nothing.

        Parameters
        ----------
        outcome : how the run ended, as text; numbers of ticks and of dropped frames are added.
        patience_s : for how long images that wait may still be written, in s; what is left of them then is dropped
            and counted. Everything else is always written. None: as long as it takes.
        why : the end is worth a snapshot, for this.

        Raises
        ------
        SessionError : the file could not be finished; what could be written stays in `PATH.partial`.
        """
        if self._closed:
            return
        self._closed = True
        self._backlog.close()
        self._thread.join(patience_s)
        waiting = self._backlog.drop_images() if self._thread.is_alive() else 0
        self._thread.join()
        try:
            if self._failure is None:
                self._finish(outcome or {"outcome": "ended"}, waiting, why)
        except Exception as error:  # noqa: BLE001  told below, as those of the thread
            self._failure = error
        finally:
            self._output.close(f"{self._failure}" if self._failure is not None else "")
        self._raise_failure()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        stopped = isinstance(error, KeyboardInterrupt)
        reason = f"{type(error).__name__}: {error}".rstrip(": ")
        try:
            self.close({"outcome": "stopped" if stopped else "failed", "reason": reason}, why=reason)
        except SessionError as second:
            if str(second) != str(error):  # the first one matters more
                error.add_note(str(second))

    def _news_of(self, tick: Tick) -> News:
        # This and `put` are all that recording costs the control loop: some 50 us.
        messages = _messages_of(tick)
        last, self._last = self._last, messages
        news: News = {}
        # Most messages are the objects of the tick before; those are passed over without a step of the interpreter.
        changed = map(operator.is_not, messages, last)
        for name, message, before in itertools.compress(zip(_FIELDS, messages, last, strict=True), changed):
            # A stage that says the same thing again in a new object has said nothing new.
            if message is not None and (
                before is None or message.stamp_ns != before.stamp_ns or not message.same_as(before)
            ):
                news[name] = message
        return news

    def _window_of(self, frame: Message | None, track: Track | None) -> Window | None:
        """What is kept of an image that is kept; None: all of it."""
        return self._windows.of(frame, track) if self._windows is not None and isinstance(frame, Frame) else None

    def _takes(self, frame: Frame) -> bool:
        """Whether there is room for an image of a live run; counts those that are missing."""
        if self._next_index is not None and frame.index > self._next_index:
            self.missing_frames += frame.index - self._next_index
        self._next_index = frame.index + 1
        kept = self._thinning.keeps(self._backlog.fill, frame.stamp_ns)
        if kept and self._backlog.has_room(_nbytes(frame)):
            return True
        self.dropped_frames += 1
        return False

    def _tell_drops(self, news: News, stamp_ns: int) -> None:
        """Add what is missing to the news when it begins, changes or ends, and twice a second in between."""
        said, every = self._said, self._thinning.every
        if said is None and not self.dropped_frames and not self.missing_frames:
            return
        told = (said.by_backlog, said.by_camera, said.kept_every) if said is not None else (0, 0, 1)
        now = (self.dropped_frames, self.missing_frames, every)
        due = said is None or stamp_ns >= said.stamp_ns + _TELL_DROPS_NS
        if told != now and (due or told[1:] != now[1:]):
            self._said = Drops(stamp_ns, FRAME_PATH, *now)
            news["drops"] = self._said

    def _work(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # of Linux, where each thread has its own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            while not self._backlog.drained:
                entry = self._backlog.take(self._output.patience_s)
                if entry is not None:
                    self._output.add(entry)
                if entry is None and self._backlog.flush_wanted:
                    self._output.flush()
                # The image of a tick comes after its other messages: where it can be, what is flushed are whole ticks.
                elif entry is None or "frame" in entry.news or not self._backlog.images_wait:
                    self._output.flush_if_due()
                if (flushed_ns := self._output.flushed_ns) is not None:
                    self._backlog.flushed(flushed_ns)
                if entry is not None:
                    self._backlog.done(entry)
        except Exception as error:  # noqa: BLE001  whatever it is, the control loop has to hear of it
            self._failure = error
            self._backlog.abandon()

    def _finish(self, outcome: Mapping[str, str], dropped: int, why: str) -> None:
        """What the thread leaves to be done; `dropped` images found no time."""
        if dropped:
            self.dropped_frames += dropped
            drops = Drops(self._last_ns, FRAME_PATH, self.dropped_frames, self.missing_frames, self._thinning.every)
            self._output.add(Entry(self._last_ns, {"drops": drops}, 0))  # at the last tick, for no other comes
        self._output.finish(outcome, why)
        if self.files:  # else nothing has come of the run, and what was there may stay
            for stale in set(pieces_of(self.path)) & set(self._replaced) - set(self.files):
                if stale.stat().st_ino == self._replaced[stale]:
                    self._remove(stale)

    def _remove(self, stale: Path) -> None:
        """A file that the run has replaced, unless another process is writing it by now."""
        try:
            remove_idle(stale)
        except OSError as error:
            self.remarks.append(f"{stale}: is left from before, it can not be removed ({error.strerror})")

    def _raise_failure(self) -> None:
        if isinstance(self._failure, SessionError):
            raise SessionError(str(self._failure)) from self._failure
        if self._failure is not None:
            raise self._failure


def _weight(news: News) -> int:
    return sum(map(_nbytes, news.values()))


def _nbytes(message: Message) -> int:
    nbytes = _MESSAGE_BYTES
    for name in _PIXELS[type(message)]:
        pixels = getattr(message, name)
        if pixels is not None:
            nbytes += pixels.nbytes
    return nbytes
