"""`flowrec bench missions`: whole missions in the simulated rig, the same worlds under several policies.

A seed is a world: a chip, a flow that is wrong, noise. Every policy flies every trip in it: with the flow and against
it, after a survey and on the assumed map alone. Only the bench looks at the truth; the stages see camera images.
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from flowrec.bench.harness import FigureFile, Results, Sets, chosen, paired, vessel_cases, wilson
from flowrec.chip import load_chip, median_width_um
from flowrec.chip.chip import Chip
from flowrec.commands.record import refuse_adrift
from flowrec.config import ResolvedConfig, load_config
from flowrec.errors import FlowrecError
from flowrec.flow import FlowSolver
from flowrec.messages import FlowField, Route, Tick
from flowrec.pipeline import assemble
from flowrec.planning import Planner
from flowrec.resolve import resolve
from flowrec.rigs.simulated.rig import SimulatedRig, true_chip
from flowrec.robot import USUAL_DELAY_S, Robot
from flowrec.run.loop import LockstepWorker, run
from flowrec.terminal import progress, say, table
from flowrec.units import seconds

# Name: what is set, beside what all have.
POLICIES: dict[str, tuple[str, ...]] = {
    "policy": ("plan.method=time_field", "control.method=policy"),
    "vector": ("plan.method=time_field", "control.method=vector"),
    "astar": ("plan.method=astar_time", "control.method=vector"),
    "plain": ("plan.method=astar_length", "control.method=vector"),
    "paper": ("plan.method=astar_paper", "control.method=ff_fb", "observer.method=luenberger"),
}
# Which way and how much is known when the robot sets out. Upstream with a survey: it rides down, then swims back.
TRIPS: dict[tuple[str, str], tuple[str, ...]] = {
    ("down", "surveyed"): (),
    ("up", "surveyed"): ("survey.share=1.0", "mission.goal=inlet"),
    ("down", "assumed"): ("mission.phases=plan,navigate",),
    ("up", "assumed"): ("mission.phases=plan,navigate", "mission.start=outlet", "mission.goal=inlet"),
}
# Everything that a planner may want to know about the truth, and nothing kept back for the controller.
_BEST = Planner(method="time_field", clearance_margin_um=0.0, speed_share=1.0)


@dataclass(frozen=True, slots=True)
class World:
    """How wrong the assumptions are. The rest (noise, latency) is as in any simulated run."""

    flow_error: float = 0.1  # every true inlet flow is the assumed one times 1 +- this; which, the seed says
    outlet_error: float = 0.0  # simulated.outlet_pressure_error
    latency_s: float | None = None  # of the robot, known to it; None: as `resolve` has it
    sets: tuple[str, ...] = ()  # further settings of all policies


@dataclass(frozen=True, slots=True)
class Row:
    """One mission."""

    seed: int
    chip: str
    way: str  # down, up
    map: str  # surveyed, assumed
    policy: str
    outcome: str  # reached, unreachable (said before leaving), or what went wrong
    note: str
    survey_contacts: int
    contacts: int  # while navigating, planning anew included
    seconds: float | None  # from the adopted route until the goal is reached
    optimum_s: float | None  # the fastest possible from there in the true flow
    ratio: float | None
    planned_s: float | None
    rms_um: float | None  # distance to the reference while navigating
    replans: int
    latency_ms: float
    radius_um: float
    speed_limit_um_s: float

    @property
    def trip(self) -> tuple[int, str, str]:
        """What is the same for all policies."""
        return self.seed, self.way, self.map


class Logbook:
    """A sink that keeps what a row tells."""

    def __init__(self) -> None:
        self.began: tuple[int, NDArray[np.float64], Route] | None = None  # stamp, true place, route
        self.contacts = {"survey": 0, "navigate": 0}
        self.replans = 0
        self.square_um2: list[float] = []
        self._last = Tick()

    def write(self, tick: Tick) -> None:
        mission, truth, before = tick.mission, tick.truth, self._last
        assert mission is not None and truth is not None
        if self.began is None and mission.phase == "navigate":
            assert tick.route is not None
            self.began = (tick.stamp_ns, truth.position_um, tick.route)
        touched = truth.contacts - (before.truth.contacts if before.truth is not None else 0)
        self.contacts["survey" if self.began is None else "navigate"] += touched
        if self.began is not None and mission.wanted == "route" and before.mission is not None:
            self.replans += mission.request != before.mission.request
        demand = tick.demand
        if mission.phase == "navigate" and demand is not None and math.isfinite(demand.error_um):
            self.square_um2.append(demand.error_um**2)
        self._last = tick


def measure(
    seeds: Annotated[int, typer.Option(min=1, help="Worlds; every policy flies all of them, both ways.")] = 40,
    cases: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Vessel cases (*.npz), besides the built-in chips.")
    ] = None,
    policies: Annotated[str, typer.Option(metavar="A,B", help=f"Of {', '.join(POLICIES)}.")] = "policy,vector,paper",
    flow_error: Annotated[float, typer.Option(help="Relative error of each inlet flow.")] = 0.1,
    outlet_error: Annotated[float, typer.Option(help="Same of outlet pressures, of the drop across the chip.")] = 0.0,
    latency: Annotated[
        float | None, typer.Option(metavar="S", help="From command to motion; 0.04, less in swift channels.")
    ] = None,
    sets: Sets = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    figure: FigureFile = None,
    maps: Sequence[str] = ("surveyed", "assumed"),
) -> Results:
    """Rows per mission, a summary per policy, and the policies compared on the trips that both arrived from.

    Seeds take the bifurcation, the vessels and each of the `cases` (*.npz), as it is and slowed down, in turn.

    Raises
    ------
    UsageError
        If there is no such policy or no case, or a figure is wanted and matplotlib is not installed.
    """
    names = chosen("bench missions: no policy", policies, POLICIES)
    world = World(flow_error, outlet_error, latency, tuple(sets or ()))
    paths = [] if cases is None else vessel_cases(cases)
    orders = [
        (seed, chip_of(seed, paths), way, how, policy, world)
        for seed in range(1, seeds + 1)
        for way, how in TRIPS
        if how in maps
        for policy in names
    ]
    rows: list[Row] = []
    with progress("flying", len(orders)) as done:
        if jobs == 1:
            for order in orders:
                rows.append(fly(*order))
                done(len(rows))
        else:
            with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as workers:
                for row in workers.map(_fly, orders, chunksize=4):
                    rows.append(row)
                    done(len(rows))
    figures = {
        "world": asdict(world),
        "seeds": seeds,
        "rows": [asdict(row) for row in rows],
        "summary": {policy: summary([row for row in rows if row.policy == policy]) for policy in names},
        "pairs": {f"{a} / {b}": compared(rows, a, b) for a, b in combinations(names, 2)},
    }
    if figure is not None:
        from flowrec.bench.figure_missions import draw

        draw(figure, figures)
    return figures


def chip_of(seed: int, paths: Sequence[Path]) -> tuple[str, ...]:
    """The settings of a seed's chip: bifurcation, vessels, and each case as it is and slowed down, in turn."""
    turn, kind = divmod(seed - 1, 4 if paths else 2)
    if kind == 0:
        return ("chip.name=bifurcation",)
    if kind == 1:
        return ("chip.name=vessels", f"chip.seed={seed}")
    path = paths[turn % len(paths)]
    return (f"chip.path={path}",) if kind == 2 else slowed(path)


