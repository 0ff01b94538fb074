"""`flowrec catalog` and `flowrec find`: every session is a row, whatever its state; SQL reads this file only."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import flowrec
from flowrec.archive import verbs
from flowrec.archive.catalog import catalog_file, refresh
from flowrec.archive.catalog.find import find, open_catalog
from flowrec.archive.catalog.format import KEY, NAME
from flowrec.archive.sweep.results import Results
from flowrec.archive.sweep.tasks import Task, content_of
from flowrec.core import FlowrecError, OperatorEvent, OutputError, SessionError, UsageError, open_new
from flowrec.store import Session, SessionWriter
from flowrec.store.session_file import Split
from flowrec.verbs import columns_of
from flowrec.verbs.ls import ls
from tests.conftest import HANG_S, typed
from tests.extras import needs
from tests.rewritten import rewrite
from tests.store.made_up import HEADER, ticks_of, write_session
from tests.store.s3_server import BUCKET, s3_server

PROVENANCE = {"operator": "Zoë", "wall_time": "2026-05-04T10:00:00+00:00"}


def made_up(path: Path, number: int, marks: int = 0, split_s: float | None = None, **figures: Any) -> Path:
    """A session of its own content, with marks by the operator and figures in its outcome."""
    header = replace(HEADER, provenance=PROVENANCE | {"seed": str(number)}, start_unix_ns=number)
    ticks = [
        replace(tick, operator=OperatorEvent(tick.stamp_ns, "mark", f"bubble {count}") if count < marks else None)
        for count, tick in enumerate(ticks_of(12, shape=(8, 8), seed=number))
    ]
    outcome = {"outcome": "reached"} | {key: str(value) for key, value in figures.items()}
    return write_session(path, ticks, header, outcome, files=Split(seconds=split_s))


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one of everything."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "may" / ".snapshots").mkdir(parents=True)
    first = made_up(folder / "a.mcap", 1, marks=2, refined_flow_error=0.03, contacts=3, ticks=12)
    made_up(folder / "may" / "b.mcap", 2, refined_flow_error=0.12, contacts=1, ticks=12, tracking_error="2 um rms")
    made_up(folder / "may" / "run.mcap", 3, split_s=0.1)
    shutil.copy(first, folder / "may" / "copy.mcap")
    shutil.copy(first, folder / "may" / ".snapshots" / "old.mcap")
    (folder / "cut.mcap").write_bytes(first.read_bytes()[:-2000])
    (folder / "killed.mcap.partial").write_bytes(first.read_bytes()[:-2000])
    (folder / "empty.mcap").touch()
    flowrec.open(first).add_note("a bubble, at the outlet", ["bubble", "talk"])
    (folder / "table.parquet").write_bytes(b"PAR1 no table")
    pq.write_table(pa.table({"x": [1]}), folder / "foreign.parquet")
    _sweep(folder / "sweep.parquet", [first])
    return folder


def _sweep(path: Path, sessions: list[Path]) -> None:
    contents = [content_of(flowrec.open(each)) for each in sessions]
    with Results.open_locked(path, sessions, contents) as results:
        for content in contents:
            for refine, error in (("fvm", 0.2), ("pi_unet", 0.01), ("gain", 0.3)):
                task = Task("elsewhere.mcap", content, (("refine", refine), ("sampler.method", "filter")))
                figures = {"refined_flow_error": [0.03, error]}
                row = {"key": task.key, "session": task.session, "content": content, "settings": dict(task.settings)}
                results.put(row | {"figures": figures, "verdict": "good", "findings": [], "cpu_s": 1.0, "error": None})


@pytest.fixture
def catalogued(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder, with its catalog, as the current one."""
    folder = tmp_path / "lab"
    shutil.copytree(lab, folder)
    monkeypatch.chdir(folder)
    refresh.refresh([folder])
    return folder


