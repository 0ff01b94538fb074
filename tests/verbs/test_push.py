"""flowrec push: sessions to a bucket, with moto's S3 server as the judge; killed, interrupted, refused, changed."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

import flowrec
from flowrec.archive.push import PushedFile, _pushed_notes, push
from flowrec.archive.verbs import push as push_verb
from flowrec.core import Ended, FlowrecError, SessionError, StoppedError, UsageError
from flowrec.store import TRAFFIC, Session, UrlPath, bucket_upload, part_path, remote_file, session_sha256
from tests.conftest import HANG_S, invoke, until
from tests.store.made_up import ticks_of, write_session
from tests.store.s3_server import BUCKET, KEYS, S3Server, s3_server
from tests.store.test_run_files import header_at_60_hz, in_parts

SESSION = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"
TARGET = f"s3://{BUCKET}/runs"
PART_BYTES = 5 << 20  # the least that S3 takes
LARGE_PARTS = 4


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    monkeypatch.setattr(bucket_upload, "_PART_BYTES", PART_BYTES)
    with s3_server(monkeypatch) as found:
        yield found


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that is sent in several parts."""
    path = tmp_path_factory.mktemp("large") / "large.mcap"
    write_session(path, ticks_of(60, shape=(540, 540)), header_at_60_hz(), frames="raw", outcome={"outcome": "reached"})
    assert LARGE_PARTS - 1 < path.stat().st_size / PART_BYTES < LARGE_PARTS
    return path


def content(server: S3Server, name: str) -> bytes:
    data: bytes = server.client.get_object(Bucket=BUCKET, Key=f"runs/{name}")["Body"].read()
    return data


def sent_parts(server: S3Server) -> list[str]:
    return [url for method, url in server.requests if method == "PUT" and "partNumber" in url]


def test_a_session_that_was_pushed_is_the_file(server: S3Server, large: Path) -> None:
    (done,) = push([large], TARGET).files
    assert content(server, "large.mcap") == large.read_bytes()
    assert (done.sent_bytes, done.sha256) == (large.stat().st_size, hashlib.sha256(large.read_bytes()).hexdigest())
    assert done.compared.startswith("by its ETag and 3 of its ranges") and session_sha256([done.url]) == done.sha256
    assert flowrec.check(done.url).findings == flowrec.check(large).findings
    (small,) = push([SESSION], TARGET).files
    assert content(server, SESSION.name) == SESSION.read_bytes() and small.sent_bytes == SESSION.stat().st_size


def test_the_same_again_sends_nothing_and_other_content_is_never_replaced(server: S3Server, large: Path) -> None:
    push([large, SESSION], TARGET)
    server.requests.clear()
    again = push([large, SESSION], TARGET)
    assert [done.sent_bytes for done in again.files] == [0, 0] and not again.failed
    assert {method for method, _ in server.requests} == {"HEAD"}
    # Sent by another program, in other parts: no ETag of ours, and still the same content.
    server.client.upload_file(str(large), BUCKET, "runs/large.mcap")
    (other,) = push([large], TARGET).files
    assert other.compared == "by reading all of it" and not other.sent_bytes
    for changed in (large.read_bytes()[:-1] + b"x", b"short"):
        server.client.put_object(Bucket=BUCKET, Key="runs/large.mcap", Body=changed)
        refused = push([large, SESSION], TARGET)
        assert "is there with another content than" in refused.failed[large] and refused.exit_status == 1
        assert len(refused.files) == 1 and content(server, "large.mcap") == changed


@pytest.mark.parametrize(
    ("parts", "same"),
    [pytest.param(LARGE_PARTS, True, marks=pytest.mark.slow("pushes a large file")), (LARGE_PARTS, False), (1, False)],
)
def test_an_object_that_comes_during_the_push_is_compared_and_not_replaced(
    server: S3Server, large: Path, parts: int, same: bool
) -> None:
    path = large if parts > 1 else SESSION
    other = path.read_bytes() if same else b"of somebody else"

    def meanwhile(method: str, url: str) -> None:
        if method == ("POST" if parts > 1 else "PUT") and url.endswith(".mcap") != ("uploadId" in url):
            server.fault = lambda *_: None
            server.client.put_object(Bucket=BUCKET, Key=f"runs/{path.name}", Body=other)

    server.fault = meanwhile
    done = push([path], TARGET)
    assert (done.exit_status, content(server, path.name)) == (int(not same), other)
    assert not server.client.list_multipart_uploads(Bucket=BUCKET).get("Uploads")