def slowed(path: Path) -> tuple[str, ...]:
    """A vessel case with a flow, and a robot to match, that 40 ms of latency and 30 frames a second can master.

    In that time the robot, 1.3 times as fast as the flow, swims a fifth of the median channel. Many cases as they are
    run a thousand times faster: there the right answer is that nobody can steer in them.
    """
    plain = load_config(None, [f"chip.path={path}"])
    chip = load_chip(plain.chip)
    speed_um_s = 0.2 * median_width_um(chip) / (USUAL_DELAY_S + 1.0 / 30.0)
    peak_um_s = float(np.linalg.norm(plain.flow.solve(chip).velocity_um_s, axis=-1).max())
    inlet_um_s = max(opening.value for opening in chip.openings if opening.kind == "inlet")
    return (
        f"chip.path={path}",
        f"chip.inlet_speed_um_s={inlet_um_s * speed_um_s / 1.3 / peak_um_s:.4g}",
        f"robot.max_speed_um_s={speed_um_s:.4g}",
    )


def _fly(order: tuple[int, tuple[str, ...], str, str, str, World]) -> Row:
    return fly(*order)


def fly(
    seed: int,
    chip_sets: tuple[str, ...],
    way: str,
    how: str,
    policy: str,
    world: World,
    watch: Callable[[Tick], None] | None = None,
) -> Row:
    """One mission, from the first frame to coils at zero."""
    sets = [
        *chip_sets,
        f"simulated.seed={seed}",
        f"simulated.outlet_pressure_error={world.outlet_error}",
        *([] if world.latency_s is None else [f"robot.delay_s={world.latency_s}"]),
        *TRIPS[way, how],
        *POLICIES[policy],
        *world.sets,
    ]
    config = load_config(None, sets)
    name = Path(config.chip.path).stem or config.chip.name
    name += " slowed" if config.chip.path and config.chip.inlet_speed_um_s is not None else ""
    try:
        chip = load_chip(config.chip)
        config = resolve(config, chip)
        refuse_adrift(config, chip)
        truth = true_field(chip, config, world)
    except FlowrecError as error:  # said in one line before anything is switched on
        nothing = (0, 0, None, None, None, None, None, 0, math.nan, math.nan, math.nan)
        return Row(seed, name, way, how, policy, "refused", str(error), *nothing)
    pipeline = assemble(config, chip)
    rig = SimulatedRig.of(pipeline, config, true_field=truth)
    log = Logbook()
    report = run(pipeline, rig, LockstepWorker(pipeline, config.worker.adopt_after_s), [log], on_tick=watch)
    mission = report.last.mission
    assert mission is not None
    outcome = report.outcome
    taken_s = best_s = None
    if log.began is not None:
        began_ns, place_um, _route = log.began
        tolerance_um = config.mission.goal_tolerance_um or config.robot.radius_um
        best_s = optimum_s(truth, place_um, mission.goal_um, tolerance_um, chip, config.robot)
        if outcome == "reached":
            taken_s = seconds(mission.since_ns - began_ns)
        elif outcome == "unreachable":
            outcome = "unreachable too late"
    return Row(
        seed=seed,
        chip=name,
        way=way,
        map=how,
        policy=policy,
        outcome=outcome,
        note=report.note,
        survey_contacts=log.contacts["survey"],
        contacts=log.contacts["navigate"],
        seconds=taken_s,
        optimum_s=best_s,
        ratio=taken_s / best_s if taken_s is not None and best_s else None,
        planned_s=float(log.began[2].arrival_s[-1]) if log.began is not None else None,
        rms_um=math.sqrt(float(np.mean(log.square_um2))) if log.square_um2 else None,
        replans=log.replans,
        latency_ms=1e3 * config.robot.delay_s,
        radius_um=config.robot.radius_um,
        speed_limit_um_s=config.robot.speed_limit_um_s,
    )


