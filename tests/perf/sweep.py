"""`python -m tests.perf.sweep DIR`: a sweep of many short missions whose workers are killed, and what it costs.

Missions with distinct seeds are flown into DIR, once. They are swept with two settings on the workers of this machine,
one of which, or its replay process, is killed by -9 again and again. Then: rows that are missing, double or failed; the
same again; the memory of the sweep itself; CPU time over that of a warm `flowrec.replay`; rows that differ from
`flowrec replay --json`. With --hazards three more missions hang, eat memory and kill their process.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import psutil
import typer

from flowrec.archive.sweep.results import read_rows
from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import pool, progress
from flowrec.core.system.processes import child_command, child_environment
from tests.short_missions import SMALL

SETTINGS = ("fvm", "assimilate")
HAZARDS = ("hang", "eat", "bomb")
_LOOK_S = 0.2
# In the replay processes, which find this module first: what a session of that name does.
_PLANTED = """
import os, sys
if "flowrec.archive.sweep.replay_process" in sys.orig_argv:
    import flowrec.verbs.session_replay as module
    genuine = module.replay
    def replay(session, *rest):
        what = session.path.stem
        while what == "hang":
            pass
        eaten = []
        while what == "eat":
            eaten.append(bytearray(b"x" * 20_000_000))
        if what == "bomb":
            os.kill(os.getpid(), 9)
        return genuine(session, *rest)
    module.replay = replay
