"""Rerun's web viewer behind the console's own address: its program, and the stream of the recording.

Rerun serves both by itself, to every page and program of this machine. Here they have the console's address instead, so
a browser must know the token, the viewer needs no permission for another origin, and one tunnel is enough.
"""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import AsyncIterator, Callable
from contextlib import suppress

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
_MOST_STREAMS = 4
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
        self._streams += 1
        try:
            upstream = await _Upstream.request(self._port, request.url.path, request.headers.items(), body)
        except (OSError, h11.RemoteProtocolError):
            self._streams -= 1
            return PlainTextResponse("Rerun's server does not answer\n", 502)
        return _HandedOn(upstream, self._end_stream)

    def _end_stream(self) -> None:
        self._streams -= 1


class _Upstream:
    """One request to Rerun's server."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._protocol = h11.Connection(h11.CLIENT)
        self.status, self.headers = 502, dict[str, str]()

    @classmethod
    async def request(cls, port: int, path: str, headers: list[tuple[str, str]], body: bytes) -> _Upstream:
        """Send a request and wait for the head of the answer."""
        self = cls(*await asyncio.open_connection(viewer.LOOPBACK, port))
        kept = [(name, value) for name, value in headers if name in ("content-type", "accept") or name[:5] == "grpc-"]
        kept += [("x-grpc-web", "1"), ("host", f"{viewer.LOOPBACK}:{port}"), ("content-length", str(len(body)))]
        for event in (h11.Request(method="POST", target=path, headers=kept), h11.Data(body), h11.EndOfMessage()):
            self._writer.write(self._protocol.send(event) or b"")
        await self._writer.drain()
        head = await self._event()
        if not isinstance(head, h11.Response):
            raise h11.RemoteProtocolError("no answer")
        self.status = head.status_code
        self.headers = {
            name.decode(): value.decode() for name, value in head.headers if name.decode().startswith(_KEPT)
        }
        return self

    async def body(self) -> AsyncIterator[bytes]:
        """The rest of the answer as it comes."""
        with suppress(OSError, h11.RemoteProtocolError):  # the run and its server have ended
            while isinstance(event := await self._event(), h11.Data):
                yield bytes(event.data)

    def close(self) -> None:
        """End the connection."""
        self._writer.close()

    async def _event(self) -> object:
        while (event := self._protocol.next_event()) is h11.NEED_DATA:
            self._protocol.receive_data(await self._reader.read(_CHUNK_BYTES))
        return event


class _HandedOn(StreamingResponse):
    """The answer of Rerun's server; `ended` is called however it ends, also where a browser takes none of it."""

    def __init__(self, upstream: _Upstream, ended: Callable[[], None]) -> None:
        super().__init__(upstream.body(), upstream.status, upstream.headers)
        self._upstream, self._ended = upstream, ended

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._upstream.close()
            self._ended()


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
