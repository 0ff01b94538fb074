"""`flowrec bench missions`: whole missions in the simulated rig, several policies in the same worlds.

A world and a seed determine the chip, what truly differs from the assumptions, and the noise. Every policy flies every
trip in it, with the flow and against it, after a survey and on the assumed map alone. Only the bench reads the truth;
the stages get camera images.

Coils take part: the demand becomes currents within the limits of amplifiers and coils, and the field that these
currents truly make moves the robot. Each command is held against the limits that a lab's amplifier enforces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from flowrec.bench.figures import draw_missions
from flowrec.bench.harness import FigureFile, Results, choose_names, vessel_cases
from flowrec.bench.mission_tables import Row, compare_times, show, summary  # noqa: F401  bench_verb calls show
from flowrec.bench.world_flights import WORLDS as FAULTS
from flowrec.bench.world_flights import Given, as_seen, in_world
from flowrec.core import (
    Currents,
    Floats,
    FlowField,
    FlowrecError,
    RigError,
    Route,
    Tick,
    UsageError,
    pool,
    progress,
    seconds,
)
from flowrec.physics import USUAL_DELAY_S, Chip, Robot, load_chip, median_width_um
from flowrec.rigs import CommandLimits, SimulatedRig, true_robot
from flowrec.run import LockstepWorker, run
from flowrec.stages import CONTROLLERS, OutputLimits, Planner, Simulated, assemble, load_config
from flowrec.verbs import SetTexts

# The settings of a policy. `plain` is the null model: the shortest path, planned without the flow.
POLICIES: dict[str, tuple[str, ...]] = {
    "policy": ("plan.method=time_field", "control.method=policy"),
    "vector": ("plan.method=time_field", "control.method=vector"),
    "astar": ("plan.method=astar_time", "control.method=vector"),
    "plain": ("plan.method=astar_length", "control.method=vector"),
    "paper": ("plan.method=astar_paper", "control.method=ff_fb", "observer.method=luenberger"),
}
POLICIES |= {
    name: ("plan.method=time_field", f"control.method={name}")
    for name in CONTROLLERS.usable()
    if not any(f"control.method={name}" in sets for sets in POLICIES.values())
}
_DEFAULT_POLICIES = "policy,vector,paper,plain,ff_fb_no_flow"
# Those of `bench worlds`, and the world of the first missions: inlet flows a tenth off, all else nearly as assumed.
WORLDS: dict[str, Callable[[Given], Sequence[str]]] = {
    **FAULTS,
    "inlet": lambda given: (f"inlet_speed_share={given.either(0.1)}", "outlet_pressure_error=0.0"),
}
_DEFAULT_WORLDS = "kind,moderate,hard"
# What a lab knows of a world whose walls and registration are exactly as stated.
_KNOWN = dict.fromkeys(("kind", "inlet"), ("plan.wall_error_um=0.0",))
# Coils as configured, which can do all that is asked of them; and coils with resistance and inductance behind voltage
# amplifiers, in the earth's field, calibrated with a Hall probe to a few percent (an assumption).
COILS: dict[str, tuple[str, ...]] = {
    "ample": (),
    "real": ("coils.amplifier.kind=voltage", "coils.bias_mt=[0.0, 0.02, 0.045]", "simulated.coil_error=0.03"),
}
# By direction and map. Upstream after a survey, the robot drifts down first and then swims back.
TRIPS: dict[tuple[str, str], tuple[str, ...]] = {
    ("down", "surveyed"): (),
    ("up", "surveyed"): ("survey.method=downstream", "survey.share=1.0", "mission.goal=inlet"),
    ("down", "assumed"): ("mission.phases=plan,navigate",),
    ("up", "assumed"): ("mission.phases=plan,navigate", "mission.start=outlet", "mission.goal=inlet"),
}
_BEST = Planner(method="time_field", clearance_margin_um=0.0, speed_share=1.0)  # no reserves


@dataclass(frozen=True, slots=True)
class TrueWorld:
    """Deviations of the true world from the assumptions."""

    name: str = "kind"  # of WORLDS
    coils: str = "ample"  # of COILS
    sets: tuple[str, ...] = ()  # further settings of all policies


class MissionLog:
    """A sink that collects the data of a row.

    `limits`: what the coils can do.
    """

    def __init__(self, limits: CommandLimits) -> None:
        self.beyond = 0
        self._limits = limits
        self.began: tuple[int, Floats, Route] | None = None  # stamp, true position, route
        self.contacts = {"survey": 0, "navigate": 0}
        self.replans = 0
        self.squared_um2: list[float] = []  # distances to the reference
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
        if tick.currents is not None and tick.currents is not before.currents:
            self.beyond += self._is_beyond(tick.currents, (tick.stamp_ns - before.stamp_ns) if before.track else 0)
        demand = tick.demand
        if mission.phase == "navigate" and demand is not None and math.isfinite(demand.error_um):
            self.squared_um2.append(demand.error_um**2)
        self._last = tick

    def _is_beyond(self, currents: Currents, frame_ns: int) -> bool:
        """True if a command, or an output sample of the frame that it lasts, is beyond a limit."""
        coils = self._limits.coils
        state, command = coils.state_and_command(currents)
        admitted = self._limits.admit(currents, currents.stamp_ns)
        samples = coils.output_samples(state, command, math.ceil(seconds(frame_ns) * coils.amplifier.output_hz) + 1)
        try:
            self._limits.check_samples(*samples)
        except RigError:
            return True
        return (admitted.frequency_hz, admitted.amplitude_mt) != (command.frequency_hz, command.amplitude_mt)


def measure(
    seeds: Annotated[int, typer.Option(min=1, help="Worlds; every policy flies all of them, both ways.")] = 40,
    cases: Annotated[Path | None, typer.Option(metavar="DIR", help="Vessel cases besides the built-in chips.")] = None,
    policies: Annotated[str, typer.Option(metavar="A,B", help=f"Of {', '.join(POLICIES)}.")] = _DEFAULT_POLICIES,
    worlds: Annotated[str, typer.Option(metavar="A,B", help=f"Of {', '.join(WORLDS)}.")] = _DEFAULT_WORLDS,
    coils: Annotated[str, typer.Option(metavar="NAME", help=f"One of {', '.join(COILS)}.")] = "real",
    first_seed: Annotated[int, typer.Option(min=1, help="Seed of the first world.")] = 1,
    sets: SetTexts = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    figure: FigureFile = None,
    maps: Sequence[str] = ("surveyed", "assumed"),
) -> Results:
    """Rows by mission, a summary by policy, and pairs of policies compared on the trips on which both arrived.

    Seeds take the bifurcation, the random vessels and each of the `cases`, as it is and slowed down, in turn. Raises
    UsageError if there is no such policy, world or kind of coils, or no case in `cases`.
    """
    names = choose_names("bench missions: no policy", policies, POLICIES)
    known_worlds = choose_names("bench missions: no world", worlds, WORLDS)
    if coils not in COILS:
        raise UsageError(f"bench missions: no coils {coils!r}; there are {', '.join(COILS)}")
    paths = [] if cases is None else vessel_cases(cases)
    missions = [
        (seed, chip_of(seed, paths), way, known, policy, TrueWorld(world, coils, tuple(sets or ())))
        for seed in range(first_seed, first_seed + seeds)
        for world in known_worlds
        for way, known in TRIPS
        if known in maps
        for policy in names
    ]
    rows: list[Row] = []
    with progress("flying", len(missions), "missions") as done, pool(jobs) as workers:
        columns = zip(*missions, strict=True)
        for row in workers.map(fly, *columns, chunksize=4) if jobs > 1 else map(fly, *columns):
            rows.append(row)
            done(len(rows))
    results = results_of(rows, known_worlds, names) | {"coils": coils, "seeds": seeds}
    if figure is not None:
        draw_missions(figure, results)
    return results


def results_of(rows: Sequence[Row], worlds: Sequence[str], policies: Sequence[str]) -> Results:
    """The rows, and by world a summary of each policy and their pairs; `fault_count`: commands beyond the limits."""
    by_world = {world: [row for row in rows if row.world == world] for world in worlds}
    return {
        "rows": [asdict(row) for row in rows],
        "summary": {
            world: {
                policy: summary(mine) for policy in policies if (mine := [row for row in some if row.policy == policy])
            }
            for world, some in by_world.items()
        },
        "pairs": {
            world: {f"{a} / {b}": compare_times(some, a, b) for a, b in combinations(policies, 2)}
            for world, some in by_world.items()
        },
        "fault_count": sum(row.beyond for row in rows),
    }


def chip_of(seed: int, paths: Sequence[Path]) -> tuple[str, ...]:
    """The settings of a seed's chip: bifurcation, random vessels, and each case as it is and slowed down, in turn."""
    turn, kind = divmod(seed - 1, 4 if paths else 2)
    if kind == 0:
        return ("chip.name=bifurcation",)
    if kind == 1:
        return ("chip.name=vessels", f"chip.seed={seed}")
    path = paths[turn % len(paths)]
    return (f"chip.path={path}",) if kind == 2 else slower_case(path)


