"""The routes of the console: its page, the connection of each page, and Rerun's web viewer."""

from __future__ import annotations

import asyncio
import html
import json
import math
import secrets
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from flowrec.console.access import Access
from flowrec.console.board import MOST_PAGES, NOTHING, Board
from flowrec.console.rerun_viewer import RerunViewer
from flowrec.run import COMMANDS, GOAL, HAND, LONGEST_NOTE, NOTE, OUTPUT, SPEED

_PERIOD_S = 0.1  # from one state to the next of a page
_FROZEN_S = 30.0  # a page that takes nothing for so long is let go
_MOST_PER_S = 10  # commands of all pages together, except those that end the run
_LEAST_SAMPLE_S = 0.005  # from one sample of a hand to the next of a page
_ALWAYS = frozenset({"stop", "zero"})
_PAGE = files("flowrec.console") / "page"
_TYPES = {"css": "text/css", "js": "text/javascript", "html": "text/html"}

Answer = Callable[[dict[str, Any]], None]


def application(board: Board, token: str, port: int, rerun_port: int | None, answer: Answer) -> ASGIApp:
    """The ASGI application.

    Parameters
    ----------
    port : of this server.
    rerun_port : of Rerun's server; None without one.
    answer : hands a command to the run.
    """
    commands = _Commands(board, answer)
    viewer = RerunViewer(rerun_port)

    async def page(_request: Request) -> Response:
        rows = [
            {"name": row.name, "key": row.key, "words": row.words, "meaning": row.meaning} for row in COMMANDS.values()
        ]
        facts = json.dumps({"commands": rows, "longest_note": LONGEST_NOTE, "rerun": rerun_port is not None})
        return _file("console.html", FACTS=html.escape(facts), NAME=html.escape(board.name))

    async def part(request: Request) -> Response:
        return _file(request.path_params["name"])

    async def live(socket: WebSocket) -> None:
        await socket.accept()
        if not board.enter():
            await socket.close(1013, f"{MOST_PAGES} pages are open already: close one")
            return
        name = secrets.token_hex(8)  # by which the run knows this page, of all consoles
        tasks = {asyncio.create_task(_send(board, socket))}
        try:
            while True:
                # The answer waits for the run, the next command for nothing.
                answering = asyncio.create_task(_answer(socket, *commands.take(await socket.receive_text(), name)))
                tasks.add(answering)
                answering.add_done_callback(tasks.discard)
        except WebSocketDisconnect:
            pass
        finally:
            commands.end_steering(name)
            for task in tasks:
                task.cancel()
            board.leave()

    routes = [
        Route("/", page),
        Route("/page/{name}", part),
        WebSocketRoute("/live", live),
        *viewer.routes(lambda: _file("viewer.html")),
    ]
    return Access(Starlette(routes=routes), token, port)


async def _send(board: Board, socket: WebSocket) -> None:
    """Send a page what is new, at most some times per second, until the run has ended."""
    shown = NOTHING
    with suppress(WebSocketDisconnect, RuntimeError):  # the page was closed
        while True:
            shown, words, picture = await board.news(shown)
            frozen = False
            try:
                async with asyncio.timeout(_FROZEN_S):
                    await socket.send_text(words)
                    if picture is not None:
                        await socket.send_bytes(picture)
            except TimeoutError:
                frozen = True
            if frozen or shown.ended is not None:
                await socket.close()
                return
            await asyncio.sleep(_PERIOD_S)


async def _answer(socket: WebSocket, number: Any, refusal: str | Awaitable[str]) -> None:
    """Tell a page what became of its command with this number, once that is known."""
    words = {"answers": number, "refusal": refusal if isinstance(refusal, str) else await refusal}
    with suppress(WebSocketDisconnect, RuntimeError):  # the page was closed
        await socket.send_text(json.dumps(words))


