"""`flowrec bench paper`: every figure, table and experiment of the paper (arXiv 2503.11124) on the simulated rig.

EXPERIMENTS is the list. A case is one cell of an experiment with one seed; its row is appended to rows.jsonl of the
folder when it ends, with the commit, processor, date and numerics that made it. A run that was stopped goes on: what
has a row is not computed again. Seeds are taken in order, so that a stop leaves cells of equal size. At the end
rows.parquet and the figures, 88 and 180 mm wide, are made of the rows. `--seeds 0:0` makes these alone.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench import paper_cases as cases
from flowrec.bench.harness import (
    Results,
    choose_names,
    code_version,
    cut_torn_end,
    kept_lines,
    need_matplotlib,
    paired_ratio,
    print_rows,
)
from flowrec.bench.paper_figures import write_figures
from flowrec.bench.paper_rows import write_parquet
from flowrec.bench.track import LAWS
from flowrec.core import FlowrecError, UsageError, append_line, progress, provenance, say

Cell = dict[str, Any]
CHEAP = ("fvm", "gain", "modes", "network", "gp", "unet", "assimilate", "pi_unet")
DEAR = ("pi_unet:printed", "pinn", "ni")  # some ten seconds a case
SENSITIVE = ("fvm", "gain", "assimilate", "pi_unet")
LEVELS: dict[str, tuple[float, ...]] = {
    "share": (0.02, 0.05, 0.1, 0.2),
    "noise": (0.0, 0.05, 0.1, 0.3),
    "inlets": (0.0, 0.15, 0.3, 0.6),
    "viscosity": (0.33, 1.0, 3.0),
}
CASES_A_CELL = 20  # that the published intervals are meant to have


@dataclass(frozen=True, slots=True)
class Experiment:
    """A row of the table."""

    of: str  # what of the paper it is
    # seed, folder of the reference data or None, and the values of a cell to the results of a row
    case: Callable[..., Results]
    cells: dict[str, Sequence[Any]]  # the values by name; their product are the cells
    seeds: int | None = None  # as many there are at most; None: without end
    needs: str = ""  # folder in the reference data, without which the experiment is left out

    def each_cell(self) -> list[Cell]:
        """The cells, the last of the values varying fastest."""
        return [dict(zip(self.cells, values, strict=True)) for values in product(*self.cells.values())]


_CHIPS = ("straight", "bifurcation")
_NAVIGATIONS = ("astar_paper", "astar_length", "time_field", "policy")


def _missions(world: str, sampler: str, *navigations: str) -> dict[str, Sequence[Any]]:
    """Cells of missions on the map of a survey, trimmed as in the paper or as the filter has it."""
    given = {"chip": _CHIPS, "world": (world,), "sampler": (sampler,)}
    return {**given, "way": ("down", "up"), "navigation": navigations}


EXPERIMENTS: dict[str, Experiment] = {
    "survey": Experiment(
        "Fig. 11", cases.survey, {"chip": _CHIPS, "world": ("moderate", "kind"), "sampler": ("trimmed", "filter")}
    ),
    "missions": Experiment("Fig. 3 and 10", cases.mission, _missions("moderate", "trimmed", *_NAVIGATIONS)),
    "missions_kind": Experiment("Fig. 3 and 10", cases.mission, _missions("kind", "trimmed", *_NAVIGATIONS)),
    "laws": Experiment(
        "baselines of Fig. 7, in missions",
        cases.mission,
        _missions("kind", "trimmed", "without", "with observer", "energy"),
    ),
    "missions_untrimmed": Experiment("Fig. 10", cases.mission, _missions("moderate", "filter", *_NAVIGATIONS)),
    "tracking_ideal": Experiment("Fig. 7 and 8", cases.tracking, {"world": ("ideal",), "law": tuple(LAWS)}, 1),
    "tracking": Experiment("Fig. 7 and 8", cases.tracking, {"world": ("all",), "law": tuple(LAWS)}),
    "planning": Experiment(
        "Fig. 5 and 6",
        cases.trip,
        {"ratio": (0.9, 0.5, 1.3), "way": ("down", "up"), "planner": tuple(cases.planners())},
    ),
    "table_1_crops": Experiment(
        "Table I, Fig. 4", cases.refinement, {"vessels": ("crops",), "method": CHEAP}, needs="masks"
    ),
    "table_1_drawn": Experiment("Table I", cases.refinement, {"vessels": ("drawn",), "method": CHEAP}),
    "table_1_openfoam": Experiment(
        "Table I", cases.refinement, {"vessels": ("openfoam",), "method": (*CHEAP, *DEAR)}, 10, "vessels"
    ),
    **{
        f"sens_{varied}": Experiment(
            "sensitivity", cases.sensitivity, {"varied": (varied,), "level": levels, "method": SENSITIVE}
        )
        for varied, levels in LEVELS.items()
    },
    "sens_mesh": Experiment(
        "sensitivity",
        cases.refinement,
        {"vessels": ("openfoam",), "level": (1, 2, 4), "method": SENSITIVE},
        10,
        "vessels",
    ),
    "table_1_crops_dear": Experiment(
        "Table I, Fig. 4", cases.refinement, {"vessels": ("crops",), "method": DEAR}, needs="masks"
    ),
    "table_1_drawn_dear": Experiment("Table I", cases.refinement, {"vessels": ("drawn",), "method": DEAR}),
    "ablation": Experiment(
        "terms of the loss", cases.refinement, {"vessels": ("drawn",), "method": tuple(cases.ABLATION)}
    ),
}


def _seed_range(text: str) -> str:
    first, _, end = text.partition(":")
    if not (first.isdecimal() and end.isdecimal() and int(first) <= int(end)):
        raise typer.BadParameter(f"{text}: is no range of seeds such as 0:20")
    return text


def measure(
    folder: Annotated[Path, typer.Option("--dir", metavar="DIR", help="Rows and figures; a run there goes on.")],
    only: Annotated[str | None, typer.Option(metavar="A,B", help=f"Of {', '.join(EXPERIMENTS)}.")] = None,
    seeds: Annotated[
        str, typer.Option(metavar="A:B", callback=_seed_range, help="From the first to before the last.")
    ] = f"0:{CASES_A_CELL}",
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            envvar="FLOWREC_REFERENCE_DATA",
            help="Reference data: vessels/*.npz by OpenFOAM, masks/*.png of fundus images.",
        ),
    ] = None,
    experiments: dict[str, Experiment] = EXPERIMENTS,
) -> Results:
    """Rows by experiment and cell: how many there are, and how long all of them take.

    Raises UsageError if there is no such experiment, the rows in the folder can not be read, or a package is missing.
    """
    names = choose_names("bench paper: no experiment", only, experiments)
    if importlib.util.find_spec("pyarrow") is None:
        raise UsageError("bench paper needs pyarrow, which is not installed: pip install 'flowrec[export]'")
    need_matplotlib()
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "rows.jsonl"
    rows = read_rows(file, experiments)
    first, end = (int(each) for each in seeds.split(":"))
    here = []
    for name in names:
        if (needs := experiments[name].needs) and (data is None or not (data / needs).is_dir()):
            say(f"{name} is left out: there is no folder of reference data with {needs} in it (--data)")
        else:
            here.append(name)
    left = [
        (name, cell, seed)
        for seed in range(first, end)
        for name in here
        if experiments[name].seeds is None or seed < (experiments[name].seeds or 0)
        for cell in experiments[name].each_cell()
        if row_key(name, cell, seed) not in rows
    ]
    facts = made_by()
    if others := {str(row["commit"]) for row in rows.values()} - {facts["commit"]}:
        say(f"{file}: has rows of {', '.join(sorted(others))}, this is {facts['commit']}; name another folder for one")
    cut_torn_end(file)
    with progress("the paper", len(left), "cases") as done:
        for count, (name, cell, seed) in enumerate(left, 1):
            row = run_case(experiments[name], name, cell, seed, data) | facts
            append_line(file, json.dumps(row).encode())
            rows[row_key(name, cell, seed)] = row
            done(count)
    kept = list(rows.values())
    if kept:
        write_parquet(kept, folder / "rows.parquet")
    return {
        "cells": [summary(name, experiments[name], kept) for name in names],
        "figures": write_figures(kept, folder),
        "commits": sorted({str(row["commit"]) for row in kept}),
    }


def run_case(experiment: Experiment, name: str, cell: Cell, seed: int, data: Path | None) -> Results:
    """The row of a case: what it is, its results or why it has none (`failed`), and the seconds that it took."""
    began, began_cpu = time.perf_counter(), time.process_time()
    try:
        found, failed = experiment.case(seed, data, **cell), ""
    except FlowrecError as error:
        found, failed = {}, str(error)
    taken = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - began_cpu}
    return {"experiment": name, **cell, "seed": seed, "failed": failed, **found, **taken}


def row_key(name: str, cell: Cell, seed: int) -> str:
    """Identifies a case, whatever the order of the values of its cell."""
    return json.dumps([name, sorted((key, value) for key, value in cell.items()), seed])


def read_rows(path: Path, experiments: dict[str, Experiment]) -> dict[str, Results]:
    """The rows of a file by their key; of two of one case the later. UsageError: it holds something else."""
    rows: dict[str, Results] = {}
    for number, line in enumerate(kept_lines(path), 1):
        try:
            row = json.loads(line)
            cell = {name: row[name] for name in experiments[row["experiment"]].cells}
            rows[row_key(row["experiment"], cell, row["seed"])] = row
        except (ValueError, TypeError, KeyError) as error:
            raise UsageError(f"{path}, line {number}: is no row of bench paper; name another folder") from error
    return rows


def made_by() -> dict[str, str]:
    """Commit, processor, date and numerics, which every row states."""
    facts = provenance(anonymous=True)
    return {
        "commit": code_version(),
        "processor": processor(),
        "date": facts["wall_time"][:10],
        "numerics": facts["numerics_version"],
    }


def processor() -> str:
    """The model of the processor and the number of cores, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else platform.processor() or platform.machine()}, {os.cpu_count()} cores"


