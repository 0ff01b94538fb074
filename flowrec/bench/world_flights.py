"""Flies one mission in a simulated world, keeps the input of its refinement, and scores refinements of it.

A flight is one mission in a simulated world. Its observations do not depend on how they are refined, so the work order
of its survey is kept, and any method can refine it later without flying again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.bench.harness import flow_scores
from flowrec.bench.null_models import NULL_MODELS, NullModel
from flowrec.bench.planted_causes import count_causes, planted_causes
from flowrec.bench.second_worlds import SECOND_WORLDS, make_survey
from flowrec.core import (
    BY_FIELD,
    NO_EXTRA,
    Bools,
    Floats,
    FlowField,
    FlowrecError,
    Observations,
    Phase,
    Tick,
    WorkOrder,
    cells_at,
    message_fields,
    seconds,
)
from flowrec.measure import as_pictured
from flowrec.physics import Chip, load_chip, sample
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, run, work
from flowrec.stages import (
    Pipeline,
    ResolvedConfig,
    assemble,
    calibration_of,
    load_config,
    observations_of_others,
    observations_topic,
    resolve,
)
from flowrec.verbs import refuse_adrift

# Messages of a work order that are kept; the assumed flow is solved again.
_KEPT = ("mission", "estimate", "health", "observations", "tracer_flow")
_OTHERS = "others"  # key of the observations of the other robots, which are kept too
# Methods that are `assimilate` with a part of the observations, for flights with tracers or other robots: the fields of
# the work order that are replaced.
OF_A_PART: Mapping[str, Mapping[str, Any]] = {
    "robot_alone": {"tracer_flow": None, "extra": NO_EXTRA},
    "tracers_alone": {"observations": None, "extra": NO_EXTRA},
}
_IN_FLIGHT = "assimilate"  # with which the robot navigates, whatever is compared


@dataclass(frozen=True, slots=True)
class Given:
    """Inputs of a world's faults: random numbers of the seed, and the configuration without the fault."""

    rng: np.random.Generator
    config: ResolvedConfig
    chip: Chip

    def either(self, size: float) -> float:
        """1 + size or 1 - size."""
        return 1.0 + size * (1.0 if self.rng.random() < 0.5 else -1.0)

    def shifted_um(self, pixels: float) -> str:
        """The centre of the image, shifted by camera pixels in any direction, as a setting."""
        camera, angle = self.config.camera, self.rng.uniform(0.0, 2.0 * math.pi)
        middle = 0.5 * (np.array(camera.size_px) - 1.0)
        place = middle + pixels * np.array([math.cos(angle), math.sin(angle)])
        x, y = calibration_of(self.config, self.chip).to_um(place)
        return f"[{x:.3f}, {y:.3f}]"


# The settings of each world, in [simulated]. Those after the presets have one fault each, as large as stated here, in a
# world that is `kind` otherwise.
WORLDS: Mapping[str, Callable[[Given], Sequence[str]]] = {
    "kind": lambda _: ("world=kind",),
    "moderate": lambda _: ("world=moderate",),
    "hard": lambda _: ("world=hard",),
    "depth": lambda _: ("unstated_depth_widths=0.5",),
    "um_per_rev": lambda given: (f"um_per_rev_share={given.either(0.15)}",),
    "slip": lambda _: ("slip=0.15",),
    "hindrance": lambda _: ("hindrance=1.0",),
    "drift": lambda _: ("drift_share=0.05", "drift_s=30.0"),
    "pulsation_0.1": lambda given: (
        *("pulsation_share=0.3", "pulsation_hz=0.1"),
        f"pulsation_phase_deg={given.rng.uniform(0.0, 360.0)}",
    ),
    "pulsation_1": lambda given: (
        *("pulsation_share=0.3", "pulsation_hz=1.0"),
        f"pulsation_phase_deg={given.rng.uniform(0.0, 360.0)}",
    ),
    "offset": lambda given: (f"centre_um={given.shifted_um(2.0)}",),  # 20 um where a camera pixel is 10 um
    "scale": lambda given: (f"um_per_px={given.config.camera.um_per_px * given.either(0.03)}",),
    "mask": lambda _: ("wall_error_px=1.0",),
    "blocked": lambda _: ("blocked_share=0.5",),
    "step_out": lambda _: ("step_out_share=0.7",),
    "latency": lambda given: (f"delay_s={2.0 * given.config.robot.delay_s}",),
    "shake": lambda given: (f"shake_um={given.config.camera.um_per_px}", "shake_hz=3.0"),
    "optics": lambda _: ("optics=oblique",),
}
_FAULT_STREAM = 0xFA017  # of the random numbers: faults are drawn apart from the world, which they leave unchanged


