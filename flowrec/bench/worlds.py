"""`flowrec bench worlds`: what the refined map is worth in worlds that are not the model's.

Every world (`simulated.world = kind, moderate, hard`, and worlds with one fault each) is flown once per chip and seed.
Then every method refines the same observations; `fvm`, no refinement, is the null model. With --rows the flights are
kept, a line of JSON each: a run that was cut short goes on, another method needs no flight, and --again refines once
more, for instance after a change of the method.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from flowrec.bench.harness import (
    Results,
    choose_names,
    code_version,
    cut_torn_end,
    kept_lines,
    mean_with_interval,
    paired_ratio,
    print_rows,
    stated_over_true,
)
from flowrec.bench.null_models import NULL_MODELS
from flowrec.bench.second_worlds import SECOND_WORLDS
from flowrec.bench.world_flights import OF_A_PART, WORLDS, Flight, FlightCase, as_line, fly, refine
from flowrec.core import UsageError, append_line, pool, progress, say
from flowrec.stages import REFINERS
from flowrec.verbs import SetTexts

CHIPS = "bifurcation,vessels-1,vessels-2,vessels-3"
KNOWN = (*REFINERS, *NULL_MODELS, *OF_A_PART)
METHODS = [name for name in ("fvm", "gain", *NULL_MODELS, "assimilate", "pi_unet") if name in KNOWN]
NULL = "gain"  # one factor for the whole assumed flow
_BEYOND = 2.0  # root mean square bars that an error exceeds where the flow was observed
_WORSE = 1.0  # times the assumed error, above which a refined map is worse


def measure(
    worlds: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help=f"Of {', '.join(WORLDS)}, which are flown, and of the second generator, which are surveys: "
            f"{', '.join(SECOND_WORLDS)}; by default all.",
        ),
    ] = None,
    chips: Annotated[str, typer.Option(metavar="A,B", help="bifurcation, straight, vessels-SEED, or files.")] = CHIPS,
    seeds: Annotated[int, typer.Option(min=1, help="Flights in each world on each chip.")] = 20,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first of them.")] = 1,
    methods: Annotated[str, typer.Option(metavar="A,B", help="Refiners to compare.")] = ",".join(METHODS),
    rows: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the flights here, and use those that are here.")
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Refine kept observations once more.")] = False,
    sets: SetTexts = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> Results:
    """Flights, and a summary by world and method.

    Raises UsageError if there is no such world or method, or `rows` is not a file of flights.
    """
    names = choose_names("bench worlds: no world", worlds, (*WORLDS, *SECOND_WORLDS))
    wanted = choose_names("bench worlds: no method", methods, KNOWN)
    cases = [
        FlightCase(world, chip, seed, tuple(sets or ()))
        for seed in range(first_seed, first_seed + seeds)
        for world in names
        for chip in (["second"] if world in SECOND_WORLDS else chips.split(","))
    ]
    flights = {} if rows is None else {flight.key(): flight for flight in read_flights(rows)}
    code = code_version()
    if others := {flight.code or "another one" for flight in flights.values()} - {code}:
        say(f"{rows}: flown by {', '.join(sorted(others))}, this is {code}; another file has only flights of one")
    left = [case for case in cases if _is_left(flights.get(case.key()), wanted, again=again)]
    if rows is not None and len(left) < len(cases):
        say(f"{rows}: {len(cases) - len(left)} of {len(cases)} flights are there")
    work = partial(fly_case, methods=wanted, again=again)
    with ExitStack() as stack:
        done = stack.enter_context(progress("flying", len(left), "missions"))
        if rows is not None:
            cut_torn_end(rows)
        for count, flight in enumerate(_each(work, [(case, flights.get(case.key())) for case in left], jobs), 1):
            flight.code = flight.code or code
            flights[flight.key()] = flight
            if rows is not None:
                append_line(rows, json.dumps(as_line(flight)).encode())
            done(count)
    return results_of([flights[case.key()] for case in cases], names, wanted)


def read_flights(path: Path) -> Iterator[Flight]:
    """The flights of a file; a line that was cut short at its end is left out. Later lines replace earlier ones."""
    for number, line in enumerate(kept_lines(path), 1):
        try:
            yield Flight.of(json.loads(line))
        except (ValueError, TypeError, KeyError) as error:
            raise UsageError(f"{path}, line {number}: is no flight of bench worlds; name another file") from error


def _is_left(flight: Flight | None, methods: Iterable[str], *, again: bool) -> bool:
    if flight is None:
        return True
    return bool(flight.order) and (again or not set(methods) <= flight.refined.keys())


def fly_case(case: FlightCase, flight: Flight | None, methods: Sequence[str], *, again: bool) -> Flight:
    """The flight of a case, flown if it is None, refined by the methods."""
    if flight is None:
        flight = fly(case)
    refine(flight, [name for name in methods if again or name not in flight.refined])
    return flight


def _each(
    work: Callable[[FlightCase, Flight | None], Flight], tasks: Sequence[tuple[FlightCase, Flight | None]], jobs: int
) -> Iterator[Flight]:
    """The results as they are ready."""
    if jobs == 1:
        yield from (work(*task) for task in tasks)
        return
    with pool(jobs) as workers:
        for future in as_completed([workers.submit(work, *task) for task in tasks]):
            yield future.result()


def results_of(flights: Sequence[Flight], worlds: Sequence[str], methods: Sequence[str]) -> Results:
    """The flights without their observations, and summaries by world, of all chips and of the networks alone."""
    groups: dict[str, Callable[[Flight], bool]] = {
        "all": lambda _flight: True,
        "bifurcation": lambda flight: flight.chip == "bifurcation",
        "networks": lambda flight: flight.chip != "bifurcation" and flight.world not in SECOND_WORLDS,
    }
    by_world = {
        world: {
            name: summary([one for one in flights if one.world == world and belongs(one)], methods)
            for name, belongs in groups.items()
        }
        for world in worlds
    }
    return {
        "methods": list(methods),
        "flights": [{key: value for key, value in as_line(one).items() if key != "order"} for one in flights],
        "summary": by_world,
        "pooled": {
            name: {method: scores([one for one in flights if belongs(one)], method) for method in methods}
            for name, belongs in groups.items()
        },
    }


def summary(flights: Sequence[Flight], methods: Sequence[str]) -> Results:
    """Contacts and arrivals of the flights in one world, and the scores of each method."""
    return {
        "flights": len(flights),
        "refused": sum(one.outcome == "refused" for one in flights),
        "reached": sum(one.outcome == "reached" for one in flights),
        "contacts": sum(one.contacts for one in flights),
        "with_contact": sum(one.contacts > 0 for one in flights),
        "methods": {method: scores(flights, method) for method in methods},
    }


def scores(flights: Sequence[Flight], method: str) -> Results:
    """Means over flights with bootstrap 95 % intervals; errors and CRPS relative to the rms speed.

    worse : flights in which the refined error is larger than the assumed one; unsaid : those of them whose note does
    not name a planted cause. invented : flights whose note names a cause that is not there, or its wrong side. beyond :
    flights with an error of more than twice its bar where the flow was observed; doubted : those that say that nothing
    explains what was observed.
    expected : the error that the fields state (error_share). over_null : error over that of `gain`, paired.
    within_2_sigma : share of the components, all flights pooled with the same weight; stated_over_true : root mean
    square of the stated errors over that of the true ones.
    """
    rows = [one.refined for one in flights if method in one.refined and "failed" not in one.refined[method]]
    mine = [row[method] for row in rows]
    worse = [row[method] for row in rows if row[method]["error"] > _WORSE * row["assumed"]["error"] + 1e-9]
    expected = [one["expected"] for one in mine if one["expected"] is not None]
    stated = [one["within_2_sigma"] for one in mine if one["within_2_sigma"] is not None]
    pairs = [row[method]["error"] / row[NULL]["error"] for row in rows if "error" in row.get(NULL, {})]
    return {
        "count": len(mine),
        "failed": sum("failed" in one.refined.get(method, {}) for one in flights),
        "assumed": mean_with_interval([row["assumed"]["error"] for row in rows]),
        "error": mean_with_interval([one["error"] for one in mine]),
        "worst": max((one["error"] for one in mine), default=None),
        "expected": mean_with_interval(expected),
        "crps": mean_with_interval([one["crps"] for one in mine]),
        "within_2_sigma": float(np.mean(stated)) if stated else None,
        "stated_over_true": stated_over_true((one["error"], one.get("stated_over_true")) for one in mine),
        "worse": len(worse),
        "unsaid": sum(not one["warned"] for one in worse),
        "warned": sum(one["warned"] for one in mine),
        "invented": sum(one.get("invented", 0) > 0 for one in mine),
        "beyond": sum(one.get("beyond", 0.0) > _BEYOND for one in mine),
        "doubted": sum(one.get("doubted", False) for one in mine),
        "doubted_beyond": sum(one.get("doubted", False) and one["beyond"] > _BEYOND for one in mine),
        "over_null": paired_ratio(np.array(pairs)) if pairs and method != NULL else None,
    }


def show(results: Results) -> None:
    """Print the scores by world and method, each method beside the null models, and how the missions ended."""
    lines: list[Results] = []
    for world, groups in results["summary"].items():
        for method, found in groups["all"]["methods"].items():
            lines.append(_line(world, method, found))
    for name, found_by in results["pooled"].items():
        for method, found in found_by.items():
            if found["count"]:
                lines.append(_line({"all": "all worlds"}.get(name, f"- {name}"), method, found))
    shown = ""
    for line in lines:  # a name stands on the first of its lines
        line["world"], shown = ("" if line["world"] == shown else line["world"]), line["world"]
    print_rows(
        "Refined flow in worlds that are not the model's: relative RMSE in %, its mean over flights (bootstrap 95 %); "
        "worse: than assumed (and its cause not named); causes: flights with a sentence on a planted one / on another; "
        "doubt: flights that say that nothing explains what was observed / whose error there is over two bars; "
        "2 sigma: part of the components; stated: over the true error; CRPS in % of the speed",
        lines,
        {
            **{"world": "{world}", "method": "{method}", "error": "{after} ({interval})"},
            **{"worse": "{worse} ({unsaid})", "causes": "{warned} / {invented}", "doubt": "{doubted} / {beyond}"},
            **{"2 sigma": "{covered}", "stated": "{stated}", "CRPS": "{score}"},
        },
    )
    flown = [world for world in results["summary"] if world not in SECOND_WORLDS]
    if flown:
        print_rows(
            "Missions, flown with the map of assimilate",
            [{"world": world, **results["summary"][world]["all"]} for world in flown],
            {
                **{"world": "{world}", "flights": "{flights}", "reached": "{reached}", "refused": "{refused}"},
                **{"with contact": "{with_contact}", "contacts": "{contacts}"},
            },
        )
    for method, found in results["pooled"]["all"].items():
        if found["failed"]:
            say(f"{method}: failed in {found['failed']} flights")


def _line(world: str, method: str, found: Results) -> Results:
    def percent(share: float | None, digits: int = 1) -> str:
        return "-" if share is None or not math.isfinite(share) else f"{100 * share:.{digits}f}"

    low, high = found["error"]["interval_95"]
    return {
        **{"world": world, "method": method, "worse": found["worse"], "unsaid": found["unsaid"]},
        **{"warned": found["warned"], "invented": found["invented"]},
        **{"doubted": found["doubted"], "beyond": found["beyond"]},
        "after": percent(found["error"]["mean"]),
        **{
            "interval": f"{percent(low)}-{percent(high)}" if found["count"] else "-",
            "score": percent(found["crps"]["mean"]),
        },
        "stated": f"{found['stated_over_true']:.2f}" if found["stated_over_true"] else "-",
        "covered": percent(found["within_2_sigma"], 0),
    }
