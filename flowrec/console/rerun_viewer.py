"""Rerun's web viewer behind the console's own address: its program, and the stream of the recording.

Rerun serves both by itself, to every page and program of this machine. Here they have the console's address instead, so
a browser must know the token, the viewer needs no permission for another origin, and one tunnel is enough.
"""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, closing, suppress
from typing import Any

import h11
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from flowrec.console.access import VIEWER_PATH
from flowrec.view import viewer

_PARTS = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
_SERVICE = "/rerun.sdk_comms.v1alpha1.MessageProxyService/"  # of Rerun 0.41; its methods that only read:
_METHODS = frozenset({"ReadMessages", "ReadTables", "Version"})
_MOST_STREAMS = 4  # of Rerun's data at a time; a further one is refused
_START_S = 20.0
_CHUNK_BYTES = 65536
_LONGEST_REQUEST_BYTES = 65536
_KEPT = ("content-type", "grpc-status", "grpc-message", "grpc-encoding")


class RerunViewer:
    """Responses of the viewer's routes; the viewer starts with the first request of a browser, and runs on."""

    def __init__(self, port: int | None) -> None:
        self._port = port
        self._parts: dict[str, bytes] = {}
        self._getting = asyncio.Lock()
        self._streams = 0

    def routes(self, page: Callable[[], Response]) -> list[Route]:
        """Routes of the page, of its program and of the stream."""

        async def start(_request: Request) -> Response:
            return page()

        return [
            Route(VIEWER_PATH, start),
            Route(VIEWER_PATH + "{name}", self._part),
            Route(_SERVICE + "{method}", self._stream, methods=["POST"]),
        ]

    async def _part(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in _PARTS or self._port is None:
            return PlainTextResponse("no such file\n", 404)
        async with self._getting:
            if not self._parts:
                self._parts = await asyncio.to_thread(_program)
        if name not in self._parts:
            return PlainTextResponse("Rerun's web viewer does not start\n", 503)
        return Response(self._parts[name], media_type=_PARTS[name], headers={"Cache-Control": "private, max-age=86400"})

    async def _stream(self, request: Request) -> Response:
        """Hand a request on to Rerun's server, and its answer back as fast as the browser takes it."""
        if self._port is None or request.path_params["method"] not in _METHODS or self._streams >= _MOST_STREAMS:
            return PlainTextResponse("refused\n", 403)
        body = await request.body()
        if len(body) > _LONGEST_REQUEST_BYTES:
            return PlainTextResponse("too long\n", 413)
        answer = self._answer(self._port, request, body)
        head = await anext(answer, None)
        if head is None:
            return PlainTextResponse("Rerun's server does not answer\n", 502)
        named = ((name.decode(), value.decode()) for name, value in head.headers)
        return _HandedOn(answer, head.status_code, {name: value for name, value in named if name.startswith(_KEPT)})

    async def _answer(self, port: int, request: Request, body: bytes) -> AsyncGenerator[Any]:
        """Ask Rerun's server: the head of its answer, then the rest as it comes; it ends where the server does."""
        protocol = h11.Connection(h11.CLIENT)
        asked = request.headers.items()
        headers = [(name, value) for name, value in asked if name in ("content-type", "accept") or name[:5] == "grpc-"]
        headers += [("x-grpc-web", "1"), ("host", f"{viewer.LOOPBACK}:{port}"), ("content-length", str(len(body)))]
        head = h11.Request(method="POST", target=request.url.path, headers=headers)
        self._streams += 1
        try:
            with suppress(OSError, h11.RemoteProtocolError):
                reader, writer = await asyncio.open_connection(viewer.LOOPBACK, port)
                with closing(writer):
                    for event in (head, h11.Data(body), h11.EndOfMessage()):
                        writer.write(protocol.send(event) or b"")
                    await writer.drain()
                    while isinstance(got := protocol.next_event(), h11.Response | h11.Data) or got is h11.NEED_DATA:
                        if got is h11.NEED_DATA:
                            protocol.receive_data(await reader.read(_CHUNK_BYTES))
                        else:
                            yield bytes(got.data) if isinstance(got, h11.Data) else got
        finally:
            self._streams -= 1


class _HandedOn(StreamingResponse):
    """The answer of Rerun's server. It is closed in any case, also if the browser reads nothing of it."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        assert isinstance(self.body_iterator, AsyncGenerator)
        async with aclosing(self.body_iterator):
            await super().__call__(scope, receive, send)


def _program() -> dict[str, bytes]:
    """Rerun's web viewer, which its executable holds: it serves it for a moment. Empty if it does not."""
    from urllib.error import URLError
    from urllib.request import ProxyHandler, build_opener

    port = viewer.free_port()
    nowhere = viewer.url(port)  # without an address of a recording it would also serve one
    try:
        process = viewer.start(["--serve-web", nowhere, "--web-viewer-port", str(port)])
    except OSError:
        return {}
    ask = build_opener(ProxyHandler({}))
    try:
        if not viewer.wait_for_server(port, _START_S, lambda: process.poll() is not None):
            return {}
        return {name: ask.open(f"http://{viewer.LOOPBACK}:{port}/{name}", timeout=_START_S).read() for name in _PARTS}
    except (URLError, OSError):
        return {}
    finally:
        process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.wait(_START_S)
