"""Ticks -> session file, without holding up the control loop."""

from __future__ import annotations

import contextlib
import errno
import operator
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from flowrec.errors import SessionError
from flowrec.messages import Drops, Frame, Message, Tick, array_fields
from flowrec.store.backlog import Backlog, Entry, News
from flowrec.store.frames import ENCODINGS
from flowrec.store.header import SessionHeader
from flowrec.store.layout import FRAME_PATH
from flowrec.store.names import partial_path
from flowrec.store.recorder import Recorder
from flowrec.store.thinning import Thinning
from flowrec.topics import TOPICS
from flowrec.units import NS_PER_S

_NICE = 5  # where there are too few cores for all, the control loop goes first
_TELL_DROPS_NS = NS_PER_S // 2
_MESSAGE_BYTES = 500  # about what a message weighs besides its pixels
_FIELDS = tuple(topic.field for topic in TOPICS)
_messages_of: Callable[[Tick], tuple[Any, ...]] = operator.attrgetter(*_FIELDS)


def _pixels(message_type: Any) -> tuple[str, ...]:
    return tuple(name for name, dtype in array_fields(message_type) if dtype != np.float64)


# Only images and rasters are weighed; the vectors of all other messages are too short to matter.
_PIXELS = {topic.type: _pixels(topic.type) for topic in TOPICS}


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
    flush_s : at most this much of a run is lost when the process is killed, in s, of wall time and of stamps;
        besides, of its images and where `block` is set, what `queue_bytes` says is waiting.
    sync_s : the same when the power fails, as long as an fsync takes less than half of it.
    overwrite : replace an existing file, and the remains of an unfinished one.
    block : what to do when the disk is slower than the run. True: `write` waits (simulation).
        False: images are thinned out (thinning.py) and counted, nothing else ever is dropped (live run).
    queue_limit_bytes : how much may wait for the disk.

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
    ) -> None:
        self.path = Path(path)
        self.partial_path = partial_path(self.path)
        self.ticks = 0  # written so far
        self.dropped_frames = 0  # for want of a faster disk
        self.missing_frames = 0  # live: those that the camera counted and never delivered
        self._thinning = Thinning()
        self._next_index: int | None = None
        self._said: Drops | None = None
        self._block = block
        self._overwrite = overwrite
        self._last: tuple[Any, ...] = (None,) * len(_FIELDS)
        self._last_ns = -1
        self._failure: BaseException | None = None
        self._closed = False
        self._refuse_if_taken()
        try:
            self._recorder = Recorder(
                self.partial_path,
                header,
                frames=ENCODINGS[frames],
                flush_s=flush_s,
                sync_s=sync_s,
                truncate=overwrite,
            )
        except OSError as error:
            raise _not_writable(self.partial_path, error) from error
        self._backlog = Backlog(queue_limit_bytes)
        self._thread = threading.Thread(target=self._work, name="session-writer", daemon=True)
        self._thread.start()

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait for the disk."""
        return self._backlog.nbytes

    @property
    def bytes_written(self) -> int:
        """Size of the file so far."""
        return self._recorder.size

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
        self._last_ns = tick.stamp_ns
        self.ticks += 1
        news = self._news_of(tick)
        if self._block:
            entry = _entry(tick.stamp_ns, news)
            if not self._backlog.has_room(entry.nbytes):
                self._backlog.wait_for_room(entry.nbytes)
                self._raise_failure()
            self._backlog.put(entry)
            return
        frame = news.pop("frame", None)
        if isinstance(frame, Frame) and not self._takes(frame):
            frame = None
        self._tell_drops(news, tick.stamp_ns)
        image: News = {"frame": frame} if frame is not None else {}
        self._backlog.put(_entry(tick.stamp_ns, news), _entry(tick.stamp_ns, image))

    def close(self, outcome: Mapping[str, str] | None = None, patience_s: float | None = None) -> None:
        """Finish the file and give it its name; a second call does nothing.

        Parameters
        ----------
        outcome : how the run ended, as text; numbers of ticks and of dropped frames are added.
        patience_s : for how long images that wait may still be written, in s; what is left of them then is dropped
            and counted. Everything else is always written. None: as long as it takes.

        Raises
        ------
        SessionError : the file could not be finished; what could be written stays in `PATH.partial`.
        """
        if self._closed:
            return
        self._closed = True
        self._backlog.close()
        self._thread.join(patience_s)
        waiting = self._backlog.drop_images() if self._thread.is_alive() else []
        self._thread.join()
        if waiting and self._failure is None:
            self._tell_waiting(waiting)
        counts = {"ticks": str(self.ticks), "dropped_frames": str(self.dropped_frames)}
        if self.missing_frames:
            counts["frames_missing_from_camera"] = str(self.missing_frames)
        if not self._recorder.lossless:
            counts["frames_encoding"] = f"{self._recorder.encoding}, not lossless: a replay sees other pixels"
        try:
            if self._failure is None:
                self._finish({**(outcome or {"outcome": "ended"}), **counts})
        finally:
            self._recorder.close()
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
            self.close({"outcome": "stopped" if stopped else "failed", "reason": reason})
        except SessionError as second:
            if str(second) != str(error):  # the first one matters more
                error.add_note(str(second))

    def _news_of(self, tick: Tick) -> News:
        # This and `put` are all that recording costs the control loop: some 50 us.
        messages = _messages_of(tick)
        last, self._last = self._last, messages
        news: News = {}
        for name, message, before in zip(_FIELDS, messages, last, strict=True):
            # A stage that says the same thing again in a new object has said nothing new.
            if (
                message is not None
                and message is not before
                and (before is None or message.stamp_ns != before.stamp_ns or not message.same_as(before))
            ):
                news[name] = message
        return news

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

    def _tell_waiting(self, stamps_ns: Sequence[int]) -> None:
        """Count images that there was no time for; at the last tick, for no other comes. The thread has ended."""
        self.dropped_frames += len(stamps_ns)
        drops = Drops(self._last_ns, FRAME_PATH, self.dropped_frames, self.missing_frames, self._thinning.every)
        try:
            self._recorder.add(Entry(self._last_ns, {"drops": drops}, 0))
        except OSError as error:
            self._failure = error

    def _work(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # of Linux, where each thread has its own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            while not self._backlog.drained:
                entry = self._backlog.take(self._recorder.patience_s)
                if entry is not None:
                    self._recorder.add(entry)
                # The image of a tick comes after its other messages: where it can be, what is flushed are whole ticks.
                if entry is None or "frame" in entry.news or not self._backlog.images_wait:
                    self._recorder.flush_if_due()
                if entry is not None:
                    self._backlog.done(entry)
        except Exception as error:  # noqa: BLE001  whatever it is, the control loop has to hear of it
            self._failure = error
            self._backlog.abandon()

    def _finish(self, outcome: Mapping[str, str]) -> None:
        try:
            self._recorder.finish(outcome)
            self._refuse_if_taken(finished=True)
            self.partial_path.replace(self.path)
            sync_directory(self.path.parent)
        except OSError as error:
            self._failure = error

    def _raise_failure(self) -> None:
        if self._failure is None:
            return
        if isinstance(self._failure, OSError):
            raise _disk_failed(self.partial_path, self._failure) from self._failure
        if isinstance(self._failure, SessionError):
            raise SessionError(
                f"{self.path}: {self._failure}; `flowrec recover {self.partial_path}` keeps what came before"
            ) from self._failure
        raise self._failure

    def _refuse_if_taken(self, *, finished: bool = False) -> None:
        if self._overwrite and not self.path.is_dir():
            return
        if self.path.exists():
            kept = f" (the finished session stays in {self.partial_path})" if finished else ""
            raise SessionError(f"{self.path}: exists already{kept}; choose another name with --out, or --overwrite it")
        if not finished and self.partial_path.exists():
            raise SessionError(
                f"{self.partial_path}: is left from a run that did not finish; `flowrec recover {self.partial_path}`"
                " saves it, another --out or --overwrite goes on without it"
            )


def _entry(stamp_ns: int, news: News) -> Entry:
    return Entry(stamp_ns, news, sum(map(_nbytes, news.values())))


def _nbytes(message: Message) -> int:
    nbytes = _MESSAGE_BYTES
    for name in _PIXELS[type(message)]:
        pixels = getattr(message, name)
        if pixels is not None:
            nbytes += pixels.nbytes
    return nbytes


def sync_directory(directory: Path) -> None:
    """Have the disk keep the new name as well."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _not_writable(path: Path, error: OSError) -> SessionError:
    if isinstance(error, FileNotFoundError):
        return SessionError(f"{path.parent}: no such directory; make it, or choose another place with --out")
    return SessionError(f"{path}: can not be made ({error.strerror}); choose another place with --out")


def _disk_failed(path: Path, error: OSError) -> SessionError:
    if error.errno == errno.ENOENT:
        return SessionError(f"{path}: is gone, it or its directory was removed or renamed; look for it there")
    what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else f"writing failed ({error.strerror})"
    return SessionError(f"{path}: {what}; free some space, then `flowrec recover {path}` saves what was recorded")
