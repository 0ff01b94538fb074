"""A server of byte ranges on the loopback interface, with faults on demand."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread

# Handler, first byte, last byte, size of the file -> whether it has answered.
Fault = Callable[[BaseHTTPRequestHandler, int, int, int], bool]


class RangeServer:
    """Serves one file under any name, or the files of a folder.

    Attributes
    ----------
    url : of the file or folder.
    fault : answers instead, where it wants to; None: no fault.
    requests : first byte and number of bytes of each range that was asked for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fault: Fault | None = None
        self.requests: list[tuple[int, int]] = []
        outer, lock = self, Lock()

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *_: object) -> None:
                pass

            def do_GET(self) -> None:
                path = outer.path / self.path.rpartition("/")[2] if outer.path.is_dir() else outer.path
                if not path.is_file():
                    status(404)(self, 0, 0, 0)
                    return
                size = path.stat().st_size
                asked = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers["Range"])
                assert asked is not None
                last = min(int(asked[2]), size - 1) if asked[1] else size - 1
                first = int(asked[1]) if asked[1] else max(0, size - int(asked[2]))
                with lock:
                    outer.requests.append((first, last - first + 1))
                if outer.fault is None or not outer.fault(self, first, last, size):
                    with path.open("rb") as file:
                        file.seek(first)
                        answer(self, first, last, size, file.read(last - first + 1))

            def do_HEAD(self) -> None:
                self.send_response(200)
                self.send_header("Content-Length", str(outer.path.stat().st_size))
                self.send_header("ETag", '"1"')
                self.end_headers()

        class Server(ThreadingHTTPServer):
            request_queue_size = 64
            daemon_threads = True

        self.server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/runs/{path.name}"


def answer(
    handler: BaseHTTPRequestHandler,
    first: int,
    last: int,
    size: int,
    body: bytes,
    etag: str = "1",
    *,
    announced: bool = True,
) -> None:
    """A partial content; a body that is too short is followed by the end of the connection, if it was `announced`."""
    handler.send_response(206)
    handler.send_header("Content-Length", str(last - first + 1 if announced else len(body)))
    handler.send_header("Content-Range", f"bytes {first}-{last}/{size}")
    handler.send_header("ETag", f'"{etag}"')
    handler.end_headers()
    handler.wfile.write(body)
    handler.close_connection = len(body) != last - first + 1


def status(code: int, location: str = "") -> Fault:
    """Always this status."""

    def fault(handler: BaseHTTPRequestHandler, *_: int) -> bool:
        handler.send_response(code)
        handler.send_header("Content-Length", "0")
        if location:
            handler.send_header("Location", location)
        handler.end_headers()
        return True

    return fault


def some(fault: Fault, after: int, count: int) -> Fault:
    """A fault of `count` requests, after some that are answered well."""
    numbers = iter(range(1 << 20))

    def chosen(handler: BaseHTTPRequestHandler, first: int, last: int, size: int) -> bool:
        return after <= next(numbers) < after + count and fault(handler, first, last, size)

    return chosen


@contextmanager
def served(path: Path) -> Iterator[RangeServer]:
    """A server of this file."""
    server = RangeServer(path)
    thread = Thread(target=server.server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.server.shutdown()
        server.server.server_close()
        thread.join()
