"""The console of a run: a page in a browser of this machine that shows the run and steers it.

Its server is a process of its own (server.py), fed with ticks as the live view is, so the run waits neither for it nor
for a browser. What an operator asks there comes back through a pipe, as words and numbers and never as objects, and
becomes an event of the run's control, as a key does.
"""

from __future__ import annotations

import json
import platform
import secrets
import threading
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Self

from flowrec.console.messages import STAYS, Begin, CommandReply, RunEnded
from flowrec.core import FlowrecError, Tick, UsageError
from flowrec.run import COMMANDS, RunControl
from flowrec.view import Feed, Scene, viewer

PACKAGES = ("starlette", "uvicorn", "websockets")  # of the extra `console`
GOAL, SPEED = "goal", "speed"  # commands with numbers
_SERVER = "flowrec.console.server"
_MAX_HZ = 10.0
_START_S = 30.0
_CLOSE_S = 3.0
_WITHOUT = "the run goes on without"


def refuse_without_packages() -> None:
    """Raise UsageError if a package of the extra is not installed."""
    for package in PACKAGES:
        if find_spec(package) is None:
            raise UsageError(f"--console needs {package}, which is not installed: pip install 'flowrec[console]'")


class Console:
    """A sink that shows the run on a page, and hands what is asked there to `control`.

    Whatever happens to the page or its server, `write` neither waits nor raises.

    Parameters
    ----------
    name : of the session's file.
    rerun_port : of Rerun's server on this machine; None without one.
    remarks : asked some times per second, in another thread.
    tell : prints a line for the operator, from any thread.

    Attributes
    ----------
    port : of the page, once the server accepts browsers.
    """

    def __init__(
        self,
        control: RunControl,
        scene: Scene,
        name: str,
        rerun_port: int | None = None,
        remarks: Callable[[], dict[str, Any]] = dict,
        tell: Callable[[str], None] = lambda _line: None,
    ) -> None:
        from flowrec.console.page_state import SHOWN

        self.port = 0
        self._control, self._tell = control, tell
        self._token = secrets.token_urlsafe(32)
        self._accepts = threading.Event()
        self._message = f"no console: its server did not start within {_START_S:g} s; {_WITHOUT}"
        self._feed: Feed | None = None
        begin = Begin(self._token, name, scene, rerun_port)
        try:
            self._feed = Feed((_SERVER,), begin, _MAX_HZ, SHOWN, remarks, answers=True)
        except OSError as error:
            self._message = f"no console: its process does not start ({error.strerror or error}); {_WITHOUT}"
            return
        threading.Thread(target=self._hear, args=(self._feed,), name="console", daemon=True).start()
        if not self._accepts.wait(_START_S):
            self._feed.process.kill()

    @property
    def message(self) -> str:
        """Instructions to open the page, or the reason why there is none."""
        return self._message

    @property
    def tunnel(self) -> str:
        """Instructions to open the page on another machine; '' if there is no page."""
        there = f"{self.port}:{viewer.LOOPBACK}:{self.port} {platform.node()}"
        return f"on another machine: ssh -L {there}, then the same address" if self.port else ""

    @property
    def url(self) -> str:
        """The address of the page, with the token."""
        return f"http://{viewer.LOOPBACK}:{self.port}/?token={self._token}"

    @property
    def pid(self) -> int | None:
        """The process of the server."""
        return None if self._feed is None else self._feed.process.pid

    @property
    def dropped(self) -> int:
        """Ticks that were not shown."""
        return 0 if self._feed is None else self._feed.dropped

    def write(self, tick: Tick) -> None:
        """Take one tick; a few microseconds."""
        if self._feed is not None:
            self._feed.write(tick)

    def close(self, ended: RunEnded | None = None, timeout_s: float = _CLOSE_S) -> None:
        """Let the pages show how the run ended, within a time limit; then end the server."""
        feed = self._feed
        if feed is not None and not feed.closing and feed.close(timeout_s, STAYS, ended):
            viewer.leave(feed.process)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _hear(self, feed: Feed) -> None:
        """Take over what the operator asks, until the process ends: the thread."""
        assert feed.process.stdout is not None
        with feed.process.stdout as answers:
            for line in answers:
                words = json.loads(line)
                if "port" in words:
                    self.port = words["port"]
                    self._message = f"console: {self.url}"
                    self._accepts.set()
                else:
                    feed.tell(CommandReply(words["ticket"], self._do(words)))
        if feed.closing:
            return
        feed.process.wait()
        self._message = f"the console ended ({feed.last_words}); {_WITHOUT}"
        if self._accepts.is_set():
            self._tell(self._message)
        self._accepts.set()

    def _do(self, words: dict[str, Any]) -> str:
        """Give a command to the run; why it does not take it, '' where it does."""
        name, taken = words["command"], True
        if name in (GOAL, SPEED) and self._control.reason:
            return f"the run ends: {self._control.reason}"
        try:
            if name == GOAL:
                self._control.set_goal(float(words["x_um"]), float(words["y_um"]))
            elif name == SPEED:
                limit = words["limit_um_s"]
                self._control.limit_speed(None if limit is None else float(limit))
            else:
                taken = COMMANDS[name].give(self._control, words["text"], "console") is not False
        except FlowrecError as error:  # a place or speed that no run could have
            self._tell(f"console: {error}")
            return str(error)
        return "" if taken else "too many commands wait for their tick; give it again"
