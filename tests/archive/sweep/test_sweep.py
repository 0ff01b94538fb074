"""`flowrec sweep`: every task once, whatever dies meanwhile; what fails is named, and nothing is overwritten."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import flowrec
from tests.extras import why

pytest.importorskip("dask", reason=why("dask"))
from flowrec.archive.sweep import cluster, replay_process
from flowrec.archive.sweep import sweep as sweep_module
from flowrec.archive.sweep.ranking import ASSUMED, RECORDED, Ranking
from flowrec.archive.sweep.replay_process import replay_task
from flowrec.archive.sweep.results import Results, read_rows
from flowrec.archive.sweep.tasks import Sessions, Task, change_of, combinations, content_of, session_files
from flowrec.core import FlowrecError, OutputError, UsageError
from flowrec.verbs import refinement_remarks
from tests.archive.sweep.rows import row_of
from tests.conftest import invoke
from tests.store.made_up import HEADER, ticks_of, write_session

GRID = ["refine=fvm,gain"]


def made_up_session(path: Path, ticks: int, **header: Any) -> Path:
    return write_session(path, ticks_of(ticks, shape=(8, 8)), replace(HEADER, **header), outcome={"outcome": "reached"})


# --- what is swept


def test_a_grid_is_every_combination_and_a_comma_in_brackets_belongs_to_its_value() -> None:
    found = combinations(["refine=fvm,gain", "mission.goal=[1,2],outlet"], ["observer=kalman"])
    assert len(found) == 4
    assert found[0] == (("refine", "fvm"), ("mission.goal", "[1,2]"), ("observer", "kalman"))
    change = change_of(found[-1])
    assert (change.refine, change.observer, change.sets) == ("gain", "kalman", {"mission.goal": "outlet"})


def test_copies_are_named_and_replayed_once_and_replays_and_half_files_are_passed_over(tmp_path: Path) -> None:
    first = made_up_session(tmp_path / "a.mcap", 5)
    shutil.copy(first, tmp_path / "b.mcap")
    made_up_session(tmp_path / "c.mcap", 6)
    made_up_session(tmp_path / "d.mcap", 7, parent={"file": "a.mcap", "sha256": "0"})
    (tmp_path / "e.mcap").write_bytes(first.read_bytes()[:-50])
    files = session_files([str(tmp_path), str(tmp_path / "*.mcap")])
    assert [file.name for file in files] == ["a.mcap", "b.mcap", "c.mcap", "d.mcap", "e.mcap"]
    sessions = Sessions.of(files)
    assert [path.name for path in sessions.by_content.values()] == ["a.mcap", "c.mcap"]
    assert sessions.unreadable == 1
    copy, derived, half = sessions.left_out
    assert "b.mcap" in copy and "a.mcap" in copy
    assert "d.mcap: is a replay" in derived
    assert "e.mcap" in half


def test_a_task_is_known_by_content_settings_and_version_and_by_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    task = Task("a.mcap", "c", (("refine", "fvm"), ("plan", "rrt")))
    same = Task("elsewhere/b.mcap", "c", task.settings[::-1], timeout_s=1.0, judge=True)
    assert same.key == task.key
    others = [replace(task, content="d"), replace(task, settings=(("refine", "fvm"),)), replace(task, refly=True)]
    others += [replace(task, packages=state) for state in ("kit 1.0 ab", "kit 1.0 cd")]
    assert len({task.key, *(other.key for other in others)}) == 6
    monkeypatch.setattr("flowrec.archive.sweep.tasks.NUMERICS_VERSION", 99)
    assert replace(task, refly=False).key != task.key


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none/*.mcap", "--grid", "refine=fvm"], "no session (.mcap) is there"),
        (["SESSION", "--grid", "refine=nosuch"], "nosuch"),
        (["SESSION", "--grid", "refin=fvm"], "unknown key refin"),
        (["SESSION", "--grid", "chip.um_per_px=2,3"], "can not change the chip of a recording"),
        (["SESSION", "--grid", "rig=lab"], "can not change the rig of a recording"),
        (["SESSION", "--grid", "refine=fvm", "--set", "refine=gain"], "refine is named twice"),
        (["SESSION", "--grid", "refine"], "expected key=value"),
        (["SESSION", "--grid", "refine=fvm", "-o", "out.csv"], "must end in .parquet"),
        (["SESSION", "--grid", "refine=fvm", "-o", "nosuch/out.parquet"], "no such directory"),
        (["SESSION", "--grid", "refine=fvm", "-o", "foreign.parquet"], "was not written by flowrec sweep"),
        (["SESSION", "--grid", "refine=fvm", "-o", "text.parquet"], "can not be read as Parquet"),
        (["SESSION", "--grid", "refine=fvm", "-o", "other.parquet"], "holds a sweep of other sessions"),
    ],
)
def test_what_can_not_be_swept_is_told_before_any_replay(
    words: list[str], said: str, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep_module, "workers_of", None)  # nothing may start
    pq.write_table(pa.table({"a": [1]}), "foreign.parquet")
    Path("text.parquet").write_text("no table")
    with Results.open_locked(Path("other.parquet"), [], ["c"]) as results:
        results.put(row_of("c", 0.1, refine="fvm"))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    words = [str(session) if word == "SESSION" else word for word in words]
    done = invoke("sweep", *(words if "-o" in words else [*words, "-o", "out.parquet"]))
    assert isinstance(done.exception, FlowrecError), done.output
    assert done.exception.exit_status in (1, 2)
    assert said in str(done.exception)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


# --- the process that replays


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Replay processes without stages, which do what the name of a session says."""
    lines = [
        "import os, pathlib, sys",
        "if 'flowrec.archive.sweep.replay_process' not in sys.orig_argv: raise ImportError",
        f"killed = pathlib.Path({str(tmp_path / 'killed')!r})",
        "def row(task):",
        "    what = task.session",
        "    while what == 'hang': pass",
        "    eaten = []",
        "    while what == 'eat' and len(eaten) < 50: eaten.append(bytearray(b'x' * 20_000_000))",
        "    if what == 'bomb': os.write(2, b'boom'); os.kill(os.getpid(), 9)",
        "    if what == 'orphan' and not killed.exists(): killed.touch(); os.kill(os.getppid(), 9)",
        "    if what == 'once' and not killed.exists(): killed.touch(); os.kill(os.getpid(), 9)",
        "    return {'key': task.key, 'session': what, 'pid': os.getpid()}",
        "def ready():",
        f"    at_start = pathlib.Path({str(tmp_path / 'at_start')!r})",
        "    if at_start.exists(): at_start.unlink(); os.kill(os.getpid(), 9)",
        "    sys.modules['__main__']._row = row",
        "import flowrec.stages, flowrec.verbs",
        "vars(flowrec.stages).update(warm_up=ready)",
        "vars(flowrec.verbs).update(FIXED=(), Change=None, refly=None)",
    ]
    (tmp_path / "sitecustomize.py").write_text("\n".join(lines))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(replay_process, "_of_thread", type("Thread", (), {})())
    yield
    process = getattr(replay_process._of_thread, "process", None)
    if process is not None:
        process._end()