class _Commands:
    """Commands from the pages, checked and handed on at once: they wait for nothing that is sent to a page."""

    def __init__(self, board: Board, answer: Answer) -> None:
        self._board, self._answer = board, answer
        self._given_s: list[float] = []
        # When pages have sent their last samples of a hand; of those that have not let go since.
        self._steering: dict[str, float] = {}

    def take(self, text: str, page: str) -> tuple[Any, str | Awaitable[str]]:
        """Hand a message of a page to the run; by which number the page knows it, and why it is not done, '' if it is.

        Only the run's own word has to be waited for.
        """
        number: Any = None
        try:
            asked = json.loads(text)
            number = asked.get("number")
            if asked["command"] == HAND and asked["held"] is True and self._is_too_soon(page):
                return number, ""
            words = self._hand(asked, page) if asked["command"] == HAND else self._words(asked)
            ticket, refusal = self._board.ticket()
            self._answer({**words, "ticket": ticket})
        except OSError:
            return number, "the run has ended"
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            return number, f"not understood: {error}"
        return number, refusal

    def _is_too_soon(self, page: str) -> bool:
        """True if the page has sent another sample of a hand a moment ago, as one does whose samples were held up."""
        now_s = time.monotonic()
        soon = now_s - self._steering.get(page, -math.inf) < _LEAST_SAMPLE_S
        if not soon:
            self._steering[page] = now_s
        return soon

    def end_steering(self, page: str, why: str = "the page was closed") -> None:
        """The hand of a page steers no longer, and nobody waits to hear what the run makes of it."""
        if page in self._steering:
            with suppress(OSError):  # the run has ended
                self._answer({**self._let_go(page, why), "ticket": 0})

    def _let_go(self, page: str, why: str) -> dict[str, Any]:
        self._steering.pop(page, None)
        return {"command": HAND, "page": page, "held": False, "why": why}

    def _hand(self, asked: dict[str, Any], page: str) -> dict[str, Any]:
        """A sample of a hand, or that it has let go; what it asks for on the image, on the chip."""
        if asked["held"] is not True:
            return self._let_go(page, str(asked["why"]))
        try:
            x, y = self._board.page_state.chip_share(*_finite(asked["x"], asked["y"]))
        except ValueError:
            self.end_steering(page, "a sample that is no number")
            raise
        press, by = int(asked["press"]), str(asked["by"])
        return {"command": HAND, "page": page, "held": True, "press": press, "x": x, "y": y, "by": by}

    def _words(self, asked: dict[str, Any]) -> dict[str, Any]:
        name = asked["command"]
        if name not in _ALWAYS:
            now_s = time.monotonic()
            self._given_s = [given_s for given_s in self._given_s if now_s - given_s < 1.0]
            if len(self._given_s) >= _MOST_PER_S:
                raise ValueError("too many at once; wait a second")
            self._given_s.append(now_s)
        if name == GOAL:
            x_um, y_um = self._board.page_state.chip_um(*_finite(asked["x_px"], asked["y_px"]))
            return {"command": name, "x_um": x_um, "y_um": y_um}
        if name == SPEED:
            limit = asked["limit_um_s"]
            return {"command": name, "limit_um_s": None if limit is None else _finite(limit)[0]}
        if name == OUTPUT:
            return {"command": name, "name": str(asked["name"]), "value": _finite(asked["value"])[0]}
        text = str(asked.get("text", ""))[:LONGEST_NOTE]
        if name == NOTE and not text.strip():
            raise ValueError("a note without a text")
        return {"command": COMMANDS[name].name, "text": text}


def _finite(*given: Any) -> tuple[float, ...]:
    numbers = tuple(float(each) for each in given)
    if not all(map(math.isfinite, numbers)):
        raise ValueError("not a number")
    return numbers


def _file(name: str, **words: str) -> Response:
    """A file of the page, with these words in the place of their names."""
    suffix = name.rpartition(".")[2]
    # The name comes from a browser: it is looked up, never joined to a path.
    found = next((each for each in _PAGE.iterdir() if each.name == name), None)
    if found is None or suffix not in _TYPES:
        return PlainTextResponse("no such file\n", 404)
    text = found.read_text(encoding="utf-8")
    for word, value in words.items():
        text = text.replace(f"{{{{{word}}}}}", value)
    return Response(text, media_type=_TYPES[suffix])
