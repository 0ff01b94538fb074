"""`python -m tests.perf.stopped_verbs`: each long verb, stopped by a signal during its imports and during its work.

A row a verb, signal and moment: exit status, the sentence, and what is left. The moments are shares of the CPU time
that the verb and its processes take when nothing stops it, so a busy machine does not move them. What may be left is a
session that says that it was stopped, and the rows of a sweep; no process, no temporary file.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import psutil  # type: ignore[import-untyped]
import typer

from flowrec.bench.flow import make_up
from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import progress
from flowrec.store import SessionMetadata

ROOT = Path(__file__).parents[2]
SIGNALS = (signal.SIGINT, signal.SIGTERM)
SHARES = (0.1, 0.5, 0.9)
IMPORTS = (0.3, 0.7)  # shares of the CPU time of imports
_MARK = "FLOWREC_STOPPED_VERB"  # in the environment of all processes of a trial
_END_S = 120.0
_POLL_S = 0.005
_GONE_S = 10.0  # for processes of other sessions to end after their parent


@dataclass(frozen=True)
class Verb:
    """A verb as it is typed: `{a}`, `{b}` are sessions, `{cases}` is a folder with a vessel case, `{out}` an empty one.

    Attributes
    ----------
    imports : modules whose import is the beginning of its work.
    kept : names of files that may be left.
    """

    words: str
    imports: str
    kept: tuple[str, ...] = ()


VERBS = {
    "verify": Verb("replay {a} --verify", "flowrec.verbs.session_replay"),
    "verify, 2 jobs": Verb("replay {a} --verify --jobs 2", "flowrec.verbs.replay_segments"),
    "refine": Verb("replay {a} --refine gain -o {out}/r.mcap", "flowrec.verbs.replay_made", ("r.mcap",)),
    "refly": Verb(
        "replay {a} --refine gain --refly -o {out}/r.mcap", "flowrec.verbs.replay_made", ("r.mcap", "r_refly.mcap")
    ),
    "check": Verb("check {a}", "flowrec.verbs.check_run"),
    "compare": Verb("compare {a} {b}", "flowrec.verbs.session_comparison"),
    "import": Verb(
        "import sessions/movie/robot.mp4 sessions/movie/lab.toml --coils sessions/movie/coils.csv -o {out}/i.mcap",
        "flowrec.verbs.align",
        ("i.mcap",),
    ),
    "calibrate motion": Verb("calibrate motion {a} -o {out}/m.toml", "flowrec.measure.calibrate_motion"),
    "calibrate coils": Verb("calibrate coils sessions/coils.csv -o {out}/c.toml", "flowrec.measure.calibrate_coils"),
    "calibrate image": Verb(
        "calibrate image {a} sessions/golden_moderate.toml -o {out}/i.toml", "flowrec.measure.calibrate_image"
    ),
    "calibrate chip": Verb(
        "calibrate chip sessions/upstream.png --um-per-px 5 -o {out}/c.toml", "flowrec.measure.calibrate_chip"
    ),
    "export": Verb("export {a} -o {out}/a.rrd", "flowrec.exports.export"),
    "export tables": Verb("export {a} {out}/tables --format csv", "flowrec.exports.export"),
    "sweep": Verb(
        "sweep {a} --grid refine=gain,fvm --workers 1 -o {out}/s.parquet", "flowrec.archive.sweep.sweep", ("s.parquet",)
    ),
    "bench flow": Verb(
        "bench flow --cases {cases} --methods gain --fields {out}/fields --out {out}/b.json",
        "flowrec.bench.flow",
        ("fields", "fields/made_up_00.gain.npz"),
    ),
    "bench survey": Verb("bench survey --cases {cases} --draws 1 --out {out}/b.json", "flowrec.bench.survey"),
    "bench plan": Verb("bench plan --trips 2 --quick --out {out}/b.json", "flowrec.bench.plan"),
    "bench observer": Verb("bench observer --session {a} --out {out}/b.json", "flowrec.bench.observer"),
    "bench track": Verb("bench track --seeds 1 --out {out}/b.json", "flowrec.bench.track"),
    "bench missions": Verb(
        "bench missions --seeds 1 --policies policy,plain --worlds kind --jobs 2 --out {out}/b.json",
        "flowrec.bench.missions",
    ),
    "bench worlds": Verb(
        "bench worlds --worlds kind --chips straight --seeds 2 --methods gain --rows {out}/rows --out {out}/b.json",
        "flowrec.bench.worlds",
        ("rows",),
    ),
    "bench solver": Verb("bench solver --quick --out {out}/b.json", "flowrec.bench.solver"),
    "bench loop": Verb("bench loop --ticks 30 --out {out}/b.json", "flowrec.bench.loop"),
    "report": Verb("report {a} -o {out}/r.html", "flowrec.verbs.report_page"),
    "view": Verb("view {a} --no-open -o {out}/v.rrd", "flowrec.exports.export"),
}


@dataclass
class Trial:
    """How a verb ended."""

    status: int
    cpu_s: float
    stopped: bool  # before it had ended by itself
    said: str
    left: list[str]
    processes: int


def trial(words: list[str], folder: Path, number: int | None = None, at_cpu_s: float = 0.0) -> Trial:
    """Run a verb in a folder; send it a signal once it and its processes have used so much CPU time."""
    mark = uuid.uuid4().hex
    before = set(folder.rglob("*"))
    process = subprocess.Popen(
        [sys.executable, "-m", "flowrec", *words],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), _MARK: mark},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
    )
    cpu_s, sent = 0.0, False
    end_s = time.monotonic() + _END_S
    try:
        while process.poll() is None and time.monotonic() < end_s:
            cpu_s = max(cpu_s, _cpu_s(process.pid))
            if number is not None and cpu_s >= at_cpu_s and not sent:
                process.send_signal(number)
                sent, end_s = True, time.monotonic() + _END_S
            time.sleep(_POLL_S)
    finally:
        if process.poll() is None:
            process.kill()
    said = process.communicate()[0]
    return Trial(process.returncode, cpu_s, sent, said, _left(folder, before), _processes_left(mark))


def _sentence(said: str) -> str:
    """The line that says that the verb was stopped; '' without one."""
    return next((line for line in said.splitlines() if "stopped (" in line or "stopped after" in line), "")


def _cpu_s(pid: int) -> float:
    total = 0.0
    with suppress(psutil.Error):
        of = psutil.Process(pid)
        for each in (of, *of.children(recursive=True)):
            with suppress(psutil.Error):
                times = each.cpu_times()
                total += times.user + times.system
    return total


def _left(folder: Path, before: set[Path]) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in set(folder.rglob("*")) - before)


def _processes_left(mark: str) -> int:
    """Processes of a trial that live on; those that watch their parent are given a while."""
    end_s = time.monotonic() + _GONE_S
    while True:
        count = sum(_has(process, mark) for process in psutil.process_iter())
        if not count or time.monotonic() > end_s:
            return count
        time.sleep(0.2)


def _has(process: Any, mark: str) -> bool:
    with suppress(psutil.Error):
        return process.environ().get(_MARK) == mark and process.status() != psutil.STATUS_ZOMBIE
    return False


def faults(verb: Verb, ended: Trial, number: int, folder: Path) -> list[str]:
    """What a stopped verb should not have done."""
    found = []
    if ended.status != 128 + number:
        found.append(f"status {ended.status}")
    if "Traceback" in ended.said:
        found.append("a traceback")
    if not _sentence(ended.said):
        found.append("does not say that it was stopped")
    for name in ended.left:
        if name not in verb.kept:
            found.append(f"leaves {name}")
        elif name.endswith(".mcap"):
            with SessionMetadata(folder / name) as file:
                outcome = file.outcome.get("outcome")
            if outcome != "stopped" and name != "r.mcap":  # a replay is whole before it is flown
                found.append(f"{name} says {outcome}")
    if ended.processes:
        found.append(f"{ended.processes} processes live on")
    return found


def measure(
    session: Annotated[Path, typer.Option(help="A small session.")] = ROOT / "sessions" / "golden_moderate.mcap",
    only: Annotated[list[str] | None, typer.Option(metavar="VERB", help="Only this verb; may be repeated.")] = None,
    share: Annotated[
        list[float] | None, typer.Option(help="Only after this share of its work; may be repeated.")
    ] = None,
) -> Results:
    """Statuses, sentences and what is left, by verb, signal and moment."""
    verbs = {name: VERBS[name] for name in only} if only else VERBS
    rows: list[dict[str, Any]] = []
    imports, shares = ((), tuple(share)) if share else (IMPORTS, SHARES)
    count = len(verbs) * len(SIGNALS) * (len(shares) + len(imports))
    with tempfile.TemporaryDirectory(prefix="flowrec-trials-") as name, progress("stopping", count, "trials") as done:
        sessions = _sessions(session, Path(name))
        for title, verb in verbs.items():
            for row in _rows(title, verb, sessions, Path(name), imports, shares):
                rows.append(row)
                done(len(rows))
    return {"rows": rows, "fault_count": sum(bool(row["faults"]) for row in rows)}


def _sessions(session: Path, folder: Path) -> dict[str, str]:
    first, second = folder / "a.mcap", folder / "b.mcap"
    first.write_bytes(session.read_bytes())
    subprocess.run(
        [sys.executable, "-m", "flowrec", "replay", str(first), "--frames", "-o", str(second)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (cases := folder / "cases").mkdir()
    make_up(cases, 1)
    return {"a": str(first), "b": str(second), "cases": str(cases)}


def _rows(
    title: str, verb: Verb, sessions: dict[str, str], folder: Path, imports: Sequence[float], shares: Sequence[float]
) -> Iterator[dict[str, Any]]:
    def words(out: Path) -> list[str]:
        out.mkdir()
        return verb.words.format(**sessions, out=out).split()

    whole = trial(words(folder / f"{uuid.uuid4().hex}"), folder / "a.mcap")
    imported = subprocess.run(
        [sys.executable, "-c", f"import flowrec.verbs.cli, {verb.imports}, time; print(time.process_time())"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    imports_s = min(float(imported.stdout), whole.cpu_s)
    moments = {f"imports, {share:g}": share * imports_s for share in imports}
    moments |= {f"work, {share:g}": imports_s + share * (whole.cpu_s - imports_s) for share in shares}
    for number in SIGNALS:
        for moment, at_cpu_s in moments.items():
            out = folder / uuid.uuid4().hex
            asked = words(out)
            ended = trial(asked, out, number, at_cpu_s)
            lines = ended.said.strip().splitlines()
            stopped = ended.stopped and ended.status != whole.status  # its verdict was said when the signal came
            yield {
                "verb": title,
                "signal": signal.Signals(number).name,
                "moment": moment,
                "status": ended.status,
                "before_its_end": stopped,
                "said": _sentence(ended.said) or (lines or [""])[-1],
                "left": ended.left,
                "faults": faults(verb, ended, number, out) if stopped else [],
            }


def show(results: Results) -> None:
    """Print the table."""
    rows = [
        row | {"said": row["said"][:100] if row["before_its_end"] else "had ended before the signal"}
        for row in results["rows"]
    ]
    names = ("verb", "signal", "moment", "status", "said", "left", "faults")
    title = f"{results['fault_count']} of {len(rows)} trials with a fault"
    print_rows(title, rows, {name: f"{{{name}}}" for name in names}, text="said")


if __name__ == "__main__":
    run(measure, show)