"""


def measure(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where missions and tables are; missions are kept.")],
    missions: Annotated[int, typer.Option(min=2)] = 20,
    length_s: Annotated[float, typer.Option("--length", help="Of a mission, s.")] = 3.0,
    workers: Annotated[int, typer.Option(min=1)] = 2,
    kill_every_s: Annotated[float, typer.Option("--kill-every", help="0: none is killed.")] = 20.0,
    compared: Annotated[int, typer.Option(help="Rows that are compared with `flowrec replay`.")] = 6,
    hazards: Annotated[bool, typer.Option("--hazards", help="With missions that hang, eat memory, kill.")] = False,
) -> Results:
    """Fly, sweep with workers killed, sweep again, compare."""
    runs, planted = folder / "runs", folder / "planted"
    for made in (runs, planted):
        made.mkdir(parents=True, exist_ok=True)
    (planted / "sitecustomize.py").write_text(_PLANTED)
    files = [runs / f"s{seed:05d}.mcap" for seed in range(1, missions + 1)]
    files += [runs / f"{name}.mcap" for name in HAZARDS if hazards]
    lacking = [(seed, file, length_s) for seed, file in enumerate(files, 1) if not file.exists()]
    began_s = time.monotonic()
    with progress("flying", len(lacking)) as done, pool(workers) as flying:
        for number, _ in enumerate(flying.map(_fly, lacking), 1):
            done(number)
    flown_s = time.monotonic() - began_s
    out = folder / "sweep.parquet"
    out.unlink(missing_ok=True)
    first = _swept(files, out, workers, kill_every_s, planted)
    again = _swept(files, out, workers, 0.0, planted)
    rows = read_rows(out)
    keys = Counter(row["key"] for row in rows)
    pairs = {(row["session"], row["settings"]["refine"]) for row in rows}
    good = [row for row in rows if not row["error"]]
    stems = {row["key"]: Path(row["session"]).stem for row in rows}
    chosen = good[:: max(len(good) // compared, 1)][:compared] if compared else []
    warm = _warm_cpu_s(chosen)
    fault_count = len(set(itertools.product(map(str, files), SETTINGS)) - pairs) + sum(n > 1 for n in keys.values())
    return {
        "missions": len(files),
        "flown_s": flown_s,
        "rows": len(rows),
        "missing": len(set(itertools.product(map(str, files), SETTINGS)) - pairs),
        "double": sum(count > 1 for count in keys.values()),
        "failed": {f"{stems[row['key']]} {row['settings']['refine']}": row["error"] for row in rows if row["error"]},
        "killed": first["killed"],
        "wall_s": first["wall_s"],
        "cpu_of_all_s": first["cpu_s"],
        "caller_mb": first["caller_mb"],
        "again_s": again["wall_s"],
        "again_computed": again["computed"],
        "task_cpu_s": float(np.mean([row["cpu_s"] for row in good])),
        "over_warm_replay": float(np.median([row["cpu_s"] / cpu_s for row, cpu_s in zip(chosen, warm, strict=True)])),
        "compared": len(chosen),
        "different": sum(map(_differs, chosen)),
        "fault_count": fault_count,
    }


def _fly(mission: tuple[int, Path, float]) -> None:
    from flowrec.core import terminal
    from flowrec.stages import load_config
    from flowrec.verbs.record import record

    terminal.console.quiet = True
    seed, file, length_s = mission
    record(load_config(None, [*SMALL, f"simulated.seed={seed}", f"duration_s={length_s}"]), file)


def _swept(files: list[Path], out: Path, workers: int, kill_every_s: float, planted: Path) -> dict[str, Any]:
    """One call of the verb, while a process of it is killed again and again."""
    words = child_command(
        "flowrec", "sweep", *map(str, files), "--grid", f"refine={','.join(SETTINGS)}", "-o", str(out)
    )
    words += ["--workers", str(workers), "--timeout", "15", "--memory", "3GB", "--json"]
    environment = child_environment()
    environment["PYTHONPATH"] = f"{planted}{os.pathsep}{environment['PYTHONPATH']}"
    began_s = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    caller = psutil.Process(process.pid)
    killed, next_kill_s, memory_mb = 0, kill_every_s, list[float]()
    victims = itertools.cycle(("spawn_main", "replay_process"))  # a worker of Dask, the process in which it replays
    while process.poll() is None:
        time.sleep(_LOOK_S)
        now_s = time.monotonic() - began_s
        try:
            memory_mb.append(caller.memory_info().rss / 1e6)
            if kill_every_s and now_s > next_kill_s:
                found = list(_processes(caller, next(victims)))
                next_kill_s = now_s + kill_every_s
                if found:
                    found[killed % len(found)].kill()
                    killed += 1
        except psutil.Error:  # it has ended meanwhile
            continue
    assert process.stdout is not None
    said = json.loads(process.stdout.read())
    quarter = max(len(memory_mb) // 4, 1)
    return {
        "wall_s": time.monotonic() - began_s,
        "cpu_s": _cpu_of_children_s(),
        "killed": killed,
        "computed": said["computed"],
        # Of the second and the third quarter, and at the end, where the rows are read and ranked.
        "caller_mb": [max(memory_mb[n * quarter : (n + 1) * quarter], default=0.0) for n in (1, 2)] + memory_mb[-1:],
    }


def _processes(caller: psutil.Process, word: str) -> Iterator[psutil.Process]:
    for process in caller.children(recursive=True):
        if any(word in each for each in process.cmdline()):
            yield process


def _cpu_of_children_s() -> float:
    times = psutil.Process().cpu_times()
    return float(times.children_user + times.children_system)


def _warm_cpu_s(rows: list[dict[str, Any]]) -> list[float]:
    """CPU time of `flowrec.replay` in this process, which has replayed each once before."""
    import flowrec

    found = []
    for row in rows:
        for _ in range(2):
            began_s = time.process_time()
            flowrec.replay(row["session"], **row["settings"])
            cpu_s = time.process_time() - began_s
        found.append(cpu_s)
    return found


def _differs(row: dict[str, Any]) -> bool:
    """Whether a row is not what `flowrec replay --json` prints."""
    words = [word for key, value in row["settings"].items() for word in (f"--{key}", value)]
    out = Path(row["session"]).parents[1] / "compared.mcap"
    command = child_command("flowrec", "replay", row["session"], *words, "--json", "--overwrite", "-o", str(out))
    said = json.loads(subprocess.run(command, env=child_environment(), check=True, stdout=subprocess.PIPE).stdout)
    out.unlink()
    figures = {each["quantity"]: [each["recorded"], each["replayed"]] for each in said["rows"]}
    same = all(said[name] == row[name] for name in ("refinement", "ticks", "duration_s"))
    return not same or figures != row["figures"]


def show(found: dict[str, Any]) -> None:
    """Print the figures."""
    lines = [{"what": name, "value": str(value)} for name, value in found.items() if name != "machine"]
    print_rows("flowrec sweep", lines, {"": "{what}", "value": "{value}"})


if __name__ == "__main__":
    run(measure, show)
    sys.exit()
