"""No verb replaces a file that it reads, that another process writes, or that it was not told to replace."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from flowrec.core import FlowrecError, SessionError, is_growing, open_new, remove_idle
from flowrec.stages import load_config
from flowrec.store import SessionReader, SessionWriter, WriterOptions
from flowrec.verbs.record import record
from tests.conftest import run, until
from tests.short_missions import LONG, SMALL
from tests.store.made_up import HEADER, ticks_of

BRIEF = ["--duration", "0.3", *(word for setting in SMALL for word in ("--set", setting))]
COILS = Path(__file__).parents[3] / "sessions" / "coils.csv"

# Each verb with an output: its words before it, what it reads, what its output is called.
VERBS: dict[str, tuple[Callable[[Path], list[object]], str, str]] = {
    "record, configuration": (lambda read: ["record", read, *BRIEF, "--out"], "conf.toml", ".mcap"),
    "record, flow field": (lambda read: ["record", "--set", f"start.field={read}", *BRIEF, "--out"], "a.mcap", ".mcap"),
    "replay": (lambda read: ["replay", read, "--out"], "a.mcap", ".mcap"),
    "export": (lambda read: ["export", read, "--format", "rrd", "--out"], "a.mcap", ".rrd"),
    "view": (lambda read: ["view", read, "--no-open", "--out"], "a.mcap", ".rrd"),
    "view, screenshot": (lambda read: ["view", read, "--screenshot"], "a.mcap", ".png"),
    "calibrate, coils": (lambda read: ["calibrate", "coils", read, "--out"], "coils.csv", ".toml"),
    "recover": (lambda read: ["recover", read, "--out"], "cut.mcap", ".mcap"),
    "bench, figures": (lambda read: ["bench", "observer", "--session", read, "--out"], "a.mcap", ".json"),
    "bench, drawing": (lambda read: ["bench", "observer", "--session", read, "--figure"], "a.mcap", ".png"),
}
NEVER_OVERWRITES = ("recover",)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of a third of a second, and the same in parts."""
    path = tmp_path_factory.mktemp("short") / "a.mcap"
    config = load_config(None, [*SMALL, "duration_s=0.3"])
    record(config, path)
    record(load_config(None, [*SMALL, "duration_s=0.3", "recording.split_s=0.1"]), path.with_name("parts.mcap"))
    return path


@pytest.fixture
def folder(short: Path, tmp_path: Path) -> Path:
    """What the verbs read, in a folder of its own."""
    for file in short.parent.iterdir():
        shutil.copy(file, tmp_path)
    shutil.copy(COILS, tmp_path / "coils.csv")
    whole = short.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    (tmp_path / "conf.toml").write_text("simulated.seed = 2\n")
    return tmp_path


