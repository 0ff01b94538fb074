"""The console of a run that a test serves, and what a page or a browser asks of it."""

from __future__ import annotations

import http.client
import importlib
import json
import socket
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

from flowrec.console import console as console_module
from flowrec.core import OperatorEvent
from flowrec.run import RunControl, obey
from flowrec.view import Scene
from tests.conftest import HANG_S

sync_client = importlib.import_module("websockets.sync.client")


class Answer(NamedTuple):
    status: int
    headers: Any
    begin: bytes


def asked(port: int, path: str, method: str, body: bytes | None, headers: dict[str, str | None]) -> Answer:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=HANG_S)
    try:
        connection.request(method, path, body, {name: value for name, value in headers.items() if value is not None})
        answer = connection.getresponse()
        return Answer(answer.status, answer.headers, answer.read(2000))
    finally:
        connection.close()


class Served:
    """A console, its run's control, and what it has told the operator."""

    def __init__(
        self, scene: Scene, rerun_port: int | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.control, self.told = RunControl(clock), list[str]()
        self.console = console_module.Console(
            partial(obey, self.control), scene, "a.mcap", rerun_port, dict, self.told.append
        )
        self.host = f"127.0.0.1:{self.console.port}"
        self.token = self.console.url.partition("=")[2]
        self.cookie = f"flowrec_console_{self.console.port}={self.token}"

    def asks(self, path: str, method: str = "GET", body: bytes | None = None, **headers: str | None) -> Answer:
        """The answer, and the first bytes of it; a header that is None is left out."""
        given = {"Host": self.host, **headers}
        return asked(self.console.port, path, method, body, given)

    def page(self, host: str = "", origin: str | None = "", cookie: str = "") -> Any:
        """The connection of a page."""
        origin = f"http://{host or self.host}" if origin == "" else origin
        return sync_client.connect(
            f"ws://{host or self.host}/live",
            sock=None if not host else _socket(self.console.port),
            origin=origin,
            additional_headers={"Cookie": cookie or self.cookie},
            compression=None,
            proxy=None,
        )


def _socket(port: int) -> Any:
    return socket.create_connection(("127.0.0.1", port))


def events_of(control: RunControl) -> Iterator[OperatorEvent]:
    """What the run would record, tick by tick."""
    stamp_ns = 0
    while True:
        stamp_ns += 10**9
        event = control.next_event(stamp_ns, held=False)
        if event is None:
            return
        yield event


def answers_to(page: Any) -> Iterator[dict[str, Any]]:
    """The answers that a page receives, without all else."""
    while True:
        words = json.loads(page.recv())
        if "answers" in words:
            yield words
