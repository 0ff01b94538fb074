"""The worker of a live run: a process for the slow stages, as the parent sees it, and the process itself.

It is no pool of multiprocessing: such a pool makes Python wait at exit for unfinished work, delays its parent while it
starts, and receives the Ctrl-C that is meant for the run.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import sys
import tempfile
import threading
import traceback
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from flowrec.core import ChildEndedError, ChildProcess, Extra, FlowrecError, Parent, Tick
from flowrec.run.workers import Results, messages_read, order_of, work
from flowrec.stages import Pipeline, warm_up

_NAME = "the process that solves and plans"
_JOIN_S = 1.0


class ProcessWorker:
    """Does orders one after the other in another process; only `close` blocks the caller.

    What the process prints is kept in memory. If the process fails, it is written to a log file that the error names.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._fills: deque[str] = deque()  # fields of Tick for the results of the orders under way, the oldest first
        self._unsent: FlowrecError | None = None  # why an order was never sent
        self._orders: queue.SimpleQueue[Pipeline | Tick | None] = queue.SimpleQueue()
        self._orders.put(pipeline)
        try:
            self._child = ChildProcess("flowrec.run.worker_process")
        except OSError as error:
            raise FlowrecError(
                f"{_NAME} does not start ({error.strerror or error}); free memory, then record again"
            ) from error
        self._sender = threading.Thread(target=self._send, name="work process", daemon=True)
        self._sender.start()

    def submit(self, order: Tick) -> None:
        """Start on an order as soon as those before it are done."""
        mission, name = order_of(order)
        read = messages_read(order, name)
        needed: dict[str, Any] = {each: message for each, message in read.items() if each not in order.extra}
        extra = Extra({path: message for path, message in order.extra.items() if path in read})
        self._orders.put(Tick(order.stamp_ns, mission=mission, extra=extra, **needed))
        self._fills.append(name)

    def due(self, stamp_ns: int) -> Results:
        """The result of the oldest order, once it is there, to be adopted on the tick of this stamp.

        Raises what the work has raised; FlowrecError if the process has ended, was stopped by a signal, or its answer
        can not be read.
        """
        if not self._fills:
            return {}
        if self._unsent is not None:
            raise self._unsent
        try:
            result = self._child.receive(0.0)
        except queue.Empty:
            if self._is_stopped():
                raise FlowrecError(
                    f"{_NAME} (process {self._child.process.pid}) was stopped by a signal, and the mission waits for "
                    "it; find out who sent it, then record again"
                ) from None
            return {}
        except ChildEndedError as error:
            raise FlowrecError(f"{_NAME} has ended unasked ({error.how}); {self._log()}") from error
        except Exception as error:
            raise FlowrecError(
                f"{_NAME} gave an answer that can not be read ({_describe(error)}); {self._log()}"
            ) from error
        if isinstance(result, Exception):
            raise result
        return {self._fills.popleft(): replace(result, stamp_ns=stamp_ns)}

    def close(self) -> None:
        """End the process at once, its threads and pipes."""
        self._child.process.kill()
        self._orders.put(None)
        self._sender.join(_JOIN_S)
        self._child.close()

    def _is_stopped(self) -> bool:
        if sys.platform != "win32":  # where no signal stops a process
            with contextlib.suppress(ChildProcessError):  # it has ended, which the next call tells
                return os.waitid(os.P_PID, self._child.process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
        return False

    def _send(self) -> None:
        try:
            while (order := self._orders.get()) is not None:
                self._child.send(order)
        except Exception as error:  # noqa: BLE001  the mission must not wait for an order that was never sent
            self._unsent = FlowrecError(f"{_NAME} can not be sent an order ({_describe(error)})")

    def _log(self) -> str:
        """Write the log file, and return the end of an error text that names it."""
        if not self._child.printed:
            return "it printed nothing; is memory short?"
        try:
            number, name = tempfile.mkstemp(prefix="flowrec-worker-", suffix=".log")
            with os.fdopen(number, "wb") as log:
                log.write(self._child.printed)
        except OSError as error:
            return f"what it printed can not be kept ({error.strerror or error})"
        return f"see {name} for what it printed"


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _answer(pipeline: Pipeline, order: Tick) -> tuple[bytes, bool]:
    """The result of an order, or what it raised, as bytes that the parent can read; and whether it is a result."""
    try:
        return pickle.dumps(work(pipeline, order), pickle.HIGHEST_PROTOCOL), True
    except BaseException as error:  # noqa: BLE001  the parent raises it
        error.add_note(traceback.format_exc())
        with contextlib.suppress(Exception):
            sent = pickle.dumps(error, pickle.HIGHEST_PROTOCOL)
            pickle.loads(sent)  # noqa: S301 - an exception may be written without complaint and not be readable
            if isinstance(error, Exception):
                return sent, False
        return pickle.dumps(FlowrecError(f"{_NAME} failed ({_describe(error)})"), pickle.HIGHEST_PROTOCOL), False


if __name__ == "__main__":
    parent = Parent()
    given: Pipeline = parent.order()
    warm_up()
    to_prepare = given.refiner.preparations(given.chip, given.solver)
    while True:
        sent, done = _answer(given, parent.order())
        parent.answer(sent)
        while done and parent.is_idle and (part := next(to_prepare, None)) is not None:
            with contextlib.suppress(FlowrecError, np.linalg.LinAlgError):  # the order that needs it says so
                part()
