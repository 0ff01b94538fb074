"""Ticks -> session file, without delaying the control loop."""

from __future__ import annotations

import itertools
import operator
import os
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flowrec.core import (
    NO_EXTRA,
    NS_PER_S,
    TOPICS,
    Clocks,
    Drops,
    Extra,
    Frame,
    Outcome,
    SessionError,
    Tick,
    nanoseconds,
    shape_error,
)
from flowrec.store.channels import FRAME_PATH, message_codec
from flowrec.store.codec import encode_record
from flowrec.store.recorder_process import RecorderProcess, RecorderThread
from flowrec.store.ring_buffer import SnapshotTrigger
from flowrec.store.roi import WindowSelector
from flowrec.store.run_files import refuse_if_taken, run_files
from flowrec.store.segments import RecordingPlan
from flowrec.store.session_file import Snapshot, WriterOptions
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.viewer_scene import ChipCamera
from flowrec.store.write_queue import EncodedMessages, End, Entry, FrameDecimation, NewMessages

_DROPS_EVERY_NS = NS_PER_S // 2
_IMAGE_BYTES = 500  # of an image besides its pixels
_FIELDS = tuple(topic.field for topic in TOPICS)
_messages_of: Callable[[Tick], tuple[Any, ...]] = operator.attrgetter(*_FIELDS)


