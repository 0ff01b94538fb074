"""A verb that is stopped says after how much, ends with the status of the signal, and calls nothing identical."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import flowrec
from flowrec.core import Coverage, Progress
from flowrec.run import RunControl
from flowrec.verbs import columns_for_people, replay_segments
from flowrec.verbs.check_run import FileCheck
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.ls import ls
from tests.conftest import HANG_S, run

ROOT = Path(__file__).parents[2]
MODERATE = ROOT / "sessions" / "golden_moderate.mcap"
TICKS = 148


class StoppedAt(Unattended):
    """Stops a replay after a number of ticks."""

    def __init__(self, ticks: int, status: int = 130) -> None:
        super().__init__(RunControl())
        self._ticks, self._status = ticks, status

    def progress(self, what: str, total: float) -> Any:
        control, left = self.run_control, iter(range(self._ticks - 1, -1, -1))

        class Counted(Progress):
            def __enter__(self) -> Counted:
                return self

            def __exit__(self, *_: object) -> None:
                """Nothing was shown."""

            def __call__(self, done: float) -> None:
                if not next(left, 0):
                    control.stop("stopped by SIGTERM", status=status)

        status = self._status
        return Counted()


def test_a_verification_that_is_stopped_is_never_identical(session: Path) -> None:
    ticks = len(list(flowrec.open(session).reader.stamps("applied")))
    done = flowrec.replay(session, verify=True, control=StoppedAt(20, 143))
    found = done.as_json()
    assert (done.same, done.identical, done.exit_status) == (None, None, 143)
    assert (found["same"], found["identical"], found["digest_faults"]) == (None, None, None)
    covered = found["covered"]
    assert (covered["done"], covered["total"], covered["whole"], covered["same"]) == (20, ticks, False, True)
    assert covered["head"] == [] and "/robot/track" in covered["topics"]
    assert done.lines()[-1] == f"stopped after 20 of {ticks} ticks (SIGTERM); those are identical"
    assert not [line for line in done.lines() if "every tick" in line or "consistent" in line]


def test_a_verification_from_the_middle_says_that_it_began_there() -> None:
    done = flowrec.replay(MODERATE, verify=True, from_s=10.0)
    assert done.same and done.exit_status == 0
    found = done.as_json()
    assert found["same"] is None and found["covered"]["same"] and found["covered"]["part"] == "from 10 s on"
    count = done.covered.done
    assert 0 < count == done.covered.total < TICKS
    word = "every tick identical" if found["covered"]["identical"] else "the same within tolerance"
    assert done.lines()[-1] == f"{count:g} of {count:g} ticks from 10 s on: {word}"
    assert f"not looked at: {TICKS - count:g} ticks before 10 s, not asked for" in done.lines()


def test_of_a_stopped_verification_in_segments_those_count_that_were_done(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attended, tasks = Unattended(), list[Future[Any]]()

    class Processes:
        """One does its work before the signal; the others are ended by it, which their tasks state as a failure."""

        def submit(self, work: Any, *arguments: object) -> Future[Any]:
            tasks.append(task := Future())
            task.set_running_or_notify_cancel()
            if len(tasks) == 1:
                task.set_result(work(*arguments))
                attended.run_control.stop("stopped by SIGTERM", status=143)
            return task

    @contextmanager
    def pool(_processes: int) -> Iterator[Processes]:
        try:
            yield Processes()
        finally:
            for task in tasks[1:]:
                task.set_exception(BrokenProcessPool())

    monkeypatch.setattr(replay_segments, "pool", pool)
    monkeypatch.setattr(replay_segments, "_TICKS", 40)
    ticks = len(list(flowrec.open(session).reader.stamps("applied")))
    done = replay_segments.verify(session, jobs=2, control=attended)
    assert len(tasks) > 2 and (done.same, done.exit_status) == (None, 143)
    count = tasks[0].result().comparison.ticks
    assert 0 < count < ticks
    assert done.lines()[-1].startswith(f"stopped after {count} of {ticks} ticks (SIGTERM); those are ")


def test_a_replay_that_is_stopped_says_so_in_its_file_and_where_it_is_listed(tmp_path: Path) -> None:
    out = tmp_path / "r.mcap"
    done = flowrec.replay(MODERATE, refine="gain", out=out, control=StoppedAt(20))
    assert done.exit_status == 130 and done.identical is not True
    facts = flowrec.info(out)
    assert (facts["outcome"], facts["covered"]) == ("stopped", f"20 of {TICKS} ticks")
    assert f"stopped after 20 of {TICKS} ticks (SIGTERM)" in facts["note"]
    assert f"stopped, 20 of {TICKS} ticks" in columns_for_people(ls([out]), 200)[1][0]


# What stops a verb before and in its work, in a process of its own: SCRIPT sends a signal at one place.
SCRIPT = """
import os, signal, sys
from flowrec import __main__ as program
{before}
sys.argv = ["flowrec", *{words!r}]
program.main()
"""
AT_IMPORT = """
class Finder:
    def find_spec(self, name, *_):
        if name == "{module}":
            os.kill(os.getpid(), signal.{name})
