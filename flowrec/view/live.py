"""Live view of a run that never makes the run wait.

`write` appends a tick to a bounded queue and returns. A thread sends what has accumulated, some times per second,
through a pipe to a process that owns Rerun (live_server.py). Only that thread can block, on a viewer that is stopped or
slow; then the queue drops its oldest ticks. The latest state is not lost with them, because each tick is sent as the
difference from the last one that was sent.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import tempfile
import threading
import time
from collections import deque
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from flowrec.messages import Frame
from flowrec.system.processes import child_command, child_environment
from flowrec.topics import Tick
from flowrec.view import live_server, viewer
from flowrec.view.scene import Scene

Mode = Literal["spawn", "serve"]

_QUEUE_TICKS = 600  # without images: small
_PREVIEW_PX = 720  # longer side of the images that are shown
_START_S = 30.0  # for the server to accept viewers: importing Rerun takes a second, on a busy machine more
_CLOSE_S = 10.0  # for the last ticks to be shown; then the process hangs
_POLL_S = 0.02
_NO_IMAGE = np.zeros((0, 0), np.uint8)
_FIELDS = tuple(field.name for field in fields(Tick))
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
        self.port = viewer.free_port() if port is None else port
        with tempfile.NamedTemporaryFile(prefix="flowrec-view-", suffix=".log", delete=False) as log:
            self._log = Path(log.name)
        self.afterwards = ""  # one line for the operator about a server that stays after `close`; '' if it does not
        self._message = self._start(mode)
        self._thread = threading.Thread(target=self._send_all, name="live view", daemon=True)
        self._thread.start()
        self._wait_until_it_accepts()

    def _start(self, mode: Mode) -> str:
        """Start the process; the message for the operator."""
        if viewer.executable() is None:
            self._ended = True
            return f"no live view: Rerun's viewer is not installed (pip install rerun-sdk); {_WITHOUT}"
        window = mode == "spawn" and viewer.has_display()
        command = child_command(live_server.__name__, str(self.port), "window" if window else "serve")
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
        return viewer.url(self.port)

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
        """Show the last ticks within a time limit, then end the process. It stays for viewers that are connected."""
        if self._closing.is_set():
            return
        self._closing.set()
        end = time.monotonic() + timeout_s
        self._thread.join(timeout_s)
        process = self._process
        if process is not None:
            while process.poll() is None and not self._said(live_server.STAYS) and time.monotonic() < end:
                time.sleep(_POLL_S)
            if process.poll() is None and self._said(live_server.STAYS):
                self.afterwards = (
                    f"live view: its server (process {process.pid}) stays for the viewers that are connected, and ends "
                    f"{live_server.ABSENT_S:g} s after the last of them"
                )
                viewer.leave(process)
            else:
                process.kill()  # SIGKILL also ends a stopped process, which unblocks the thread
                process.wait()
            self._thread.join(1.0)
        with contextlib.suppress(OSError):  # Windows, while the process has it open
            self._log.unlink(missing_ok=True)

    def _wait_until_it_accepts(self) -> None:
        """Wait for the server, so that its address is said when viewers can connect; end it if it takes too long."""
        end = time.monotonic() + _START_S
        while not self._ended and not self._said(live_server.ACCEPTS):
            if time.monotonic() > end:
                assert self._process is not None
                self._process.kill()
                self._message = f"no live view: its server did not start within {_START_S:g} s; {_WITHOUT}"
                return
            time.sleep(_POLL_S)

    def _said(self, word: str) -> bool:
        """Whether the process has written a word."""
        try:
            return word in self._log.read_text(errors="replace")
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

    def _batch(self, sent: Tick) -> tuple[live_server.Batch, Tick]:
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