class SessionWriter:
    """Records ticks in a new session file; `write` returns at once, a recorder compresses and writes.

    Until `close` the file is named `PATH.partial`; then it gets its name in one step. A message is written in the first
    tick that holds it, with the tick's stamp as log time; the arrays of a message must not change afterwards. To be
    used as a context manager: an exception that leaves the block becomes the outcome. Raises SessionError: the path can
    not be written, or is taken.

    Parameters
    ----------
    path : file to make.
    header : is written first, and is on the disk when the constructor returns.
    options : how to write it.
    inputs : files that the run reads; a path that would replace one of them is refused.

    Attributes
    ----------
    ticks : written so far.
    dropped_frames : images that were left out because the disk is too slow.
    missing_frames : of a live run: images that the camera counted and never delivered.
    remarks : texts about snapshots, added while the run goes on.
    """

    def __init__(
        self,
        path: Path | str,
        header: SessionHeader,
        options: WriterOptions | None = None,
        *,
        inputs: Iterable[Path] = (),
    ) -> None:
        self.path = Path(path)
        self.ticks = self.dropped_frames = self.missing_frames = 0
        self._options = options = options or WriterOptions()
        self._block = options.block
        self._flush_ns = nanoseconds(options.flush_s)
        self._decimation = FrameDecimation()
        self._selector = WindowSelector(options.region) if options.region is not None else None
        self._next_index: int | None = None
        self._drops: Drops | None = None  # the last one that was recorded
        self._keyframe_ns = header.part.keyframe_ns if header.part is not None else None
        self._last: tuple[Any, ...] = (None,) * len(_FIELDS)
        self._first_ns: int | None = None
        self._last_ns = -1
        self._closed = self._told = False
        self._extra = NO_EXTRA
        encoded = (topic for topic in options.topics.topics if topic.type is not Frame)
        self._codecs = {topic.field: message_codec(topic.type, path=topic.path) for topic in encoded}
        self._start_unix_ns = header.start_unix_ns
        self._trigger = SnapshotTrigger(options.files) if isinstance(options.files, Snapshot) else None
        self._left_out = [topic.field for topic in options.topics.topics if topic.path in options.left_out_topics]
        refuse_if_taken(self.path, overwrite=options.overwrite, inputs=inputs)
        # Only what was there before this run may be removed after it.
        replaced = {file: file.stat().st_ino for file in run_files(self.path)} if options.overwrite else {}
        run = os.urandom(8).hex()  # the same in all files of the run, and in no other run
        plan = RecordingPlan(self.path, header, options, ChipCamera.of(header), run, replaced)
        self._recorder: RecorderThread | RecorderProcess
        self._recorder = RecorderProcess(plan) if options.own_process else RecorderThread(plan)
        self._queue = self._recorder.queue

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait for the recorder."""
        return self._queue.nbytes

    @property
    def bytes_written(self) -> int:
        """Size of the files so far."""
        return self._recorder.size

    @property
    def files(self) -> list[Path]:
        """The complete files, in order; those of a recorder in its own process when it has ended."""
        return self._recorder.files

    @property
    def partial_path(self) -> Path:
        """The file that is written at present."""
        return self._recorder.partial_path

    @property
    def remarks(self) -> deque[str]:
        """Texts about snapshots, added while the run goes on."""
        return self._recorder.remarks

    def prioritise(self) -> bool:
        """Give the recorder a real-time priority below that of the loop; True if the system allows it."""
        return self._recorder.prioritise()

    def write(self, tick: Tick) -> None:
        """Record what is new in this tick.

        Raises SessionError: the disk has failed, a message does not fit its declaration (both are raised by a later
        call than the one that caused them), the session is closed, or the stamp does not increase.
        """
        if self._recorder.failure is not None and self._goes_on():
            return
        if self._closed:
            raise SessionError(f"{self.path}: the session is closed; nothing more can be written to it")
        if tick.stamp_ns <= self._last_ns:
            raise SessionError(
                f"{self.path}: the tick at {tick.stamp_ns} ns does not come after the one at {self._last_ns} ns;"
                " stamps of a session must grow, check the clock of the rig"
            )
        start_unix_ns = None
        if self._first_ns is None:
            self._first_ns = tick.stamp_ns
            start_unix_ns = self._begin_at_clocks(tick)
        elif self._block and tick.stamp_ns - self._flush_ns >= self._first_ns:
            self._queue.wait_for_flush(min(self._last_ns, tick.stamp_ns - self._flush_ns))
            self._raise_failure()
        self._last_ns = tick.stamp_ns
        new = self._new_messages(tick)
        # Not counted: a keyframe, which the part before counted, and a tick of which recovery found only the image.
        ticks = int(tick.stamp_ns != self._keyframe_ns and new.keys() != {"frame"})
        self.ticks += ticks
        for field in self._left_out:
            new.pop(field, None)
        dropped, missing = self.dropped_frames, self.missing_frames
        # A run that waits for its disk records every image, with the rest of its tick.
        frame = new.get("frame") if self._block else new.pop("frame", None)
        window, image = None, None
        if isinstance(frame, Frame) and (self._block or self._takes(frame)):
            window = self._selector.window_of(frame, tick.track) if self._selector is not None else None
            if not self._block:
                image = Entry(tick.stamp_ns, {"frame": frame}, _frame_bytes(frame), late=True, window=window)
        self._add_drops(new, tick.stamp_ns)
        encoded = self._encode(new)
        entry = Entry(
            tick.stamp_ns,
            encoded,
            _size_of(encoded),
            ticks,
            image_bytes=image.nbytes if image is not None else 0,
            dropped=self.dropped_frames - dropped,
            missing=self.missing_frames - missing,
            window=window if self._block else None,
            event=self._trigger.event_in(tick.stamp_ns, new) if self._trigger is not None else "",
            start_unix_ns=start_unix_ns,
        )
        if self._block and not self._queue.has_room(entry.nbytes):
            self._queue.wait_for_room(entry.nbytes)
            self._raise_failure()
        try:
            self._queue.put(entry, image)
        except SessionError as error:
            self._recorder.failure = error
            self._goes_on()

    def close(self, outcome: Mapping[str, str] | None = None, timeout_s: float | None = None, *, why: str = "") -> None:
        """Finish the file and give it its name; a second call does nothing.

        Raises SessionError: the file could not be finished; what could be written stays in `PATH.partial`.

        Parameters
        ----------
        outcome : how the run ended, as text; numbers of ticks and of dropped frames are added.
        timeout_s : time for writing the images in the queue, in s; the images that remain are dropped and counted. All
            other messages are always written. None: no limit.
        why : take a snapshot of the end, for this reason.
        """
        if self._closed:
            return
        self._closed = True
        drops = self.dropped_frames, self.missing_frames, self._decimation.every
        self._queue.close(End(dict(outcome or {"outcome": Outcome.ENDED}), why, self._last_ns, *drops))
        if not self._recorder.wait(timeout_s):
            self._queue.drop_images()
            self._recorder.wait(None)
        self.dropped_frames += self._recorder.dropped
        self._raise_failure()

    def discard(self) -> None:
        """Leave no file of this run; earlier files of its name stay. Does nothing after `close`."""
        if self._closed:
            return
        self._closed = True
        self._queue.close(End({}, discard=True))
        self._recorder.wait(None)
        if self._recorder.failure is not None:  # it has left what it had written
            for file in (self.partial_path, *self.files):
                file.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        if not self._options.keep_failed:
            self.discard()
            return
        stopped = isinstance(error, KeyboardInterrupt)
        reason = f"{type(error).__name__}: {error}".rstrip(": ")
        try:
            self.close({"outcome": Outcome.STOPPED if stopped else Outcome.FAILED, "reason": reason}, why=reason)
        except SessionError as second:
            if str(second) != str(error):  # the first one matters more
                error.add_note(str(second))

    def _new_messages(self, tick: Tick) -> NewMessages:
        # This, `_encode` and `put` are all of the writer that runs in the control loop: some 100 us.
        messages = _messages_of(tick)
        last, self._last = self._last, messages
        new: NewMessages = {}
        # Most messages are the objects of the tick before; those are skipped without a step of the interpreter.
        changed = map(operator.is_not, messages, last)
        for name, message, before in itertools.compress(zip(_FIELDS, messages, last, strict=True), changed):
            # An equal message in another object is not new.
            if message is not None and (
                before is None or message.stamp_ns != before.stamp_ns or not message.same_as(before)
            ):
                new[name] = message
        if tick.extra is not self._extra:
            self._add_extra(new, tick.extra)
        return new

    def _add_extra(self, new: NewMessages, extra: Extra) -> None:
        last, self._extra = self._extra, extra
        for path, message in extra.items():
            before = last.get(path)
            if message is before or (before is not None and message.same_as(before)):
                continue
            topic = self._options.topics.by_path.get(path)
            if topic is None or type(message) is not topic.type:
                kind = type(message).__name__
                raise SessionError(f"{self.path}: no topic {path} of {kind} is declared; name its row in `topics`")
            if fault := shape_error(message):  # of a package: what is written can be read
                raise SessionError(f"{self.path}: {path}: {fault}")
            new[path] = message

    def _encode(self, new: NewMessages) -> EncodedMessages:
        encoded: EncodedMessages = {}
        for field, message in new.items():
            if isinstance(message, Frame):
                encoded[field] = message
                continue
            try:
                encoded[field] = encode_record(message, self._codecs[field], self._start_unix_ns)
            except SessionError as error:
                raise SessionError(f"{self.path}: {error}; what was recorded before it is kept") from error
        return encoded

    def _takes(self, frame: Frame) -> bool:
        """True if there is room for an image of a live run; counts those that are missing."""
        if self._next_index is not None and frame.index > self._next_index:
            self.missing_frames += frame.index - self._next_index
        self._next_index = frame.index + 1
        kept = self._decimation.keeps(self._queue.fill, frame.stamp_ns)
        if kept and self._queue.has_room(_frame_bytes(frame)):
            return True
        self.dropped_frames += 1
        return False

    def _add_drops(self, new: NewMessages, stamp_ns: int) -> None:
        """Record the lost images when losses begin, change or end, and twice a second in between."""
        last = self._drops
        if last is None and not self.dropped_frames and not self.missing_frames:
            return
        before = (last.by_backlog, last.by_camera, last.kept_every) if last is not None else (0, 0, 1)
        now = (self.dropped_frames, self.missing_frames, self._decimation.every)
        due = last is None or stamp_ns >= last.stamp_ns + _DROPS_EVERY_NS
        if before != now and (due or before[1:] != now[1:]):
            new["drops"] = self._drops = Drops(stamp_ns, FRAME_PATH, *now)

    def _begin_at_clocks(self, first: Tick) -> int | None:
        """Let the session begin when its first tick was, by the host's clock: to prepare the run has taken a while."""
        clocks = first.clocks
        if not (self._options.start_by_clocks and isinstance(clocks, Clocks)):
            return None
        self._start_unix_ns = clocks.wall_ns - clocks.stamp_ns
        return self._start_unix_ns

    def _goes_on(self) -> bool:
        """True if the run goes on although its recorder has failed, which is told once; else the failure is raised."""
        if not self._options.accept_losses:
            self._raise_failure()
        if not self._told:
            self._told = True
            self.remarks.append(f"{self._recorder.failure}; NOTHING IS RECORDED any more, and the run goes on")
        return True

    def _raise_failure(self) -> None:
        failure = self._recorder.failure
        if isinstance(failure, SessionError):
            raise SessionError(str(failure)) from failure
        if failure is not None:
            raise failure


def _size_of(messages: EncodedMessages) -> int:
    """Bytes of messages in memory."""
    return sum(
        _frame_bytes(each) if isinstance(each, Frame) else sum(map(len, each.payload)) for each in messages.values()
    )


def _frame_bytes(frame: Frame) -> int:
    return _IMAGE_BYTES + frame.image.nbytes
