"""`python -m tests.perf.stops`: each way to end a run, in real processes, until the field is off and the process ends.

A row per kind: the worst time from its cause to the field being off (by the driver log of stop_trial.py: no command
with a field follows), its timer, the worst time from the cause to the end of the process, and the state of the files.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import FlowrecError, progress
from flowrec.store import SessionReader, recover

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGUSR1, signal.SIGUSR2]
_RAMP_S, _HANG_S, _SIGHT_S = 0.9, 0.5, 1.4
_AFTER = 45  # commands to the coils, then the signal is sent
_START_S, _END_S = 120.0, 30.0


@dataclass(frozen=True)
class Kind:
    """What is done to a run: the fault of stop_trial.py, then signals, 10 ms from one to the next."""

    fault: str = "none"
    sent: tuple[signal.Signals, ...] = ()
    timer_s: float = 0.0
    worker: signal.Signals | None = None  # to the process of the slow stages instead


# Down the ramp where the loop is well; at once where it is told so; a stuck loop is told by the guard's timer.
KINDS = {
    **{one.name: Kind(sent=(one,), timer_s=_RAMP_S if one in SIGNALS[:3] else 0.0) for one in SIGNALS},
    "SIGINT twice": Kind(sent=(signal.SIGINT, signal.SIGINT)),
    "SIGTERM twice": Kind(sent=(signal.SIGTERM, signal.SIGTERM)),
    "camera stuck in C": Kind("camera-in-c", timer_s=_HANG_S),
    "camera stuck in C, SIGINT three times, SIGTERM": Kind(
        "camera-in-c", (signal.SIGINT, signal.SIGINT, signal.SIGINT, signal.SIGTERM), _HANG_S
    ),
    "camera silent": Kind("camera-waits", timer_s=_HANG_S),
    "camera 1.4 s late": Kind("camera-late", timer_s=_HANG_S),
    "camera frozen": Kind("camera-frozen", timer_s=_SIGHT_S),
    "camera black": Kind("camera-black", timer_s=_SIGHT_S),
    "stage raises": Kind("stage-raises"),
    "stage never returns": Kind("stage-for-ever", timer_s=_HANG_S),
    "stage never returns, in C": Kind("stage-in-c", timer_s=_HANG_S),
    "worker killed": Kind(worker=signal.SIGKILL),
    "worker stopped": Kind(worker=signal.SIGSTOP),
    "zero() raises 5 times, SIGINT twice": Kind("zero-raises", (signal.SIGINT, signal.SIGINT), 5 * 0.02),
    "zero() takes 30 ms, SIGINT twice": Kind("zero-slow", (signal.SIGINT, signal.SIGINT), 0.03),
}


@dataclass
class Ended:
    """A run that has ended. Times in s of CLOCK_MONOTONIC; `log` has (time, thread, event, amplitude in mT)."""

    path: Path
    log: list[tuple[float, str, str, float]]
    cause_s: float
    end_s: float
    status: int
    stderr: str
    ends: tuple[str, ...] = ("apply", "zero")

    @property
    def off_s(self) -> float | None:
        """From when on the driver had no field, None: it had one to the end. Only what follows the cause counts.

        `ends` are the events that take the field away. An amplifier whose zero() fails does not obey a command of zero
        either, so there only a zero() that has returned counts.
        """
        off_s: float | None = None
        for at_s, _thread, event, amplitude_mt in self.log:
            if event == "apply" and amplitude_mt > 0.0:
                off_s = None
            elif at_s >= self.cause_s and event in self.ends and off_s is None:
                off_s = at_s
        return off_s

    def after_cause(self) -> list[tuple[str, float]]:
        """Events and amplitudes from the cause on, in order."""
        return [(event, amplitude_mt) for at_s, _, event, amplitude_mt in self.log if at_s >= self.cause_s]

    def file(self) -> str:
        """Whole, recovered or lost."""
        if self.path.exists():
            return "whole" if "outcome" in SessionReader(self.path).outcome else "without outcome"
        try:
            return "recovered" if recover(self.path.with_name(self.path.name + ".partial")).ticks > 0 else "lost"
        except FlowrecError:
            return "lost"


def stop(kind: Kind, folder: Path, *sets: str) -> Ended:
    """Start a run, do that to it, wait for its end. A process that stops itself is continued when its log is read."""
    path, log = folder / "run.mcap", folder / "driver.log"
    with (folder / "stderr").open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.perf.stop_trial", kind.fault, str(path), str(log), *sets],
            cwd=Path(__file__).parents[2],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdout=subprocess.DEVNULL,
            stderr=errors,
        )
        try:
            by_itself = not (kind.sent or kind.worker)
            waited = " cause " if kind.fault not in ("none", "zero-raises", "zero-slow") else None
            _until(lambda: _has_begun(log, waited), _START_S, process)
            cause_s = time.monotonic()
            if kind.worker is not None:
                os.kill(_worker_of(process.pid), kind.worker)
            for one in kind.sent:
                cause_s = time.monotonic() if one is kind.sent[0] else cause_s
                process.send_signal(one)
                time.sleep(0.01)
            if signal.SIGTSTP in kind.sent:
                _until(lambda: _stopped(process.pid), _END_S, process)
                (folder / "driver.log.stopped").write_bytes(log.read_bytes())
                process.send_signal(signal.SIGCONT)
            with contextlib.suppress(subprocess.TimeoutExpired):  # its log shows it
                process.wait(_END_S)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    end_s = time.monotonic()
    lines = _lines(log)
    if waited and (by_itself or kind.timer_s == _HANG_S):
        cause_s = next(at_s for at_s, _, event, _ in lines if event == "cause")
    stderr = (folder / "stderr").read_text(errors="replace")
    ends = ("zero",) if kind.fault.startswith("zero-") else ("apply", "zero")
    return Ended(path, lines, cause_s, end_s, process.returncode, stderr, ends)


def _lines(log: Path) -> list[tuple[float, str, str, float]]:
    words = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
    return [(float(at_s), thread, event, float(amplitude_mt)) for at_s, thread, event, amplitude_mt in words]


def _has_begun(log: Path, waited: str | None) -> bool:
    text = log.read_text() if log.exists() else ""
    return waited in text if waited else text.count(" apply ") > _AFTER


def _until(happened: object, timeout_s: float, process: subprocess.Popen[bytes]) -> None:
    assert callable(happened)
    end_s = time.monotonic() + timeout_s
    while not happened() and process.poll() is None:
        if time.monotonic() > end_s:
            raise TimeoutError(f"a trial has not come so far within {timeout_s:g} s")
        time.sleep(0.01)


def _stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def _worker_of(pid: int) -> int:
    children = [int(word) for task in Path(f"/proc/{pid}/task").iterdir() for word in _read(task / "children").split()]
    return next(child for child in children if "worker_process" in _read(Path(f"/proc/{child}/cmdline")))


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def measure(
    trials: Annotated[int, typer.Option(min=1, help="Runs of each kind.")] = 20,
    only: Annotated[list[str] | None, typer.Option(metavar="KIND", help="Only this kind; may be repeated.")] = None,
) -> Results:
    """Worst times by kind, exit statuses, and how many runs left which files."""
    rows = {}
    kinds = only or list(KINDS)
    with progress("stopping runs", trials * len(kinds)) as done:
        for place, name in enumerate(kinds):
            ended: list[Ended] = []
            files: dict[str, int] = {}
            for trial in range(trials):
                with tempfile.TemporaryDirectory(prefix="flowrec-stops-") as folder:
                    ended.append(stop(KINDS[name], Path(folder)))
                    files[ended[-1].file()] = files.get(ended[-1].file(), 0) + 1
                done(place * trials + trial + 1)
            offs = [one.off_s - one.cause_s if one.off_s is not None else float("inf") for one in ended]
            rows[name] = {
                "field_off_s": max(offs),
                "timer_s": KINDS[name].timer_s,
                "process_gone_s": max(one.end_s - one.cause_s for one in ended),
                "statuses": sorted({one.status for one in ended}),
                "files": files,
            }
    return {"trials": trials, "rows": rows}


def show(results: Results) -> None:
    """Print the table."""
    print_rows(
        f"{results['trials']} runs of each kind, worst times from the cause on",
        [{"kind": kind, **row} for kind, row in results["rows"].items()],
        {
            "kind": "{kind}",
            "field off, s": "{field_off_s:.3f}",
            "timer, s": "{timer_s:g}",
            "process gone, s": "{process_gone_s:.2f}",
            "statuses": "{statuses}",
            "files": "{files}",
        },
    )


if __name__ == "__main__":
    run(measure, show)