def flowrec_process(*words: object) -> subprocess.Popen[str]:
    code = f"import flowrec.store.bucket_upload as b; b._PART_BYTES, b._TOGETHER = {PART_BYTES}, 1"
    code += "; from flowrec.verbs.cli import main; main()"
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow("kills an upload in a process of its own")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_push_that_is_killed_or_interrupted_goes_on_where_it_was(
    server: S3Server, large: Path, end: signal.Signals
) -> None:
    held = Event()

    def hold(method: str, url: str) -> None:
        if "partNumber=3" in url:
            held.wait(HANG_S)

    server.fault = hold
    process = flowrec_process("push", large, TARGET)
    try:
        until(lambda: len(sent_parts(server)) == 3 or process.poll() is not None)
        process.send_signal(end)
        _, err = process.communicate(timeout=HANG_S)  # though a part is being sent
    finally:
        process.kill()
        held.set()
    assert process.returncode == (-9 if end == signal.SIGKILL else 130)
    if end == signal.SIGINT:
        (line,) = err.splitlines()
        assert re.search(r"[\d.]+ of [\d.]+ MB \(SIGINT", line)
    assert "Contents" not in server.client.list_objects_v2(Bucket=BUCKET)
    server.fault = lambda *_: None
    server.requests.clear()
    (done,) = push([large], TARGET).files
    assert content(server, "large.mcap") == large.read_bytes()
    there = LARGE_PARTS - len(sent_parts(server))
    assert there in (2, 3) and done.sent_bytes == large.stat().st_size - there * PART_BYTES
    assert not server.client.list_multipart_uploads(Bucket=BUCKET).get("Uploads")
    assert not [file for file in large.parent.iterdir() if file != large]  # no state beside it


def test_a_push_that_is_stopped_says_so_in_json_too() -> None:
    told = push_verb.verb.result({}, StoppedError(Ended(), "what was sent stays"))  # type: ignore[attr-defined]
    assert told.as_json is not None and told.as_json()["exit_status"] == told.exit_status == 130


def test_what_another_upload_has_left_is_not_taken_for_ours(server: S3Server, large: Path) -> None:
    client, key = server.client, {"Bucket": BUCKET, "Key": "runs/large.mcap"}
    foreign = client.create_multipart_upload(**key)["UploadId"]
    client.upload_part(**key, UploadId=foreign, PartNumber=1, Body=bytes(PART_BYTES))
    ours = client.create_multipart_upload(**key)["UploadId"]
    data = large.read_bytes()
    client.upload_part(**key, UploadId=ours, PartNumber=1, Body=data[:PART_BYTES])
    client.upload_part(**key, UploadId=ours, PartNumber=2, Body=bytes(PART_BYTES))  # of a file that was changed
    server.requests.clear()
    push([large], TARGET)
    assert content(server, "large.mcap") == data
    assert len(sent_parts(server)) == LARGE_PARTS - 1
    assert [each["UploadId"] for each in client.list_multipart_uploads(Bucket=BUCKET)["Uploads"]] == [foreign]


def test_the_upload_that_was_interrupted_last_goes_on_however_many_others_have_left_before(large: Path) -> None:
    data = large.read_bytes()
    ages = {f"{age:02d}": data if age < 2 else bytes(len(data)) for age in range(20)}  # the two last ones are of ours

    def answer(verb: str, UploadId: str = "", **_words: object) -> dict[str, object]:
        if verb == "list_multipart_uploads":
            times = {age: datetime(2026, 1, 1, tzinfo=UTC) - timedelta(hours=int(age)) for age in ages}
            return {"Uploads": [{"Key": "x", "UploadId": age, "Initiated": times[age]} for age in sorted(ages)[::-1]]}
        md5 = hashlib.md5(ages[UploadId][:PART_BYTES], usedforsecurity=False).hexdigest()
        return {"Parts": [{"PartNumber": 1, "Size": PART_BYTES, "ETag": f'"{md5}"'}]}

    with bucket_upload.LocalParts(large) as parts:
        parts.part_bytes = PART_BYTES
        assert bucket_upload._Upload(answer, "x", parts)._find_interrupted() == "00"