@dataclass(frozen=True, slots=True)
class FlightCase:
    """Definition of a simulated mission."""

    world: str
    chip: str  # bifurcation, straight, vessels-SEED, or the path of a chip or of a vessel case
    seed: int
    sets: tuple[str, ...] = ()  # further settings

    def key(self) -> tuple[str, str, int, tuple[str, ...]]:
        """Identifies the flight."""
        return self.world, self.chip, self.seed, tuple(self.sets)


@dataclass(slots=True)
class Flight:
    """A flight as it is kept: one line of JSON.

    Attributes
    ----------
    world, chip, seed, sets : those of its case.
    outcome, note : of the mission; `refused` before anything was driven.
    contacts : wall contacts, also those of the survey.
    seconds : from the first frame to the last.
    truth : the deviations from the configuration that the seed drew, in words.
    drift : ratio of the flow during the survey to the steady one, by the drift of the pump.
    order : messages of the last work order before the navigation that asked for a refinement; {} if there was none.
    refined : scores by method.
    code : version and commit that flew it.
    """

    world: str
    chip: str
    seed: int
    sets: tuple[str, ...]
    outcome: str
    note: str
    contacts: int = 0
    seconds: float = 0.0
    truth: str = ""
    drift: float = 1.0
    order: dict[str, Any] = field(default_factory=dict)
    refined: dict[str, dict[str, Any]] = field(default_factory=dict)
    code: str = ""

    @classmethod
    def of(cls, line: Mapping[str, Any]) -> Flight:
        """The flight of a line."""
        return cls(**{**line, "sets": tuple(line["sets"])})

    def key(self) -> tuple[str, str, int, tuple[str, ...]]:
        """That of its case."""
        return FlightCase(self.world, self.chip, self.seed, self.sets).key()


def chip_sets(chip: str) -> tuple[str, ...]:
    """The settings of a chip by name."""
    if "." in chip or "/" in chip:
        return (f"chip.path={chip}",)
    name, _, seed = chip.partition("-")
    return (f"chip.name={name}", *((f"chip.seed={seed}",) if seed else ()))


def prepare_case(case: FlightCase) -> tuple[ResolvedConfig, Chip]:
    """The configuration of a case on its chip.

    Raises FlowrecError where the mission can not be flown.
    """
    sets = [*chip_sets(case.chip), f"refine.method={_IN_FLIGHT}", f"simulated.seed={case.seed}", *case.sets]
    return in_world(WORLDS[case.world], list(WORLDS).index(case.world), case.seed, sets)


def in_world(
    faults: Callable[[Given], Sequence[str]], number: int, seed: int, sets: Sequence[str]
) -> tuple[ResolvedConfig, Chip]:
    """The configuration of a seed in a world, and its chip.

    Parameters
    ----------
    number : of the world, which has random numbers of its own.
    sets : settings, which those of the world do not replace.

    Raises FlowrecError where the mission can not be flown.
    """
    asked = load_config(None, ["simulated.world=kind", *sets])
    chip = load_chip(asked.chip)
    given = Given(np.random.default_rng([seed, _FAULT_STREAM, number]), resolve(asked, chip), chip)
    asked = load_config(None, ["simulated.world=kind", *(f"simulated.{fault}" for fault in faults(given)), *sets])
    config = resolve(asked, chip)
    refuse_adrift(config, chip)
    return config, chip