@pytest.mark.slow("waits for processes that hang")
def test_what_hangs_eats_memory_or_kills_its_process_is_named_and_the_rest_is_done(
    planted: None, tmp_path: Path
) -> None:
    good = Task("good", "c", ())
    (tmp_path / "at_start").touch()
    pid = replay_task(good)["pid"]  # of the second process; the first was killed before it was ready
    assert not (tmp_path / "at_start").exists()
    assert replay_task(good)["pid"] == pid  # warm
    assert "0.3 s" in replay_task(Task("hang", "c", (), timeout_s=0.3))["error"]
    eaten = replay_task(Task("eat", "c", ()), memory_bytes=300_000_000)
    assert "0.3 GB" in eaten["error"]
    assert eaten["peak_memory_bytes"] > 300_000_000
    assert "error" not in replay_task(Task("once", "c", ()))  # tried again
    bombed = replay_task(Task("bomb", "c", (("refine", "fvm"),)))
    assert "2 processes" in bombed["error"] and "SIGKILL: boom" in bombed["error"]
    assert (bombed["session"], bombed["settings"]) == ("bomb", {"refine": "fvm"})
    assert replay_task(good)["pid"] not in (pid, os.getpid())


# --- results


def test_what_a_killed_sweep_has_left_is_taken_over_but_for_half_a_row(tmp_path: Path) -> None:
    out = tmp_path / "out.parquet"
    first, second = row_of("c", 0.1, refine="fvm"), row_of("d", 0.2, refine="fvm", plan="rrt") | {"verdict": None}
    with Results.open_locked(out, [], ["c"]) as results:
        results.put(first)
    folder = tmp_path / "out.parquet.tasks"
    assert not folder.exists()
    folder.mkdir()
    (folder / f"{second['key']}.json").write_text(json.dumps(second))
    (folder / "torn.json").write_text('{"key": "to')
    with Results.open_locked(out, [], ["d"]) as results:
        assert results.failed == {first["key"]: False, second["key"]: False}
        assert results.judged == {"c"}
        results.put(row_of("d", refine="gain", plan="rrt") | {"error": "why"})
        with pytest.raises(OutputError, match="another sweep"), Results.open_locked(out, [], ["d"]):
            pass
    # The order of rows is that of their keys, which contain the version of the numerics.
    rows = sorted(read_rows(out), key=lambda row: (len(row["settings"]), row["settings"]["refine"]))
    assert [row["settings"] for row in rows] == [
        {"refine": "fvm"},
        {"refine": "fvm", "plan": "rrt"},
        {"refine": "gain", "plan": "rrt"},
    ]
    assert rows[0]["figures"] == first["figures"]
    assert [row["verdict"] for row in rows] == ["good"] * 3  # of the session, whichever task has checked it
    assert rows[2]["error"] == "why"
    assert [path.name for path in tmp_path.iterdir()] == ["out.parquet"]


