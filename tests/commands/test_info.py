"""`flowrec ls` and `flowrec recover` as a person types them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from flowrec.cli import app
from flowrec.commands.info import list_sessions
from flowrec.errors import SessionError
from flowrec.store.session_file import WriterOptions
from flowrec.store.writer import SessionWriter
from tests.store.made_up import HEADER, ticks_of


def typed(*words: object) -> Result:
    return CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)


def write(path: Path, count: int) -> Path:
    with SessionWriter(path, HEADER, WriterOptions(block=True)) as writer:
        for tick in ticks_of(count, shape=(8, 8)):
            writer.write(tick)
        writer.close({"outcome": "reached"})
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A whole session, one cut off, the remains of a run, and things that are none."""
    content = write(tmp_path / "a.mcap", 61).read_bytes()
    longer = write(tmp_path / "b.mcap", 1000).read_bytes()
    (tmp_path / "b.mcap").write_bytes(longer[: len(longer) // 2])
    (tmp_path / "c.mcap.partial").write_bytes(content[:-2000])
    (tmp_path / "d.mcap").touch()
    (tmp_path / "notes.txt").write_text("no session")
    (tmp_path / "e.mcap").mkdir()
    return tmp_path


def test_all_session_files_of_a_directory_are_listed_whatever_state_they_are_in(folder: Path) -> None:
    rows = list_sessions(folder)
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
        assert [row.outcome for row in list_sessions(tmp_path)] == ["recording"]
    assert [row.outcome for row in list_sessions(tmp_path)] == ["ended"]


def test_listing_reads_no_messages(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flowrec.store.mcap_reader.McapReader.messages", None)
    assert list_sessions(folder)[0].outcome == "reached"


def test_a_real_session_is_listed_with_its_chip_and_its_date(session: Path) -> None:
    (row,) = [row for row in list_sessions(session.parent) if row.name == session.name]
    assert (row.outcome, bool(row.chip), bool(row.recorded)) == ("reached", True, True)


def test_ls_prints_a_table_or_json(folder: Path) -> None:
    rows = json.loads(typed("ls", folder, "--json").stdout)
    assert [row["name"] for row in rows] == ["a.mcap", "b.mcap", "c.mcap.partial", "d.mcap"]
    assert "a.mcap" in typed("ls", folder).stdout
    with pytest.raises(SessionError, match="no such directory"):
        typed("ls", folder / "nowhere")


def test_the_exit_status_of_recover_says_whether_something_was_lost(folder: Path) -> None:
    assert typed("recover", folder / "a.mcap").exit_code == 0
    assert typed("recover", folder / "b.mcap").exit_code == 3
    assert typed("recover", folder / "c.mcap.partial", "--out", folder / "f.mcap").exit_code == 0  # all but the index
    assert {row.name: row.outcome for row in list_sessions(folder)} == {
        "a.mcap": "reached",
        "b.mcap": "unreadable",
        "b_recovered.mcap": "cut",
        "c.mcap.partial": "unfinished",
        "d.mcap": "unreadable",
        "f.mcap": "reached",
    }
    with pytest.raises(SessionError, match="is empty"):
        typed("recover", folder / "d.mcap")
