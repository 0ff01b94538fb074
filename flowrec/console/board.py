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

from flowrec.console.console import CommandReply, RunEnded
from flowrec.console.page_state import Drawing, PageState
from flowrec.view import Batch, Scene

MOST_PAGES = 8  # open at a time; a further one is refused
_MOST_EVENTS = 100  # the last ones, for pages that open later


class PageContents(NamedTuple):
    """All that a page can show at a moment."""

    state: dict[str, Any]
    drawing: Drawing
    picture: bytes  # the last image that was made for pages
    events: int  # the number of them so far
    ended: RunEnded | None


NOTHING = PageContents({}, {}, b"", 0, None)


class Board:
    """The latest state.

    Attributes
    ----------
    loop : of the server.
    over : the run has ended, and all pages that are awake can show it.
    left : no page is connected.
    page_state : the state itself, which only the thread that hears the run changes.
    """

    def __init__(self, scene: Scene, name: str) -> None:
        self.loop: asyncio.AbstractEventLoop | None = None
        self.over, self.left = asyncio.Event(), asyncio.Event()
        self.left.set()
        self.name = name
        self._pages = 0
        self.page_state = PageState(scene)
        self._now = NOTHING
        self._events: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_MOST_EVENTS)
        self._changed = asyncio.Event()
        self._waking = False
        self._tickets = itertools.count(1)
        self._verdicts: dict[int, asyncio.Future[str]] = {}

    # ---- by the thread that hears the run

    def take(self, batch: Batch) -> None:
        """Take over what has happened."""
        _, drawing, picture, count, ended = self._now
        for event in self.page_state.take(batch):
            count += 1
            self._events.append((count, event))
        new_drawing = self.page_state.drawing()
        if new_drawing != drawing:
            drawing = new_drawing
        if self._pages:
            picture = self.page_state.picture() or picture
        self._now = PageContents(self.page_state.state(), drawing, picture, count, ended)
        self._wake()

    def end(self, ended: RunEnded) -> None:
        """Take over how the run ended."""
        self._now = self._now._replace(ended=ended)
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
        if self._now.ended is not None:
            self.over.set()

    def _settle(self, verdict: CommandReply) -> None:
        waiting = self._verdicts.pop(verdict.ticket, None)
        if waiting is not None and not waiting.done():  # done: its page is gone
            waiting.set_result(verdict.refusal)

    def ticket(self) -> tuple[int, Awaitable[str]]:
        """A number for a command that is handed to the run, and why the run does not do it, '' where it does."""
        ticket = next(self._tickets)
        self._verdicts[ticket] = asyncio.get_running_loop().create_future()
        return ticket, self._verdicts[ticket]

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

    async def news(self, shown: PageContents) -> tuple[PageContents, str, bytes | None]:
        """Wait until there is more than a page has shown: all there is; what is new of it, as JSON; a new picture."""
        while shown is self._now:
            await self._changed.wait()
        now = self._now
        words: dict[str, Any] = {"state": now.state, "name": self.name}
        if now.drawing is not shown.drawing:
            words["drawing"] = now.drawing
        words["events"] = [event for number, event in list(self._events) if shown.events < number <= now.events]
        if now.ended is not None:
            words["ended"] = now.ended._asdict()
        return now, json.dumps(words), now.picture if now.picture is not shown.picture else None
