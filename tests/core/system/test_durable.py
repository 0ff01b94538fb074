"""A full disk, a killed process, a changed output: what was there before is whole, and nothing is left."""

from __future__ import annotations

import errno
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flowrec.core import (
    JSON,
    Output,
    OutputFolder,
    SessionError,
    append_line,
    remove_leftovers,
    replacing,
    temporary_name,
)
from flowrec.core.system.leftovers import OLD
from flowrec.core.system.outputs import is_as_written, note_written, written_sha256
from flowrec.store import notes_file
from flowrec.store.notes import append_note, read_notes
from tests.conftest import invoke, until

WAITS = """
import signal, sys, time
from pathlib import Path
from flowrec.core.system.durable import replacing
from flowrec.core.system.output_folder import OutputFolder
with replacing(Path(sys.argv[1]) / "x.json"), OutputFolder(Path(sys.argv[1]) / "tables", {}).new_folder() as part:
    (part / "half.csv").write_text("half")
    print("waits", flush=True)
    time.sleep(1000)
"""


@contextmanager
def disk_of(nbytes: int) -> Iterator[None]:
    """No file can become larger: a write that would make it larger is cut short, the next one fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (nbytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def waiting_writer(folder: Path, code: str = WAITS) -> Iterator[subprocess.Popen[str]]:
    """A process that writes a file and a folder, and does not come to an end."""
    with subprocess.Popen([sys.executable, "-c", code, folder], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "waits\n"
            yield process
        finally:
            process.kill()


def name_of_the_dead() -> str:
    """The name of a temporary file of a process that has ended."""
    words = [sys.executable, "-c", "from flowrec.core.system.leftovers import temporary_name as t; print(t())"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def test_a_note_on_a_full_disk_is_an_error_and_the_others_stay_whole(tmp_path: Path) -> None:
    session = tmp_path / "a.mcap"
    append_note(session, "key", "first", [], "Zoë")
    before = notes_file(session).read_bytes()
    for room in (0, 1, 30):
        with disk_of(len(before) + room), pytest.raises(SessionError, match=r"\.jsonl"):
            append_note(session, "key", "the bubble entered at 12:30", [], "Zoë")
        assert notes_file(session).read_bytes() == before
    with disk_of(5), pytest.raises(SessionError, match=r"b\.mcap"):
        append_note(tmp_path / "b.mcap", "key", "first", [], "Zoë")
    append_note(session, "key", "second", [], "Zoë")
    assert [note.text for note in read_notes(session, "key")] == ["first", "second"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.notes.jsonl"]


def test_a_line_that_a_power_cut_has_torn_is_not_continued(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_bytes(b"first\nto")
    append_line(path, b"third\n")
    append_line(path, b"fourth")
    assert path.read_bytes() == b"first\nto\nthird\nfourth\n"


def test_a_file_that_can_not_be_replaced_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    refused = pytest.raises(SessionError, match=r"a\.json: ")
    with refused, disk_of(1000), Output(path, JSON, overwrite=True).new_file() as part:
        part.write_bytes(bytes(2000))
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_what_was_put_in_the_place_of_an_output_while_it_was_made_stays(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"ours")
    ours = "79ccc9d00c1ae44ab5e56dc39aa7b42be9d71b2b69d8c1e1d5a39c12f5b79c12"
    with pytest.raises(SessionError, match=r"a\.json"):
        Output(path, JSON, replaces=ours).check()
    import hashlib

    output = Output(path, JSON, replaces=hashlib.sha256(b"ours").hexdigest())
    with output.new_file() as part:
        part.write_bytes(b"new")
    assert path.read_bytes() == b"new"
    path.write_bytes(b"ours")
    with pytest.raises(SessionError, match=r"a\.json"), output.new_file():
        path.write_bytes(b"of a person")
    assert path.read_bytes() == b"of a person" and list(tmp_path.iterdir()) == [path]


def test_a_name_is_free_again_where_a_file_can_not_get_it_on_a_disk_without_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(errno.EPERM, "no links here")

    monkeypatch.setattr("os.link", refused)
    with replacing(tmp_path / "a.json", overwrite=False) as part:
        part.write_bytes(b"whole")
    assert (tmp_path / "a.json").read_bytes() == b"whole"
    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(PermissionError), replacing(tmp_path / "b.json", overwrite=False) as part:
        part.write_bytes(b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_an_output_is_replaced_only_where_it_is_the_file_that_was_written_and_from_the_same_facts(
    tmp_path: Path,
) -> None:
    path, facts = tmp_path / "a.json", {"session": "abc", "format": "json"}
    assert written_sha256(path, facts) == ""
    path.write_bytes(b"ours")
    note_written(path, facts)
    sha256 = written_sha256(path, facts)
    assert sha256 and is_as_written(path, facts)
    assert written_sha256(path, facts | {"session": "def"}) == "" and not is_as_written(path, facts | {"new": "1"})
    Output(path, JSON, replaces=sha256).check()
    path.rename(tmp_path / "elsewhere.json")
    path.symlink_to(tmp_path / "elsewhere.json")  # of a person, for whom the file behind it may be another one soon
    with pytest.raises(SessionError, match=r"a\.json"):
        Output(path, JSON, replaces=sha256).check()


def test_what_a_killed_process_has_left_is_removed_and_nothing_that_may_be_in_use(tmp_path: Path) -> None:
    _, _, *numbers = name_of_the_dead().split("-")
    other_host = tmp_path / "-".join((".flowrec", "0" * 8, *numbers))
    foreign = [other_host, tmp_path / ".flowrec-notes", tmp_path / ".flowrec-rrd"]
    for path in foreign:
        path.touch()
    with waiting_writer(tmp_path):
        with waiting_writer(tmp_path) as killed:
            pass
        assert killed.returncode == -signal.SIGKILL
        again = temporary_name().split("-")
        again[3] = str(int(again[3]) - 1)  # the number of a process that was given again
        (tmp_path / "-".join(again)).touch()
        mine = tmp_path / temporary_name(".json")
        mine.touch()
        left = sorted(path.name for path in tmp_path.iterdir())
        removed = remove_leftovers(tmp_path)
        assert len(removed) == 3 and len(left) == 3 + 3 + 1 + 2
        assert not any(path.exists() for path in removed) and mine.exists() and all(path.exists() for path in foreign)
    mine.unlink()
    with replacing(tmp_path / "y.json") as part:  # the next start of whatever writes there
        part.write_text("{}")
    assert sorted(path.name for path in tmp_path.iterdir() if path not in foreign) == ["y.json"]


def test_recover_removes_what_killed_processes_have_left_beside_a_session(tmp_path: Path) -> None:
    session = Path(shutil.copy(Path(__file__).parents[3] / "sessions" / "golden_moderate.mcap", tmp_path))
    (tmp_path / name_of_the_dead()).touch()
    assert invoke("recover", session).exit_code == 0
    assert list(tmp_path.iterdir()) == [session]


def test_sigterm_leaves_nothing(tmp_path: Path) -> None:
    code = f"""
from flowrec.core.system.endings import one_line_at_the_end
with one_line_at_the_end():
    exec({WAITS!r})
"""
    with waiting_writer(tmp_path, code) as process:
        process.terminate()
        until(lambda: process.poll() is not None)
    assert process.returncode == 143 and not list(tmp_path.iterdir())


def test_a_folder_whose_process_was_killed_between_two_names_is_there_again(tmp_path: Path) -> None:
    folder = tmp_path / "tables"
    for content in ("1", "2"):
        with OutputFolder(folder, {}, overwrite=True).new_folder() as part:
            (part / "a.csv").write_text(content)
    # As the process left it: the former folder moved away, the new one whole and without its name.
    dead = name_of_the_dead()
    folder.rename(tmp_path / dead)
    (tmp_path / (dead + OLD)).mkdir()
    remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["tables"] and (folder / "a.csv").read_text() == "2"
