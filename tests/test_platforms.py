"""Importing flowrec, reading, replaying and exporting need no module that only POSIX systems have."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parents[1] / "sessions" / "golden.mcap"
WITHOUT_POSIX = """
import contextlib, io, json, sys
modules, commands = map(json.loads, sys.argv[1:])
sys.modules |= dict.fromkeys(modules)
from flowrec.verbs.cli import main
for words in commands:
    if words[0] == "export":  # Rerun imports psutil, which needs `resource` on Linux and not on Windows
        del sys.modules["resource"]
    sys.argv, said = ["flowrec", *words], io.StringIO()
    with contextlib.redirect_stdout(said):
        try:
            main()
        except SystemExit as end:
            status = end.code or 0
    print(json.dumps([status, said.getvalue()]))
"""


@pytest.mark.slow("every verb that reads, with the libraries of each, in a process of its own")
def test_a_verb_that_reads_needs_no_posix_module(tmp_path: Path) -> None:
    exported = tmp_path / "golden.rrd"
    cases: list[tuple[list[object], str, int]] = [
        (["--version"], "flowrec ", 0),
        (["info", GOLDEN], "reached", 0),
        (["check", GOLDEN], "golden.mcap: GOOD", 0),
        (["ls", GOLDEN.parent], "golden.mcap", 0),
        (["compare", GOLDEN, GOLDEN], "identical", 0),
        (["replay", GOLDEN, "--verify"], "by other numerics", 3),
        (["export", GOLDEN, "--out", exported], "", 0),
    ]
    modules = json.dumps(["fcntl", "termios", "tty", "resource"])
    commands = json.dumps([[str(word) for word in words] for words, _, _ in cases])
    command = [sys.executable, "-c", WITHOUT_POSIX, modules, commands]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(cases), done.stderr
    for (words, output, status), (ended, said) in zip(cases, answers, strict=True):
        assert (ended, output in said) == (status, True), (words, said, done.stderr)
    assert exported.stat().st_size > 100_000


def test_every_lock_is_granted_where_there_are_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from flowrec.core.system import locks

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
