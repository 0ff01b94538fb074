"""The recorder of a run: a thread, or a process of its own that finishes the files however the run has ended.

The run puts entries into two rings in shared memory (shared_queue.py); the process takes them. When the process of the
run has ended, killed or not, its pipe is closed: the recorder then writes what is left in the rings and completes the
files. It takes no signals: Ctrl-C and a SIGTERM to all processes of a service are for the run, which ends it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from flowrec.core import (
    ChildEndedError,
    ChildProcess,
    FlowField,
    Priority,
    SessionError,
    TopicTable,
    declaration,
    declared_topic,
    prioritise_thread,
    shell_word,
)
from flowrec.store.parts import Parts
from flowrec.store.ring_buffer import RingBuffer
from flowrec.store.run_files import partial_path
from flowrec.store.segments import RecordingPlan
from flowrec.store.session_file import Snapshot
from flowrec.store.shared_queue import QueueReader, SharedQueue
from flowrec.store.write_queue import WriteQueue

MODULE = "flowrec.store.recorder_process"  # its process is known by its words: this, and the path of the session
_NICE = 5  # of a run that waits for its disk: where there are too few cores for all, the loop goes first
_SILENT_S = 120.0  # without a byte written at the end of the run
_REPORT_S = 0.2


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
        self.run = _files_of(plan, self.remarks.append)
        self._low = plan.options.block
        self._thread = threading.Thread(target=self._work, name="session-writer", daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Bytes of the files so far."""
        return self.run.size

    @property
    def files(self) -> list[Path]:
        """The complete files, in order."""
        return self.run.files

    @property
    def partial_path(self) -> Path:
        """The file that is written at present."""
        return self.run.partial_path

    @property
    def dropped(self) -> int:
        """Images that were left out at the end."""
        return self.run.dropped

    def prioritise(self) -> bool:
        """Give it a real-time priority below that of the loop; True if the system allows it."""
        native_id = self._thread.native_id
        return native_id is not None and prioritise_thread(native_id, Priority.WRITER)

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for the end of the recording; True if it has come in time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        # Not in a live run: preempted by any other program, it would keep the interpreter's lock from the loop.
        if self._low and sys.platform == "linux":  # only there has each thread a priority of its own
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            self.run.record(self.queue)
        except Exception as error:  # noqa: BLE001  `write` and `close` raise it in the control loop
            self.failure = error
            self.queue.abandon()