def compare(rows: Iterable[Results], by: str, a: str, b: str, name: str) -> Results:
    """`paired_ratio` of a value of the rows whose `by` is `a` over that of those whose `by` is `b`.

    Rows are a pair that have the seed and all other values of their cells in common; what has no partner is left out.
    """
    values: dict[str, dict[str, float]] = {}
    for row in rows:
        if row["failed"] or row.get(name) is None:
            continue
        cell = {key: row[key] for key in EXPERIMENTS[row["experiment"]].cells if key != by}
        values.setdefault(row[by], {})[row_key(row["experiment"], cell, row["seed"])] = row[name]
    one, other = values.get(a, {}), values.get(b, {})
    return paired_ratio(np.array([one[key] / other[key] for key in sorted(one.keys() & other.keys())], np.float64))


def summary(name: str, experiment: Experiment, rows: Sequence[Results]) -> Results:
    """The state of an experiment: cases of its cells, CPU time spent and, to CASES_A_CELL in each, left."""
    counts = [sum(_is(row, name, cell) for row in rows) for cell in experiment.each_cell()]
    mine = [row for row in rows if row["experiment"] == name]
    spent = sum(row["cpu_seconds"] for row in mine)
    wanted = min(CASES_A_CELL, experiment.seeds or CASES_A_CELL)
    left = sum(max(wanted - count, 0) for count in counts)
    return {
        "experiment": name,
        "of": experiment.of,
        "cells": len(counts),
        "fewest": min(counts),
        "most": max(counts),
        "failed": sum(bool(row["failed"]) for row in mine),
        "spent_h": spent / 3600.0,
        "left_h": left * spent / len(mine) / 3600.0 if mine else None,
    }


def _is(row: Results, name: str, cell: Cell) -> bool:
    return row["experiment"] == name and all(row[key] == value for key, value in cell.items())


def show(results: Results) -> None:
    """Print the state of each experiment; the numbers are in rows.parquet, and notebook 05 makes its tables of them."""
    print_rows(
        f"Rows of the paper, by {'; '.join(results['commits']) or 'nobody yet'}; left: to {CASES_A_CELL} cases a cell",
        results["cells"],
        {
            **{"experiment": "{experiment}", "of the paper": "{of}", "cells": "{cells}", "cases": "{fewest} to {most}"},
            **{"failed": "{failed}", "spent, CPU h": "{spent_h:.2f}", "left": "{left_h:.2f}"},
        },
    )
    say(f"{len(results['figures'])} figures: {', '.join(results['figures'])}")