def true_field(chip: Chip, config: ResolvedConfig, world: World) -> FlowField:
    """The flow that really is: every inlet off by exactly the world's share, outlets and viscosity as the rig draws."""
    solver = FlowSolver(k=config.simulated.k)
    drawn = true_chip(chip, config.simulated, solver)
    rng = np.random.default_rng([config.simulated.seed, 0xF10])
    signs = np.where(rng.random(len(chip.openings)) < 0.5, -1.0, 1.0)
    inlet = np.array([opening.kind == "inlet" for opening in chip.openings])
    values = np.where(inlet, chip.boundary_values * (1.0 + world.flow_error * signs), drawn.boundary_values)
    field = solver.solve(chip.with_boundary(values, drawn.viscosity_mpa_s))
    return replace(field, method="truth", note=f"inlets off by {100 * world.flow_error:g} %")


def optimum_s(
    truth: FlowField,
    start_um: NDArray[np.float64],
    goal_um: NDArray[np.float64],
    tolerance_um: float,
    chip: Chip,
    robot: Robot,
) -> float | None:
    """The least time in the true flow at the robot's speed limit until the goal is within the tolerance.

    No margin but the robot's radius, no latency, no noise: nothing can be faster. None where there is no way.
    """
    route = _BEST.plan(truth, start_um, goal_um, chip, robot)
    if not route.reachable:
        return None
    far = np.hypot(*(route.waypoints_um - goal_um).T)
    after = int(np.argmax(far <= tolerance_um)) if (far <= tolerance_um).any() else len(far) - 1
    if after == 0:
        return 0.0
    share = min(max((far[after - 1] - tolerance_um) / max(far[after - 1] - far[after], 1e-9), 0.0), 1.0)
    return float(route.arrival_s[after - 1] + share * (route.arrival_s[after] - route.arrival_s[after - 1]))


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Shares with their Wilson 95 % intervals, and how the arrivals compare with the optimum."""
    count = len(rows)
    ratios = np.array([row.ratio for row in rows if row.ratio is not None])
    errors = [row.rms_um / row.radius_um for row in rows if row.rms_um is not None]
    kept = {
        "reached": sum(row.outcome == "reached" for row in rows),
        "unreachable": sum(row.outcome in ("unreachable", "refused") for row in rows),
        "without_contact": sum(row.contacts == 0 for row in rows),
        "survey_without_contact": sum(row.survey_contacts == 0 for row in rows),
    }
    kept["honest"] = kept["reached"] + kept["unreachable"]
    shares = {name: {"count": k, "share": k / count, "wilson_95": wilson(k, count)} for name, k in kept.items()}
    return {
        "missions": count,
        **shares,
        "failed": [f"{row.chip} {row.seed} {row.way} {row.map}: {row.outcome}" for row in rows if not _honest(row)],
        "ratio": {
            "median": float(np.median(ratios)),
            "mean": float(ratios.mean()),
            "worst": float(ratios.max()),
            "within_10_percent": {
                "share": float((ratios <= 1.1).mean()),
                "wilson_95": wilson(int((ratios <= 1.1).sum()), len(ratios)),
            },
        }
        if len(ratios)
        else None,
        "rms_radii": float(np.mean(errors)) if errors else None,
        "replans": sum(row.replans for row in rows),
    }


def _honest(row: Row) -> bool:
    return row.outcome in ("reached", "unreachable", "refused")


def compared(rows: Sequence[Row], a: str, b: str) -> dict[str, Any]:
    """Times of `a` over those of `b` on the trips on which both arrived."""
    times = {(row.policy, row.trip): row.seconds for row in rows if row.seconds}
    trips = sorted({row.trip for row in rows})
    ratios = np.array([times[a, trip] / times[b, trip] for trip in trips if (a, trip) in times and (b, trip) in times])
    return paired(ratios)


def show(figures: dict[str, Any]) -> None:
    """Print the summary per policy and the comparisons."""
    rows = []
    for name, line in figures["summary"].items():
        ratio = line["ratio"]
        rows.append(
            (
                name,
                str(line["missions"]),
                *(_share(line[key]) for key in ("reached", "honest", "without_contact", "survey_without_contact")),
                *((f"{ratio[key]:.2f}" for key in ("median", "mean", "worst")) if ratio else ("-", "-", "-")),
                f"{100 * ratio['within_10_percent']['share']:.0f} %" if ratio else "-",
            )
        )
    error = 100 * figures["world"]["flow_error"]
    table(
        f"Missions over {figures['seeds']} worlds, inlet flows {error:g} % off, Wilson 95 % intervals in brackets",
        ("policy", "n", "reached", "honest", "no contact", "survey", "median", "mean", "worst", "< 1.1"),
        rows,
    )
    for name, line in figures["summary"].items():
        for trouble in line["failed"]:
            say(f"{name}: {trouble}")
    if figures["pairs"]:
        table(
            "Time of one over time of the other on the same trips",
            ("policies", "n", "mean ratio (95 %)", "faster", "sign test p", "Wilcoxon p"),
            [
                (
                    name,
                    str(pair["count"]),
                    f"{pair['mean']:.3f} ({pair['interval_95'][0]:.3f} to {pair['interval_95'][1]:.3f})",
                    f"{pair['less']} of {pair['count']}",
                    f"{pair['sign_p']:.1g}",
                    f"{pair['wilcoxon_p']:.1g}",
                )
                for name, pair in figures["pairs"].items()
                if pair["count"]
            ],
        )


def _share(share: dict[str, Any]) -> str:
    low, high = share["wilson_95"]
    return f"{share['count']} ({100 * low:.0f}-{100 * high:.0f} %)"
