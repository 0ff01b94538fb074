"""Watching a run while it happens, without ever making it wait.

`write` puts a tick into a bounded queue and returns. A thread takes what is there, a few times a second, and hands it
through a pipe to a process of its own, which owns Rerun (feed.py). Only that thread can block, on a viewer that is
stopped or slow; then the queue drops its oldest ticks. Latest state is never lost with them: what is handed over is
the difference between the last tick that went through and the tick that goes next.
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

from flowrec.messages import Frame, Tick
from flowrec.system import child_process
from flowrec.view import viewer
from flowrec.view.scene import Scene

Mode = Literal["spawn", "serve"]

_QUEUE_TICKS = 600  # without images: small
_PREVIEW_PX = 720  # longer side of the images that are shown
_CLOSE_S = 2.5  # for the last ticks to be shown
_NO_IMAGE = np.zeros((0, 0), np.uint8)
_FIELDS = tuple(field.name for field in fields(Tick))


class LiveView:
    """A sink that shows the run in Rerun: `spawn` opens a window, `serve` waits for viewers on this machine.

    Whatever becomes of the viewer, `write` neither waits nor raises. `message` is one line for the operator.
    """

    def __init__(self, scene: Scene, mode: Mode = "spawn", port: int | None = None, max_hz: float = 20.0) -> None:
        self._scene = scene
        self._period_s = 1.0 / max_hz
        self._queue: deque[Tick] = deque(maxlen=_QUEUE_TICKS)
        self._frame: Frame | None = None  # the latest, with its image
        self._dropped = 0
        self._gone = False
        self._closing = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._port = viewer.free_port() if port is None else port
        window = mode == "spawn" and viewer.has_display()
        with tempfile.NamedTemporaryFile(prefix="flowrec-view-", suffix=".log", delete=False) as log:
            self._log = Path(log.name)
        self._message = self._start(window, mode)
        self._thread = threading.Thread(target=self._hand_over, name="live view", daemon=True)
        self._thread.start()

    def _start(self, window: bool, mode: Mode) -> str:
        """Start the feed; what to tell the operator."""
        if viewer.executable() is None:
            self._gone = True
            return "no live view: Rerun's viewer is not installed (pip install rerun-sdk); the run goes on without"
        command = child_process.command("flowrec.view.feed", str(self._port), "window" if window else "serve")
        try:
            with self._log.open("wb") as log:
                self._process = subprocess.Popen(  # noqa: S603 - our own module
                    command,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,  # Ctrl-C ends the run, and then the run ends this
                    env=child_process.environment(),
                )
        except OSError as error:
            self._gone = True
            return f"no live view: its process does not start ({error.strerror or error}); the run goes on without"
        how = f"rerun --connect {self.url}"
        if window:
            return f"live view: a window opens; another one: {how}"
        why = "no screen here; " if mode == "spawn" else ""
        return f"live view: {why}open it on this machine with: {how}"

    @property
    def message(self) -> str:
        """One line for the operator: how to open the view, or why there is none."""
        if self._process is not None and self._gone and not self._closing.is_set():
            said = [line for line in self._log_text().splitlines() if line.strip()]
            return f"the live view ended ({said[-1] if said else 'it was killed'}); the run goes on without"
        return self._message

    @property
    def url(self) -> str:
        """What a viewer on this machine connects to."""
        return f"rerun+http://{viewer.LOOPBACK}:{self._port}/proxy"

    @property
    def pid(self) -> int | None:
        """The process that owns Rerun."""
        return None if self._process is None else self._process.pid

    @property
    def dropped(self) -> int:
        """Ticks that were not shown, because the view could not keep up or is gone."""
        return self._dropped

    def write(self, tick: Tick) -> None:
        """Take one tick; a few microseconds."""
        if self._gone:
            self._dropped += 1
            return
        if tick.frame is not None:
            self._frame = tick.frame  # before the queue: the thread looks for the image of the tick it takes last
            tick = replace(tick, frame=Frame(tick.frame.stamp_ns, tick.frame.index, _NO_IMAGE))
        if len(self._queue) == _QUEUE_TICKS:
            self._dropped += 1
        self._queue.append(tick)

    def close(self, patience_s: float = _CLOSE_S) -> None:
        """Show what is left, for a moment, and let go. A window stays open."""
        if self._closing.is_set():
            return
        self._closing.set()
        end = time.monotonic() + patience_s
        self._thread.join(patience_s)
        process = self._process
        if process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(end - time.monotonic(), 0.0))
            process.kill()  # SIGKILL also ends a stopped process, and that frees the thread from its pipe
            process.wait()
            self._thread.join(1.0)
        self._log.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- the thread

    def _hand_over(self) -> None:
        if self._process is None or self._process.stdin is None:
            return
        pipe = self._process.stdin
        sent = Tick()
        try:
            pickle.dump(self._scene, pipe, pickle.HIGHEST_PROTOCOL)
            pipe.flush()
            while not self._gone:
                last = self._closing.wait(self._period_s)
                if last or self._queue:
                    batch, sent = self._batch(sent)
                    pickle.dump(batch, pipe, pickle.HIGHEST_PROTOCOL)
                    pipe.flush()
                elif self._process.poll() is not None:
                    break
                if last:
                    break
        except OSError:  # the process is gone
            pass
        finally:
            self._gone = True
            self._dropped += len(self._queue)
            self._queue.clear()
            with contextlib.suppress(OSError):
                pipe.close()

    def _batch(self, sent: Tick) -> tuple[tuple[int, list[dict[str, Any]]], Tick]:
        """All ticks that wait, each as what changed, the last with its image; and the last tick itself."""
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
            changes[-1]["frame"] = Frame(frame.stamp_ns, frame.index, frame.image[::step, ::step])
        return (step, changes), sent

    def _log_text(self) -> str:
        try:
            return self._log.read_text(errors="replace")
        except OSError:
            return ""
