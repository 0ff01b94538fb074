"""The worker of a live run: a process for the slow stages, as the parent sees it, and the process itself.

It is no pool of multiprocessing: such a pool makes Python wait at exit for unfinished work, delays its parent while it
starts, and receives the Ctrl-C that is meant for the run.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, BinaryIO

from flowrec.core import WORKER_FIELDS, FlowrecError, Tick, start_child
from flowrec.run.workers import Result, Results, order_of, work
from flowrec.stages import Pipeline, warm_up

_NAME = "the process that solves and plans"
_LOG_BYTES = 65_536  # the last part of what the process printed
_JOIN_S = 1.0


class ProcessWorker:
    """Does orders one after the other in another process; only `close` blocks the caller.

    What the process prints is kept in memory. If the process fails, it is written to a log file that the error names.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._fills: deque[str] = deque()  # fields of Tick that the results to come go to
        # The threads share only these queues, which lock themselves, and `_printed`, which the receiver reads after the
        # thread that fills it has ended.
        self._results: queue.SimpleQueue[Result | Exception] = queue.SimpleQueue()
        self._orders: queue.SimpleQueue[Pipeline | Tick | None] = queue.SimpleQueue()
        self._printed = b""
        self._orders.put(pipeline)
        try:
            self._process = start_child("flowrec.run.worker_process", stderr=subprocess.PIPE)
        except OSError as error:
            raise FlowrecError(
                f"{_NAME} does not start ({error.strerror or error}); free memory, then record again"
            ) from error
        self._threads = [
            threading.Thread(target=target, name="work process", daemon=True)
            for target in (self._collect_output, self._send, self._receive)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, order: Tick) -> None:
        """Start on an order as soon as those before it are done."""
        mission, name = order_of(order)
        needed = {field: getattr(order, field) for field in WORKER_FIELDS[name].reads}
        self._orders.put(Tick(order.stamp_ns, mission=mission, **needed))
        self._fills.append(name)

    def due(self, stamp_ns: int) -> Results:
        """The result of the oldest order, once it is there, to be adopted on the tick of this stamp.

        Raises what the work has raised; FlowrecError if the process has ended, was stopped by a signal, or its answer
        can not be read.
        """
        if not self._fills:
            return {}
        try:
            result = self._results.get_nowait()
        except queue.Empty:
            if self._is_stopped():
                raise FlowrecError(
                    f"{_NAME} (process {self._process.pid}) was stopped by a signal, and the mission waits for it; "
                    "find out who sent it, then record again"
                ) from None
            return {}
        if isinstance(result, Exception):
            raise result
        return {self._fills.popleft(): replace(result, stamp_ns=stamp_ns)}

    def close(self) -> None:
        """End the process at once, its threads and pipes."""
        self._process.kill()
        self._process.wait()
        self._orders.put(None)
        for thread in self._threads:
            thread.join(_JOIN_S)
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert pipe is not None
            with contextlib.suppress(OSError):  # the unread part of an order
                pipe.close()

    def _is_stopped(self) -> bool:
        if sys.platform != "win32":  # where no signal stops a process
            with contextlib.suppress(ChildProcessError):  # it has ended; the receiver reports that
                return os.waitid(os.P_PID, self._process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
        return False

    def _collect_output(self) -> None:
        pipe = self._process.stderr
        assert pipe is not None
        while output := os.read(pipe.fileno(), _LOG_BYTES):
            self._printed = (self._printed + output)[-_LOG_BYTES:]

    def _send(self) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        try:
            while (order := self._orders.get()) is not None:
                pipe.write(pickle.dumps(order, pickle.HIGHEST_PROTOCOL))
                pipe.flush()
        except OSError:
            pass  # it has ended; the receiver reports that
        except Exception as error:  # noqa: BLE001  the mission must not wait for an order that was never sent
            self._results.put(FlowrecError(f"{_NAME} can not be sent an order ({_describe(error)})"))

    def _receive(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        try:
            while True:
                self._results.put(pickle.load(pipe))  # noqa: S301 - from our own process
        except (OSError, EOFError, pickle.UnpicklingError):
            self._results.put(FlowrecError(f"{_NAME} has ended unasked ({self._cause()}); {self._log()}"))
        except BaseException as error:  # noqa: BLE001  after any error the mission must not wait for ever
            self._results.put(
                FlowrecError(f"{_NAME} gave an answer that can not be read ({_describe(error)}); {self._log()}")
            )

    def _cause(self) -> str:
        try:
            status = self._process.wait(_JOIN_S)
        except subprocess.TimeoutExpired:
            return "its pipe is closed"
        return f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    def _log(self) -> str:
        """Write the log file; the end of an error text that names it."""
        if self._process.poll() is not None:
            self._threads[0].join(_JOIN_S)
        if not self._printed:
            return "it printed nothing; is memory short?"
        try:
            number, name = tempfile.mkstemp(prefix="flowrec-worker-", suffix=".log")
            with os.fdopen(number, "wb") as log:
                log.write(self._printed)
        except OSError as error:
            return f"what it printed can not be kept ({error.strerror or error})"
        return f"see {name} for what it printed"


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _answer(pipeline: Pipeline, order: Tick) -> bytes:
    """The result of an order, or what it raised, as bytes that the parent can read."""
    try:
        return pickle.dumps(work(pipeline, order), pickle.HIGHEST_PROTOCOL)
    except BaseException as error:  # noqa: BLE001  the parent raises it
        error.add_note(traceback.format_exc())
        with contextlib.suppress(Exception):
            sent = pickle.dumps(error, pickle.HIGHEST_PROTOCOL)
            pickle.loads(sent)  # noqa: S301 - an exception may be written without complaint and not be readable
            if isinstance(error, Exception):
                return sent
        return pickle.dumps(FlowrecError(f"{_NAME} failed ({_describe(error)})"), pickle.HIGHEST_PROTOCOL)


def _serve(orders: BinaryIO, results: BinaryIO) -> None:
    """Work until the parent process has ended."""
    waiting: queue.SimpleQueue[Tick] = queue.SimpleQueue()
    pipeline: Pipeline = pickle.load(orders)  # noqa: S301 - from our own parent
    threading.Thread(target=_listen, args=(orders, waiting.put), daemon=True).start()
    warm_up()
    while True:
        results.write(_answer(pipeline, waiting.get()))
        results.flush()


def _listen(orders: BinaryIO, put: Callable[[Any], None]) -> None:
    try:
        while True:
            put(pickle.load(orders))  # noqa: S301 - from our own parent
    except (OSError, EOFError):
        os._exit(0)  # also during an order, because no process reads the result any more
    except BaseException:  # noqa: BLE001  an order that can not be read
        traceback.print_exc()
        os._exit(1)


if __name__ == "__main__":
    private = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get between the results
    try:
        _serve(sys.stdin.buffer, private)
    except (BrokenPipeError, EOFError):
        os._exit(0)
