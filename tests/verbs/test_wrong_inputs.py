"""What a newcomer names by mistake: the line says what it is, and what reads it; nothing is left, nothing is begun."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

import flowrec
from flowrec.core import UsageError
from flowrec.store.session_path import session_path
from flowrec.verbs import align
from tests.verbs.test_cli import flowrec as command
from tests.verbs.test_cli import one_line_error

ROOT = Path(__file__).parents[2]
SESSIONS = ROOT / "sessions"
GOLDEN = SESSIONS / "golden.mcap"
MOVIE, LAB = SESSIONS / "movie" / "robot.mp4", SESSIONS / "movie" / "lab.toml"


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["info", MOVIE], 1, "flowrec import"),
        (["check", "a.rrd"], 1, "flowrec view"),
        (["view", "a.rrd"], 1, "is no recording of Rerun"),  # its viewer would be waited for
        (["record", MOVIE], 2, "flowrec import"),
        (["import", MOVIE, SESSIONS / "coils.csv"], 2, "--coils"),
        (["record", "latin.toml"], 2, "UTF-8"),
        (["record", "long.toml"], 2, "bytes, more than"),
        (["import", MOVIE], 2, "flowrec init"),
        (["import", MOVIE, LAB, "--coils", "no.csv"], 2, "no.csv: no such file"),
        (["export", GOLDEN, "a.avi"], 2, "say which with --format"),
        (["view", GOLDEN, "--time", "3"], 2, "--screenshot"),
        (["view", GOLDEN, "--time", "99", "--screenshot", "a.png"], 2, "runs from 0 s to 7.06667 s"),
        (["cut", GOLDEN, "--from", "5", "--to", "2"], 2, "the end is before the begin"),
        (["info", "ftp://host/a.mcap"], 2, "ftp://"),
        (["new", "plugin", "numpy"], 2, "installed package"),
        (["record", "--out", "a.rrd/a.mcap"], 2, "is a file, not a directory"),
        (["record", "--set", "=3"], 2, "expected key=value"),
        (["record", "--set", "robot.radius_um=5um"], 2, "without its unit"),
        (["info", "a" * 300 + ".mcap"], 1, "name too long"),
    ],
)
def test_what_is_taken_for_something_else_is_told_in_one_line_and_leaves_nothing(
    words: list[object], status: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.rrd").write_text("text")
    Path("latin.toml").write_bytes(b"[camera]\nrate_hz = 30 # caf\xe9\n")
    Path("long.toml").write_bytes(b" " * 3_000_000)
    done = command(*words)
    one_line_error(done, status)
    assert said.lower() in done.stderr.lower() and done.stderr.count("\n") == 1, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"a.rrd", "latin.toml", "long.toml"}


def test_a_name_that_is_like_none_is_answered_with_the_names_alone() -> None:
    like = command("replay", GOLDEN, "--controller", "polcy")
    unlike = command("replay", GOLDEN, "--controller", "qqqq")
    assert "the nearest is policy" in like.stderr
    assert "must be one of vector" in unlike.stderr and "nearest" not in unlike.stderr
    twice = command("compare", GOLDEN, GOLDEN, "--only", "/robot/trak")
    assert twice.stderr.count("/robot/track") == 1, twice.stderr


@pytest.mark.parametrize("time_s", [math.nan, math.inf, -1.0])
def test_a_time_that_no_session_has_is_refused_in_python_too(time_s: float) -> None:
    with pytest.raises(UsageError, match="runs from 0 s to"):
        flowrec.open(GOLDEN).stamp_ns(time_s)


def test_a_folder_with_a_colon_is_no_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run:").mkdir()
    assert session_path("run:/a.mcap") == Path("run:/a.mcap")


def test_an_import_whose_output_is_taken_does_not_look_through_the_movie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def looked(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(align, "fit_import", looked)
    (taken := tmp_path / "a.mcap").write_text("mine")
    one_line_error(command("import", MOVIE, LAB, "--out", taken), 2, "exists already")
    assert taken.read_text() == "mine"


@pytest.mark.skipif(sys.platform == "win32", reason="shells of POSIX")
@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_a_verb_works_with_closed_standard_streams(closed: str) -> None:
    words = f"exec {sys.executable} -m flowrec info {GOLDEN} {closed}"
    done = subprocess.run(["bash", "-c", words], cwd=ROOT, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_output_that_can_not_be_written_is_one_line() -> None:
    words = f"{sys.executable} -m flowrec new --help && {sys.executable} -m flowrec info {GOLDEN} > /dev/full"
    done = subprocess.run(["bash", "-c", words], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and "No space left" in done.stderr, done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="a limit of POSIX")
def test_a_cut_that_the_disk_refuses_leaves_nothing_and_promises_nothing(tmp_path: Path) -> None:
    words = f"ulimit -f 100; exec {sys.executable} -m flowrec cut {GOLDEN} --to 5 -o {tmp_path / 'a.mcap'}"
    done = subprocess.run(["bash", "-c", words], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 1 and not list(tmp_path.iterdir())
    assert "nothing is left" in done.stderr and "recover" not in done.stderr, done.stderr
