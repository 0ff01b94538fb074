"""Access control of the console: a browser that was given the token, from the console's own page.

The server is bound to 127.0.0.1, which keeps other machines out, but not the pages of others in a browser of this
machine. A page elsewhere can send requests to 127.0.0.1, and can give its own name the address 127.0.0.1 (DNS
rebinding). Cookies know no ports, so a page of another program of this machine sends the console's cookie along.
Therefore each request must name this machine as its host, and one that does something must come from the console's own
origin. Ports are not compared with the console's: a tunnel (ssh -L) may have another.
"""

from __future__ import annotations

import hmac

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_HOSTS = frozenset({"127.0.0.1", "localhost"})
_READING = frozenset({"GET", "HEAD"})
VIEWER_PATH = "/rerun/"
_POLICY = (
    "default-src 'none'; script-src 'self'{wasm}; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self' {ws}; worker-src 'self' blob:; frame-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors {ancestors}"
)
# A page of its own rather than a redirect: a browser sends a cookie of SameSite=Strict with a request that this page
# makes, not with a redirect of one that a link elsewhere has made. It replaces the address with the token.
_WELCOME = (
    '<!doctype html><title>flowrec</title><link rel="icon" href="data:,"><meta http-equiv="refresh" content="0; url=/">'
)
REFUSED = "flowrec: refused; open the address that the terminal shows, with its token\n"


def cookie_name(port: int) -> str:
    """The consoles of one machine have different ports and share their cookies."""
    return f"flowrec_console_{port}"


def same(given: str, token: str) -> bool:
    """True if a token is the right one, in a time that does not tell how much of it is right."""
    return bool(token) and hmac.compare_digest(given.encode(), token.encode())


class Access:
    """ASGI middleware: refuses with 403 what does not come from the console's page, and adds headers to the rest."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token, self._cookie = app, token, cookie_name(port)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or hand on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        host = asked.headers.get("host", "")
        acts = scope["type"] == "websocket" or scope["method"] not in _READING
        if host.rsplit(":", 1)[0] not in _HOSTS or (acts and asked.headers.get("origin") != f"http://{host}"):
            await self._refuse(scope, receive, send)
        elif not acts and scope["path"] == "/" and same(asked.query_params.get("token", ""), self._token):
            welcome = HTMLResponse(_WELCOME)
            welcome.set_cookie(self._cookie, self._token, httponly=True, samesite="strict", path="/")
            await welcome(scope, receive, _with_headers(scope, host, send))
        elif same(asked.cookies.get(self._cookie, ""), self._token):
            await self._app(scope, receive, _with_headers(scope, host, send))
        else:
            await self._refuse(scope, receive, send)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await receive()  # its wish to connect
            await send({"type": "websocket.close", "code": 1008})  # before it was accepted: the status 403
        else:
            await PlainTextResponse(REFUSED, 403)(scope, receive, _with_headers(scope, "", send))


def _with_headers(scope: Scope, host: str, send: Send) -> Send:
    """Send with the headers that forbid other pages to show, read or guess anything."""
    if scope["type"] != "http":
        return send
    viewer = scope["path"].startswith(VIEWER_PATH)
    policy = _POLICY.format(
        wasm=" 'wasm-unsafe-eval'" if viewer else "",
        ws=f"ws://{host}" if host else "",
        ancestors="'self'" if viewer else "'none'",
    )

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers["Content-Security-Policy"] = policy
            headers["X-Content-Type-Options"] = "nosniff"
            headers["Referrer-Policy"] = "no-referrer"
            headers["Cross-Origin-Resource-Policy"] = "same-origin"
            headers["Cross-Origin-Opener-Policy"] = "same-origin"
            headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return sending
