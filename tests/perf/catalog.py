"""`python -m tests.perf.catalog DIR`: what a catalog of ten thousand sessions costs to make, to refresh and to search.

Each session has the head of a real one (settings, chip, provenance) with a seed of its own, its first ticks without
images, and figures of its own, so every file has other content; they are made once. Times are of whole commands, the
start of Python included, and beside them the time within `refresh` and `find` of one process that has imported all.
"""

from __future__ import annotations

import itertools
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.archive.catalog.find import find
from flowrec.archive.catalog.format import NAME
from flowrec.archive.catalog.refresh import refresh
from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import OperatorEvent, progress
from flowrec.store import Session, SessionWriter, WriterOptions

SOURCE = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"
QUERIES = (
    "outcome = 'reached' and refined_flow_error < 0.02",
    "events.text like '%bubble%' and events.time_s > 0.1 and seed < 100",
    "seed = 77",
)
_MARKED = 50  # one session of so many has a mark


def measure(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where sessions and catalog are; sessions are kept.")],
    sessions: Annotated[int, typer.Option(min=20)] = 10_000,
    added: Annotated[int, typer.Option(min=1, help="Sessions that are new in the refresh.")] = 10,
    repeats: Annotated[int, typer.Option(min=1)] = 7,
) -> Results:
    """Make, catalog, add, refresh, find."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{number // 1000:02d}" / f"s{number:05d}.mcap" for number in range(sessions + added)]
    with progress("making sessions", sessions) as done:
        for number, path in enumerate(paths[:sessions]):
            if not path.exists():
                make(path, number)
            done(number)
    for path in paths[sessions:]:
        path.unlink(missing_ok=True)
    (folder / NAME).unlink(missing_ok=True)
    rows = [_timed("first catalog", ["catalog", str(folder)], None, 1)]
    for number, path in enumerate(paths[sessions:], sessions):
        make(path, number)
    rows.append(_timed(f"refresh after {added} new", ["catalog", str(folder)], None, 1))
    rows.append(_timed("refresh, nothing new", ["catalog", str(folder)], lambda: refresh([folder]), 3))
    for query in QUERIES:
        words = ["find", query, "--catalog", str(folder)]
        rows.append(_timed(f"find {query}", words, lambda query=query: find(query, folder), repeats))
    rows.append(_timed("find ... --paths", ["find", QUERIES[0], "--paths", "--catalog", str(folder)], None, repeats))
    return {"sessions": sessions, "rows": rows, "catalog_bytes": (folder / NAME).stat().st_size}


def _shown(found: Results) -> None:
    columns = {"what": "{what}", "wall": "{wall_s} s", "least wall": "{least_wall_s} s", "CPU": "{CPU_s} s"}
    columns |= {"within": "{inside_s:.3f} s"}
    print_rows(f"{found['sessions']} sessions", found["rows"], columns)


def make(path: Path, number: int) -> None:
    """A session of its own seed, content and figures."""
    path.parent.mkdir(exist_ok=True)
    source = Session(SOURCE)
    rng = np.random.default_rng(number)
    header = replace(source.header, provenance={**source.provenance, "seed": str(number)})
    outcome = {key: str(value) for key, value in source.run.outcome.items()}
    outcome |= {"refined_flow_error": repr(float(rng.gamma(2.0, 0.03))), "contacts": str(int(rng.poisson(0.5)))}
    with SessionWriter(path, header, WriterOptions(block=True, frames="raw", sync_s=1e6)) as writer:
        for count, tick in enumerate(itertools.islice(_ticks(source), 10)):
            due = count == 5 and number % _MARKED == 0
            event = OperatorEvent(tick.stamp_ns, "mark", f"a bubble in run {number}") if due else None
            writer.write(replace(tick, operator=event))
        writer.close(outcome)


_known: list[Any] = []


def _ticks(source: Session) -> list[Any]:
    if not _known:
        few = itertools.islice(source.ticks(with_frames=False), 10)
        _known.extend(replace(tick, assumed=None, refined=None, true_field=None, route=None) for tick in few)
    return _known


def _timed(what: str, words: list[str], inside: Callable[[], object] | None, repeats: int) -> dict[str, Any]:
    """Median wall and CPU time of a command, and of a call within this process."""
    walls, cpus = [], []
    for _ in range(repeats):
        before, began_s = _children_s(), time.perf_counter()
        subprocess.run([sys.executable, "-m", "flowrec", *words], check=True, capture_output=True)
        walls.append(time.perf_counter() - began_s)
        cpus.append(_children_s() - before)
    row = {"what": what, "wall_s": round(median(walls), 3), "CPU_s": round(median(cpus), 3)}
    row |= {"least_wall_s": round(min(walls), 3)}
    if inside is not None:
        inside()
        within = []
        for _ in range(repeats):
            began_s = time.perf_counter()
            inside()
            within.append(time.perf_counter() - began_s)
        row["inside_s"] = round(median(within), 3)
    return row | {"inside_s": row.get("inside_s")}


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    run(measure, _shown)
