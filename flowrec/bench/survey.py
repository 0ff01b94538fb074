"""`flowrec bench survey`: error of the assimilated flow by the places of its observations, whose number is the same.

A case is read without its truth, which is read to make observations and to score the result. A robot that starts at the
inlet and must still reach the outlet can follow the ways of the survey planners only; the other ways are references.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.flow import make_up
from flowrec.bench.harness import Cases, Names, Results, choose_names, print_rows, vessel_cases
from flowrec.bench.vessel_truth import NOISES, Noise, ObservedShare, read_observations, read_true_velocity
from flowrec.bench.vessels import thin
from flowrec.core import Floats, FlowError, FlowField, Observations, Route, nearest_pixels, progress, say
from flowrec.physics import Chip, Doubts, FlowSolver, FlowUncertainty, relative_rmse, sample
from flowrec.stages import (
    Need,
    Refiner,
    ResolvedConfig,
    Sampling,
    SurveyOrder,
    SurveyPlanner,
    covariance_after,
    length_um,
    load_config,
    resolve,
)

RANDOM_CASES = 20  # made up where no folder of cases is given
_MOST_STRETCHES = 60  # of a route; a survey that asks for more is ended
Points = Floats


@dataclass(frozen=True, slots=True, eq=False)
class SurveyCase:
    """A case, and how it is observed."""

    name: str
    config: ResolvedConfig
    chip: Any
    assumed: FlowField
    truth: FlowField
    count: int  # of the observations
    spacing_um: float  # between two along the given way
    noise_um_s: float
    given_um: Points  # (count, 2) the places along the given way
    rng: np.random.Generator

    def observe(self, places_um: Points) -> Observations:
        """The true flow at places (n, 2), with noise."""
        flow = sample(self.truth, places_um)
        flow = flow + self.noise_um_s * self.rng.standard_normal(flow.shape)
        return Observations(0, places_um, flow, np.full(len(places_um), self.noise_um_s))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The places of the observations, and the time that a robot needs for them, s; None: they are on no route."""

    places_um: Points
    seconds: float | None = None
    reason: str = ""


def given_places(task: SurveyCase) -> Seen:
    """The places that the case holds: a path along the skeleton between two openings."""
    return Seen(task.given_um)


def random(task: SurveyCase) -> Seen:
    """Random places of the skeleton."""
    places = np.argwhere(thin(task.chip.mask))[:, ::-1] * task.chip.um_per_px
    return Seen(places[task.rng.permutation(len(places))[: task.count]].astype(np.float64))


def prior(task: SurveyCase) -> Seen:
    """Places of the skeleton, chosen one after another so that each lowers the stated error of the map most."""
    places = (np.argwhere(thin(task.chip.mask))[:, ::-1] * task.chip.um_per_px).astype(np.float64)
    return Seen(_best(task, places))


def _best(task: SurveyCase, places: Points) -> Points:
    """Greedy choice among places (n, 2): each next one lowers the predicted error of the map most."""
    uncertainty = task.config.refine.uncertainty(
        task.assumed, Observations(0, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)), task.chip, task.config.flow
    )
    assert uncertainty is not None
    need, each = place_information(uncertainty, task.noise_um_s, task.chip, places)
    covariance, left, taken = uncertainty.covariance, list(range(len(places))), []
    for _ in range(min(task.count, len(places))):
        errors = [need.error(covariance_after(covariance, each[k])) for k in left]
        best = left.pop(int(np.argmin(errors)))
        covariance = covariance_after(covariance, each[best])
        taken.append(best)
    return places[taken]