@pytest.fixture(scope="module")
def _standing(lab: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("standing") / "lab"
    shutil.copytree(lab, folder)
    (folder / "secret.csv").write_text("secret\n1\n")
    refresh.refresh([folder])
    return folder


@pytest.fixture
def standing(_standing: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One such copy for all tests that change nothing; with a secret."""
    monkeypatch.chdir(_standing)
    return _standing


def names(where: str = "", **options: Any) -> list[str]:
    return [Path(path).name for path in find(where, **options).paths()]


# --- what is in a catalog


def test_every_session_is_a_row_whatever_its_state_and_is_read_once(
    catalogued: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = {row["name"]: row for row in find().as_json()["sessions"]}
    assert {name: row["outcome"] for name, row in rows.items()} == {
        "a.mcap": "reached",
        "b.mcap": "reached",
        "copy.mcap": "reached",
        "run.mcap": "reached",
        "cut.mcap": "unreadable",
        "empty.mcap": "unreadable",
        "killed.mcap.partial": "unfinished",
    }
    assert rows["run.mcap"]["parts"] > 1 and rows["a.mcap"]["tags"] == ["bubble", "talk"]
    assert "flowrec recover" in rows["cut.mcap"]["note"]
    monkeypatch.setattr(refresh, "row_of", None)
    again = refresh.refresh([catalogued])
    assert (again.sessions, again.new, again.changed, again.gone, again.broken) == (7, 0, 0, 0, 3)


def test_two_processes_write_the_same_rows_as_one(standing: Path, tmp_path: Path) -> None:
    found = refresh.refresh([standing], tmp_path / "two.parquet", jobs=2)
    assert (found.sessions, found.new, found.broken) == (7, 7, 3)
    one, two = (find(catalog=path).as_json()["sessions"] for path in (standing / NAME, tmp_path / "two.parquet"))
    assert [{**row, "path": row["name"]} for row in one] == [{**row, "path": row["name"]} for row in two]


def test_a_session_that_another_program_has_written_anew_has_the_same_content(lab: Path, tmp_path: Path) -> None:
    written = tmp_path / "anew.mcap"
    rewrite(lab / "a.mcap", written)
    assert written.read_bytes() != (lab / "a.mcap").read_bytes()
    assert content_of(Session(written)) == content_of(Session(lab / "a.mcap"))


def test_ls_and_find_have_the_same_columns_values_and_answers(standing: Path) -> None:
    with open_catalog(standing / NAME) as (_, table):
        known = {row["name"]: row for row in table.rows("")[1]}
        columns = table.columns
    for place in (standing, standing / "may"):
        for row in ls([place]):
            listed = columns_of(row, (place / Path(row.name).name).relative_to(standing).as_posix())
            stated = {name: ", ".join(v) if isinstance(v, list) else v for name, v in listed.items()}
            assert stated == {name: known[Path(row.name).name].get(name) for name in stated}
            assert {name for name, value in stated.items() if value is not None} <= set(columns)
    for where in (
        "refined_flow_error < 0.05",
        "refined_flow_error is null or outcome <> 'reached'",
        "tracking_error > 0",  # of an older file, in words
        "name like '%.MCAP'",
        "contacts / ticks > 0.2",
        "tags like '%talk%' and notes_added = 'a bubble, at the outlet'",
        "local_changes = true or parts > 1",
        "recorded > '2026-05' and operator_events = 2 -- marks",
        "duration_s between 0.1 and 0.3 and seed in (1, 2)",
        "upper(outcome) = 'REACHED' and size_bytes > 10",
    ):
        listed = [Path(row.name).name for row in ls([standing, standing / "may"], where=where)]
        assert sorted(listed) == sorted(names(where)), where
    listed = [row.name for row in ls([standing], sort="-refined_flow_error")]
    assert listed[0] == "a.mcap" and names(sort="-refined_flow_error")[0] == "b.mcap"


def test_replays_of_sweeps_and_marks_of_the_operator_are_found_with_their_sessions(standing: Path) -> None:
    best = find("sweep.place = 1 and sweep.refine = 'pi_unet'")
    assert [Path(path).name for path in best.paths()] == ["a.mcap", "copy.mcap"]  # the same content
    assert best.mentioned == ["sweep.place", "sweep.refine"]
    assert not find("sweep.place = 1 and sweep.refine = 'fvm'").rows
    cells = typed("find", "sweep.refine = 'fvm'", "--sort", "-sweep.replayed_refined_flow_error").stdout
    assert "sweep.replayed_refined_flow_error" in cells and "20.0 %" in cells
    assert names("sweep.key is null and verdict is null and outcome = 'reached'") == ["b.mcap", "run.mcap"]
    assert names("sweep.\"sampler.method\" = 'filter' and verdict = 'good'") == ["a.mcap", "copy.mcap"]
    # A row for each of two events and three replays.
    assert len(find("events.action = 'mark' and sweep.cpu_s = 1 and name = 'a.mcap'").rows) == 6
    (row,) = find("events.text = 'bubble 1' and path = 'a.mcap'").rows
    assert row["events"]["time_s"] == pytest.approx(flowrec.open("a.mcap").reader.stamps("operator")[1] / 1e9)
    assert names("len(list_filter(sweep, lambda s: s.replayed_refined_flow_error < 0.1)) = 1", limit=1) == ["a.mcap"]


def test_marks_are_read_from_the_chunks_that_hold_them(catalogued: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a session without events is opened by its head and index only")

    monkeypatch.setattr(refresh, "_events", refuse)
    made_up(catalogued / "new.mcap", 9)
    assert refresh.refresh([catalogued]).new == 1


# --- what a refresh does


def test_what_has_changed_is_read_again_and_what_is_gone_is_dropped(catalogued: Path) -> None:
    before = find("name = 'b.mcap'").rows
    made_up(catalogued / "new.mcap", 9)
    shutil.copy(catalogued / "may" / "b.mcap", catalogued / "cut.mcap")  # recovered
    flowrec.open("may/copy.mcap").add_note("seen again")
    (catalogued / "empty.mcap").unlink()
    done = refresh.refresh([])  # the places that the catalog states
    assert (done.sessions, done.new, done.changed, done.gone) == (7, 1, 2, 1)
    assert names("notes_added like '%seen again%'") == ["copy.mcap"]
    assert find("name = 'b.mcap'").rows == before


def test_names_of_any_bytes_are_known_again_and_printed_so_that_they_can_be_opened(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "Anna's lab"
    folder.mkdir()
    monkeypatch.chdir(folder)
    odd = [b"line\nfeed.mcap", b"\x1b[31m.mcap", b"caf\xe9.mcap", b"quote'd.mcap", b"plain.mcap"]
    for name in odd:
        shutil.copy(lab / "a.mcap", os.fsdecode(name))
    assert refresh.refresh([folder]).new == 5
    again = refresh.refresh([folder])
    assert (again.new, again.changed, again.gone) == (0, 0, 0)
    printed = typed("find", "--paths", "--null").stdout_bytes.split(b"\0")
    assert sorted(printed) == [b"", *sorted(odd)] and all(Path(os.fsdecode(name)).is_file() for name in odd)
    lines = typed("find", "duration_s > 0", "--paths")
    assert b"caf\xe9.mcap\n" in lines.stdout_bytes and "--null" in lines.stderr
    assert "\x1b" not in typed("find").output and len(json.loads(typed("find", "--json").stdout)["sessions"]) == 5


def test_a_run_that_is_being_recorded_is_asked_for_again(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        for tick in ticks_of(3, shape=(8, 8)):
            writer.write(tick)
        refresh.refresh([tmp_path])
        assert find("outcome = 'recording'", tmp_path).paths()
        killed = tmp_path / "k.mcap.partial"
        shutil.copy(tmp_path / "s.mcap.partial", killed)
    assert refresh.refresh([tmp_path]).changed == 0  # another name: s.mcap.partial is gone, s.mcap is new
    with killed.open("rb+") as growing:
        import fcntl

        fcntl.flock(growing, fcntl.LOCK_EX)
        os.utime(killed, ns=(1, 1))
        refresh.refresh([tmp_path])
        assert find("outcome = 'recording'", tmp_path).paths()
    refresh.refresh([tmp_path])  # size and time are the same
    assert find("outcome = 'unfinished'", tmp_path).paths()


def test_the_catalog_moves_with_its_folder(catalogued: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = catalogued.rename(catalogued.with_name("moved"))
    monkeypatch.chdir(moved / "may")
    assert find("name = 'b.mcap'").paths() == ["b.mcap"]
    assert find("name = 'a.mcap'").paths() == [str(moved / "a.mcap")]
    monkeypatch.setattr(refresh, "row_of", None)
    assert refresh.refresh([moved]).changed == 0


def test_an_interrupted_catalog_keeps_what_it_has_read_and_goes_on(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    genuine, read = refresh.row_of, []

    def interrupted(found: Any, path: str) -> dict[str, Any]:
        read.append(path)
        if len(read) == 4:
            raise KeyboardInterrupt
        return genuine(found, path)

    monkeypatch.setattr(refresh, "row_of", interrupted)
    out = tmp_path / "c.parquet"
    shown = typed("catalog", lab, "-o", out)
    assert shown.exit_code == 130 and len(find(catalog=out).rows) == 3 and "4 not read yet" in find(catalog=out).title()
    assert (done := refresh.refresh([lab], out)).new == 4 and not done.left


def test_two_refreshes_at_a_time_do_not_meet_and_a_killed_one_is_no_hindrance(catalogued: Path) -> None:
    before = (catalogued / NAME).read_bytes()
    lock = catalogued / f".{NAME}.lock"
    with open_new(lock), pytest.raises(OutputError, match=NAME):
        refresh.refresh([catalogued])
    assert (catalogued / NAME).read_bytes() == before and lock.exists()  # left by the process that was killed
    assert refresh.refresh([catalogued]).sessions == 7
    assert sorted(each.name for each in catalogued.glob(".*")) == []


def test_a_full_disk_leaves_the_former_catalog(catalogued: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (catalogued / NAME).read_bytes()

    def full(_: pa.Table, path: Path, **__: object) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(catalog_file.pq, "write_table", full)
    with pytest.raises(FlowrecError, match=NAME):
        refresh.refresh([catalogued])
    assert (catalogued / NAME).read_bytes() == before and not list(catalogued.glob(".*"))


def test_a_damaged_catalog_or_one_of_another_version_is_made_anew_and_no_other_file_ever(
    catalogued: Path, tmp_path: Path
) -> None:
    path = catalogued / NAME
    whole = pq.read_table(path)
    for damage in (b"", path.read_bytes()[:-100]):
        path.write_bytes(damage)
        assert "is damaged" in refresh.refresh([catalogued]).remarks[0]
    about = json.loads(whole.schema.metadata[KEY.encode()]) | {"format": 99}
    pq.write_table(whole.replace_schema_metadata({KEY: json.dumps(about)}), path)
    with pytest.raises(UsageError, match="another version"):
        find()
    assert "another version" in refresh.refresh([catalogued]).remarks[0] and find().rows
    for other in (catalogued / "foreign.parquet", catalogued / "table.parquet", catalogued / "sweep.parquet"):
        before = other.read_bytes()
        with pytest.raises(OutputError, match=other.name):
            refresh.refresh([catalogued], other)
        assert other.read_bytes() == before
        with pytest.raises(UsageError, match=other.name):
            find(catalog=other)


def test_places_without_a_session_are_refused_and_a_disk_that_is_not_mounted_empties_nothing(
    catalogued: Path, tmp_path: Path
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "text.txt").touch()
    out = tmp_path / "c.parquet"
    for name in ("empty", "none", "none.mcap", "text.txt"):
        with pytest.raises((SessionError, UsageError), match=name):
            refresh.refresh([tmp_path / name], out)
    assert list(empty.iterdir()) == [] and not out.exists()
    refresh.refresh([catalogued / "may"], out)
    before = out.read_bytes()
    (catalogued / "may").rename(catalogued / "unmounted")
    (catalogued / "may").mkdir()
    with pytest.raises(SessionError, match="may"):
        refresh.refresh([], out)
    assert out.read_bytes() == before


def test_what_a_file_states_can_neither_fill_the_catalog_nor_change_a_column(tmp_path: Path) -> None:
    made_up(tmp_path / "good.mcap", 1, refined_flow_error=0.1)
    facts: dict[str, Any] = {f"x{number}": "y" for number in range(1000)}
    facts |= {"sweep": "z", "signature": "z", "name": "/etc", "Refined_Flow_Error": "bad", "ticks": "9" * 24}
    facts |= {"refined_flow_error": "none", "content": "z", "note": "\x1b[31m" + "t" * 90_000, "a b'\"": "z"}
    made_up(tmp_path / "bad.mcap", 2, **facts)
    refresh.refresh([tmp_path])
    assert names("refined_flow_error > 0", catalog=tmp_path) == ["good.mcap"]
    (row,) = find("name = 'bad.mcap'", tmp_path).rows
    assert len(row) < 450 and len(row["note"]) < 30_000 and "\x1b" not in row["note"] and row["content"] != "z"


# --- what an expression may do


@pytest.mark.parametrize(
    "where",
    ["1; drop table sessions", "1) union select (1", "1) order by (name", "1) limit (1", "true) group by (path",
     "true); copy sessions to 'x.csv'; select (1", "true); copy sessions to 'flowrec-catalog.parquet'; select (1",
     "true); attach 'x.db'; select (1", "true); set enable_external_access = true; select (1", "delete from sessions",
     "copy sessions to 'x.csv'", "attach 'x.db'", "install httpfs", "pragma database_list", "set threads = 4",
     "exists (select * from read_csv('secret.csv'))", "exists (from read_text('secret.csv'))",
     "exists (from glob('*'))", "exists (from 'secret.csv')", "exists (from somebody)", "getenv('HOME') = ''",
     'outcome = "reached"', "refined_flow_error <", "outcome + 1 > 2", "cast(outcome as integer) = 1"],
)  # fmt: skip
def test_sql_that_writes_reads_other_files_or_is_wrong_is_refused_in_one_line_with_status_2(
    standing: Path, where: str
) -> None:
    somebody = pa.table({"x": [1]})  # which DuckDB would find in this frame
    before = {path: path.read_bytes() for path in standing.rglob("*") if path.is_file()}
    with pytest.raises(UsageError, match=r"^[^\n]*$"):
        find(where)
    assert before == {path: path.read_bytes() for path in standing.rglob("*") if path.is_file()} and len(somebody)


@pytest.mark.parametrize(
    "statement",
    ["COPY (SELECT 1) TO '{folder}/x.csv'", "SELECT * FROM read_text('{folder}/secret.csv')", "SET threads = 2",
     "SET enable_external_access = true", "ATTACH '{folder}/x.db'", "INSTALL httpfs", "LOAD httpfs",
     "SELECT * FROM read_csv('http://127.0.0.1:9/x.csv')", "SELECT * FROM glob('{folder}/*')"],
)  # fmt: skip
def test_the_connection_itself_can_do_none_of_it(standing: Path, statement: str) -> None:
    with open_catalog(standing / NAME) as (_, table), pytest.raises(duckdb.Error):
        table.connection.execute(statement.format(folder=standing)).fetchall()
    assert not (standing / "x.csv").exists() and not (standing / "x.db").exists()


@pytest.mark.slow("waits for a condition that does not end")
def test_ctrl_c_ends_a_condition_that_does_not_end(catalogued: Path) -> None:
    endless = "(select count(*) from range(1000000000) a, range(1000000000) b where a.range + b.range = seed) > 0"
    code = (
        "import os, signal, sys, threading\nfrom flowrec.__main__ import main\n"
        "from flowrec.verbs import session_table\n"  # before the signal
        f"sys.argv = ['flowrec', 'find', {endless!r}]\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGINT)).start()\nmain()"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=HANG_S)
    assert done.returncode == 130 and len(done.stderr.splitlines()) == 1, done.stderr


def test_find_shows_a_table_json_or_paths_and_says_how_old_the_catalog_is(
    standing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = typed("find", "contacts > 0 and name like 'a%'").stdout
    assert ".mcap" in shown and shown.count(".mcap") == 1 and "contacts" in shown and "#bubble #talk" in shown
    assert typed("find", "outcome = 'reached'", "--paths", "--sort", "-name", "--limit", 2).stdout.split() == [
        "may/run.mcap",
        "may/copy.mcap",
    ]
    found = json.loads(typed("find", "seed = 2", "--json").stdout)
    assert (found["of"], found["sessions"][0]["seed"], found["sessions"][0]["path"]) == (7, 2, "may/b.mcap")
    assert typed("find", "seed = 77").exit_code == 0
    monkeypatch.setattr(verbs, "_SHOWN_ROWS", 3)
    assert typed("find").stdout.count(".mcap") == 3
    assert typed("find", "--limit", 5).stdout.count(".mcap") == 5
    assert len(json.loads(typed("find", "--json").stdout)["sessions"]) == 7
    for wrong, named in (
        ({"where": "outcom = 'reached'"}, "did you mean outcome"),
        ({"where": "sweep.refin = 'fvm'"}, "did you mean sweep.refine"),
        ({"sort": "-outcom"}, "did you mean outcome"),
        ({"catalog": standing / "none.parquet"}, "none.parquet"),
    ):
        with pytest.raises(UsageError, match=rf"\b{named}\b"):
            find(**wrong)


def test_find_needs_neither_pyarrow_nor_numpy(standing: Path) -> None:
    code = "import sys; sys.argv = ['flowrec', 'find', 'seed = 1', '--paths']\nfrom flowrec.verbs.cli import main\n"
    code += (
        "try:\n    main()\nexcept SystemExit:\n    print([m for m in ('pyarrow', 'numpy', 'mcap') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["a.mcap", "may/copy.mcap", "[]"], done.stderr


@pytest.fixture(autouse=True)
def _no_catalog_above(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@needs("moto")
def test_sessions_in_a_bucket_are_catalogued_by_a_listing_and_read_again_where_the_version_differs(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with s3_server(monkeypatch) as server:
        for path in (lab / "a.mcap", lab / "a.mcap.notes.jsonl", lab / "may" / "b.mcap", lab / "sweep.parquet"):
            server.client.upload_file(str(path), BUCKET, f"runs/{path.name}")
        made_up(tmp_path / "near.mcap", 9)
        out = tmp_path / "c.parquet"
        assert refresh.refresh([f"s3://{BUCKET}/runs", tmp_path], out).new == 3
        assert find("outcome = 'reached' and tags like '%bubble%'", out).paths() == [f"s3://{BUCKET}/runs/a.mcap"]
        assert find("sweep.refine = 'pi_unet'", out).paths() == [f"s3://{BUCKET}/runs/a.mcap"]
        server.requests.clear()
        assert refresh.refresh([], out).changed == 0
        assert not [url for _, url in server.requests if url.endswith(".mcap")]
        other = (lab / "may" / "b.mcap").read_bytes()[:-1] + b"x"  # of the same size
        server.client.put_object(Bucket=BUCKET, Key="runs/b.mcap", Body=other)
        assert refresh.refresh([], out).changed == 1
        before = out.read_bytes()
        server.fault = lambda *_: 403
        for place in (f"s3://{BUCKET}/runs", f"s3://{BUCKET}/runs/a.mcap"):
            with pytest.raises(FlowrecError, match="credentials"):
                refresh.refresh([place], out)
        assert out.read_bytes() == before
    with pytest.raises(UsageError, match="password"):
        refresh.refresh(["s3://key:secret@lab/runs"], out)
