"""Records a run: takes entries from a queue, writes them to the files of the run, and completes those.

It works in a process of its own (recorder_process.py), which outlives the run, or in a thread of the run's process.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from flowrec.core import Drops, Priority, prioritise_thread, remove_idle
from flowrec.store.channels import FRAME_PATH
from flowrec.store.codec import codec_of, encode_record
from flowrec.store.ring_buffer import RingBuffer
from flowrec.store.run_files import run_files
from flowrec.store.segments import Parts
from flowrec.store.session_file import Snapshot, WriterOptions
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.viewer_scene import ChipCamera
from flowrec.store.write_queue import End, Entry, WriteQueue

_NICE = 5  # of a run that waits for its disk: where there are too few cores for all, the loop goes first


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """Order to record a run.

    Attributes
    ----------
    path, header, options, camera : of the run.
    run : a random word for the heads of its files.
    replaced : files of an earlier run, which may be removed after this one, with their inodes.
    """

    path: Path
    header: SessionHeader
    options: WriterOptions
    camera: ChipCamera | None
    run: str
    replaced: Mapping[Path, int]


class EntryQueue(Protocol):
    """The end of a queue at which entries are taken; see WriteQueue."""

    given_up: int

    @property
    def flush_wanted(self) -> bool:
        """True if the run waits for a flush."""

    @property
    def end(self) -> End | None:
        """The end of the run; None before it."""

    @property
    def drained(self) -> bool:
        """Nothing is left to take, and nothing will come."""

    @property
    def images_wait(self) -> bool:
        """True if the next entry may be the image of a tick that was taken before."""

    def take(self, timeout_s: float | None) -> Entry | None:
        """The next entry; None where there is none in time, or something else is to be done."""

    def release(self, entry: Entry) -> None:
        """Free the room of an entry."""

    def mark_flushed(self, stamp_ns: int) -> None:
        """Note that the operating system has the ticks up to a stamp."""


class Recorder:
    """The files of a run while they are written.

    Parameters
    ----------
    plan : what is to be recorded; the head of its file is on the disk when the constructor returns.
    tell : receives what happens, as text.

    Attributes
    ----------
    dropped : images that were left out at the end.

    Raises
    ------
    SessionError : a file can not be made.
    """

    def __init__(self, plan: RecordingPlan, tell: Callable[[str], None]) -> None:
        self.dropped = 0
        self._plan, self._tell = plan, tell
        self._files: Parts | RingBuffer
        files, where = plan.options.files, (plan.path, plan.header, plan.options, plan.camera)
        if isinstance(files, Snapshot):
            self._files = RingBuffer(*where, files, plan.run, tell)
        else:
            self._files = Parts(*where, files, plan.run)
        self._start_unix_ns = plan.header.start_unix_ns

    @property
    def size(self) -> int:
        """Bytes of the files so far."""
        return self._files.size

    @property
    def files(self) -> list[Path]:
        """The complete files, in order."""
        return list(self._files.files)

    @property
    def flushed_ns(self) -> int | None:
        """Stamp up to which no state waits for the disk; None before the first flush."""
        return self._files.flushed_ns

    @property
    def partial_path(self) -> Path:
        """The file that is written at present."""
        return self._files.partial_path

    def record(self, queue: EntryQueue) -> None:
        """Write what the queue gives until the end of the run, then complete the files, or remove them.

        Raises
        ------
        SessionError : the disk refuses, or an image can not be stored; what was written stays in a `.partial` file.
        """
        reason = ""
        try:
            while not queue.drained:
                self._record_next(queue)
            assert queue.end is not None
            if not queue.end.discard:
                self._finish(queue.end, queue.given_up)
        except Exception as error:
            reason = f"{error}"
            raise
        finally:
            unfinished = self.partial_path
            self._files.close(reason)
        if queue.end.discard:
            for file in (unfinished, *self.files):
                file.unlink(missing_ok=True)

    def _record_next(self, queue: EntryQueue) -> None:
        entry = queue.take(self._files.timeout_s)
        if entry is not None:
            if entry.start_unix_ns is not None:
                self._start_unix_ns = entry.start_unix_ns
                self._files.begin_at(entry.start_unix_ns)
            self._files.add(entry)
        if entry is None and queue.flush_wanted:
            self._files.flush()
        # The image of a tick comes after its other messages: where possible, whole ticks are flushed.
        elif entry is None or "frame" in entry.messages or not queue.images_wait:
            self._files.flush_if_due()
        if (flushed_ns := self._files.flushed_ns) is not None:
            queue.mark_flushed(flushed_ns)
        if entry is not None:
            queue.release(entry)

    def _finish(self, end: End, given_up: int) -> None:
        if given_up:
            self.dropped = given_up
            drops = Drops(end.last_ns, FRAME_PATH, end.dropped + given_up, end.missing, end.kept_every)
            encoded = encode_record(drops, codec_of(Drops), self._start_unix_ns)
            self._files.add(Entry(end.last_ns, {"drops": encoded}, 0))  # at the last tick, because no other comes
        self._files.finish(end.outcome, end.why)
        if not self.files:  # what was there before may stay
            return
        for stale in set(run_files(self._plan.path)) & set(self._plan.replaced) - set(self.files):
            if stale.stat().st_ino == self._plan.replaced[stale]:
                try:
                    remove_idle(stale)  # unless another process is writing it by now
                except OSError as error:
                    self._tell(f"{stale}: is left from an earlier run and can not be removed ({error.strerror})")


class RecorderThread:
    """Records in a thread of this process, and ends with it.

    Attributes
    ----------
    queue : takes the entries.
    failure : of the recording.
    remarks : what happens, as text.
    """

    def __init__(self, plan: RecordingPlan) -> None:
        self.failure: BaseException | None = None
        self.remarks: deque[str] = deque()
        self.queue = WriteQueue(plan.options.queue_limit_bytes)
        self.recorder = Recorder(plan, self.remarks.append)
        self._low = plan.options.block
        self._thread = threading.Thread(target=self._work, name="session-writer", daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Bytes of the files so far."""
        return self.recorder.size

    @property
    def files(self) -> list[Path]:
        """The complete files, in order."""
        return self.recorder.files

    @property
    def partial_path(self) -> Path:
        """The file that is written at present."""
        return self.recorder.partial_path

    @property
    def dropped(self) -> int:
        """Images that were left out at the end."""
        return self.recorder.dropped

    def prioritise(self) -> bool:
        """Let it write in real time, behind a loop that has that priority too; whether it is allowed."""
        native_id = self._thread.native_id
        return native_id is not None and prioritise_thread(native_id, Priority.WRITER)

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for the end of the recording; whether it has come in time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        # Not in a live run: preempted by any other program, it would keep the interpreter's lock from the loop.
        if self._low and sys.platform == "linux":  # only there has each thread a priority of its own
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            self.recorder.record(self.queue)
        except Exception as error:  # noqa: BLE001  `write` and `close` raise it in the control loop
            self.failure = error
            self.queue.abandon()