def place_information(
    uncertainty: FlowUncertainty, noise_um_s: float, chip: Chip, places_um: Points
) -> tuple[Need, list[Points]]:
    """The need of the whole map, and the information (q, q) of one observation in each of n places (n, 2).

    Without a robot: what observations would be worth if they could be taken anywhere.
    """
    rows, columns = nearest_pixels(places_um / chip.um_per_px, chip.mask.shape)
    pixel = (np.cumsum(chip.mask.ravel()) - 1)[rows * chip.mask.shape[1] + columns]
    effect = replace(uncertainty, doubts=Doubts.none(0)).effect(pixel, np.zeros((len(pixel), 2)))
    variance = noise_um_s**2 + uncertainty.error_um_s[pixel] ** 2
    need = Need.of(uncertainty, (1.0, np.ones(len(uncertainty.mean_um_s))))
    return need, [effect[k].T @ effect[k] / variance[k] for k in range(len(pixel))]


def survey(task: SurveyCase, planner: SurveyPlanner, choose: bool = False) -> Seen:
    """Places along the route of a survey: evenly spread, or with `choose` the best of those a mask pixel apart."""
    config = task.config
    start = np.array(config.mission.start)
    sampling = Sampling(2.0 * task.spacing_um, 0.0, task.noise_um_s)
    route: Route | None = None
    observed = task.observe(np.zeros((0, 2)))
    for _ in range(_MOST_STRETCHES):
        uncertainty = config.refine.uncertainty(task.assumed, observed, task.chip, config.flow)
        ends = 0.0 if route is None else route.lasts_s
        order = SurveyOrder(
            *(task.assumed, start, task.chip, config.robot, np.array(config.mission.goal)),
            *(uncertainty, sampling, observed, route, ends),
        )
        new = planner.plan(order)
        if not new.reachable:
            break
        route, start = new, new.waypoints_um[-1]
        observed = _extend_observations(observed, task.observe(_along(route, sampling.spacing_um)))
        if not route.more:
            break
    if route is None:
        return Seen(np.zeros((0, 2)), reason=new.reason)
    length = length_um(route)
    places = _along(route, length / max(task.count - 1, 1) * (1.0 - 1e-9))
    if choose:
        places = _best(task, _along(route, task.chip.um_per_px))
    return Seen(places[: task.count], route.lasts_s, route.reason)


def _extend_observations(before: Observations, now: Observations) -> Observations:
    """The observations along a route that was extended; those along its first part keep their flows."""
    flow = np.concatenate([before.flow_um_s, now.flow_um_s[len(before.flow_um_s) :]])
    return replace(now, flow_um_s=flow)


