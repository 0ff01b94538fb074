"""The process of the console: `python -m flowrec.console.server`, started by console.py.

It reads what the run sends from stdin, serves one page at 127.0.0.1, and writes what the operator asks to stdout, one
JSON object a line. It ends with its stdin.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, TextIO

import uvicorn

from flowrec.console.app import application
from flowrec.console.board import Board
from flowrec.console.console import STAYS, Begin, CommandReply, RunEnded
from flowrec.view import LOOPBACK, read_feed

PORT = 8460  # where it is free: the operator's tunnel and bookmark stay from run to run
_NOTHING_SAID = RunEnded("the run's process has ended without a word; flowrec recover makes a session of its file")
_LONGEST_MESSAGE_BYTES = 4096
_CLOSE_S = 2.0  # for pages to take the last state


def serve() -> None:
    """Serve until the run has ended."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else is printed goes to the log
    source = read_feed()
    begin: Begin = next(source)
    listening = _listening()
    port = listening.getsockname()[1]
    board = Board(begin.scene, begin.name)
    _answer(answers, {"port": port})
    app = application(board, begin.token, port, begin.rerun_port, lambda words: _answer(answers, words))
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,  # addresses hold the token
            server_header=False,
            lifespan="off",
            ws="websockets-sansio",
            ws_max_size=_LONGEST_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
        )
    )
    asyncio.run(_serve(server, listening, board, source))


async def _serve(server: uvicorn.Server, listening: socket.socket, board: Board, source: Iterator[Any]) -> None:
    board.loop = asyncio.get_running_loop()
    threading.Thread(target=_read, args=(source, board), name="run", daemon=True).start()
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    await board.over.wait()
    with suppress(TimeoutError):
        await asyncio.wait_for(board.left.wait(), _CLOSE_S)
    server.should_exit = True
    await serving


def _listening() -> socket.socket:
    """A socket of this machine, at the usual port or any other."""
    for port in (PORT, 0):
        found = socket.socket()
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            found.bind((LOOPBACK, port))
            found.listen(64)
        except OSError:
            found.close()
        else:
            return found
    sys.exit("no port is free")


def _read(source: Iterator[Any], board: Board) -> None:
    """Take over what the run sends, until it ends: the thread."""
    ended = _NOTHING_SAID
    for news in source:
        if isinstance(news, RunEnded):
            ended = news
            print(STAYS, flush=True)
        elif isinstance(news, CommandReply):
            board.settle(news)
        else:
            board.take(news)
    board.end(ended)


def _answer(answers: TextIO, words: dict[str, Any]) -> None:
    """One line to the run, which reads at once."""
    answers.write(json.dumps(words) + "\n")
    answers.flush()


if __name__ == "__main__":
    serve()
