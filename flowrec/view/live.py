"""Live view of a run that never makes the run wait: a process that owns Rerun, fed with ticks, and its sink.

The process, `python -m flowrec.view.live PORT window|serve`, hosts a server on the loopback interface to which any
number of viewers connect, so a viewer that was closed can be opened again. A viewer calls it an error when its server
ends, and Rerun 0.41 has no other end of a stream. So the process stays after the run while a viewer is connected.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import Literal

from flowrec.core import Tick, seconds
from flowrec.view import viewer
from flowrec.view.feed import Batch, Feed, FeedSink, read_feed
from flowrec.view.scene import Scene

Mode = Literal["spawn", "serve"]

_START_S = 30.0  # for the server to accept viewers: importing Rerun takes a second, on a busy machine more
_CLOSE_S = 10.0  # for the last ticks to be shown; then the process hangs
_MAX_HZ = 20.0
_WITHOUT = "the run goes on without"

ACCEPTS = "flowrec: accepts viewers"  # what the process says to the run
STAYS = "flowrec: stays for its viewers"
ABSENT_S = 2.0  # without a viewer, after which the process ends
_SERVER_START_S = 10.0  # of it, for the server itself
_SERVER_MEMORY = "256MB"  # kept for viewers that connect later
_POLL_S = 0.25


class LiveView(FeedSink):
    """A sink that shows the run in Rerun: `spawn` opens a window, `serve` waits for viewers on this machine."""

    def __init__(self, scene: Scene, mode: Mode = "spawn", port: int | None = None) -> None:
        super().__init__()
        self.port = viewer.free_port() if port is None else port
        self.afterwards = ""  # one line for the operator about a server that stays after `close`; '' if it does not
        self._message = self._start(scene, mode)
        self._wait_until_it_accepts()

    def _start(self, scene: Scene, mode: Mode) -> str:
        """Start the process; the message for the operator."""
        if viewer.executable() is None:
            return f"no live view: Rerun's viewer is not installed (pip install rerun-sdk); {_WITHOUT}"
        window = mode == "spawn" and viewer.has_display()
        command = (__name__, str(self.port), "window" if window else "serve")
        try:
            self._feed = Feed(command, scene, _MAX_HZ)
        except OSError as error:
            return f"no live view: its process does not start ({error.strerror or error}); {_WITHOUT}"
        how = f"rerun --connect {self.url}"
        if window:
            return f"live view: a window opens; another one: {how}"
        why = "no screen here; " if mode == "spawn" else ""
        return f"live view: {why}open it on this machine with: {how}"

    @property
    def message(self) -> str:
        """One line for the operator: how to open the view, or why there is none."""
        feed = self._feed
        if feed is None or not feed.ended or feed.closing:
            return self._message
        return f"the live view ended ({feed.last_words}); {_WITHOUT}"

    @property
    def url(self) -> str:
        """Address for a viewer on this machine."""
        return viewer.url(self.port)

    def close(self, timeout_s: float = _CLOSE_S) -> None:
        """Show the last ticks within a time limit, then end the process. It stays for viewers that are connected."""
        if self._end(timeout_s, STAYS):
            self.afterwards = (
                f"live view: its server (process {self.pid}) stays for the viewers that are connected, and "
                f"ends {ABSENT_S:g} s after the last of them"
            )

    def _wait_until_it_accepts(self) -> None:
        """Wait for the server, so that its address is said when viewers can connect; end it if it takes too long."""
        feed = self._feed
        if feed is None or viewer.until(lambda: feed.ended or feed.has_logged(ACCEPTS) or None, _START_S):
            return
        feed.process.kill()
        self._message = f"no live view: its server did not start within {_START_S:g} s; {_WITHOUT}"


def serve() -> None:
    """Show what arrives at stdin, first the scene, then batches; stay for the viewers."""
    import rerun as rr  # here, so that a run does not import it

    from flowrec.view.blueprint import blueprint
    from flowrec.view.entities import SUMMARY
    from flowrec.view.logger import TickLogger
    from flowrec.view.rrd_file import describe, open_stream
    from flowrec.view.summary_text import LiveSummary

    port, window = int(sys.argv[1]), sys.argv[2] == "window"
    source = read_feed()
    scene: Scene = next(source)
    stream = open_stream(scene)
    present: AbstractSet[str] = frozenset({SUMMARY})
    with socket.socket() as trial:  # Rerun reports a taken port only in its log
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((viewer.LOOPBACK, port))
        except OSError:
            sys.exit(f"port {port} is taken by another program")
    stream.set_sinks(
        rr.GrpcServerSink(bind_ip=viewer.LOOPBACK, port=port, server_memory_limit=_SERVER_MEMORY),
        default_blueprint=blueprint(scene, ("",), present, 0.0, [{}], live=True),
    )
    if not viewer.wait_for_server(port, _SERVER_START_S):
        sys.exit(f"the server does not accept viewers at port {port}")
    print(ACCEPTS, flush=True)
    describe(stream, scene)
    opened = viewer.open_window("--connect", viewer.url(port)) if window else None
    logger, summary = TickLogger(stream, scene), LiveSummary(scene)
    tick, begun = Tick(), 0
    batch: Batch
    for batch in source:
        logger.image_step = batch.step
        news = False
        for changes in batch.changes:
            tick = replace(tick, **changes)
            news |= summary.add(tick)
            logger.states.doubtful = summary.doubtful
            logger.log(tick)
        if news:
            stream.log(SUMMARY, summary.document(), static=True)
        phases = logger.states.phases
        ended = tick.mission is not None and tick.mission.finished
        if not logger.present <= present or (len(phases) > begun and not ended):
            # What is shown for the first time is added to the layout. At the end it stays as a person has arranged it.
            present, begun = present | logger.present, len(phases)
            stream.send_blueprint(blueprint(scene, ("",), present, seconds(tick.stamp_ns), [phases], live=True))
    stream.log(SUMMARY, summary.document(), static=True)
    _stay(port, opened)
    stream.disconnect()


def _stay(port: int, window: subprocess.Popen[bytes] | None) -> None:
    """Wait until no viewer has been connected for ABSENT_S; not at all if none is connected now."""
    if not _is_watched(port, window):
        return
    print(STAYS, flush=True)
    while viewer.until(lambda: _is_watched(port, window) or None, ABSENT_S):
        time.sleep(_POLL_S)


def _is_watched(port: int, window: subprocess.Popen[bytes] | None) -> bool:
    """True if the window is open or a viewer connected."""
    import psutil  # type: ignore[import-untyped]

    if window is not None and window.poll() is None:
        return True
    return any(
        each.status == psutil.CONN_ESTABLISHED and each.laddr.port == port
        for each in psutil.Process().net_connections("tcp")
    )


if __name__ == "__main__":
    serve()
