"""`python -m tests.perf.constants`: which numbers in the source decide a result, and how much.

Each module-level number of the chosen rooms is made smaller and larger by a factor in a copy of the package, and the
same missions are flown with it. A number that changes an outcome needs a source, a derivation or a bench beside it, or
is better a setting; one that changes nothing needs neither. Missions are a function of their seed, but a robot that
takes another path meets other noise, so changes of a few percent mean nothing.
"""

from __future__ import annotations

import ast
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import flowrec
from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import progress

PACKAGE = Path(flowrec.__file__).parent
ROOMS = "vision,estimation,planning,control,refine,flow"
FLIGHTS = (
    ("chip.name=bifurcation", "simulated.seed=11"),
    ("chip.name=vessels", "chip.seed=12", "simulated.seed=12"),
    (
        *("chip.name=bifurcation", "simulated.seed=13", "survey.method=downstream", "survey.share=1.0"),
        *("mission.goal=inlet", "control.method=policy"),
    ),
)
# Numbers that name something, or that only a bench uses.
NOT_QUANTITIES = ("LENGTH, TRAVEL_TIME, PAPER", "USED, SKIPPED, RESTART", "SIGNS", "LEVELS", "OUTPUTS", "INPUTS")
NOTICED = 0.1  # relative change of a measure


@dataclass(frozen=True, slots=True)
class Constant:
    """Where a number, or several, stand in the source; `span` are the offsets of each literal in its line."""

    file: Path
    line: int
    name: str
    spans: tuple[tuple[int, int], ...]

    def scaled(self, source: str, factor: float) -> str:
        """The source with these numbers times a factor; a whole number stays whole and changes by one at least."""
        lines = source.splitlines(keepends=True)
        text = lines[self.line - 1]
        for begin, end in reversed(self.spans):
            value = ast.literal_eval(text[begin:end])
            new = value * factor
            if isinstance(value, int):
                new = max(1, round(new))
                new += (factor > 1.0) - (factor < 1.0) if new == value else 0
            text = f"{text[:begin]}{new!r}{text[end:]}"
        lines[self.line - 1] = text
        return "".join(lines)


def constants(rooms: list[str]) -> Iterator[Constant]:
    """Module-level numbers and tuples of numbers, each on one line."""
    for room in rooms:
        for file in sorted((PACKAGE / room).rglob("*.py")):
            for node in ast.parse(file.read_text()).body:
                if not isinstance(node, ast.Assign) or node.lineno != node.end_lineno:
                    continue
                name = ast.unparse(node.targets[0]).strip("()")
                parts = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
                numbers = [
                    part for part in parts if isinstance(part, ast.Constant) and type(part.value) in (int, float)
                ]
                if numbers and len(numbers) == len(parts) and name not in NOT_QUANTITIES:
                    spans = tuple((n.col_offset, n.end_col_offset or 0) for n in numbers if n.value)
                    yield Constant(file.relative_to(PACKAGE), node.lineno, name, spans)


def fly() -> dict[str, Any]:
    """Measures of the flights with the package that is imported here, on one line of stdout."""
    from flowrec.bench.missions import MissionLog
    from flowrec.physics import load_chip, relative_rmse
    from flowrec.rigs import SimulatedRig
    from flowrec.run import LockstepWorker
    from flowrec.run import run as fly_mission
    from flowrec.stages import assemble, load_config
    from flowrec.stages.resolve import resolve

    measures: dict[str, Any] = {}
    for number, sets in enumerate(FLIGHTS):
        asked = load_config(None, list(sets))
        chip = load_chip(asked.chip)
        config = resolve(asked, chip)
        pipeline = assemble(config, chip)
        log, truth, tracked = MissionLog(), [], []

        def watch(tick: Any, truth: list[Any] = truth, tracked: list[float] = tracked) -> None:
            if tick.true_field is not None:
                truth.append(tick.true_field)
            if tick.track.seen:
                tracked.append(float(np.hypot(*(tick.track.position_um - tick.truth.position_um))))

        rig, worker = SimulatedRig.of(pipeline, config), LockstepWorker(pipeline, config.worker.adopt_after_s)
        report = fly_mission(pipeline, rig, worker, [log], on_tick=watch)
        last = report.last
        measures |= {
            f"{number} outcome": report.outcome,
            f"{number} contacts": sum(log.contacts.values()),
            f"{number} end s": last.stamp_ns * 1e-9,
            f"{number} tracked um": float(np.median(tracked)) if tracked else None,
            f"{number} off route um": math.sqrt(float(np.mean(log.squared_um2))) if log.squared_um2 else None,
        }
        if last.refined is not None:
            measures[f"{number} refined %"] = 100.0 * float(relative_rmse(last.refined, truth[0], chip.mask).v)
    return measures


