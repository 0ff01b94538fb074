"""The latest state of a run, from which each page takes what it has not shown yet.

A page that is slow or frozen misses states; nothing waits for it and nothing is kept for it, so what it costs does not
grow. One thread takes over what the run sends; the pages wait in the loop of the server.
"""

from __future__ import annotations

import asyncio
import itertools
import json
from collections import deque
from collections.abc import Awaitable
from typing import Any, NamedTuple

from flowrec.console.messages import CommandReply, RunEnded
from flowrec.console.page_state import Drawing, PageState
from flowrec.view import Batch, Scene

MOST_PAGES = 8
_MOST_EVENTS = 100


class PageProgress(NamedTuple):
    """Counters of the latest content that a page has received."""

    number: int = 0
    drawing: int = 0
    picture: int = 0
    event: int = 0


class News(NamedTuple):
    """Content that a page has not received yet.

    Attributes
    ----------
    shown : how far it is with this.
    words : JSON.
    picture : its last image; None if it has that.
    last : the run has ended, and this says so.
    """

    shown: PageProgress
    words: str
    picture: bytes | None
    last: bool


class Board:
    """The latest state.

    Attributes
    ----------
    loop : of the server.
    over : the run has ended, and all pages that are awake can show it.
    left : no page is connected.
    """

    def __init__(self, scene: Scene, name: str) -> None:
        self.loop: asyncio.AbstractEventLoop | None = None
        self.over, self.left = asyncio.Event(), asyncio.Event()
        self.left.set()
        self.name = name
        self._pages = 0
        self._page_state = PageState(scene)
        self._at = PageProgress()
        self._state: dict[str, Any] = {}
        self._drawing: Drawing = {}
        self._picture = b""
        self._events: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_MOST_EVENTS)
        self._ended: RunEnded | None = None
        self._changed = asyncio.Event()
        self._waking = False
        self._tickets = itertools.count(1)
        self._verdicts: dict[int, asyncio.Future[str]] = {}

    # ---- by the thread that hears the run

    def take(self, batch: Batch) -> None:
        """Take over what has happened."""
        number, drawing_number, picture_number, event_number = self._at
        for event in self._page_state.take(batch):
            event_number += 1
            self._events.append((event_number, event))
        drawing = self._page_state.drawing()
        if drawing != self._drawing:
            self._drawing, drawing_number = drawing, drawing_number + 1
        picture = self._page_state.picture() if self._pages else None
        if picture is not None:
            self._picture, picture_number = picture, picture_number + 1
        self._state = self._page_state.state()
        self._at = PageProgress(number + 1, drawing_number, picture_number, event_number)
        self._wake()

    def end(self, ended: RunEnded) -> None:
        """Take over how the run ended."""
        self._ended = ended
        self._at = self._at._replace(number=self._at.number + 1)
        self._wake()

    def settle(self, verdict: CommandReply) -> None:
        """Take over what the run made of a command."""
        if self.loop is not None:
            self.loop.call_soon_threadsafe(self._settle, verdict)

    def _wake(self) -> None:
        if self.loop is not None and not self._waking:
            self._waking = True
            self.loop.call_soon_threadsafe(self._wake_pages)

    # ---- in the loop of the server

    def _wake_pages(self) -> None:
        self._waking = False
        self._changed.set()
        self._changed = asyncio.Event()
        if self._ended is not None:
            self.over.set()

    def _settle(self, verdict: CommandReply) -> None:
        waiting = self._verdicts.pop(verdict.ticket, None)
        if waiting is not None and not waiting.done():  # done: its page is gone
            waiting.set_result(verdict.refusal)

    def ticket(self) -> int:
        """A number for a command that is handed to the run, which will say what it made of it."""
        ticket = next(self._tickets)
        self._verdicts[ticket] = asyncio.get_running_loop().create_future()
        return ticket

    def refusal(self, ticket: int) -> Awaitable[str]:
        """Wait for the run: why it does not do a command, '' where it does."""
        return self._verdicts[ticket]

    def chip_um(self, x_px: float, y_px: float) -> tuple[float, float]:
        """The place on the chip that the image shows there."""
        return self._page_state.chip_um(x_px, y_px)

    def enter(self) -> bool:
        """Count a page; False if there are too many."""
        if self._pages >= MOST_PAGES:
            return False
        self._pages += 1
        self.left.clear()
        return True

    def leave(self) -> None:
        """A page is gone."""
        self._pages -= 1
        if not self._pages:
            self.left.set()

    async def news(self, shown: PageProgress) -> News:
        """Wait until there is more than a page has shown."""
        while shown.number == self._at.number:
            await self._changed.wait()
        at, ended = self._at, self._ended
        words: dict[str, Any] = {"state": self._state, "name": self.name}
        if at.drawing != shown.drawing:
            words["drawing"] = self._drawing
        words["events"] = [event for number, event in list(self._events) if shown.event < number <= at.event]
        if ended is not None:
            words["ended"] = ended._asdict()
        picture = self._picture if at.picture != shown.picture else None
        return News(at, json.dumps(words), picture, ended is not None)
