"""`python -m tests.perf.fuzz`: corrupted sessions, each opened, described, read, checked and recovered; counts faults.

A session may be read, or refused with an error of flowrec in one line. A fault is another exception, a hang, memory
above a limit, a file where none was asked for, an incomplete file that passes for complete, or a verdict of `check`
that the reader contradicts.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from flowrec.bench.harness import Results, Seed, run
from flowrec.core import FlowrecError, forget_peak, peak_mb, printable, progress, table
from flowrec.store import Session, SessionReader, recover
from flowrec.verbs.check import check
from flowrec.verbs.info import info
from flowrec.verbs.ls import ls
from tests.perf.mutate import blind, corrupt
from tests.store.drafts import Draft, small_draft

TIME_LIMIT_S = 20.0
MEMORY_LIMIT_MB = 270.0  # besides the 240 MB of the program itself: together less than 512
VERBS = ("info", "ls", "open", "middle", "ticks", "check", "recover")
_FAULTS_KEPT = 50


class _TookTooLongError(BaseException):
    """Not an Exception, so that no code under test catches it."""


class Campaign:
    """Corrupts one session in many ways; a seed determines the file.

    Parameters
    ----------
    folder : an empty one.
    verbs : what is done with each file.
    """

    def __init__(self, folder: Path, verbs: Sequence[str] = VERBS) -> None:
        self._folder = folder
        self._verbs = verbs
        self._work = folder / "work" / "out"
        self._work.mkdir(parents=True)
        self._draft: Draft = small_draft()
        self._whole = self._draft.build()
        path = self._work / "whole.mcap"
        path.write_bytes(self._whole)
        with SessionReader(path) as reader:
            self._stamps = [tick.stamp_ns for tick in reader.ticks()]
        if check(path).word != "good":
            raise FlowrecError(f"{path}: the session to corrupt is not good; repair tests/store/drafts.py first")
        path.unlink()
        forget_peak()
        self._base_mb = peak_mb()
        self.kinds: Counter[str] = Counter()
        self.ends: Counter[str] = Counter()
        self.faults: list[dict[str, Any]] = []
        self.worst_s = self.worst_mb = 0.0

    def run(self, seed: int) -> list[str]:
        """Corrupt and read one file; its faults."""
        kind, data = corrupt(self._draft, self._whole, seed)
        self.kinds[kind] += 1
        path = self._work / ("case.mcap.partial" if seed % 5 == 0 else "case.mcap")
        path.write_bytes(data)
        forget_peak()
        began = time.perf_counter()
        faults = self._read(path, kind)
        self.worst_s = max(self.worst_s, time.perf_counter() - began)
        memory_mb = peak_mb()
        self.worst_mb = max(self.worst_mb, memory_mb)
        if memory_mb - self._base_mb > MEMORY_LIMIT_MB:
            faults.append(f"{memory_mb - self._base_mb:.0f} MB more than before")
        faults += self._strays()
        self.faults += [{"seed": seed, "kind": kind, "fault": fault} for fault in faults][:_FAULTS_KEPT]
        return faults

    def _read(self, path: Path, kind: str) -> list[str]:
        faults: list[str] = []
        stamps: list[int] = []
        word = [""]

        def ticks() -> None:
            with SessionReader(path) as reader:
                stamps.extend(tick.stamp_ns for tick in reader.ticks())

        def middle() -> None:
            with SessionReader(path) as reader:
                reader.tick_before(self._stamps[3], with_frames=False)
                next(reader.ticks(self._stamps[2]), None)
                sum(1 for _ in reader.messages("estimate"))

        def judged() -> None:
            verdict = check(path)
            word[0] = verdict.word
            if any(printable(line) != line for line in verdict.lines()):
                raise AssertionError("the verdict is not safe on a terminal")

        def opened() -> None:
            with Session(path) as session:
                _ = session.config, session.chip, session.reader

        def saved() -> None:
            done = recover(path, self._work / "saved.mcap")
            with SessionReader(done.path) as reader:
                if sum(1 for _ in reader.ticks()) < min(done.ticks, 1):
                    raise AssertionError("what was recovered can not be read")

        sound = {}
        for name, verb in (
            ("info", lambda: info(path)),
            ("ls", lambda: ls([self._work])),
            ("open", opened),
            ("middle", middle),
            ("ticks", ticks),
            ("check", judged),
            ("recover", saved),
        ):
            if name not in self._verbs:
                continue
            sound[name], fault = _tried(verb)
            self.ends[f"{name}: {'read' if sound[name] else 'refused'}"] += 1
            if fault:
                faults.append(f"{name}: {fault}")
        if sound.get("ticks") and blind(kind) and stamps != self._stamps:
            faults.append(f"{len(stamps)} ticks were read as if they were all")
        if stamps != sorted(set(stamps)):
            faults.append("ticks are not in order of time")
        if word[0] in ("good", "usable") and not (sound.get("ticks", True) and sound.get("open", True)):
            faults.append(f"check says {word[0]}, but it can not be read")
        return faults

    def _strays(self) -> list[str]:
        """Files where none was asked for; the others are removed."""
        for path in self._work.iterdir():
            if path.name in ("case.mcap", "case.mcap.partial", "saved.mcap"):
                path.unlink()
        strays = [str(path.relative_to(self._folder)) for path in self._folder.rglob("*") if not path.is_dir()]
        return [f"wrote {stray}" for stray in strays]


def measure(
    count: Annotated[int, typer.Option(min=1, help="Number of corrupted sessions.")] = 2000, seed: Seed = 0
) -> Results:
    """Corrupt and read `count` files, with the seeds from `seed` on; counts, and faults with their seeds."""
    folder = Path(tempfile.mkdtemp(prefix="flowrec-fuzz-"))
    began, cpu = time.perf_counter(), time.process_time()
    try:
        with _without_waiting_for_the_disk(), progress("corrupting and reading", count) as done:
            campaign = Campaign(folder)
            base_mb = peak_mb()
            for number in range(count):
                campaign.run(seed + number)
                done(number + 1)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return {
        "files": count,
        "first_seed": seed,
        "kinds": dict(campaign.kinds),
        "ends": dict(sorted(campaign.ends.items())),
        "fault_count": len(campaign.faults),
        "faults": campaign.faults[:_FAULTS_KEPT],
        "worst_file_s": campaign.worst_s,
        "peak_memory_mb": campaign.worst_mb,
        "memory_before_mb": base_mb,
        "wall_s": time.perf_counter() - began,
        "cpu_s": time.process_time() - cpu,
    }


def show(figures: dict[str, Any]) -> None:
    """Print the table."""
    rows = [
        ("files", str(figures["files"])),
        ("seeds", f"{figures['first_seed']} to {figures['first_seed'] + figures['files'] - 1}"),
        *((name, str(count)) for name, count in figures["ends"].items()),
        ("slowest file, all verbs", f"{figures['worst_file_s']:.2f} s"),
        ("peak memory", f"{figures['peak_memory_mb']:.0f} MB ({figures['memory_before_mb']:.0f} MB before)"),
        ("faults", str(figures["fault_count"])),
        *((f"seed {fault['seed']} ({fault['kind']})", fault["fault"]) for fault in figures["faults"][:20]),
    ]
    table("Corrupted sessions", ("", "value"), rows)


def _tried(verb: Callable[[], object]) -> tuple[bool, str]:
    """Whether it worked, and its fault if there is one."""
    try:
        with _time_limit():
            verb()
    except FlowrecError as error:
        said = str(error)
        return False, "" if said and printable(said) == said else f"an error in more than a line: {said!r}"
    except _TookTooLongError:
        return False, f"longer than {TIME_LIMIT_S:g} s"
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a fault
        where = traceback.extract_tb(error.__traceback__)[-1]
        return False, f"{type(error).__name__} in {Path(where.filename).name}:{where.lineno}: {error}"[:300]
    return True, ""


@contextlib.contextmanager
def _time_limit() -> Iterator[None]:
    def stop(_number: int, _frame: FrameType | None) -> None:
        raise _TookTooLongError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _without_waiting_for_the_disk() -> Iterator[None]:
    """Without fsync, which would take most of the time of a recovery."""
    fsync = os.fsync
    os.fsync = lambda fd: None
    try:
        yield
    finally:
        os.fsync = fsync


if __name__ == "__main__":
    run(measure, show)