@pytest.mark.slow("waits for a server in trouble")
def test_a_server_in_trouble_is_asked_again_and_that_is_said(server: S3Server, large: Path) -> None:
    failing = iter([500, 503, None, None, 500])
    server.fault = lambda method, _: next(failing, None) if method in ("PUT", "POST") else None
    TRAFFIC.repeated = 0
    done = invoke("push", large, TARGET, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["repeated_requests"] == 3
    assert content(server, "large.mcap") == large.read_bytes()


def test_an_end_whose_answer_was_lost_is_no_failure(server: S3Server, large: Path) -> None:
    ends: list[str] = []

    def fault(method: str, url: str) -> int | None:
        if method != "POST" or "uploadId" not in url:
            return None
        ends.append(url)
        if len(ends) == 1:  # it is done, and the answer is lost: the upload is not known any more
            key = {"Bucket": BUCKET, "Key": "runs/large.mcap", "UploadId": url.partition("uploadId=")[2]}
            parts = server.client.list_parts(**key)["Parts"]
            listed = [{name: part[name] for name in ("PartNumber", "ETag")} for part in parts]
            server.client.complete_multipart_upload(**key, MultipartUpload={"Parts": listed})  # the second end
            return 500
        return None if len(ends) == 2 else 404

    server.fault = fault
    assert not push([large], TARGET).failed and len(ends) == 3
    assert content(server, "large.mcap") == large.read_bytes()


def test_progress_ends_with_the_size_of_the_file(server: S3Server, large: Path) -> None:
    done: list[int] = []
    bucket_upload.Bucket(UrlPath(TARGET)).upload(large, done.append)
    assert done == sorted(done) and len(done) == LARGE_PARTS and done[-1] == large.stat().st_size


class Pretending:
    """A client of a store that answers as if it had taken an object, and has stored something else or nothing."""

    def __init__(self, client: Any, stored: bytes | None) -> None:
        self._client, self._stored = client, stored

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def put_object(self, **words: Any) -> Any:
        if self._stored is not None:
            self._client.put_object(Bucket=words["Bucket"], Key=words["Key"], Body=self._stored)
        return {"ETag": hashlib.md5(words["Body"]).hexdigest()}


@pytest.mark.parametrize("kept", ["nothing", "a beginning", "more", "zeros"])
def test_a_store_that_answers_well_and_keeps_something_else_is_found_out(
    server: S3Server, monkeypatch: pytest.MonkeyPatch, kept: str
) -> None:
    data = SESSION.read_bytes()
    stored = {"nothing": None, "a beginning": data[:-1], "more": data + data[-9:], "zeros": bytes(len(data))}[kept]
    made = bucket_upload._client
    monkeypatch.setattr(bucket_upload, "_client", lambda folder: Pretending(made(folder), stored))
    done = push([SESSION], TARGET)
    said = "is not there, although the store has taken it" if stored is None else "does not hold what was sent"
    assert said in done.failed[SESSION] and not done.files and done.exit_status == 1


def test_who_may_write_and_not_read_is_told_that_nothing_was_compared(server: S3Server) -> None:
    server.fault = lambda method, _: 403 if method in ("GET", "HEAD") else None
    done = push([SESSION], TARGET)
    assert done.exit_status == 3 and str(done.files[0]).endswith("not compared: these credentials may not read it")
    server.fault = lambda *_: None
    assert content(server, SESSION.name) == SESSION.read_bytes()


def test_what_a_store_does_not_offer_is_asked_for_once_and_called_so(server: S3Server) -> None:
    server.fault = lambda method, _: 501 if method == "PUT" else None
    with pytest.raises(FlowrecError, match="501"):
        push([SESSION], TARGET)
    assert [method for method, _ in server.requests].count("PUT") == 1


@pytest.mark.slow("pushes a file in parts")
def test_a_part_that_arrives_otherwise_is_never_called_pushed(
    server: S3Server, large: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """moto does not compare the MD5 of a part as S3 does: what it has stored is read."""
    spoilt = large.read_bytes()
    spoilt = spoilt[:1000] + b"?" + spoilt[1001:]

    class Client(Pretending):
        def upload_part(self, **words: Any) -> Any:
            assert base64.b64decode(words["ContentMD5"]) == hashlib.md5(words["Body"]).digest()
            if words["PartNumber"] == 1:
                words["Body"] = spoilt[:PART_BYTES]
            return self._client.upload_part(**words)

    made = bucket_upload._client
    monkeypatch.setattr(bucket_upload, "_client", lambda folder: Client(made(folder), None))
    done = push([large], TARGET)
    assert "does not hold what was sent" in done.failed[large] and not done.files


@pytest.mark.slow("records a run in parts and pushes it")
def test_all_parts_of_a_run_go_with_its_notes_and_notes_that_were_added_later(server: S3Server, tmp_path: Path) -> None:
    run = tmp_path / "x.mcap"
    in_parts(run, [20, 40])
    Session(run).add_note("first")
    assert len(push([run], TARGET).files) == 4
    far = Session(f"{TARGET}/x.mcap")
    assert flowrec.compare(run, far, ignore=["drawings"]).identical and [note.text for note in far.notes] == ["first"]
    Session(run).add_note("second")
    assert [bool(done.sent_bytes) for done in push([run], TARGET).files] == [False, False, False, True]
    remote_file._remembered.clear()
    assert [note.text for note in far.notes] == ["first", "second"]
    notes = run.with_name("x.mcap.notes.jsonl")
    notes.write_text(notes.read_text().partition("\n")[0] + "\n")
    assert not push([run], TARGET).failed  # the bucket has more
    notes.write_text("{}\n")
    assert "has other notes than" in push([run], TARGET).failed[run]
    assert len(Session(f"{TARGET}/x.mcap").notes) == 2


def test_what_is_damaged_or_unfinished_is_not_pushed(server: S3Server, tmp_path: Path) -> None:
    data = bytearray(SESSION.read_bytes())
    data[len(data) // 2] ^= 255
    (bad := tmp_path / "bad.mcap").write_bytes(data)
    (cut := tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    (text := tmp_path / "text.mcap").write_text("no session")
    in_parts(run := tmp_path / "x.mcap", [20, 40])
    part_path(run, 3).rename(part_path(run, 3).with_name("x.part003.mcap.partial"))
    absent = tmp_path / "absent.mcap"
    done = push([bad, cut, text, run, absent, SESSION], TARGET)
    assert set(done.failed) == {bad, cut, text, run, absent} and [each.file for each in done.files] == [SESSION]
    said_of = ("is not pushed, ", "recover", "is not an MCAP file", "was not finished", "no such file")
    for path, said in zip((bad, cut, text, run, absent), said_of, strict=True):
        assert said in done.failed[path] and "\n" not in done.failed[path], done.failed[path]
    (listed,) = server.client.list_objects_v2(Bucket=BUCKET)["Contents"]
    assert listed["Key"] == f"runs/{SESSION.name}"


def test_a_file_that_changes_while_it_is_sent_is_refused(server: S3Server, large: Path, tmp_path: Path) -> None:
    (path := tmp_path / "large.mcap").write_bytes(large.read_bytes())

    def change(method: str, url: str) -> None:
        if "partNumber=1" in url:
            with path.open("ab") as file:
                file.write(b"more")

    server.fault = change
    assert "changes while it is sent" in push([path], TARGET).failed[path]
    assert "Contents" not in server.client.list_objects_v2(Bucket=BUCKET)


WRONG: dict[str, tuple[dict[str, str | None], str, int | None, str]] = {
    "no bucket": ({}, "s3://other/runs", None, r"there is no such bucket \(404\); check its name"),
    "forbidden": ({}, TARGET, 403, r"refuses access \(403\); check the credentials in the environment"),
    "no credentials": ({"AWS_ACCESS_KEY_ID": None}, TARGET, None, "there are no credentials in the environment"),
    "nobody": ({"AWS_ENDPOINT_URL": "http://127.0.0.1:1"}, TARGET, None, r"no connection, 4 tries"),
    "broken": ({}, TARGET, 500, "the server answers 500, 4 tries"),
    "elsewhere": ({}, TARGET, 301, "is redirected without end"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_bucket_that_does_not_take_it_is_one_line_without_a_credential(
    server: S3Server, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    environment, target, status, said = WRONG[kind]
    for name, value in {"AWS_EC2_METADATA_DISABLED": "true", **environment}.items():
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    server.fault = lambda *_: status
    with pytest.raises(FlowrecError, match=said) as caught:
        push([SESSION], target)
    assert "\n" not in str(caught.value) and str(caught.value).startswith("s3://")
    assert not any(secret in str(caught.value) for secret in KEYS.values())


@pytest.mark.parametrize(
    "target", ["https://host/runs", "gs://lab/runs", "runs", "s3://lab/a.mcap", "s3://lab/runs?X=KEY", "s3://"]
)
def test_a_target_that_is_no_folder_of_s3_is_refused(target: str) -> None:
    with pytest.raises(UsageError, match=r"no folder of S3|name a folder|a URL with a query") as caught:
        push([SESSION], target)
    assert "KEY" not in str(caught.value)
    with pytest.raises(UsageError, match="nothing is pushed from a session at a URL"):
        push([Path("s3://lab/a.mcap")], TARGET)


def test_two_sessions_of_one_name_are_refused(tmp_path: Path) -> None:
    (other := tmp_path / SESSION.name).write_bytes(SESSION.read_bytes())
    with pytest.raises(UsageError, match="has the name of"):
        push([SESSION, other], TARGET)


@pytest.mark.parametrize(
    ("sent", "told"),
    [(3_000_000, "3.0 MB sent, compared"), (1_000_000, "3.0 MB sent, 1.0 MB of them now, c"), (0, "is there already")],
)
def test_what_was_sent_by_an_earlier_call_is_told_apart(tmp_path: Path, sent: int, told: str) -> None:
    file = PushedFile(tmp_path / "a.mcap", UrlPath("s3://lab/a.mcap"), 3_000_000, sent, "", "by reading all of it")
    assert told in str(file)


@pytest.mark.parametrize(
    ("there", "sent"),
    [
        (None, True),
        (b"", True),
        (b"one\n", True),
        (b"one\ntwo\n", False),
        (b"one\ntwo\nthree\n", False),
        (b"two\n", None),
    ],
)
def test_lines_that_were_added_to_notes_are_sent_and_notes_that_have_more_or_others_stay(
    there: bytes | None, sent: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, stored = tmp_path / "a.mcap.notes.jsonl", tmp_path / "stored"
    here.write_bytes(b"one\ntwo\n")
    if there is not None:
        stored.write_bytes(there)

    def put(_name: str, data: bytes, replaces: str = "") -> str:
        assert replaces == ("" if there is None else "etag")
        stored.write_bytes(data)
        return "new"

    bucket = SimpleNamespace(
        url=lambda _name: stored, stat=lambda _name: None if there is None else (1, "etag"), put=put
    )
    for name in ("forget", "_read_back"):
        monkeypatch.setattr(sys.modules[push.__module__], name, lambda *_: "")
    if sent is None:
        with pytest.raises(SessionError, match="other notes"):
            _pushed_notes(bucket, here)  # type: ignore[arg-type]
    else:
        assert _pushed_notes(bucket, here).sent_bytes == (8 if sent else 0)  # type: ignore[arg-type]
    assert stored.read_bytes() == (here.read_bytes() if sent else there)