def fly(case: FlightCase) -> Flight:
    """Fly a case; nothing is written. A world of the second generator is a survey that its seed gives."""
    if case.world in SECOND_WORLDS:
        return Flight(case.world, case.chip, case.seed, case.sets, "surveyed", "", order={"seed": case.seed})
    flight = Flight(case.world, case.chip, case.seed, case.sets, "refused", "")
    try:
        config, chip = prepare_case(case)
    except FlowrecError as error:
        flight.note = str(error)
        return flight
    rig = SimulatedRig.of(assemble(config, chip), config)
    pipeline = as_seen(config, chip, rig)[0]
    orders: list[Tick] = []

    def watch(tick: Tick) -> None:
        mission, before = tick.mission, orders[-1].mission if orders else None
        assert mission is not None
        new = before is None or mission.request != before.request
        if new and mission.wanted == WorkOrder.REFINE and mission.phase != Phase.NAVIGATE:
            orders.append(tick)

    report = run(pipeline, rig, LockstepWorker(pipeline, config.worker.adopt_after_s), [], on_tick=watch)
    flight.outcome, flight.note = report.outcome, report.note
    flight.contacts, flight.seconds = report.contacts, report.duration_s
    flight.truth = rig.true_world().field.note
    if orders:
        order = orders[-1]
        flight.order = {name: _as_json(getattr(order, name)) for name in _KEPT if getattr(order, name) is not None}
        others = {observations_topic(number): _as_json(each) for number, each in observations_of_others(order).items()}
        flight.order |= {_OTHERS: others} if others else {}
        flight.drift = rig.pump.mean_drift(seconds(order.stamp_ns))
    return flight


@dataclass(frozen=True, slots=True)
class Judged:
    """A refinement problem, the function that solves it by a named method, and the truth that scores the result."""

    assumed: FlowField
    refine_by: Callable[[str], FlowField]
    truth_um_s: NDArray[np.floating]  # (h, w, 2)
    fluid: Bools  # (h, w) where it is compared
    planted: Sequence[str]
    seen_um: Floats  # (n, 2) where the flow was observed


def refine(flight: Flight, methods: Sequence[str]) -> None:
    """Refine what a flight has observed by some methods and score them; also the assumed flow, as `assumed`."""
    if not flight.order:
        return
    judged = _problem_of_survey(flight) if flight.world in SECOND_WORLDS else _problem_of_flight(flight)
    flight.refined["assumed"] = score_field(judged.assumed, judged)
    for method in methods:
        try:
            result = judged.refine_by(method)
        except FlowrecError as error:
            flight.refined[method] = {"failed": str(error)}
            continue
        flight.refined[method] = score_field(result, judged)


def _problem_of_flight(flight: Flight) -> Judged:
    config, chip = prepare_case(FlightCase(flight.world, flight.chip, flight.seed, flight.sets))
    rig = SimulatedRig.of(assemble(config, chip), config)
    truth = rig.true_world().field.velocity_um_s * np.float32(flight.drift)
    pipeline, place = as_seen(config, chip, rig)
    order = _order_of(flight, pipeline)
    assert order.assumed is not None and order.observations is not None

    def refine_by(method: str) -> FlowField:
        return place(_refine_order(order, pipeline, config, pipeline.chip, method))

    seen_um = order.observations.position_um
    return Judged(place(order.assumed), refine_by, truth, chip.mask, planted_causes(config, chip), seen_um)


def as_seen(config: ResolvedConfig, chip: Chip, rig: SimulatedRig) -> tuple[Pipeline, Callable[[FlowField], FlowField]]:
    """The stages, with the walls of the rig's image where they are asked for; and a map as the truth has its places.

    The frame of a chip is that of its registration: maps are compared where the camera sees them.
    """
    if not config.camera.trace_walls:
        return assemble(config, chip), lambda found: found
    pipeline = assemble(*as_pictured(config, chip, rig.picture())[:2])
    rows, columns = np.indices(chip.mask.shape)
    in_image = rig.calibration.to_px(np.stack((columns, rows), axis=-1) * chip.um_per_px)
    seen = pipeline.calibration
    turn = rig.calibration.um_per_px / seen.um_per_px * rig.calibration.axes.T @ seen.axes
    at_px = seen.to_um(in_image) / chip.um_per_px

    def place(found: FlowField) -> FlowField:
        cells = cells_at(at_px.reshape(-1, 2), chip.mask.shape)
        velocity = sample(found, at_px * chip.um_per_px) @ turn.T
        std = None if found.std_um_s is None else cells.interpolate(found.std_um_s).reshape(velocity.shape)
        std_um_s = None if std is None else std.astype(np.float32)
        return replace(found, velocity_um_s=velocity.astype(np.float32), std_um_s=std_um_s, wall_px=None)

    return pipeline, place


