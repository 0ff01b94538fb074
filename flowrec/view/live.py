"""Live view of a run that never makes the run wait, and the process that serves it.

`write` appends a tick to a bounded queue and returns. A thread sends what has accumulated, some times per second,
through a pipe to a process that owns Rerun (`python -m flowrec.view.live`). Only that thread can block, on a viewer
that is stopped or slow; then the queue drops its oldest ticks. The latest state is not lost with them, because each
tick is sent as the difference from the last one that was sent.

The process hosts a server on the loopback interface to which any number of viewers connect, so a viewer that was closed
can be opened again. It ends with the pipe, or with the window that it has opened.
"""

from __future__ import annotations

import contextlib
import pickle
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Set as AbstractSet
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from flowrec.messages import Frame
from flowrec.system.processes import child_command, child_environment
from flowrec.topics import Tick
from flowrec.view import viewer
from flowrec.view.scene import Scene

Mode = Literal["spawn", "serve"]
Batch = tuple[int, list[dict[str, Any]]]  # step of the preview image, and the changes of each tick

_QUEUE_TICKS = 600  # without images: small
_PREVIEW_PX = 720  # longer side of the images that are shown
_START_S = 10.0  # for the server to accept viewers: importing Rerun takes a second
_CLOSE_S = 2.5  # for the last ticks to be shown
_POLL_S = 0.02
_ALL_SHOWN = "all is shown"
_NO_IMAGE = np.zeros((0, 0), np.uint8)
_FIELDS = tuple(field.name for field in fields(Tick))
_SERVER_MEMORY = "256MB"  # kept for viewers that connect later
_FLUSH_S = 0.5  # for the last ticks to reach the viewers
_WITHOUT = "the run goes on without"


