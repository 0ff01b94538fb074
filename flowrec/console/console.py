"""The console of a run: a page in a browser of this machine that shows the run and steers it.

Its server is a process of its own (server.py). It gets ticks as the live view does, so the run waits neither for it nor
for a browser. What an operator asks there comes back through a pipe, as words and numbers and never as objects. Like a
key, it becomes an event of the run's control: in the run's own process, or through its socket.
"""

from __future__ import annotations

import json
import platform
import secrets
import threading
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any, NamedTuple

from flowrec.core import DOUBTS, FlowField, UsageError, Value, completes_mission, verdict_lines
from flowrec.run import HAND
from flowrec.view import Feed, FeedSink, Scene, viewer

PACKAGES = ("starlette", "uvicorn", "websockets")  # of the extra `console`
_SERVER = "flowrec.console.server"
_MAX_HZ = 10.0  # of what its pages are sent
_START_S, _CLOSE_S = 30.0, 3.0  # time for its process to start, and to end
_WITHOUT = "the run goes on without"
STAYS = "flowrec: shows its pages how the run ended"  # what the process says last; it ends by itself a moment later


class Begin(NamedTuple):
    """The first message to the console's process; ticks and replies follow."""

    token: str  # that a browser must know
    name: str  # of the session's file
    scene: Scene
    rerun_port: int | None  # of Rerun's server on this machine; None without one


class CommandReply(NamedTuple):
    """Answer of the run to a command."""

    ticket: int  # number of the command, as the server counts them
    refusal: str  # why the run does not do it; '' where it has taken it


class RunEnded(NamedTuple):
    """The last message to the console's process: how the run ended, and where its file is."""

    outcome: str  # in a few words
    files: str = ""
    good: bool = False  # the mission was completed; green, as in all pictures, and else red
    # sentences as in all pictures, see `verdict_lines`; none where only the outcome is known
    told: tuple[str, ...] = ()
    doubtful: bool = False  # its result is

    @classmethod
    def of(cls, figures: Mapping[str, Value], refined: FlowField | None, files: str) -> RunEnded:
        """The end of a run with these figures and this last map."""
        outcome = str(figures.get("outcome", "unknown"))
        told = tuple(verdict_lines(figures, refined))
        return cls(outcome, files, completes_mission(outcome), told, doubtful=bool(figures.get(DOUBTS)))


def refuse_without_packages() -> None:
    """Raise UsageError if a package of the extra is not installed."""
    for package in PACKAGES:
        if find_spec(package) is None:
            raise UsageError(f"--console needs {package}, which is not installed: pip install 'flowrec[console]'")


class Console(FeedSink):
    """A sink that shows the run on a page, and hands what is asked there to the run.

    Parameters
    ----------
    obey : gives the words of a command to the run and returns why it does not take it; called in another thread.
    name : of the session's file.
    rerun_port : of Rerun's server on this machine; None without one.
    remarks : asked some times per second, in another thread.
    tell : prints a line for the operator, from any thread.

    Attributes
    ----------
    port : of the page, once the server accepts browsers.
    message : how to open the page, or the reason why there is none.
    """

    def __init__(
        self,
        obey: Callable[[dict[str, Any]], str],
        scene: Scene,
        name: str,
        rerun_port: int | None = None,
        remarks: Callable[[], dict[str, Any]] = dict,
        tell: Callable[[str], None] = lambda _line: None,
    ) -> None:
        from flowrec.console.page_state import SHOWN

        super().__init__()
        self.port = 0
        self._obey, self._tell = obey, tell
        self._token = secrets.token_urlsafe(32)
        self._accepts = threading.Event()
        self.message = f"no console: its server did not start within {_START_S:g} s; {_WITHOUT}"
        begin = Begin(self._token, name, scene, rerun_port)
        try:
            self._feed = Feed((_SERVER,), begin, _MAX_HZ, SHOWN, remarks, answers=True)
        except OSError as error:
            self.message = f"no console: its process does not start ({error.strerror or error}); {_WITHOUT}"
            return
        threading.Thread(target=self._hear, args=(self._feed,), name="console", daemon=True).start()
        if not self._accepts.wait(_START_S):
            self._feed.process.kill()

    @property
    def tunnel(self) -> str:
        """Instructions to open the page on another machine; '' if there is no page."""
        there = f"{self.port}:{viewer.LOOPBACK}:{self.port} {platform.node()}"
        return f"on another machine: ssh -L {there}, then the same address" if self.port else ""

    @property
    def url(self) -> str:
        """The address of the page, with the token."""
        return f"http://{viewer.LOOPBACK}:{self.port}/?token={self._token}"

    def close(self, ended: RunEnded | None = None, timeout_s: float = _CLOSE_S) -> None:
        """Let the pages show how the run ended, within a time limit; then end the server."""
        self._end(timeout_s, STAYS, ended)

    def _hear(self, feed: Feed) -> None:
        """Take over what the operator asks, until the process ends: the thread."""
        assert feed.process.stdout is not None
        with feed.process.stdout as answers:
            for line in answers:
                words = json.loads(line)
                if "port" in words:
                    self.port = words["port"]
                    self.message = f"console: {self.url}"
                    self._accepts.set()
                else:
                    refusal = self._obey(words)
                    feed.tell(CommandReply(words["ticket"], refusal))
                    if refusal and words["command"] != HAND:  # that has 50 samples a second
                        self._tell(f"console: {refusal}")
        if feed.closing:
            return
        feed.process.wait()
        self.message = f"the console ended ({feed.last_words}); {_WITHOUT}"
        if self._accepts.is_set():
            self._tell(self.message)
        self._accepts.set()
