"""Sessions at a URL: the same as the file, in few requests, and one line for whatever a server does."""

from __future__ import annotations

import gzip
import json
import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

import flowrec
from flowrec.core import FlowrecError, SessionError, UsageError
from flowrec.exports import write_layouts
from flowrec.store import TIMEOUT_KEY, TRAFFIC, RefusedError, UrlPath, remote_file, session_sha256, traffic
from flowrec.store.object_requests import _redirect_target
from flowrec.store.session_path import session_path
from flowrec.store.traffic import ask_repeatedly
from tests.conftest import HANG_S, invoke, run
from tests.extras import needs
from tests.store.range_server import Fault, RangeServer, answer, served, some, status
from tests.store.s3_server import BUCKET, KEYS, s3_server

SESSION = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"


@pytest.fixture
def session() -> Path:
    return SESSION


@pytest.fixture
def server(session: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RangeServer]:
    monkeypatch.setenv(TIMEOUT_KEY, "30")
    monkeypatch.setattr(traffic, "_PAUSE_S", 0.01)
    remote_file._remembered.clear()
    with served(session) as found:
        yield found


def test_a_session_at_a_url_is_the_file(server: RangeServer, session: Path) -> None:
    far, near = flowrec.open(server.url), flowrec.open(session)
    assert flowrec.compare(near, far, ignore=["drawings"]).identical
    assert flowrec.check(far.path).findings == flowrec.check(session).findings
    assert (far.header, far.outcome, far.key) == (near.header, near.outcome, near.key)
    assert session_sha256([far.path]) == session_sha256([session])


def test_a_session_is_opened_in_two_requests(server: RangeServer) -> None:
    opened = flowrec.open(server.url)
    assert opened.outcome and opened.header.provenance and opened.duration_s > 0.0
    assert len(server.requests) == 2


def test_an_index_longer_than_the_end_that_is_fetched_first_is_fetched_once(
    server: RangeServer, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_file, "_END_BYTES", 4 << 10)
    near = flowrec.open(session)
    for far in (flowrec.open(server.url), flowrec.open(server.url)):
        assert (far.header, far.outcome, far.topics) == (near.header, near.outcome, near.topics)
    of_the_end = [first for first, _ in server.requests if first > session.stat().st_size - (1 << 20)]
    assert len(of_the_end) == 2


def test_a_second_of_ticks_is_fetched_alone(server: RangeServer, session: Path) -> None:
    far = flowrec.open(server.url)
    near = [tick.stamp_ns for tick in flowrec.open(session).ticks(2.0, with_frames=False) if tick.stamp_ns < 3e9]
    found = []
    for tick in far.ticks(2.0, with_frames=False):
        if tick.stamp_ns >= 3_000_000_000:
            break
        found.append(tick.stamp_ns)
    assert found == near
    fetched = sum(nbytes for _, nbytes in server.requests)
    assert fetched < session.stat().st_size / 2
    assert len(server.requests) == len(set(server.requests))  # nothing is asked for twice