def test_settings_are_ranked_over_the_sessions_that_all_have_and_differences_are_paired() -> None:
    rng = np.random.default_rng(0)
    hard = rng.uniform(0.1, 0.9, 12)  # sessions differ more than settings
    good, poor = hard + rng.normal(0.0, 0.01, 12), hard + rng.normal(0.05, 0.01, 12)
    rows = [row_of(f"{n}", float(value), refine="poor") for n, value in enumerate(poor)]
    rows += [row_of(f"{n}", float(value), refine="good") for n, value in enumerate(good)]
    rows += [row_of("0", None, refine="broken") | {"error": "why"}]
    rows[3] = row_of("3", None, refine="poor")  # so no setting is judged by session 3
    ranking = Ranking.of(rows)
    assert (ranking.sessions, ranking.of_sessions, ranking.figure) == (11, 12, "refined_flow_error")
    by_name = {each.settings: each for each in ranking.rows}
    assert {RECORDED, ASSUMED} < by_name.keys()
    assert [each.settings for each in ranking.rows if "refine" in each.settings] == [
        "refine=good",
        "refine=poor",
        "refine=broken",
    ]
    kept = np.arange(12) != 3
    best = by_name[ranking.rows[0].settings]
    from scipy.stats import ttest_rel

    reference = ttest_rel(poor[kept], best.values).confidence_interval(0.95)
    assert by_name["refine=poor"].interval == pytest.approx((reference.low, reference.high))
    assert by_name["refine=poor"].difference == pytest.approx(float(np.mean(poor[kept] - best.values)))
    assert (by_name["refine=broken"].failed, by_name["refine=broken"].cpu_s) == (
        1,
        None,
    )  # that is of tasks that were done
    with pytest.raises(UsageError, match="assumed_flow_error"):
        Ranking.of(rows, "map")


# --- the whole