def slower_case(path: Path) -> tuple[str, ...]:
    """A vessel case with a slower flow and robot, which 40 ms of latency and 30 frames a second can control.

    In that time the robot, 1.3 times as fast as the flow, swims a fifth of the median channel width. The flow in many
    cases is a thousand times faster; no robot can be controlled in them.
    """
    original = load_config(None, [f"chip.path={path}"])
    chip = load_chip(original.chip)
    speed_um_s = 0.2 * median_width_um(chip) / (USUAL_DELAY_S + 1.0 / 30.0)
    peak_um_s = float(np.linalg.norm(original.flow.solve(chip).velocity_um_s, axis=-1).max())
    inlet_um_s = max(opening.value for opening in chip.openings if opening.kind == "inlet")
    return (
        f"chip.path={path}",
        f"chip.inlet_speed_um_s={inlet_um_s * speed_um_s / 1.3 / peak_um_s:.4g}",
        f"robot.max_speed_um_s={speed_um_s:.4g}",
    )


def fly(
    seed: int,
    chip_sets: tuple[str, ...],
    way: str,
    known: str,
    policy: str,
    world: TrueWorld,
    watch: Callable[[Tick], None] | None = None,
    start: Tick | None = None,
) -> Row:
    """One mission; `known` is the map, surveyed or assumed. `watch` gets every tick.

    `start` has what is known before, such as the refined flow of an earlier mission in the same world.
    """
    sets = [*chip_sets, f"simulated.seed={seed}", *COILS[world.coils], *TRIPS[way, known], *POLICIES[policy]]
    sets += [*_KNOWN.get(world.name, ()), *world.sets]
    asked = load_config(None, sets)
    name = Path(asked.chip.path).stem or asked.chip.name
    name += " slowed" if asked.chip.path and asked.chip.inlet_speed_um_s is not None else ""
    try:
        config, chip = in_world(WORLDS[world.name], list(WORLDS).index(world.name), seed, sets)
        rig = SimulatedRig.of(assemble(config, chip), config)
        pipeline, _ = as_seen(config, chip, rig)
        truth = rig.true_world().field
    except FlowrecError as error:  # before anything is switched on
        return Row(world.name, seed, name, way, known, policy, "refused", str(error))
    log = MissionLog(CommandLimits(config.coils, config.robot, OutputLimits()))
    report = run(pipeline, rig, LockstepWorker(pipeline, config.worker.adopt_after_s), [log], start, on_tick=watch)
    mission, outcome = report.last.mission, report.outcome
    assert mission is not None
    taken_s = best_s = planned_s = None
    if log.began is not None:
        began_ns, start_um, route = log.began
        planned_s = route.lasts_s
        tolerance_um = config.mission.goal_tolerance_um or config.robot.radius_um
        able = able_robot(config.robot, config.simulated)
        best_s = optimum_s(truth, start_um, mission.goal_um, tolerance_um, chip, able)
        if outcome == "reached":
            taken_s = seconds(mission.since_ns - began_ns)
        elif outcome == "unreachable":
            outcome = "unreachable too late"
    return Row(
        *(world.name, seed, name, way, known, policy, outcome, report.note),
        survey_contacts=log.contacts["survey"],
        contacts=log.contacts["navigate"],
        seconds=taken_s,
        optimum_s=best_s,
        ratio=taken_s / best_s if taken_s is not None and best_s else None,
        planned_s=planned_s,
        rms_um=math.sqrt(float(np.mean(log.squared_um2))) if log.squared_um2 else None,
        replans=log.replans,
        beyond=log.beyond,
        latency_ms=1e3 * config.robot.delay_s,
        radius_um=config.robot.radius_um,
        speed_limit_um_s=config.robot.speed_limit_um_s,
    )


def able_robot(robot: Robot, simulated: Simulated) -> Robot:
    """The robot with the speed that it truly has."""
    true = true_robot(robot, simulated)
    return replace(true, max_speed_um_s=robot.max_speed_um_s * true.um_per_rev / robot.um_per_rev)


def optimum_s(
    truth: FlowField,
    start_um: Floats,
    goal_um: Floats,
    tolerance_um: float,
    chip: Chip,
    robot: Robot,
) -> float | None:
    """The least time in the true flow, at the robot's speed limit, until the goal is within the tolerance.

    Without margin, latency and noise: a lower bound of every policy. None if there is no route.
    """
    route = _BEST.plan(truth, start_um, goal_um, chip, robot)
    if not route.reachable:
        return None
    distance_um = np.hypot(*(route.waypoints_um - goal_um).T)
    near = distance_um <= tolerance_um
    after = int(np.argmax(near)) if near.any() else len(near) - 1
    if after == 0:
        return 0.0
    before_um, after_um = distance_um[after - 1 : after + 1]
    ratio = min(max((before_um - tolerance_um) / max(before_um - after_um, 1e-9), 0.0), 1.0)
    return float(route.arrival_s[after - 1] + ratio * (route.arrival_s[after] - route.arrival_s[after - 1]))