def measure(
    rooms: Annotated[str, typer.Option(metavar="A,B", help="Rooms whose numbers are changed.")] = ROOMS,
    factor: Annotated[float, typer.Option(min=1.01, help="By which they become larger, and smaller.")] = 1.4,
    every: Annotated[int, typer.Option(min=1, help="Only each n-th number.")] = 1,
) -> Results:
    """One row for each number: what changed, and the larger of both changes."""
    chosen = list(constants(rooms.split(",")))[::every]
    rows = []
    with ExitStack() as stack:
        copy = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        shutil.copytree(PACKAGE, copy / "flowrec", ignore=shutil.ignore_patterns("__pycache__"))
        before = _flown(copy)
        done = stack.enter_context(progress("flying", len(chosen)))
        for number, constant in enumerate(chosen, 1):
            file = copy / "flowrec" / constant.file
            source = file.read_text()
            changes: dict[str, float] = {}
            for by in (1.0 / factor, factor):
                file.write_text(constant.scaled(source, by))
                for name, change in _changes(before, _flown(copy)).items():
                    changes[name] = max(changes.get(name, 0.0), change, key=abs)
            file.write_text(source)
            noticed = {name: change for name, change in changes.items() if abs(change) > NOTICED}
            largest = max(noticed.items(), key=lambda entry: abs(entry[1]), default=("", 0.0))
            rows.append(
                {"constant": f"{constant.file}:{constant.line} {constant.name}", "measure": largest[0]}
                | {"change": largest[1], "noticed": noticed}
            )
            done(number)
    return {"factor": factor, "before": before, "rows": sorted(rows, key=lambda row: -abs(row["change"]))}


def _flown(copy: Path) -> dict[str, Any]:
    """Measures of the flights with a copy of the package; {} if it does not run."""
    words = [sys.executable, "-c", "import json; from tests.perf.constants import fly; print(json.dumps(fly()))"]
    paths = os.pathsep.join([str(copy), str(Path(__file__).parents[2])])
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run(words, check=False, capture_output=True, text=True, env=environment, cwd=copy)
    return json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else {}


def _changes(before: dict[str, Any], after: dict[str, Any]) -> dict[str, float]:
    """Relative change of each measure; infinite where an outcome is another, or there is none."""
    changes = {}
    for name, old in before.items():
        new = after.get(name)
        if isinstance(old, str) or old is None or new is None:
            changes[name] = 0.0 if old == new else math.inf
        elif name.endswith("contacts"):
            changes[name] = float(new - old)
        else:
            changes[name] = (new - old) / max(abs(old), 1e-12)
    return changes


def show(results: Results) -> None:
    """Print the numbers that change a measure by more than a tenth."""
    noticed = [row for row in results["rows"] if row["change"]]
    print_rows(
        f"{len(noticed)} of {len(results['rows'])} numbers change a measure by more than {NOTICED:.0%} when they are "
        f"{results['factor']:g} times larger or smaller",
        noticed,
        {"constant": "{constant}", "measure": "{measure}", "change": "{change:+.0%}"},
    )


if __name__ == "__main__":
    run(measure, show)