class LiveView:
    """A sink that shows the run in Rerun: `spawn` opens a window, `serve` waits for viewers on this machine.

    Whatever happens to the viewer, `write` neither waits nor raises.
    """

    def __init__(self, scene: Scene, mode: Mode = "spawn", port: int | None = None, max_hz: float = 20.0) -> None:
        self._scene = scene
        self._period_s = 1.0 / max_hz
        self._queue: deque[Tick] = deque(maxlen=_QUEUE_TICKS)
        self._frame: Frame | None = None  # the latest, with its image
        self.dropped = 0  # ticks that were not shown, because the view could not keep up or has ended
        self._ended = False
        self._closing = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._port = viewer.free_port() if port is None else port
        with tempfile.NamedTemporaryFile(prefix="flowrec-view-", suffix=".log", delete=False) as log:
            self._log = Path(log.name)
        self._message = self._start(mode)
        self._thread = threading.Thread(target=self._send_all, name="live view", daemon=True)
        self._thread.start()
        if not self._ended:
            viewer.wait_for_server(self._port, _START_S, lambda: self._ended)

    def _start(self, mode: Mode) -> str:
        """Start the process; the message for the operator."""
        if viewer.executable() is None:
            self._ended = True
            return f"no live view: Rerun's viewer is not installed (pip install rerun-sdk); {_WITHOUT}"
        window = mode == "spawn" and viewer.has_display()
        command = child_command(__name__, str(self._port), "window" if window else "serve")
        try:
            with self._log.open("wb") as log:
                self._process = subprocess.Popen(  # noqa: S603 - our own module
                    command,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,  # Ctrl-C ends the run, and then the run ends this
                    env=child_environment(),
                )
        except OSError as error:
            self._ended = True
            return f"no live view: its process does not start ({error.strerror or error}); {_WITHOUT}"
        how = f"rerun --connect {self.url}"
        if window:
            return f"live view: a window opens; another one: {how}"
        why = "no screen here; " if mode == "spawn" else ""
        return f"live view: {why}open it on this machine with: {how}"

    @property
    def message(self) -> str:
        """One line for the operator: how to open the view, or why there is none."""
        if self._process is None or not self._ended or self._closing.is_set():
            return self._message
        log = self._log.read_text(errors="replace") if self._log.exists() else ""
        lines = [line for line in log.splitlines() if line.strip()]
        return f"the live view ended ({lines[-1] if lines else 'it was killed'}); {_WITHOUT}"

    @property
    def url(self) -> str:
        """What a viewer on this machine connects to."""
        return viewer.url(self._port)

    @property
    def pid(self) -> int | None:
        """The process that owns Rerun."""
        return None if self._process is None else self._process.pid

    def write(self, tick: Tick) -> None:
        """Take one tick; a few microseconds."""
        if self._ended:
            self.dropped += 1
            return
        if tick.frame is not None:
            self._frame = tick.frame  # before the queue: the thread looks for the image of the tick that it takes last
            tick = replace(tick, frame=Frame(tick.frame.stamp_ns, tick.frame.index, _NO_IMAGE))
        if len(self._queue) == _QUEUE_TICKS:
            self.dropped += 1
        self._queue.append(tick)

    def close(self, timeout_s: float = _CLOSE_S) -> None:
        """Show the last ticks within a time limit, then end the process. A window stays open."""
        if self._closing.is_set():
            return
        self._closing.set()
        end = time.monotonic() + timeout_s
        self._thread.join(timeout_s)
        process = self._process
        if process is not None:
            while process.poll() is None and not self._shows_all() and time.monotonic() < end:
                time.sleep(_POLL_S)
            if process.poll() is None and self._shows_all():
                process.returncode = 0  # it serves its window on: not waited for, and no leak
            else:
                process.kill()  # SIGKILL also ends a stopped process, which unblocks the thread
                process.wait()
            self._thread.join(1.0)
        with contextlib.suppress(OSError):  # Windows, while the process has it open
            self._log.unlink(missing_ok=True)

    def _shows_all(self) -> bool:
        """Whether the process has shown everything and only waits for its window to be closed."""
        try:
            return _ALL_SHOWN in self._log.read_text(errors="replace")
        except OSError:
            return False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _send_all(self) -> None:
        """Send the scene, then batches of ticks, until the view is closed or its process ends: the thread."""
        if self._process is None or self._process.stdin is None:
            return
        pipe = self._process.stdin
        sent = Tick()
        try:
            _send(pipe, self._scene)
            while not self._ended:
                closing = self._closing.wait(self._period_s)
                if closing or self._queue:
                    batch, sent = self._batch(sent)
                    _send(pipe, batch)
                elif self._process.poll() is not None:
                    break
                if closing:
                    break
        except OSError:  # the process has ended
            pass
        finally:
            self._ended = True
            self.dropped += len(self._queue)
            self._queue.clear()
            with contextlib.suppress(OSError):
                pipe.close()

    def _batch(self, sent: Tick) -> tuple[Batch, Tick]:
        """All ticks in the queue, each as its changes, the last with its image; and the last tick itself."""
        changes: list[dict[str, Any]] = []
        step = 1
        while self._queue:
            tick = self._queue.popleft()
            changes.append(
                {name: getattr(tick, name) for name in _FIELDS if getattr(tick, name) is not getattr(sent, name)}
            )
            sent = tick
        frame = self._frame
        if changes and frame is not None and sent.frame is not None and frame.index == sent.frame.index:
            step = max(1, -(-max(frame.image.shape) // _PREVIEW_PX))
            changes[-1]["frame"] = replace(frame, image=frame.image[::step, ::step])
        return (step, changes), sent


def _send(pipe: Any, what: object) -> None:
    pickle.dump(what, pipe, pickle.HIGHEST_PROTOCOL)
    pipe.flush()


def serve() -> None:
    """Show what arrives at stdin, first the scene, then batches: the process."""
    import rerun as rr  # here, so that a run does not import it

    from flowrec.view.blueprint import blueprint
    from flowrec.view.logger import TickLogger
    from flowrec.view.rrd_file import describe, open_stream

    port, window = int(sys.argv[1]), sys.argv[2] == "window"
    source = sys.stdin.buffer
    scene: Scene = pickle.load(source)  # noqa: S301 - from our own parent
    stream = open_stream(scene)
    present: AbstractSet[str] = frozenset()
    with socket.socket() as trial:  # Rerun reports a taken port only in its log
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((viewer.LOOPBACK, port))
        except OSError:
            sys.exit(f"port {port} is taken by another program")
    stream.set_sinks(
        rr.GrpcServerSink(bind_ip=viewer.LOOPBACK, port=port, server_memory_limit=_SERVER_MEMORY),
        default_blueprint=blueprint(scene, ("",), present),
    )
    describe(stream, scene)
    viewer_process = None
    if window:
        viewer.wait_for_server(port, _START_S)
        viewer_process = viewer.open_window("--connect", viewer.url(port))
    logger = TickLogger(stream, scene)
    tick = Tick()
    while True:
        try:
            step, changes_of_ticks = pickle.load(source)  # noqa: S301
        except (EOFError, pickle.UnpicklingError):  # the run ended, or was killed while it wrote
            break
        logger.image_step = step
        for changes in changes_of_ticks:
            tick = replace(tick, **changes)
            logger.log(tick)
        if logger.present != present:
            # Something is shown for the first time: its view is added to the layout.
            present = frozenset(logger.present)
            stream.send_blueprint(blueprint(scene, ("",), present))
    stream.flush(timeout_sec=1.0)
    time.sleep(_FLUSH_S)
    if viewer_process is not None:
        # A viewer calls it an error when its server ends, so the server stays as long as its own window.
        print(_ALL_SHOWN, flush=True)
        viewer_process.wait()
    stream.disconnect()


if __name__ == "__main__":
    serve()
