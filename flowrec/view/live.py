"""Live view of a run that never makes the run wait: a process that owns Rerun (live_server.py), fed with ticks."""

from __future__ import annotations

from typing import Literal

from flowrec.view import live_server, viewer
from flowrec.view.feed import Feed, FeedSink
from flowrec.view.scene import Scene

Mode = Literal["spawn", "serve"]

_START_S = 30.0  # for the server to accept viewers: importing Rerun takes a second, on a busy machine more
_CLOSE_S = 10.0  # for the last ticks to be shown; then the process hangs
_MAX_HZ = 20.0
_WITHOUT = "the run goes on without"


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
        command = (live_server.__name__, str(self.port), "window" if window else "serve")
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
        if self._end(timeout_s, live_server.STAYS):
            self.afterwards = (
                f"live view: its server (process {self.pid}) stays for the viewers that are connected, and "
                f"ends {live_server.ABSENT_S:g} s after the last of them"
            )

    def _wait_until_it_accepts(self) -> None:
        """Wait for the server, so that its address is said when viewers can connect; end it if it takes too long."""
        feed = self._feed
        if feed is None or viewer.until(lambda: feed.ended or feed.has_logged(live_server.ACCEPTS) or None, _START_S):
            return
        feed.process.kill()
        self._message = f"no live view: its server did not start within {_START_S:g} s; {_WITHOUT}"
