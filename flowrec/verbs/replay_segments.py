"""A verification in segments side by side: any tick is a restart point of a replay.

Each segment starts from the recorded state at the last tick of the one before and is compared tick by tick, its last
tick included. So the state with which a segment ends is the state with which the next one begins, or it is a
difference. The verdict and the first difference are those of one pass; after it the counts of differences are not,
because the next segment starts from the recording again.
"""

from __future__ import annotations

import os
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from flowrec.core import NUMERICS_VERSION, SessionError, Tick, UsageError, pool
from flowrec.run import CommandDifference, RunReport
from flowrec.stages import other_packages
from flowrec.store import Session
from flowrec.verbs.comparison import Comparison, Side
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.replay_result import Replay, WorkerResults, coverage_of, digest_lines
from flowrec.verbs.session_replay import replay_session

_TICKS = 300  # of a segment at least: restoring its start takes as long as a few of them
_PER_JOB = 4  # segments, because those with work orders take longer
_JOBS_LIMIT = 256  # more processes than machines have cores
_POLL_S = 0.2  # until a request to stop is seen

Segment = tuple[int | None, int]  # stamps of the first and the last tick; None: the beginning of the session


class _Verified(NamedTuple):
    """A segment's result, without the session, which the caller has."""

    report: RunReport
    recorded: Tick
    comparison: Comparison
    worker: WorkerResults
    frames_missing: int


def verify(
    session: Session | Path | str, jobs: int = 1, from_s: float | None = None, control: Unattended | None = None
) -> Replay:
    """Replay a session as it was recorded, in `jobs` processes, and compare every message.

    Raises UsageError: a number of jobs that is not possible, or a time outside of the session; SessionError: the
    session can not be read or replayed, or a process was killed.

    Parameters
    ----------
    jobs : processes at a time; 1: one pass in this process, as for a session of other numerics; 0: one for each core.
    from_s : session time in s to start at.
    control : as of `replay`. Of a verification that it stops, the segments count that were done by then.
    """
    if not 0 <= jobs <= _JOBS_LIMIT:
        raise UsageError(f"--jobs {jobs}: the number of processes is 1 to {_JOBS_LIMIT}, or 0 for one a core")
    jobs = jobs or os.cpu_count() or 1
    session, control = Session.of(session), control or Unattended()
    packages = other_packages(session.config, session.provenance)
    start_ns = session.stamp_ns(from_s, "--from") if from_s is not None else None
    segments = _segments(session, jobs, start_ns) if jobs > 1 else []
    if len(segments) < 2:
        return replay_session(session, from_s=from_s, verify=True, control=control)
    tasks: list[Future[_Verified]] = []
    digest: Future[tuple[bool, list[str]]] | None = None
    stopped = control.run_control
    try:
        with (
            control.end_on_signals(),
            pool(min(jobs, len(segments))) as executor,
            control.progress(f"replaying {session.path.name}", float(len(segments))) as progress,
        ):
            tasks += [executor.submit(_verify_segment, session.path, segment) for segment in segments]
            digest = executor.submit(digest_lines, session.path)
            waiting: set[Future[Any]] = {*tasks, digest}
            while waiting:
                done, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for task in done:
                    task.result()  # a failure ends the others
                progress(float(sum(task.done() for task in tasks)))
                if stopped.reason:
                    raise _StoppedError
    except BrokenProcessPool as error:
        raise SessionError(f"{session.path}: a process of the replay was killed; try fewer --jobs") from error
    except _StoppedError:
        pass
    found = [task.result() for task in tasks if _has_succeeded(task)]
    sides = Side.of("recorded", session), Side.of_replay(session.reader.topics)
    comparison, worker = Comparison(sides=sides), WorkerResults(Comparison(sides=sides))
    for each in found:
        comparison.followed_by(each.comparison)
        worker.followed_by(each.worker)
    report = replace(found[-1].report if found else RunReport(), ticks=comparison.ticks, duration_s=session.duration_s)
    return Replay(
        session,
        session.config,
        report,
        found[-1].recorded if found else Tick(),
        report.last,
        comparison,
        CommandDifference(),
        sum(each.frames_missing for each in found),
        coverage_of(session, comparison.ticks, (start_ns, session.reader.last_ns), from_s, stopped),
        worker,
        digest.result() if digest is not None and _has_succeeded(digest) else None,
        packages=packages,
    )


class _StoppedError(Exception):
    """Leaves the pool, whose processes then end at once."""


def _has_succeeded(task: Future[Any]) -> bool:
    return task.done() and not task.cancelled() and task.exception() is None


def _segments(session: Session, jobs: int, start_ns: int | None) -> list[Segment]:
    """Segments of about equal numbers of ticks, a few for each job."""
    if session.numerics != str(NUMERICS_VERSION):
        return []  # today's stages compute from more than an older file states, so it can not be entered anywhere
    stamps = [stamp_ns for stamp_ns in session.reader.stamps("applied") if stamp_ns >= (start_ns or 0)]
    count = min(_PER_JOB * jobs, len(stamps) // _TICKS)
    if count < 2:
        return []
    starts = [stamps[len(stamps) * number // count] for number in range(1, count)]
    ends = [stamp_ns - 1 for stamp_ns in starts] + [session.reader.last_ns]
    return list(zip([start_ns, *starts], ends, strict=True))


def _verify_segment(path: Path, segment: Segment) -> _Verified:
    """The replay of a segment, in a process of the pool."""
    done = replay_session(path, verify=True, segment_ns=segment)
    assert done.worker is not None
    return _Verified(done.report, done.recorded, done.comparison, done.worker, done.frames_missing)
