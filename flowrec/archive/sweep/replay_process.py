"""The process in which a worker replays. It stays warm, and is ended if a task hangs or needs too much memory.

Dask can end a worker but not say why, and a kernel that computes for minutes would keep a worker from answering its
scheduler. So a worker, of whatever cluster, only watches this process: `replayed` runs in the worker, the rest in here.
"""

from __future__ import annotations

import atexit
import contextlib
import pickle
import queue
import threading
import time
from dataclasses import replace
from typing import Any

from flowrec.archive.sweep.tasks import Task, change_of, content_of
from flowrec.core import (
    ChildEndedError,
    ChildProcess,
    FlowrecError,
    Parent,
    SessionError,
    forget_peak,
    peak_mb,
    printable,
)

Row = dict[str, Any]

_READY = "ready"
_START_S = 600.0  # a new installation compiles its kernels
_PERIOD_S = 0.1  # between two looks at the memory
_ATTEMPTS = 2  # a task that has ended its process so often is set aside

_of_thread = threading.local()


class _EndedError(Exception):
    """The process has ended during a task; the text says why."""


class _LimitError(_EndedError):
    """It was ended, because the task has reached a limit."""


def replay_task(task: Task, memory_bytes: int | None = None) -> Row:
    """Replay a session in the process of this thread; the row of the task, with an error where it has failed.

    `memory_bytes`: the limit of a task that states none.
    """
    task = replace(task, memory_bytes=task.memory_bytes or memory_bytes)
    row: Row = {}
    for _ in range(_ATTEMPTS):
        process: _Process | None = getattr(_of_thread, "process", None)
        try:
            process = _of_thread.process = process or _Process()
            return process.row(task)
        except _EndedError as ended:
            _of_thread.process = None
            limited = isinstance(ended, _LimitError)
            text = str(ended) if limited else f"it has ended {_ATTEMPTS} processes ({ended}), and is set aside"
            row = failed_row(task, text)
            if process is not None:  # None: it has ended before it was ready
                row |= {"wall_s": process.lasted_s, "peak_memory_bytes": process.peak_bytes}
            if limited:
                break
    return row


def failed_row(task: Task, error: str) -> Row:
    """The row of a task without a result."""
    return _task_columns(task) | {"error": printable(error)}


def _task_columns(task: Task) -> Row:
    from flowrec.core import NUMERICS_VERSION, __version__

    return {
        "key": task.key,
        "session": task.session,
        "content": task.content,
        "settings": dict(task.settings),
        "refly": task.refly,
        "flowrec": __version__,
        "numerics_version": NUMERICS_VERSION,
    }


class _Process:
    """The process, as its worker sees it.

    Attributes
    ----------
    lasted_s, peak_bytes : of the last task: how long it took, and its largest memory that was seen.
    """

    def __init__(self) -> None:
        self.lasted_s, self.peak_bytes = 0.0, 0
        self._child = ChildProcess("flowrec.archive.sweep.replay_process")
        atexit.register(self._end)
        self._wait(time.monotonic(), _START_S, None)

    def row(self, task: Task) -> Row:
        """The row of a task; _EndedError if the process has ended before."""
        self.peak_bytes, began_s = 0, time.monotonic()
        self._child.send(task)
        try:
            row: Row = self._wait(began_s, task.timeout_s, task.memory_bytes)
        finally:
            self.lasted_s = time.monotonic() - began_s
        return row

    def _wait(self, began_s: float, timeout_s: float | None, memory_bytes: int | None) -> Any:
        import psutil  # type: ignore[import-untyped]

        while True:
            try:
                return self._child.receive(_PERIOD_S)
            except queue.Empty:
                pass
            except ChildEndedError as error:
                self._end()
                raise _EndedError(str(error)) from error
            with contextlib.suppress(psutil.Error):  # it has ended, which the next turn tells
                self.peak_bytes = max(self.peak_bytes, psutil.Process(self._child.process.pid).memory_info().rss)
            if timeout_s is not None and time.monotonic() - began_s > timeout_s:
                self._end()
                raise _LimitError(f"it took longer than {timeout_s:g} s (--timeout), and was ended")
            if memory_bytes is not None and self.peak_bytes > memory_bytes:
                self._end()
                raise _LimitError(f"it needed more than {memory_bytes / 1e9:.3g} GB (--memory), and was ended")

    def _end(self) -> None:
        atexit.unregister(self._end)
        self._child.close()


def _row(task: Task) -> Row:
    """Replay one session in this process."""
    forget_peak()
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    row = _task_columns(task)
    try:
        row |= _figures(task)
    except FlowrecError as error:
        row["error"] = str(error)
    except Exception as error:  # noqa: BLE001  a defect in one task is a row of the sweep, not its end
        row["error"] = printable(f"{type(error).__name__}: {error}")
    row |= {"cpu_s": time.process_time() - began_cpu_s, "wall_s": time.perf_counter() - began_s}
    if task.judge:
        row |= _judgement(task)
    return row | {"peak_memory_bytes": round(peak_mb() * 1e6)}


def _figures(task: Task) -> Row:
    """The output of `flowrec replay --json`."""
    from flowrec.run import before_after
    from flowrec.store import Session
    from flowrec.verbs import refinement_remarks, refly, replay_session

    with Session(task.session) as session:
        if content_of(session) != task.content:
            raise SessionError(f"{task.session}: was changed while the sweep was under way; call it again")
        done = replay_session(session, change_of(task.settings))
        rows = before_after(done) + (refly(done, None) if task.refly else [])
    return {
        "figures": {key: [was, now] for key, was, now in rows},
        "refinement": refinement_remarks(done),
        "ticks": done.report.ticks,
        "duration_s": done.report.duration_s,
    }


def _judgement(task: Task) -> Row:
    """The result of `flowrec check`."""
    from flowrec.verbs import check

    try:
        verdict = check(task.session)
    except SessionError as error:
        return {"verdict": "bad", "findings": [str(error)]}
    return {"verdict": verdict.word, "findings": [finding.text for finding in verdict.findings]}


def _serve(parent: Parent) -> None:
    """Work until the worker has ended."""
    from flowrec.core import console
    from flowrec.stages import warm_up
    from flowrec.verbs import refly  # noqa: F401 - with all that a replay needs, before the first task

    console.quiet = True  # a thousand replays have a thousand lines
    warm_up()
    answer: Any = _READY
    while True:
        parent.answer(pickle.dumps(answer))
        answer = _row(parent.order())


if __name__ == "__main__":
    _serve(Parent())