def test_ctrl_c_keeps_what_is_done_and_a_second_call_does_the_rest(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[Task] = []

    def interrupted(_client: object, tasks: Iterator[Task], *, local: bool) -> Iterator[dict[str, Any]]:
        for number, task in enumerate(tasks):
            if number == stop_at:
                raise KeyboardInterrupt
            done.append(task)
            yield row_of(task.content, 0.1, **dict(task.settings)) | {"key": task.key}

    monkeypatch.setattr(sweep_module, "workers_of", lambda *_: nullcontext())
    monkeypatch.setattr(sweep_module, "rows_of", interrupted)
    out = tmp_path / "out.parquet"
    words = ["sweep", str(session), "--grid", GRID[0], "-o", str(out), "--json"]
    stop_at = 1
    assert invoke(*words).exit_code == 130
    assert len(read_rows(out)) == 1
    stop_at = 2
    said = json.loads(invoke(*words).stdout)
    assert (said["tasks"], said["computed"], said["passed_over"]) == (2, 1, 1)
    assert json.loads(invoke(*words).stdout)["computed"] == 0
    assert [dict(task.settings)["refine"] for task in done] == ["fvm", "gain"]
    assert [task.judge for task in done] == [True, False]


def test_each_task_is_done_once_though_a_worker_is_killed_with_it(planted: None) -> None:
    tasks = [Task(name, "c", ()) for name in ("a", "orphan", "b")]
    with cluster.workers_of(None, 1) as client:
        assert client.scheduler.address.startswith("tls://127.0.0.1:")
        rows = list(cluster.rows_of(client, tasks, local=True))
    assert [row["key"] for row in rows] == [task.key for task in tasks]
    first, orphan, _ = (row["pid"] for row in rows)
    assert first != orphan  # the process of the worker that was killed went with it


def test_workers_that_are_killed_before_they_are_ready_are_started_again_but_not_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def starts_at(number: int) -> Callable[..., str]:
        tries = iter(range(1, number + 1))

        def start(**_: object) -> str:
            if next(tries) < number:
                raise RuntimeError("Nanny failed to start.")
            return "cluster"

        return start

    monkeypatch.setattr(cluster.distributed, "LocalCluster", starts_at(3))
    assert cluster._local_cluster(2) == "cluster"
    monkeypatch.setattr(cluster.distributed, "LocalCluster", starts_at(5))
    with pytest.raises(FlowrecError, match="2 workers"):
        cluster._local_cluster(2)


@pytest.mark.slow("replays a session in a process of its own and beside it")
def test_a_row_is_what_flowrec_replay_and_check_say(session: Path) -> None:
    content = content_of(flowrec.open(session))
    task = Task(str(session), content, (("refine", "gain"), ("robot.um_per_rev", "24")), judge=True)
    row = replay_process._row(task)
    done = flowrec.replay(session, refine="gain", sets={"robot.um_per_rev": 24})
    assert row["figures"] == {key: [was, now] for key, was, now in done.before_after}
    assert (row["key"], row["ticks"], row["duration_s"]) == (task.key, done.report.ticks, done.report.duration_s)
    assert row["refinement"] == refinement_remarks(done)
    assert row["verdict"] == flowrec.check(session).word
    assert row["cpu_s"] > 0.0 and row["peak_memory_bytes"] > 1e7
    assert "was changed" in replay_process._row(replace(task, content="other"))["error"]


def test_the_page_of_a_sweep_shows_the_ranking_and_what_has_failed(tmp_path: Path) -> None:
    out = tmp_path / "out.parquet"
    with Results.open_locked(out, [], []) as results:
        for content, good, poor in (("a", 0.1, 0.2), ("b", 0.3, 0.35)):
            results.put(row_of(content, good, refine="<gain>"))
            results.put(row_of(content, poor, refine="fvm"))
        results.put(row_of("c", refine="fvm") | {"error": "it <hangs>"})
    assert invoke("report", out).exit_code == 0
    html = out.with_name("out_report.html").read_text(encoding="utf-8")
    assert html.index("refine=&lt;gain&gt;, refined flow error 20.0 %") < html.index("refine=fvm, 7.5 % more")
    assert "it &lt;hangs&gt;" in html and 'class="wide"' in html
    assert "<gain>" not in html


def test_a_scheduler_that_is_not_there_or_of_another_version_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.3)
    with (
        pytest.raises(FlowrecError, match="tcp://127") as told,
        cluster.workers_of("tcp://127.0.0.1:1", None),
    ):
        pass
    assert told.value.exit_status == 1
    with pytest.raises(UsageError), cluster.workers_of("nosuch://127.0.0.1:1", None):
        pass

    async def old(_scheduler: str) -> dict[str, str]:
        return {"distributed": "2021.1.0"}

    monkeypatch.setattr(cluster, "_versions_of", old)
    with pytest.raises(FlowrecError, match=r"distributed 2021\.1\.0"), cluster.workers_of("tcp://127.0.0.1:1", None):
        pass