@pytest.fixture
def flowrec(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """The command line in this process: exit status, and the last line on stderr."""

    def typed(*words: object) -> tuple[int, str]:
        status = run(words)
        lines = capsys.readouterr().err.strip().splitlines()
        assert not any("Traceback" in line for line in lines)
        return status, lines[-1] if lines else ""

    return typed


def contents(folder: Path) -> dict[str, bytes | str | None]:
    """Everything in a folder: what is in the files, where links lead."""
    return {
        file.name: str(file.readlink()) if file.is_symlink() else None if file.is_dir() else file.read_bytes()
        for file in folder.iterdir()
    }


def outputs(folder: Path, read: Path, suffix: str) -> Iterator[tuple[str, Path, str]]:
    """Every output that is to be refused: what is wrong with it, its path, and what the refusal must say."""
    yield "same", read, "is read by this command"
    yield "same by another path", folder / ".." / folder.name / read.name, "is read by this command"
    hard, soft = folder / f"hard{suffix}", folder / f"soft{suffix}"
    os.link(read, hard)
    yield "hard link", hard, "is read by this command"
    soft.symlink_to(read)
    yield "symbolic link", soft, "is read by this command"
    existing = folder / f"precious{suffix}"
    existing.write_bytes(b"precious")
    yield "existing", existing, "exists already"
    (folder / f"lost{suffix}").symlink_to(folder / "nowhere")
    yield "link to nothing", folder / f"lost{suffix}", "exists already"
    (folder / f"folder{suffix}").mkdir()
    yield "directory", folder / f"folder{suffix}", "is a directory"
    yield "no suffix", folder / "x", f"name it {folder / 'x'}{suffix}"
    yield "wrong suffix", folder / "g.csv", f"name it {folder / 'g'}{suffix}"
    yield "no folder", folder / "no" / f"x{suffix}", "no such directory"


@pytest.mark.parametrize("verb", VERBS)
def test_an_output_that_is_read_or_there_or_of_another_format_is_refused(verb, folder, flowrec):
    words, name, suffix = VERBS[verb]
    read = folder / name
    for wrong, out, said in outputs(folder, read, suffix):
        before = contents(folder)
        for more in ([], ["--overwrite"]):
            if more and (verb in NEVER_OVERWRITES or wrong in ("existing", "link to nothing")):
                continue
            status, line = flowrec(*words(read), out, *more)
            assert contents(folder) == before, (wrong, more, line)
            assert status == 2 and said in line, (wrong, more, line)


def test_a_replay_replaces_neither_the_session_that_it_comes_from_nor_a_part_of_it(folder, flowrec):
    assert flowrec("replay", folder / "a.mcap", "--out", folder / "r.mcap")[0] == 0
    before = contents(folder)
    assert len([name for name in before if ".part" in name]) > 2
    for session, out in (
        ("r.mcap", "a.mcap"),
        ("parts.mcap", "parts.mcap"),
        ("parts.mcap", "parts.part001.mcap"),
        ("parts.part002.mcap", "parts.mcap"),
    ):
        status, line = flowrec("replay", folder / session, "--out", folder / out, "--overwrite")
        assert contents(folder) == before, (session, out)
        assert status == 2 and "is read by this command" in line


def test_with_overwrite_an_existing_output_is_replaced_whole(folder, flowrec):
    for words, out in (
        (["calibrate", "coils", folder / "coils.csv"], "c.toml"),
        (["export", folder / "a.mcap"], "c.rrd"),
    ):
        (folder / out).write_bytes(b"precious")
        os.link(folder / out, folder / "kept")
        assert flowrec(*words, "--out", folder / out, "--overwrite")[0] == 0
        assert (folder / out).stat().st_size > 100
        assert (folder / "kept").read_bytes() == b"precious"  # the same file by another name
        (folder / "kept").unlink()
    assert not [name for name in contents(folder) if name.startswith(".flowrec-")]


def test_the_rrd_beside_a_session_is_made_anew_only_where_it_was_made_from_that_session(folder, flowrec):
    session, rrd = folder / "a.mcap", folder / "a.rrd"
    assert flowrec("export", session)[0] == 0
    made = rrd.read_bytes()
    assert flowrec("view", session, "--no-open")[0] == 0
    assert rrd.read_bytes() == made
    assert flowrec("export", session)[0] == 0
    assert rrd.read_bytes() != made
    assert flowrec("export", folder / "parts.part001.mcap")[0] == 0
    for foreign in (b"notes of a person", (folder / "parts.part001.rrd").read_bytes()):
        rrd.write_bytes(foreign)
        for words in (["export", session], ["view", session, "--no-open"]):
            status, line = flowrec(*words)
            assert rrd.read_bytes() == foreign
            assert status == 2 and "exists already" in line


def test_a_run_that_can_not_write_its_rrd_does_not_begin(tmp_path, flowrec):
    (tmp_path / "x.rrd").write_bytes(b"precious")
    status, line = flowrec("record", *BRIEF, "--out", tmp_path / "x.mcap", "--view", "rrd")
    assert contents(tmp_path) == {"x.rrd": b"precious"}
    assert status == 2 and "x.rrd: exists already" in line


def is_locked(path: Path) -> bool:
    """Whether another open file holds the exclusive lock."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


@pytest.mark.slow("a real recording in a process of its own")
def test_a_run_onto_a_session_that_another_process_records_is_refused_and_that_one_ends_whole(tmp_path, flowrec):
    out = tmp_path / "x.mcap"
    partial = tmp_path / "x.mcap.partial"
    sets = [word for setting in LONG for word in ("--set", setting)]
    command = [sys.executable, "-m", "flowrec", "record", "--realtime", "--out", str(out), *sets]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as first:
        try:
            until(lambda: partial.exists() and partial.stat().st_size > 500_000)
            said = [
                flowrec("record", *BRIEF, "--out", out, *more)
                for more in (["--overwrite"], ["--overwrite", "--split", "1s"], [])
            ]
            said.append(flowrec("recover", partial, "--out", tmp_path / "y.mcap"))
            (tmp_path / "z.mcap").write_bytes(b"cut off")
            said.append(flowrec("recover", tmp_path / "z.mcap", "--out", out))
        finally:
            first.send_signal(signal.SIGTERM)
    assert first.returncode == 0
    assert sorted(contents(tmp_path)) == ["x.mcap", "z.mcap"]
    with SessionReader(out) as reader:
        assert len(list(reader.ticks())) == int(reader.outcome["ticks"]) > 0
        assert reader.outcome["outcome"] == "stopped"
    assert all(status and "x.mcap" in line and "just now" in line for status, line in said), said


def test_a_second_writer_is_refused_and_the_first_loses_nothing(tmp_path):
    ticks = list(ticks_of(20))
    with SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(block=True)) as first:
        for tick in ticks[:10]:
            first.write(tick)
        for overwrite in (True, False):
            with pytest.raises(SessionError, match=r"x\.mcap"):
                SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(overwrite=overwrite)).close()
        for tick in ticks[10:]:
            first.write(tick)
    assert len(list(SessionReader(tmp_path / "x.mcap").ticks())) == 20


def test_a_file_that_is_written_is_neither_opened_nor_removed_whatever_was_found_before(tmp_path):
    path = tmp_path / "x"
    with open_new(path) as first:
        first.write(b"precious")
        for again in (partial(open_new, path, overwrite=True), partial(remove_idle, path)):
            with pytest.raises(BlockingIOError):
                again()
        assert path.read_bytes() == b"precious" and is_growing(path)
    remove_idle(path)
    assert not path.exists()


def test_a_writer_waits_for_one_who_only_asks_and_then_holds_its_lock(tmp_path):
    partial = tmp_path / "x.mcap.partial"
    partial.write_bytes(b"left from a run")
    asks = partial.open("rb")
    fcntl.flock(asks, fcntl.LOCK_SH)
    threading.Timer(0.2, asks.close).start()
    with open_new(partial, overwrite=True):  # at once: a whole writer may begin later than that on a busy machine
        assert is_locked(partial)
    with SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(overwrite=True)):
        assert is_locked(partial)


@pytest.mark.parametrize("link", [os.link, lambda old, new: new.symlink_to(old)], ids=["hard", "symbolic"])
def test_remains_that_are_a_link_to_another_session_are_replaced_and_the_other_stays(link, tmp_path):
    other = tmp_path / "other.mcap"
    other.write_bytes(b"precious")
    link(other, tmp_path / "x.mcap.partial")
    SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(overwrite=True)).close()
    assert other.read_bytes() == b"precious"
    assert SessionReader(tmp_path / "x.mcap").header == HEADER


@pytest.mark.parametrize("links", [True, False])
def test_a_name_that_was_taken_during_a_run_is_not_replaced_at_its_end(links, tmp_path, monkeypatch):
    if not links:  # as on FAT and some network disks

        def refuse(*_: object, **__: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, "link", refuse)
    SessionWriter(tmp_path / "free.mcap", HEADER).close()
    writer = SessionWriter(tmp_path / "x.mcap", HEADER)
    (tmp_path / "x.mcap").symlink_to(tmp_path / "nowhere")
    with pytest.raises(FlowrecError, match=r"x\.mcap: exists already"):
        writer.close()
    assert sorted(contents(tmp_path)) == ["free.mcap", "x.mcap", "x.mcap.partial"]
    assert (tmp_path / "x.mcap").is_symlink()


def test_what_was_made_of_the_same_run_meanwhile_stays(tmp_path):
    (tmp_path / "x.part001.mcap").write_bytes(b"of an older run")
    with SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(overwrite=True)):
        (tmp_path / "x.part002.mcap").write_bytes(b"of another run")
    assert sorted(contents(tmp_path)) == ["x.mcap", "x.part002.mcap"]


def test_a_file_that_fails_on_its_way_leaves_nothing(folder, flowrec, monkeypatch):
    before = contents(folder)

    def full(_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    status, line = flowrec("calibrate", "coils", folder / "coils.csv", "--out", folder / "c.toml")
    assert status == 1 and "c.toml: " in line
    assert contents(folder) == before
