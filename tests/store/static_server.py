"""Starlette's server of static files under uvicorn, on the loopback interface; each request waits first."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def static_server(folder: Path, arrive: Callable[[], None]) -> Iterator[str]:
    """URL of a folder; `arrive` is called with each request, in a thread of its own, before it is answered."""
    import uvicorn
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.routing import Mount
    from starlette.staticfiles import StaticFiles

    files = Starlette(routes=[Mount("/", StaticFiles(directory=folder))])

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            await run_in_threadpool(arrive)
            await files(scope, receive, send)

    settings = uvicorn.Config(app, port=0, log_level="error", lifespan="off")
    server = uvicorn.Server(settings)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()
