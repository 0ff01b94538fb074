"""`flowrec sweep`: replay many sessions with many settings on the workers of Dask, and rank the settings."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flowrec.archive.sweep.cluster import rows_of, workers_of
from flowrec.archive.sweep.ranking import Ranking, settings_text
from flowrec.archive.sweep.results import COLUMNS, Results, read_rows
from flowrec.archive.sweep.tasks import Sessions, Settings, Task, change_of, combinations, session_files
from flowrec.core import Coverage, progress, say
from flowrec.stages import facts_of, of_stages
from flowrec.store import Session

_NAMED = 5  # files and failed tasks that are named one by one


@dataclass(frozen=True, slots=True)
class Swept:
    """The result of a sweep.

    Attributes
    ----------
    path : the Parquet file.
    tasks, computed : number of the tasks of this call, and of those that were not done before.
    sessions : number of sessions that were swept.
    unreadable : number of files that are no whole sessions.
    rows : of all tasks of this call that are done.
    ranking : of the settings.
    """

    path: Path
    tasks: int
    computed: int
    sessions: int
    unreadable: int
    rows: list[dict[str, Any]]
    ranking: Ranking

    @property
    def failed(self) -> list[dict[str, Any]]:
        """Rows with an error."""
        return [row for row in self.rows if row.get("error")]

    @property
    def covered(self) -> Coverage:
        """The tasks with a result, of all of this call."""
        return Coverage(len(self.rows) - len(self.failed), self.tasks, "replays")

    @property
    def exit_status(self) -> int:
        """0 all done, 3 a task has failed or a file is no whole session."""
        return 3 if self.failed or self.unreadable else 0

    def lines(self) -> list[str]:
        """Numbers of finished and failed tasks, as text."""
        failed = self.failed
        passed = f", {self.tasks - self.computed} were done before" if self.computed < self.tasks else ""
        lines = [f"{self.computed} replays done{passed}; {self.covered.amount} have a result -> {self.path}"]
        lines += [f"failed: {row['session']} with {settings_text(row)}: {row['error']}" for row in failed[:_NAMED]]
        if failed:
            more = f"{len(failed) - _NAMED} more have failed; " if len(failed) > _NAMED else ""
            lines.append(f"{more}--retry does what has failed again")
        return lines

    def as_json(self) -> dict[str, Any]:
        """The result in numbers; the rows are in the file."""
        failed = [{name: row[name] for name in ("session", "settings", "error")} for row in self.failed]
        counts = {"sessions": self.sessions, "unreadable": self.unreadable}
        counts |= {"tasks": self.tasks, "computed": self.computed, "passed_over": self.tasks - self.computed}
        return {"out": str(self.path), **counts, "failed": failed, "ranking": self.ranking.as_json()} | {
            "covered": self.covered.as_json()
        }


def sweep(
    places: Sequence[str],
    grid: Sequence[str],
    out: Path,
    sets: Sequence[str] = (),
    *,
    refly: bool = False,
    by: str | None = None,
    retry: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    timeout_s: float | None = None,
    memory_bytes: int | None = None,
) -> Swept:
    """Replay sessions with every combination of settings, each once, and write one row a replay.

    Parameters
    ----------
    places : files, folders and patterns such as `runs/*.mcap`.
    grid : texts `key=value,value`: methods (of methods.REPLAYED) and settings.
    out : the Parquet file; one of an earlier sweep of these sessions is continued.
    sets : texts `key=value` that hold for all replays.
    refly : fly the recorded and the replayed plan, too, as `flowrec replay --refly`.
    by : the figure by which settings are ranked; None: the first of RANKED_BY that a row has.
    retry : do tasks again that have failed.
    scheduler, workers : of Dask; see `workers_of`.
    timeout_s, memory_bytes : limits of a task.

    Raises
    ------
    UsageError : no session, a setting that is unknown or fixed by the recording.
    OutputError : `out` may not be written.
    FlowrecError : the scheduler does not answer, or has ended.
    """
    chosen = combinations(grid, sets, tuple(COLUMNS))
    files = session_files(places)
    with progress("reading heads and indexes", len(files), "sessions") as done:
        sessions = Sessions.of(files, done)
    packages = _packages(next(iter(sessions.by_content.values())), chosen)
    _tell(sessions.left_out)
    tasks = {
        task.key: task
        for content, path in sessions.by_content.items()
        for settings in chosen
        for task in [Task(str(path), content, settings, refly, False, timeout_s, memory_bytes, packages[settings])]
    }
    computed = 0
    with Results.open_locked(out, files, sessions.by_content) as results:
        failed = results.failed
        waiting = [task for key, task in tasks.items() if key not in failed or (retry and failed[key])]
        if waiting:
            say(f"{len(waiting)} replays to do, {len(tasks) - len(waiting)} are done")
            with workers_of(scheduler, workers) as client, progress("sweeping", len(waiting), "replays") as done:
                for row in rows_of(client, _judged_once(waiting, results.judged), local=scheduler is None):
                    results.put(row)
                    computed += 1
                    done(computed)
    rows = [row for row in read_rows(out) if row["key"] in tasks]
    return Swept(out, len(tasks), computed, len(sessions.by_content), sessions.unreadable, rows, Ranking.of(rows, by))


def _packages(path: Path, chosen: Sequence[Settings]) -> dict[Settings, str]:
    """The outside packages that each of the settings uses, as JSON; UsageError for settings that no replay takes."""
    session = Session(path)
    found: dict[Settings, str] = {}
    for settings in chosen:
        change = change_of(settings)
        changed = change.apply(session.config)
        change.stale_results(session.config, changed)
        facts = facts_of(changed, session.provenance, of_stages)
        found[settings] = json.dumps(facts, sort_keys=True) if facts else ""
    return found


def _judged_once(tasks: Sequence[Task], judged: set[str]) -> Iterator[Task]:
    """The tasks; the first one of each session whose verdict is not known also checks the session."""
    known = set(judged)
    for task in tasks:
        yield replace(task, judge=task.content not in known)
        known.add(task.content)


def _tell(lines: Sequence[str]) -> None:
    for line in lines[:_NAMED]:
        say(line)
    if len(lines) > _NAMED:
        say(f"and {len(lines) - _NAMED} files more")
