"""The slow stages in a process of their own: the parent's end, and the process itself (python -m flowrec.work_process).

Not a pool of multiprocessing's: that makes Python wait at its end for what is being worked on, holds up its parent
while it starts, and hears the Ctrl-C that is meant for the run.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any, BinaryIO

from flowrec.errors import FlowrecError
from flowrec.messages import FlowField, Route, Tick
from flowrec.pipeline import Pipeline
from flowrec.work import warm_up, work

Result = FlowField | Route


class WorkProcess:
    """Takes orders, one after the other; nothing here ever blocks the caller."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._results: queue.SimpleQueue[Result | Exception] = queue.SimpleQueue()
        self._orders: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._orders.put(pipeline)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "flowrec.work_process"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C and a closed terminal end the run, and then the run ends this
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
        except OSError as error:
            raise FlowrecError(
                f"the process that solves and plans does not start ({error.strerror or error})"
            ) from error
        for target in (self._send, self._receive):
            threading.Thread(target=target, name="work process", daemon=True).start()

    def submit(self, order: Tick) -> None:
        """Start on an order as soon as those before it are done."""
        self._orders.put(order)

    def result(self) -> Result | None:
        """That of the oldest order whose result was not taken yet; None while it is worked on.

        Raises what the work has raised, FlowrecError where the process is gone.
        """
        try:
            result = self._results.get_nowait()
        except queue.Empty:
            return None
        if isinstance(result, Exception):
            raise result
        return result

    def close(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()

    def _send(self) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        try:
            while True:
                pickle.dump(self._orders.get(), pipe, pickle.HIGHEST_PROTOCOL)
                pipe.flush()
        except OSError:
            pass  # it is gone; the other thread says so

    def _receive(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        try:
            while True:
                self._results.put(pickle.load(pipe))  # noqa: S301 - from our own process
        except (OSError, EOFError, pickle.UnpicklingError):
            self._results.put(FlowrecError("the process that solves and plans has ended unasked; is memory short?"))


def _serve(orders: BinaryIO, results: BinaryIO) -> None:
    """Work until the parent is gone, however it went."""
    waiting: queue.SimpleQueue[Tick] = queue.SimpleQueue()
    pipeline: Pipeline = pickle.load(orders)  # noqa: S301 - from our own parent
    threading.Thread(target=_listen, args=(orders, waiting.put), daemon=True).start()
    warm_up()
    while True:
        order = waiting.get()
        try:
            answer: Result | Exception = work(pipeline, order)
        except Exception as error:  # noqa: BLE001  the parent raises it
            answer = error
        pickle.dump(answer, results, pickle.HIGHEST_PROTOCOL)
        results.flush()


def _listen(orders: BinaryIO, put: Callable[[Tick], None]) -> None:
    try:
        while True:
            put(pickle.load(orders))  # noqa: S301 - from our own parent
    except (OSError, EOFError, pickle.UnpicklingError):
        os._exit(0)  # in the midst of its work, for nobody waits for that any more


if __name__ == "__main__":
    private = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not get in between
    try:
        _serve(sys.stdin.buffer, private)
    except (OSError, EOFError, pickle.UnpicklingError):
        os._exit(0)