def test_each_image_is_that_of_its_number_and_one_alone_is_fetched_with_its_chunk(
    server: RangeServer, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    near = flowrec.open(session)
    frames = near.frames
    for number, (frame, stamp_ns) in enumerate(zip(near.messages("frame"), near.reader.frame_stamps, strict=True)):
        assert frames[number].same_as(frame) and frame.stamp_ns == stamp_ns
    assert frames[-1].same_as(frame) and len(frames) == number + 1
    monkeypatch.setattr(remote_file, "_END_BYTES", 128 << 10)
    assert flowrec.open(server.url).frames[number // 2].same_as(frames[number // 2])
    assert len(server.requests) <= 4
    with pytest.raises(IndexError, match=f"frame {number + 1} of {number + 1}"):
        frames[number + 1]


FAULTS = {
    "refused": (status(403), r"refuses access \(403\); check the credentials in the environment"),
    "missing": (status(404), r"is not there \(404\)"),
    "broken": (status(500), r"the server answers 500, \d tries"),
    "cut": (lambda to, a, b, size: answer(to, a, b, size, b"x" * ((b - a) // 2)) is None, "was cut, \\d tries"),
    "lying": (lambda to, a, b, size: answer(to, a, b, size, b"x", announced=False) is None, "sent 1 of|no connection"),
    "silent": (lambda *_: time.sleep(1.2) is None, "does not answer in time"),
    "shorter": (lambda to, a, b, size: answer(to, a, b - 1, size, b"x" * (b - a)) is None, "were asked for"),
    "other": (lambda to, a, b, size: answer(to, 7, 7 + b - a, size, b"x" * (b - a + 1)) is None, "were asked for"),
    "whole": (status(200), "can not be read in ranges"),
    "no offer": (status(501), r"does not offer what is asked of it \(501\)"),
    "circle": (status(302, "/again"), "redirected more than 3 times"),
    "file": (status(302, "file:///etc/passwd"), "redirected from http to file"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_of_a_server_is_one_line_within_the_time_limit(
    server: RangeServer, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    server.fault, expected = FAULTS[kind]
    monkeypatch.setenv(TIMEOUT_KEY, "1" if kind == "silent" else "30")
    began_s = time.monotonic()
    with pytest.raises(SessionError, match=expected) as caught:
        flowrec.open(server.url)
    assert str(caught.value).startswith(server.url) and "\n" not in str(caught.value)
    assert time.monotonic() - began_s < HANG_S


@pytest.mark.parametrize("kind", ["broken", "cut", "shorter"])
def test_a_fault_that_passes_is_counted_and_does_no_harm(server: RangeServer, session: Path, kind: str) -> None:
    server.fault = some(FAULTS[kind][0], after=3, count=2)
    before = TRAFFIC.repeated
    assert flowrec.compare(flowrec.open(session), flowrec.open(server.url), ignore=["drawings"]).identical
    assert TRAFFIC.repeated - before == 2


@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_a_server_that_takes_the_last_bytes_for_the_first_is_asked_for_them_by_number(
    server: RangeServer, session: Path, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    whole = session.read_bytes()

    def first_ones(to: BaseHTTPRequestHandler, first: int, last: int, size: int) -> bool:
        if not to.headers["Range"].startswith("bytes=-"):
            return False
        answer(to, 0, last - first, size, whole[: last - first + 1])
        return True

    server.fault = first_ones
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": server.url.rpartition("/runs/")[0]}.items():
        monkeypatch.setenv(name, value)
    url = server.url if scheme == "http" else f"s3://{BUCKET}/{session.name}"
    before = TRAFFIC.repeated
    assert flowrec.open(url).last.track.same_as(flowrec.open(session).last.track) and TRAFFIC.repeated == before


def _unlabelled(to: BaseHTTPRequestHandler, first: int, last: int, _size: int) -> bool:
    to.send_response(206)
    to.send_header("Content-Length", str(last - first + 1))
    to.end_headers()
    to.wfile.write(bytes(last - first + 1))
    return True


def _compressed(to: BaseHTTPRequestHandler, first: int, last: int, size: int) -> bool:
    body = gzip.compress(bytes(last - first + 1))
    to.send_response(206)
    to.send_header("Content-Length", str(len(body)))
    to.send_header("Content-Range", f"bytes {first}-{last}/{size}")
    to.send_header("Content-Encoding", "gzip")
    to.end_headers()
    to.wfile.write(body)
    return True


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (FAULTS["whole"][0], "can not be read in ranges, the server sends whole files only"),
        (_unlabelled, "answers 206 without a range"),
        (_compressed, "the server compresses ranges"),
    ],
)
@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_a_store_that_answers_ranges_wrongly_is_refused_by_what_it_does_and_asked_once(
    server: RangeServer, session: Path, monkeypatch: pytest.MonkeyPatch, scheme: str, fault: Fault, expected: str
) -> None:
    server.fault = fault
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": server.url.rpartition("/runs/")[0]}.items():
        monkeypatch.setenv(name, value)
    before = TRAFFIC.repeated
    with pytest.raises(SessionError, match=expected):
        flowrec.open(server.url if scheme == "http" else f"s3://{BUCKET}/{session.name}")
    assert TRAFFIC.repeated == before


def test_a_verb_says_which_requests_it_has_repeated(server: RangeServer, capsys: pytest.CaptureFixture[str]) -> None:
    server.fault = some(FAULTS["broken"][0], after=0, count=3)
    assert run(["info", server.url, "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["session"] == server.url
    assert printed.err.splitlines() == ["3 requests were repeated: the server answers 500 (3)"]


def test_a_session_that_is_replaced_while_it_is_read_is_not_mixed_with_the_new_one(
    server: RangeServer, session: Path
) -> None:
    opened = flowrec.open(server.url)
    content = session.read_bytes()
    server.fault = lambda to, a, b, size: answer(to, a, b, size, content[a : b + 1], etag="2") is None
    with pytest.raises(SessionError, match="was replaced while it was read"):
        list(opened.ticks())
    assert flowrec.open(server.url).outcome == opened.outcome  # opened anew it is the new one


def test_the_limits_on_hostile_files_hold_at_a_url(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TIMEOUT_KEY, "2")
    data = bytearray(session.read_bytes())
    data[-37 + 9 : -37 + 17] = (1 << 40).to_bytes(8, "little")  # the footer's offset of the index
    (bad := tmp_path / "bad.mcap").write_bytes(data)
    with served(bad) as server:
        for place in (bad, server.url):
            with pytest.raises(SessionError, match=r"announced, the file ends at|bytes, more than|damaged"):
                flowrec.open(place)
        assert sum(nbytes for _, nbytes in server.requests) <= 1 << 20
    with served(tmp_path / "empty.mcap") as server:
        (tmp_path / "empty.mcap").touch()
        server.fault = status(416)
        with pytest.raises(SessionError, match="is empty"):
            flowrec.open(server.url)


@pytest.mark.slow("makes every output of a session through a server")
def test_outputs_of_a_session_at_a_url_are_made_in_this_folder(
    server: RangeServer, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert flowrec.export(server.url, file_format="csv") == Path(f"{session.stem}_csv")
    done = invoke("replay", server.url, "--set", "plan.speed_share=0.7")  # a Path of the URL
    assert done.exit_code == 0, done.output
    assert flowrec.open(f"{session.stem}_replay_001.mcap").header.parent["file"] == session.name
    with pytest.raises(UsageError, match="URL"):
        flowrec.open(server.url).add_note("seen")


@pytest.mark.parametrize("url", ["https://host/a.mcap?sig=KEY", "https://KEY@host/a.mcap", "http://me:KEY@host/a.mcap"])
def test_a_url_with_a_credential_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(UsageError) as caught:
        flowrec.open(url)
    assert "KEY" not in str(caught.value)


def test_a_url_stays_one_as_a_path() -> None:
    path = session_path("s3://bucket/runs/a.mcap")
    assert isinstance(path, UrlPath)
    assert str(path.with_name("b.mcap")) == "s3://bucket/runs/b.mcap"
    assert session_path(Path("s3://bucket/runs/a.mcap")) == path
    assert not isinstance(session_path("runs/a.mcap"), UrlPath)


@pytest.mark.parametrize(
    ("url", "target"),
    [
        ("https://93.184.216.34/a", "http://93.184.216.34/a"),
        ("http://93.184.216.34/a", "http://127.0.0.1/a"),
        ("http://93.184.216.34/a", "http://169.254.169.254/latest/meta-data"),
        ("http://93.184.216.34/a", "http://[::1]/a"),
    ],
)
def test_a_redirect_to_a_private_or_a_less_safe_place_is_not_followed(url: str, target: str) -> None:
    with pytest.raises(RefusedError, match="not followed"):
        _redirect_target(url, target)


@needs("moto")
def test_a_session_in_a_bucket_is_the_file_and_credentials_are_never_printed(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With moto's S3 server, and boto3 for the upload."""
    with s3_server(monkeypatch) as server:
        server.client.upload_file(str(session), BUCKET, "runs/a.mcap")
        far = flowrec.open(f"s3://{BUCKET}/runs/a.mcap")
        assert flowrec.compare(flowrec.open(session), far, ignore=["drawings"]).identical
        for missing in (f"s3://{BUCKET}/none.mcap", "s3://other/a.mcap"):
            with pytest.raises(FlowrecError, match="404") as caught:
                flowrec.open(missing)
            assert not re.search("SECRET|KEY", str(caught.value))
    with pytest.raises(FlowrecError, match="no connection") as caught:
        flowrec.open(f"s3://{BUCKET}/runs/b.mcap")
    assert "SECRET" not in str(caught.value)


def test_layouts_of_a_session_at_a_url_are_written_here(server: RangeServer, tmp_path: Path) -> None:
    made = write_layouts(server.url, tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([made.foxglove, made.rerun])


def test_a_request_that_takes_no_signal_does_not_hold_up_the_end() -> None:
    """Clients of compiled code wait for their server whatever signal comes."""
    asked, released = threading.Event(), threading.Timer(5.0, lambda: None)
    released.start()

    def ask(_limit_s: float) -> str:
        asked.set()
        while released.is_alive():
            with suppress(KeyboardInterrupt):
                released.join()
        return "answered"

    def interrupt() -> None:
        asked.wait()
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            ask_repeatedly(Path("https://host/a.mcap"), ask)
    finally:
        signal.signal(signal.SIGINT, before)
        released.cancel()
