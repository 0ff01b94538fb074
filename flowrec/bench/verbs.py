"""`flowrec bench NAME`: the table of the benches. A bench is imported when it is run."""

from __future__ import annotations

import importlib

import typer

from flowrec.bench.harness import HELP_WIDTH, AsJson, Overwrite, Sets, WholeDescriptions, run
from flowrec.errors import UsageError

__all__ = ["HELP_WIDTH", "AsJson", "Overwrite", "Sets", "WholeDescriptions", "bench"]

BENCHES = {
    "flow": "Refinement: error of the flow before and after each method (Table I and Fig. 4 of the paper).",
    "survey": "The survey: error of the flow with as many observations along different ways.",
    "plan": "Planning: path length and travel time of each planner, upstream and downstream, over the least time.",
    "observer": "Estimation: error of each observer on the paper's lemniscate; settings that suit a recording.",
    "track": "Control: how closely each law tracks the paper's lemniscate in a vortex; vision: robots of many looks.",
    "missions": "Whole simulated missions: arrivals, wall contacts and time over the least time, policies in pairs.",
    "worlds": "The refined map in worlds that are not the model's: errors, error bars and warnings of each refiner.",
    "solver": "The flow solver: deviation from exact and published solutions, time and memory.",
    "loop": "The control loop: time of one tick with recording and viewing on and off, and the speed of a replay.",
}
MOVED = {
    **{name: f"tests.perf.{name}" for name in ("store", "fuzz", "clocks", "large", "grid")},
    "train": "flowrec.refine.training",
}

bench = typer.Typer(
    cls=WholeDescriptions, help="Measure flowrec: validate an installation, reproduce the paper.", no_args_is_help=True
)
_ALL_WORDS = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def _bench(context: typer.Context) -> None:
    module = importlib.import_module(f"flowrec.bench.{context.info_name}")
    run(module.measure, module.show, context.args, context.command_path, BENCHES[str(context.info_name)])


def _moved(context: typer.Context) -> None:
    where = MOVED[str(context.info_name)]
    clone = " in a clone of the repository" if where.startswith("tests") else ""
    raise UsageError(f"{context.command_path} has moved: run 'python -m {where} --help'{clone}")


for _name, _summary in BENCHES.items():
    bench.command(_name, help=_summary, context_settings=_ALL_WORDS)(_bench)
for _name in MOVED:
    bench.command(_name, hidden=True, context_settings=_ALL_WORDS)(_moved)
