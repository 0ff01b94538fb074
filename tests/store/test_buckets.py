"""Runs in parts, notes, folders and patterns at a URL: in a bucket (moto's S3 server), and where nothing lists."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import flowrec
from flowrec.archive.sweep.tasks import content_of, session_files
from flowrec.core.errors import FlowrecError, SessionError, UsageError
from flowrec.store import remote_file, traffic
from flowrec.store.reader import SessionReader
from flowrec.store.run_files import part_path
from flowrec.store.session import Session
from flowrec.store.session_path import session_path
from flowrec.verbs.ls import ls
from tests.conftest import invoke
from tests.store.range_server import served
from tests.store.s3_server import BUCKET, KEYS, S3Server, s3_server
from tests.store.test_run_files import in_parts

SESSION = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"
CUTS, TICKS = 3, 120


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded mission, cut into parts, with a note."""
    path = tmp_path_factory.mktemp("run") / "x.mcap"
    with SessionReader(SESSION) as reader:
        ticks, header = list(itertools.islice(reader.ticks(), TICKS)), reader.header
    in_parts(path, [TICKS * cut // (CUTS + 1) for cut in range(1, CUTS + 1)], ticks, header)
    Session(path).add_note("bubble at the outlet", ["bubble"])
    return path


@pytest.fixture
def bucket(run: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """Holds the run, a session beside it, and a folder."""
    monkeypatch.setattr(traffic, "_PAUSE_S", 0.01)
    remote_file._remembered.clear()
    with s3_server(monkeypatch) as server:
        client = server.client
        for file in run.parent.iterdir():
            client.upload_file(str(file), BUCKET, f"runs/{file.name}")
        client.upload_file(str(SESSION), BUCKET, "runs/whole.mcap")
        client.put_object(Bucket=BUCKET, Key="runs/x2/xy.mcap", Body=b"")
        client.put_object(Bucket=BUCKET, Key="runs/x.partial_results.txt", Body=b"")
        server.requests.clear()
        yield server


def is_the_run(far: Session, near: Session) -> None:
    assert flowrec.compare(near, far, ignore=["drawings"]).identical
    assert (far.key, far.outcome, far.topics) == (near.key, near.outcome, near.topics)
    theirs, mine = flowrec.check(far.path), flowrec.check(near.path)
    assert (theirs.word, theirs.findings, theirs.topics) == (mine.word, mine.findings, mine.topics)
    assert flowrec.info(far) == flowrec.info(near)
    assert far.notes == near.notes and far.notes[0].tags == ("bubble",)


@pytest.mark.slow("reads a run of several parts through a server")
def test_a_run_in_parts_in_a_bucket_is_the_run(bucket: S3Server, run: Path) -> None:
    is_the_run(Session(f"s3://{BUCKET}/runs/x.mcap"), Session(run))
    assert sum("list-type" in url for _, url in bucket.requests) < 12
    bucket.client.delete_object(Bucket=BUCKET, Key=f"runs/{part_path(run, 2).name}")
    remote_file._remembered.clear()
    with pytest.raises(SessionError, match=r"s3://lab/runs/x\.part002\.mcap: is missing from its run"):
        Session(f"s3://{BUCKET}/runs/x.mcap")


def test_a_run_in_parts_where_nothing_lists_is_the_run(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remote_file._remembered.clear()
    with served(run.parent) as server:
        is_the_run(Session(server.url + "/x.mcap"), Session(run))
        part_path(run, 4).rename(run.with_name("away"))
        remote_file._remembered.clear()
        try:
            with pytest.raises(SessionError, match=r"x\.part004\.mcap: is missing, though x\.part003\.mcap says"):
                Session(server.url + "/x.mcap")
        finally:
            run.with_name("away").rename(part_path(run, 4))
        with pytest.raises(SessionError, match="does not list its files"):
            ls([session_path(server.url + "/")])


def test_who_may_read_but_not_list_reads_a_run_in_parts(bucket: S3Server, run: Path) -> None:
    known = {f"/{BUCKET}/runs/{file.name}" for file in run.parent.glob("*.mcap")}
    bucket.fault = lambda method, url: None if url in known else 403  # as S3 answers for what is not there, too
    far = Session(f"s3://{BUCKET}/runs/x.mcap")
    assert far.run.outcome == Session(run).run.outcome and not far.notes
    assert flowrec.info(far)["parts"] == CUTS + 1


@pytest.mark.slow("replays and exports a run of several parts through a server")
def test_a_replay_and_an_export_of_a_run_in_parts_in_a_bucket(
    bucket: S3Server, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    url = f"s3://{BUCKET}/runs/x.mcap"
    done = invoke("replay", url, "--verify", "--json")
    near = invoke("replay", run, "--verify", "--json")
    assert (done.exit_code, {**json.loads(done.stdout), "session": ""}) == (
        near.exit_code,
        {**json.loads(near.stdout), "session": ""},
    )
    far, here = flowrec.export(url, file_format="csv"), flowrec.export(run, tmp_path / "near", file_format="csv")
    assert far == Path("x_csv")
    assert [file.name for file in sorted(far.iterdir())] == [file.name for file in sorted(here.iterdir())]
    assert (far / "track.csv").read_bytes() == (here / "track.csv").read_bytes()


def test_a_folder_and_a_pattern_in_a_bucket_are_listed_and_swept(bucket: S3Server, run: Path) -> None:
    folder = f"s3://{BUCKET}/runs/"
    rows = ls([session_path(folder)])
    assert [(row.name, row.outcome, row.parts) for row in rows] == [
        ("whole.mcap", "reached", 0),
        ("x.mcap", "reached", 4),
    ]
    assert rows[1].facts["tags"] == ["bubble"]
    both = [f"s3://{BUCKET}/runs/whole.mcap", f"s3://{BUCKET}/runs/x.mcap"]
    assert list(map(str, session_files([folder]))) == both
    assert list(map(str, session_files([f"s3://{BUCKET}/runs/*.mcap"]))) == both
    for pattern in ("x*.mcap", "[x]*.mcap"):
        assert list(map(str, session_files([f"s3://{BUCKET}/runs/{pattern}"]))) == both[1:]
    assert [content_of(Session(url)) for url in both] == [content_of(Session(SESSION)), content_of(Session(run))]
    for wrong, said in [
        (f"s3://{BUCKET}/*/x.mcap", "stands after its last slash"),
        (f"s3://{BUCKET}/none/", "no file is there"),
        (f"s3://{BUCKET}/runs/x.partial*", "no session"),
        ("s3://other/runs/", r"is not there \(404\)"),
    ]:
        with pytest.raises(FlowrecError, match=said) as caught:
            session_files([wrong])
        assert not any(secret in str(caught.value) for secret in KEYS.values())
    with pytest.raises(UsageError, match="names no object"):
        flowrec.open(f"s3://{BUCKET}")


def test_the_notes_of_a_session_in_a_bucket_are_printed_and_none_is_added(bucket: S3Server) -> None:
    url = f"s3://{BUCKET}/runs/x.mcap"
    assert "#bubble bubble at the outlet" in invoke("note", url).stdout
    with pytest.raises(UsageError, match="no note is added to a session at a URL; copy it to this machine"):
        Session(url).add_note("seen")