def _problem_of_survey(flight: Flight) -> Judged:
    """The survey of a world of the second generator, made again from its seed."""
    made = make_survey(flight.world, flight.seed)
    config = load_config(None, flight.sets)
    solver = config.flow
    assumed = solver.solve(made.chip)

    def refine_by(method: str) -> FlowField:
        if method in NULL_MODELS:
            return NullModel(method).refine(assumed, made.observations, made.chip, solver)
        refiner = replace(config.refine, method=method, adopt="always")
        return refiner.refine(assumed, made.observations, made.chip, solver)

    both = made.fluid & made.chip.mask
    return Judged(assumed, refine_by, made.truth_um_s, both, made.planted, made.observations.position_um)


def _refine_order(order: Tick, pipeline: Pipeline, config: ResolvedConfig, chip: Chip, method: str) -> FlowField:
    """The field that a refiner or a null model gives for a work order, good or bad."""
    if method in NULL_MODELS:
        assert order.assumed is not None and order.observations is not None
        return NullModel(method).refine(order.assumed, order.observations, chip, pipeline.solver)
    if method in OF_A_PART:
        order, method = replace(order, **OF_A_PART[method]), _IN_FLIGHT
    refiner = replace(config.refine, method=method, adopt="always")
    result = work(replace(pipeline, refiner=refiner), order)
    assert isinstance(result, FlowField)
    return result


def score_field(found: FlowField, judged: Judged) -> dict[str, Any]:
    """`flow_scores` over the pixels that are compared, and what the field says of itself.

    expected : the error that it states. warned : whether the note names a planted cause, on the right side; invented :
    clauses that name another one (planted_causes.py). doubted : whether it says that nothing it knows explains the flow
    somewhere. beyond : root mean square error over root mean square bar at the places that were observed.
    """
    right, invented = count_causes(found.note, judged.planted)
    said = {"expected": found.error_share, "warned": right > 0, "invented": invented, "note": found.note}
    said["doubted"] = found.parameter("unexplained_share") is not None
    if found.std_um_s is not None:
        column, row = np.round(judged.seen_um / found.um_per_px).astype(int).T
        h, w = judged.fluid.shape
        column, row = np.clip(column, 0, w - 1), np.clip(row, 0, h - 1)
        here = judged.fluid[row, column]
        off = (found.velocity_um_s - judged.truth_um_s)[row, column][here]
        bars = float(np.linalg.norm(found.std_um_s[row, column][here]))
        said["beyond"] = float(np.linalg.norm(off)) / max(bars, 1e-12)
    return flow_scores(found, judged.truth_um_s, judged.fluid) | said


def _as_json(message: Any) -> dict[str, Any]:
    """A message as plain data; arrays as (shape, values)."""
    return {
        each.name: (value.shape, value.ravel().tolist()) if isinstance(value, np.ndarray) else value
        for each in message_fields(type(message))
        for value in (getattr(message, each.name),)
    }


def _order_of(flight: Flight, pipeline: Pipeline) -> Tick:
    """The tick of the work order of a flight, with the assumed flow solved again."""
    kept = dict(flight.order)
    others = {path: _message(Observations, data) for path, data in kept.pop(_OTHERS, {}).items()}
    messages = {name: _message(BY_FIELD[name].type, data) for name, data in kept.items()}
    tick = Tick(stamp_ns=messages["mission"].stamp_ns, extra=NO_EXTRA.with_messages(others), **messages)
    solve = replace(messages["mission"], wanted=WorkOrder.SOLVE.value)
    assumed = work(pipeline, replace(tick, mission=solve))
    assert isinstance(assumed, FlowField)
    return replace(tick, assumed=assumed)


def _message(kind: type, data: Mapping[str, Any]) -> Any:
    """The message that `_as_json` gave."""
    arrays = {each.name for each in message_fields(kind) if each.dtype is not None}
    values = {
        key: np.reshape(value[1], value[0]) if key in arrays and value is not None else value
        for key, value in data.items()
    }
    return kind(**values)


def as_line(flight: Flight) -> dict[str, Any]:
    """A flight as it is written."""
    return asdict(flight)
