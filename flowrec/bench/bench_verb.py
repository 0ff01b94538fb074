"""The verb bench: the table of the benches. Only this file imports flowrec.bench, late."""

from __future__ import annotations

import importlib

import typer

from flowrec.verbs import WholeDescriptions

BENCHES = {
    "paper": "The paper, all of it: each figure, table and experiment; goes on after a stop.",
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

bench = typer.Typer(
    cls=WholeDescriptions, help="Measure flowrec: validate an installation, reproduce the paper.", no_args_is_help=True
)
_ALL_WORDS = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def _bench(context: typer.Context) -> None:
    from flowrec.bench.harness import run

    module = importlib.import_module(f"flowrec.bench.{context.info_name}")
    run(module.measure, module.show, context.args, context.command_path, BENCHES[str(context.info_name)])


for _name, _summary in BENCHES.items():
    bench.command(_name, help=_summary, context_settings=_ALL_WORDS)(_bench)
