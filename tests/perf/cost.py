"""`python -m tests.perf.cost SESSION...`: what the work on a session costs, and on a million sessions of 1 GB.

Each work reads the session at a URL of this machine, in a process of its own that has done the same work once before on
the first session: CPU time, requests, bytes read, largest memory. A line through the sessions, cost = fixed + GB x
slope, gives the cost of a session of another size. CONTRIBUTING.md states what follows for a million sessions.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import peak_mb, progress
from flowrec.core.system.processes import child_command, child_environment
from tests.store.range_server import served

_SECONDS_PER_YEAR = 365.25 * 24 * 3600


def _head(url: str) -> None:
    import flowrec
    from flowrec.archive.sweep.tasks import content_of

    content_of(flowrec.open(url))


def _poses(url: str) -> None:
    import flowrec

    for _ in flowrec.open(url).messages("track"):
        pass


def _check(url: str) -> None:
    import flowrec

    flowrec.check(url)


def _task(method: str) -> Callable[[str], None]:
    """A task of `flowrec sweep` without its check."""

    def replayed(url: str) -> None:
        import flowrec
        from flowrec.archive.sweep import replay_process
        from flowrec.archive.sweep.tasks import Task, content_of

        row = replay_process._row(Task(url, content_of(flowrec.open(url)), (("refine", method),)))
        assert not row.get("error"), row["error"]

    return replayed


WORKS: dict[str, Callable[[str], None]] = {
    "head and index": _head,
    "poses": _poses,
    "check": _check,
    "task of a sweep, gain": _task("gain"),
    "task of a sweep, assimilate": _task("assimilate"),
    "task of a sweep, pi_unet": _task("pi_unet"),
}


def measure(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Two at least, of different sizes.")],
    count: Annotated[float, typer.Option(help="Sessions of the archive.")] = 1e6,
    gigabytes: Annotated[float, typer.Option("--gb", help="Size of each of them.")] = 1.0,
) -> Results:
    """Do every work on every session, and extrapolate."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in WORKS}
    with progress("working", len(WORKS) * len(sessions)) as done:
        for number, name in enumerate(WORKS):
            for each, session in enumerate(sessions):
                found[name].append(_measured(name, sessions[0], session))
                done(number * len(sessions) + each + 1)
    rows = [_extrapolated(name, sizes, count, gigabytes) for name, sizes in found.items()]
    return {"sessions": count, "gigabytes": gigabytes, "measured": found, "rows": rows}


def _measured(name: str, first: Path, session: Path) -> dict[str, float]:
    with served(first) as warming, served(session) as server:
        words = child_command("tests.perf.cost", "--work", name, warming.url, server.url)
        said = subprocess.run(words, env=child_environment(), check=True, stdout=subprocess.PIPE)
    return {"gb": session.stat().st_size / 1e9, **json.loads(said.stdout)}


def _extrapolated(name: str, measured: list[dict[str, float]], count: float, gigabytes: float) -> dict[str, Any]:
    sizes = [each["gb"] for each in measured]
    row: dict[str, Any] = {"work": name, "mb": max(each["mb"] for each in measured)}
    for key in ("cpu_s", "requests", "read_gb"):
        slope, fixed = np.polyfit(sizes, [each[key] for each in measured], 1)
        row |= {f"{key}_fixed": float(fixed), f"{key}_per_gb": float(slope), key: float(fixed + gigabytes * slope)}
    row["core_years"] = count * row["cpu_s"] / _SECONDS_PER_YEAR
    row["all_requests"] = count * row["requests"]
    row["all_read_pb"] = count * row["read_gb"] / 1e6
    return row


def _work(name: str, warming: str, url: str) -> None:
    """Runs in a process of its own; prints its cost as JSON."""
    from flowrec.core import terminal
    from flowrec.store.remote_file import TRAFFIC

    terminal.console.quiet = True
    WORKS[name](warming)
    requests, read_bytes, began_s = TRAFFIC.requests, TRAFFIC.nbytes, time.process_time()
    WORKS[name](url)
    cost = {"cpu_s": time.process_time() - began_s, "requests": TRAFFIC.requests - requests}
    print(json.dumps(cost | {"read_gb": (TRAFFIC.nbytes - read_bytes) / 1e9, "mb": peak_mb()}))


def show(found: dict[str, Any]) -> None:
    """Print the table."""
    print_rows(
        f"{found['sessions']:.0e} sessions of {found['gigabytes']:g} GB",
        found["rows"],
        {
            "": "{work}",
            "CPU of one": "{cpu_s_fixed:.2f} + {cpu_s_per_gb:.1f} s/GB",
            "requests": "{requests_fixed:.0f} + {requests_per_gb:.0f} /GB",
            "read": "{read_gb_fixed:.4f} + {read_gb_per_gb:.3f} GB/GB",
            "memory": "{mb:.0f} MB",
            "core-years": "{core_years:.2g}",
            "all requests": "{all_requests:.2g}",
            "all read": "{all_read_pb:.2g} PB",
        },
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        _work(*sys.argv[2:])
        sys.exit()
    run(measure, show)
    sys.exit()
