"""moto's S3 server on the loopback interface, in this process, with faults on demand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from threading import Condition, Thread
from typing import Any

import pytest

from flowrec.store import remote_file, traffic
from tests.extras import why

KEYS = {"AWS_ACCESS_KEY_ID": "KEY-OF-THE-LAB", "AWS_SECRET_ACCESS_KEY": "SECRET-OF-THE-LAB", "AWS_REGION": "us-east-1"}
BUCKET = "lab"
_NO_UPLOAD = b"<Error><Code>NoSuchUpload</Code></Error>"  # how S3 answers 404 for an upload that has ended
# Method and URL with its query -> status to answer instead, or None.
Fault = Callable[[str, str], int | None]


class S3Server:
    """One bucket.

    Attributes
    ----------
    url : of the server.
    fault : answers instead, where it returns a status.
    requests : method and URL of each request.
    client : boto3's.
    """

    def __init__(self) -> None:
        from moto.server import DomainDispatcherApplication, create_backend_app
        from werkzeug.serving import WSGIRequestHandler, make_server

        self.fault: Fault = lambda *_: None
        self.requests: list[tuple[str, str]] = []
        self._answering, self._changed = 0, Condition()
        app = DomainDispatcherApplication(create_backend_app)

        def wrapped(environ: dict[str, Any], start: Any) -> Any:
            url = f"{environ['PATH_INFO']}?{environ.get('QUERY_STRING', '')}".rstrip("?")
            self.requests.append((environ["REQUEST_METHOD"], url))
            status = self.fault(environ["REQUEST_METHOD"], url)
            if status is None:
                with self._changed:
                    self._answering += 1
                try:
                    return app(environ, start)
                finally:
                    with self._changed:
                        self._answering -= 1
                        self._changed.notify_all()
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            body = _NO_UPLOAD if status == 404 else b""
            start(f"{status} No", [("Content-Length", str(len(body)))])
            return [body]

        class Handler(WSGIRequestHandler):
            def log(self, *_: object) -> None:
                pass

        self._server = make_server("127.0.0.1", 0, wrapped, threaded=True, request_handler=Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self._thread.start()

    @cached_property
    def client(self) -> Any:
        import boto3

        return boto3.client(
            "s3", endpoint_url=self.url, region_name="us-east-1", aws_access_key_id="a", aws_secret_access_key="b"
        )

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        with self._changed:  # what a client left behind is still being stored
            assert self._changed.wait_for(lambda: not self._answering, 60.0)


@contextmanager
def s3_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """A server with an empty bucket, and its credentials in the environment."""
    pytest.importorskip("moto", reason=why("moto"))
    from moto.moto_api._internal import moto_api_backend

    server = S3Server()
    monkeypatch.setattr(traffic, "_PAUSE_S", 0.01)
    remote_file._remembered.clear()
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": server.url}.items():
        monkeypatch.setenv(name, value)
    try:
        server.client.create_bucket(Bucket=BUCKET)
        server.requests.clear()
        yield server
    finally:
        server.close()
        moto_api_backend.reset()  # moto keeps buckets beyond a server; as a request it would meet `fault`, or time out