def _along(route: Route, spacing_um: float) -> Points:
    """Places (n, 2) along a route at equal distances, its start first."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route.waypoints_um, axis=0).T))])
    at = np.arange(0.0, length[-1] + 1e-9, spacing_um)
    return np.column_stack([np.interp(at, length, route.waypoints_um[:, c]) for c in (0, 1)])


_EXPLORE = SurveyPlanner(method="information", route_share=0.0)
WAYS: dict[str, Callable[[SurveyCase], Seen]] = {
    "given": given_places,
    "downstream": lambda task: survey(task, SurveyPlanner(method="downstream", share=1.0)),
    "random": random,
    "information": lambda task: survey(task, _EXPLORE),
    "information:chosen": lambda task: survey(task, _EXPLORE, choose=True),
    "information:longer": lambda task: survey(task, replace(_EXPLORE, worth=0.5 * _EXPLORE.worth)),
    "information:unhurried": lambda task: survey(task, replace(_EXPLORE, worth=0.25 * _EXPLORE.worth), choose=True),
    "prior": prior,
}


def measure(
    cases: Cases = None,
    ways: Names = None,
    noise: Noise = "05",
    share: ObservedShare = "10",
    count: Annotated[int, typer.Option(min=1, help="Random cases, where no folder is given.")] = RANDOM_CASES,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first of them.")] = 1,
    draws: Annotated[int, typer.Option(min=1, help="Draws of the noise per case; the error is their mean.")] = 4,
) -> Results:
    """Rows by case and way, and a summary by way. Raises UsageError if there is no case or no such way."""
    names = choose_names("bench survey: no way", ways, WAYS)
    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        if cases is None:
            cases = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            make_up(cases, count, seed)
        paths = vessel_cases(cases)
        done = stack.enter_context(progress("surveying", len(paths), "cases"))
        for number, path in enumerate(paths, 1):
            rows += survey_rows(path, names, noise, share, draws)
            done(number)
    return {
        **{"noise": noise, "share": share, "rows": rows},
        "summary": {name: summary([row for row in rows if row["way"] == name]) for name in names},
    }


def survey_rows(path: Path, names: Sequence[str], noise: str, share: str, draws: int) -> list[dict[str, Any]]:
    """The rows of a case."""
    config = resolve_case(path)
    chip, solver = config[1], FlowSolver(2)
    seen = read_observations(path, noise, share)
    assumed = solver.solve(chip)
    truth = replace(assumed, velocity_um_s=read_true_velocity(path).astype(np.float32))
    steps = np.hypot(*np.diff(seen.position_um, axis=0).T)
    sigma = max(float(seen.std_um_s[0]), 1e-3 * NOISES["05"] * float(np.abs(assumed.velocity_um_s).max()))
    rows = []
    for name in names:
        task = SurveyCase(
            *(path.stem, config[0], chip, assumed, truth, len(seen.std_um_s), float(steps.mean()), sigma),
            *(seen.position_um, np.random.default_rng([1, *path.stem.encode()])),
        )
        row: dict[str, Any] = {"case": path.stem, "way": name, "count": None, "error": None, "seconds": None}
        try:
            found = WAYS[name](task)
        except FlowError as fault:
            rows.append(row | {"reason": str(fault)})
            continue
        fields = (
            Refiner("assimilate").refine(assumed, task.observe(found.places_um), chip, solver) for _ in range(draws)
        )
        error = float(np.mean([relative_rmse(each, truth, chip.mask).v for each in fields]))
        rows.append(
            row
            | {"count": len(found.places_um), "error": error, "seconds": found.seconds, "reason": found.reason}
            | {"crossing_s": crossing_s(config[0], chip, assumed)}
        )
    return rows


def crossing_s(config: ResolvedConfig, chip: Any, assumed: FlowField) -> float | None:
    """The planned time from start to goal in the assumed flow."""
    route = config.plan.plan(assumed, config.mission.start, config.mission.goal, chip, config.robot)
    return route.lasts_s if route.reachable else None


def resolve_case(path: Path) -> tuple[ResolvedConfig, Any]:
    """The configuration of a mission on a case, and its chip."""
    from flowrec.physics import load_chip

    asked = load_config(None, [f"chip.path={path}"])
    chip = load_chip(asked.chip)
    return resolve(asked, chip), chip


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and worst error over the cases, and the mean duration in crossings of the chip."""
    errors = np.array([row["error"] for row in rows if row["error"] is not None])
    times = [row["seconds"] / row["crossing_s"] for row in rows if row["seconds"] and row.get("crossing_s")]
    if not len(errors):
        return {"cases": 0, "mean": None, "median": None, "worst": None, "crossings": None, "count": None}
    return {
        "cases": len(errors),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "worst": float(errors.max()),
        "crossings": float(np.mean(times)) if times else None,
        "count": float(np.mean([row["count"] for row in rows if row["count"] is not None])),
    }


def show(results: Results) -> None:
    """Print the summary by way."""
    print_rows(
        f"Error of the assimilated flow, noise {results['noise']} %, as many observations as {results['share']} % of "
        "the skeleton",
        [{"way": name, **line} for name, line in results["summary"].items()],
        {
            **{"way": "{way}", "cases": "{cases}", "observations": "{count:.0f}", "mean": "{mean:.4f}"},
            **{"median": "{median:.4f}", "worst": "{worst:.4f}", "time / crossing": "{crossings:.1f}"},
        },
    )
    for row in results["rows"]:
        if row["error"] is None or row["count"] == 0:
            say(f"{row['case']} {row['way']}: {row['reason']}")