class RecorderProcess:
    """The recorder's process, as the run sees it; see RecorderThread.

    Raises SessionError: a file can not be made, or the process does not start.
    """

    def __init__(self, plan: RecordingPlan) -> None:
        self.failure: BaseException | None = None
        self.remarks: deque[str] = deque()
        self.files: list[Path] = []
        self.partial_path = partial_path(plan.path)
        self.dropped = 0
        self._ended = threading.Event()
        try:
            self.queue = SharedQueue(plan.options.queue_limit_bytes, images=not plan.options.block)
            self._child = ChildProcess(MODULE, str(plan.path.absolute()), inherited=self.queue.descriptors)
        except OSError as error:
            raise SessionError(f"{plan.path}: its recorder does not start ({error})") from error
        try:
            self._child.send((_portable(plan), self.queue.handles))
            assert self._child.process.stdin is not None
            self.queue.wake_by(self._child.process.stdin.fileno())
            refusal: str = self._child.receive()
        except ChildEndedError as error:
            refusal = f"{plan.path}: its recorder does not start ({error})"
        if refusal:
            self._close()
            raise SessionError(refusal)
        self._listener = threading.Thread(target=self._listen, name="recorder", daemon=True)
        self._listener.start()

    @property
    def size(self) -> int:
        """Bytes of the files so far."""
        return self.queue.files_bytes

    def prioritise(self) -> bool:
        """Give it a real-time priority below that of the loop; True if the system allows it."""
        return prioritise_thread(self._child.process.pid, Priority.WRITER)

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for the end of the recording; True if it has come in time."""
        if timeout_s is not None:
            if not self._ended.wait(timeout_s):
                return False
        else:
            size = -1
            while not self._ended.wait(_SILENT_S):
                if size == (size := self.size):
                    self.failure = SessionError(
                        f"{self.partial_path}: its recorder (process {self._child.process.pid}) has written nothing"
                        f" for {_SILENT_S:g} s; it completes the file when it can"
                    )
                    return True
        self._close()
        return True

    def _listen(self) -> None:
        """Take answers until the process has ended."""
        try:
            while not self._ended.is_set():
                self._take(self._child.receive())
        except ChildEndedError as error:
            if not self._ended.is_set():
                self.failure = SessionError(
                    f"{self.partial_path}: its recorder has ended ({error});"
                    f" `flowrec recover {shell_word(self.partial_path)}` saves what it had written"
                )
        finally:
            self._ended.set()
            self.queue.abandon()

    def _take(self, answer: tuple[str, Any]) -> None:
        kind, value = answer
        if kind == "remark":
            self.remarks.append(value)
        else:
            self.files, self.partial_path, self.dropped, failure = value
            self.failure = failure or self.failure
            self._ended.set()

    def _close(self) -> None:
        """The process ends by itself, when its pipe is closed."""
        self._child.finish()
        self.queue.close()


def _files_of(plan: RecordingPlan, tell: Callable[[str], None]) -> Parts | RingBuffer:
    """The files that a plan is recorded to."""
    kind = RingBuffer if isinstance(plan.options.files, Snapshot) else Parts
    return kind(plan, tell)


def _portable(plan: RecordingPlan) -> tuple[RecordingPlan, list[tuple[str, str]]]:
    """The plan without topics of packages, and their declarations: the recorder imports no package."""
    topics = [(topic.path, declaration(topic)) for topic in plan.options.topics.extra]
    return replace(plan, options=replace(plan.options, topics=TopicTable(()))), topics


def _work() -> None:
    """Record one run: the process."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed does not get between the answers
    (plan, topics), handles = pickle.load(sys.stdin.buffer)  # noqa: S301 - from our own parent
    table = TopicTable(declared_topic(path, text) for path, text in topics)
    plan = replace(plan, options=replace(plan.options, topics=table))
    if plan.options.block and sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    queue = QueueReader(handles, sys.stdin.fileno())
    try:
        recorder = _files_of(plan, lambda text: _answer(answers, ("remark", text)))
    except SessionError as error:
        _answer(answers, str(error))
        return
    _answer(answers, "")
    failure: Exception | None = None
    try:
        threading.Thread(target=_work_beside, args=(recorder, queue), daemon=True).start()
        recorder.record(queue)
    except SessionError as error:
        failure = SessionError(str(error))  # others may not be pickled
    except Exception as error:  # noqa: BLE001  the run raises it
        failure = RuntimeError(f"{type(error).__name__}: {error}")
    _answer(answers, ("ended", (recorder.files, recorder.partial_path, recorder.dropped, failure)))


def _work_beside(recorder: Parts | RingBuffer, queue: QueueReader) -> None:
    """Load what draws the file, which takes a second, before the run has ended; tell the size of the files."""
    from flowrec.physics import sample

    velocity, pressure = np.zeros((2, 2, 2), np.float32), np.zeros((2, 2), np.float32)
    still = FlowField(0, 0, "", 1.0, velocity, pressure, None, np.zeros(1), 1.0, 1.0, "")
    for places in ((0.0, 0.0), np.zeros((1, 2))):
        sample(still, places)  # by kernels, which are loaded now

    while True:
        queue.note_files_bytes(recorder.size)
        time.sleep(_REPORT_S)


def _answer(answers: IO[bytes], value: object) -> None:
    with contextlib.suppress(BrokenPipeError):  # the run has ended: nobody asks
        answers.write(pickle.dumps(value))
        answers.flush()


if __name__ == "__main__":
    _work()
