"""Importing flowrec, reading, replaying and exporting need no module that only POSIX systems have."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parents[1] / "sessions" / "golden.mcap"
WITHOUT_POSIX = """
import sys
sys.modules |= dict.fromkeys(sys.argv.pop(1).split(","))
from flowrec.cli import main
main()
"""


def flowrec_without(modules: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a verb in an interpreter in which importing any of these modules fails."""
    command = [sys.executable, "-c", WITHOUT_POSIX, modules, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("words", "output", "status"),
    [
        (["--version"], "flowrec ", 0),
        (["info", GOLDEN], "reached", 0),
        (["check", GOLDEN], "golden.mcap: GOOD", 0),
        (["ls", GOLDEN.parent], "golden.mcap", 0),
        (["compare", GOLDEN, GOLDEN], "identical", 0),
        (["replay", GOLDEN, "--verify"], "by other numerics", 3),
    ],
)
def test_a_verb_that_reads_needs_no_posix_module(words: list[object], output: str, status: int) -> None:
    done = flowrec_without("fcntl,termios,tty,resource", *words)
    assert done.returncode == status, done.stderr
    assert output in done.stdout


def test_an_rrd_is_exported_without_a_posix_module(tmp_path: Path) -> None:
    # Rerun imports psutil, which needs `resource` on Linux and not on Windows.
    done = flowrec_without("fcntl,termios,tty", "export", GOLDEN, "--out", tmp_path / "golden.rrd")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "golden.rrd").stat().st_size > 100_000


def test_every_lock_is_granted_where_there_are_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from flowrec.system import locks

    with locks.open_new(tmp_path / "a") as file:
        assert locks.is_growing(tmp_path / "a")
        monkeypatch.setattr(locks, "HAS_LOCKS", False)
        assert not locks.is_growing(tmp_path / "a")
        assert locks.try_lock(file.fileno(), exclusive=True)


def test_a_session_is_read_by_several_threads_where_there_is_no_pread(monkeypatch: pytest.MonkeyPatch) -> None:
    from concurrent.futures import ThreadPoolExecutor

    from flowrec.store import byte_source

    monkeypatch.setattr(byte_source.sys, "platform", "win32")
    monkeypatch.delattr(byte_source.os, "pread")
    data = GOLDEN.read_bytes()
    source = byte_source.open_bytes(GOLDEN)
    offsets = [(number * 7919) % (len(data) - 64) for number in range(20_000)]
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda offset: source.read(offset, 64), offsets, chunksize=50))
    assert found == [data[offset : offset + 64] for offset in offsets]