sys.meta_path.insert(0, Finder())
"""
AT_PROGRESS = """
from flowrec.core import terminal
calls = iter(range(1000))
def told(self, done, plain=terminal.Progress.__call__):
    plain(self, done)
    if next(calls) == {count}:
        os.kill(os.getpid(), signal.{name})
terminal.Progress.__call__ = told
"""


def stopped(words: list[object], before: str, limit_s: float | None = None) -> subprocess.CompletedProcess[str]:
    """A verb in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", SCRIPT.format(before=before, words=[str(word) for word in words])],
        check=False,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        capture_output=True,
        text=True,
        timeout=limit_s,
    )


@pytest.mark.parametrize(
    ("verb", "module", "name", "status"),
    [("check", "typer", "SIGINT", 130), ("view", "rerun", "SIGTERM", 143), ("report", "numpy", "SIGINT", 130)],
)
def test_a_signal_during_imports_is_one_line(verb: str, module: str, name: str, status: int) -> None:
    done = stopped([verb, MODERATE], AT_IMPORT.format(module=module, name=name))
    assert done.returncode == status
    assert done.stderr.startswith("flowrec: stopped (SIG") and done.stderr.count("\n") == 1, done.stderr
    assert done.stdout == ""


def test_a_verb_that_is_stopped_does_not_wait_for_its_threads() -> None:
    """As for one that asks a server which does not answer."""
    waits = (
        "from concurrent.futures import ThreadPoolExecutor; ThreadPoolExecutor(1).submit(__import__('time').sleep, 600)"
    )
    done = stopped(["report", MODERATE], waits + AT_IMPORT.format(module="numpy", name="SIGINT"), HANG_S)
    assert done.returncode == 130 and done.stderr.startswith("flowrec: stopped (SIGINT"), done.stderr


@pytest.mark.slow("stops two verbs in processes of their own")
def test_a_check_and_an_export_that_are_stopped_say_after_how_much(tmp_path: Path) -> None:
    done = stopped(["check", MODERATE, "--json"], AT_PROGRESS.format(count=8, name="SIGINT"))
    found = json.loads(done.stdout)
    assert (done.returncode, found["verdict"], found["covered"]["whole"]) == (130, "stopped", False)
    words = ["export", MODERATE, tmp_path / "tables", "--format", "csv", "--json"]
    done = stopped(words, AT_PROGRESS.format(count=1, name="SIGTERM"))
    assert done.returncode == 143 and list(tmp_path.iterdir()) == []
    assert "of 12.2 s (SIG" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert json.loads(done.stdout)["covered"]["whole"] is False


@pytest.mark.parametrize("verb", ["check", "report"])
def test_a_verb_that_is_stopped_in_a_part_of_it_is_stopped_and_leaves_nothing(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A report begins with a check, whose verdict so far is no report."""

    def stopped(_self: FileCheck) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FileCheck, "read", stopped)
    monkeypatch.chdir(tmp_path)
    assert run([verb, MODERATE]) == 130
    told = "".join(capsys.readouterr())
    assert "stopped" in told, told
    assert not list(tmp_path.iterdir())


def test_what_is_covered_is_never_said_of_more() -> None:
    some = Coverage(47, 1934, stopped="SIGINT: Ctrl-C")
    assert some.sentence("identical") == "stopped after 47 of 1934 ticks (SIGINT: Ctrl-C); those are identical"
    none = Coverage(0, 1934, stopped="SIGTERM", status=143)
    assert "identical" not in none.sentence("identical") and not none.whole
    assert Coverage(1934, 1934).whole
    assert not Coverage(1933, 1934).whole and not Coverage(9, 9, part="from 1 s on").whole
