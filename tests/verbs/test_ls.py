"""`flowrec ls`, `flowrec note` and `flowrec recover` as a person types them."""

from __future__ import annotations

import itertools
import json
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from flowrec.core import SessionError, UsageError
from flowrec.run import CommandSocket, RunControl
from flowrec.store import SessionReader, SessionWriter, WriterOptions, notes_file
from flowrec.verbs import read_each
from flowrec.verbs.ls import ls
from flowrec.verbs.view import view as view_session
from tests.conftest import HANG_S, typed
from tests.store.made_up import HEADER, ticks_of, write_session


def write(path: Path, count: int, **figures: float) -> Path:
    return write_session(
        path,
        ticks_of(count, shape=(8, 8)),
        outcome={"outcome": "reached", **{key: repr(value) for key, value in figures.items()}},
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole session, one cut off, the remains of a run, and things that are none."""
    tmp_path = tmp_path_factory.mktemp("made")
    content = write(tmp_path / "a.mcap", 61).read_bytes()
    longer = write(tmp_path / "b.mcap", 1000).read_bytes()
    (tmp_path / "b.mcap").write_bytes(longer[: len(longer) // 2])
    (tmp_path / "c.mcap.partial").write_bytes(content[:-2000])
    (tmp_path / "d.mcap").touch()
    (tmp_path / "notes.txt").write_text("no session")
    (tmp_path / "e.mcap").mkdir()
    return tmp_path


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "folder"))


def test_all_session_files_of_a_directory_are_listed_whatever_state_they_are_in(folder: Path) -> None:
    rows = ls([folder])
    assert [(row.name, row.outcome) for row in rows] == [
        ("a.mcap", "reached"),
        ("b.mcap", "unreadable"),
        ("c.mcap.partial", "unfinished"),
        ("d.mcap", "unreadable"),
    ]
    assert rows[0].duration_s == pytest.approx(1.0, abs=1e-3)
    assert rows[0].size_bytes == (folder / "a.mcap").stat().st_size
    assert "flowrec recover" in rows[1].note and "is empty" in rows[3].note


def test_a_run_that_is_going_on_is_listed_as_such(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        for tick in ticks_of(3, shape=(8, 8)):
            writer.write(tick)
        assert [row.outcome for row in ls([tmp_path])] == ["recording"]
    assert [row.outcome for row in ls([tmp_path])] == ["ended"]


@pytest.mark.slow("two runs in real time")
@pytest.mark.skipif(sys.platform == "win32", reason="descriptors are inherited by POSIX processes only")
def test_a_run_under_way_is_found_and_shown_until_it_ends(session: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    recorded = SessionReader(session)
    with SessionWriter(path, recorded.header, WriterOptions(own_process=True, block=True, flush_s=0.05)) as writer:
        for tick in itertools.islice(recorded.ticks(), 100):
            writer.write(tick)
        rows = {Path(row["name"]).name: row for row in json.loads(typed("ls", "--live", "--json").stdout)}
        assert rows["x.mcap.partial"]["outcome"] == "recording"  # other runs of this machine may stand beside it
        words = [sys.executable, "-m", "flowrec", "view", path, "--live", "--console", "--no-open"]
        control = RunControl()
        with CommandSocket(path, control, print), subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as view:
            assert view.stderr is not None
            told = [view.stderr.readline() for _ in range(4)]
            assert "rerun --connect" in told[0] and "Ctrl-C ends the view" in told[3]
            port, token = told[1].strip().rpartition("127.0.0.1:")[2].split("/?token=")
            with connect(
                f"ws://127.0.0.1:{port}/live",
                origin=f"http://127.0.0.1:{port}",
                additional_headers={"Cookie": f"flowrec_console_{port}={token}"},
                proxy=None,
            ) as page:
                page.send(json.dumps({"number": 7, "command": "hold"}))
                answers = (json.loads(word) for word in page if isinstance(word, str))
                assert next(word for word in answers if "answers" in word) == {"answers": 7, "refusal": ""}
                event = control.next_event(10**9, held=False)
                assert event is not None and event.action == "pause"
                writer.close({"outcome": "lost"})
                told = [json.loads(word) for word in page if isinstance(word, str)]
                assert "lost" in told[-1]["ended"]["outcome"] and not told[-1]["ended"]["good"]
            last = view.stderr.read()
    assert view.returncode == 0 and f"the run has ended at {tick.stamp_ns / 1e9:.1f} s: lost" in last
    with pytest.raises(SessionError, match=path.name):
        typed("view", path, "--live")


@pytest.mark.parametrize("options", [{}, {"console": True}, {"live": True, "out": Path("x.rrd")}])
def test_a_view_without_a_session_is_refused_unless_it_is_of_a_run_under_way(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        view_session(None, **options)


def test_listing_reads_no_messages(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flowrec.store.mcap_reader.McapReader.messages", None)
    assert ls([folder])[0].outcome == "reached"


def test_ls_prints_a_table_or_json(folder: Path) -> None:
    rows = json.loads(typed("ls", folder, "--json").stdout)
    assert [row["name"] for row in rows] == ["a.mcap", "b.mcap", "c.mcap.partial", "d.mcap"]
    assert "a.mcap" in typed("ls", folder).stdout
    with pytest.raises(SessionError, match="nowhere"):
        typed("ls", folder / "nowhere")


def test_the_exit_status_of_recover_says_whether_something_was_lost(folder: Path) -> None:
    assert typed("recover", folder / "a.mcap").exit_code == 0
    assert typed("recover", folder / "b.mcap").exit_code == 3
    assert typed("recover", folder / "c.mcap.partial", "--out", folder / "f.mcap").exit_code == 0  # all but the index
    found = {row.name: row.outcome for row in ls([folder])}
    assert len(found) == 6 and found["b_recovered.mcap"] == "cut" and found["f.mcap"] == "reached"
    with pytest.raises(SessionError, match=r"d\.mcap"):
        typed("recover", folder / "d.mcap")


@pytest.fixture
def flown(tmp_path: Path) -> list[Path]:
    """Three runs in two folders, one of them without a known error."""
    (tmp_path / "old").mkdir()
    errors = {"a.mcap": {"refined_flow_error": 0.12}, "old/b.mcap": {"refined_flow_error": 0.03}, "c.mcap": {}}
    return [write(tmp_path / name, 5 + k, **error) for k, (name, error) in enumerate(errors.items())]


def names(*words: object, **options: str) -> list[str]:
    return [Path(row.name).name for row in ls([*map(Path, words)], **options)]  # type: ignore[arg-type]


def test_files_and_folders_are_listed_together_chosen_by_their_facts_and_sorted(flown: list[Path]) -> None:
    first, second, third = flown
    assert names(first.parent, second) == ["a.mcap", "c.mcap", "b.mcap"]
    assert names(first.parent, second, sort="refined_flow_error") == ["b.mcap", "a.mcap", "c.mcap"]
    assert names(first.parent, second, sort="-refined_flow_error") == ["a.mcap", "b.mcap", "c.mcap"]
    assert names(*flown, where="refined_flow_error < 0.05 and outcome = 'reached'") == ["b.mcap"]
    assert names(*flown, where="refined_flow_error is null or name like '%a.mcap'") == ["a.mcap", "c.mcap"]
    shown = typed("ls", first.parent, second, "--where", "refined_flow_error > 0").stdout
    assert "12.0 %" in shown and "3.0 %" in shown and third.name not in shown


@pytest.mark.parametrize(
    ("chosen", "named"),
    [
        ({"where": "refined_error < 0.05"}, "did you mean refined_flow_error"),
        ({"where": "exists(from read_text('a.mcap'))"}, ""),  # the others: tests/archive/catalog/test_catalog.py
        ({"sort": "outcom"}, "did you mean outcome"),
    ],
)
def test_an_expression_that_is_wrong_or_does_more_than_choose_is_refused_in_one_line(
    flown: list[Path], chosen: dict[str, str], named: str
) -> None:
    with pytest.raises(UsageError, match=rf"^[^\n]*\b{named}\b[^\n]*$"):
        ls(flown, **chosen)


def test_without_duckdb_sessions_are_sorted_and_a_choice_names_the_extra(
    flown: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "duckdb", None)
    monkeypatch.delitem(sys.modules, "flowrec.verbs.session_table", raising=False)
    assert names(*flown, sort="refined_flow_error") == ["b.mcap", "a.mcap", "c.mcap"]
    with pytest.raises(UsageError, match=r"pip install 'flowrec\[catalog\]'"):
        names(*flown, where="refined_flow_error > 0")


def test_a_note_lies_beside_the_recording_which_does_not_change_and_is_listed_with_it(flown: list[Path]) -> None:
    path, other, _ = flown
    before = path.read_bytes()
    typed("note", path, "a bubble at the outlet", "--tag", "bubble")
    typed("note", path, "used for the talk", "--tag", "talk", "--tag", "bubble")
    assert path.read_bytes() == before
    said = typed("note", path).stdout.splitlines()
    assert len(said) == 2 and said[0].endswith("#bubble a bubble at the outlet")
    assert names(*flown, where="tags like '%talk%'") == ["a.mcap"]
    shown = " ".join(typed("ls", *flown).stdout.split())
    assert "#bubble #talk used for the talk" in shown
    assert "a bubble at the outlet" in typed("info", path).stdout
    # A copied note is not that of another session.
    notes_file(path).rename(notes_file(other))
    assert typed("note", path).stdout == typed("note", other).stdout == ""


def test_a_line_that_was_cut_or_is_damaged_costs_only_itself(flown: list[Path]) -> None:
    path = flown[0]
    typed("note", path, "first")
    with notes_file(path).open("ab") as file:
        file.write(b'{"session": "x", "tex')  # the power went
    typed("note", path, "second \x1b[31m\u202e")
    with notes_file(path).open("ab") as file:
        file.write(b"[" * 100_000 + b"\n" + b"9" * 300_000 + b"\n\xff\xfe\n[1]\n")
    rows = json.loads(typed("note", path, "--json").stdout)["notes"]
    assert [row["text"] for row in rows] == ["first", "second \x1b[31m\u202e"]
    assert "\x1b" not in typed("note", path).stdout and "\u202e" not in typed("ls", path).stdout
    for words in (["x" * 10_001], ["", "--tag", ""], [" ", "--tag", "t" * 61]):
        with pytest.raises(UsageError, match="a note"):
            typed("note", path, *words)


def test_an_interruption_leaves_sessions_at_urls_unread_that_still_wait() -> None:
    begun: list[int] = []
    answered = threading.Event()

    def read(number: int) -> int:
        begun.append(number)
        answered.wait(HANG_S)
        return number

    with pytest.raises(KeyboardInterrupt), read_each(read, range(1000), far=True):
        raise KeyboardInterrupt
    answered.set()
    for thread in threading.enumerate():
        if thread.name.startswith("sessions"):
            thread.join(HANG_S)
    assert len(begun) < 100


def test_a_folder_without_a_session_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ls([tmp_path]).show()
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and str(tmp_path) in said.err
