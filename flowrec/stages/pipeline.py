"""One tick: a frame comes in, currents go out. One call per stage, in order.

The previous Tick is all the state between ticks, so the pipeline can resume at any tick.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from flowrec.core import (
    FIXED,
    PUMP,
    Action,
    Applied,
    AxesCheck,
    Floats,
    Floats32,
    FlowField,
    Message,
    Observations,
    Phase,
    PumpShare,
    RobotWalls,
    Source,
    Tick,
    TopicTable,
    Track,
    UsageError,
    nearest_pixel,
    seconds,
)
from flowrec.physics import (
    Calibration,
    ChannelWidths,
    Chip,
    FlowSolver,
    Robot,
    clearance_um,
    sample,
)
from flowrec.stages.config import ResolvedConfig, calibration_of
from flowrec.stages.control import Coils, Controller
from flowrec.stages.control.axes_check import leg_velocity, steady_velocity, watch
from flowrec.stages.control.events import event_of
from flowrec.stages.control.mission import MissionStateMachine
from flowrec.stages.estimation import HealthMonitor, Observer, Sampler
from flowrec.stages.estimation.pump import PumpFollower, at_pump
from flowrec.stages.estimation.superposition import Superposition
from flowrec.stages.estimation.tracer_stretches import collect_stretches
from flowrec.stages.extra_topics import ExtraStage, extra_rows, topics_of
from flowrec.stages.inputs import Inputs, with_inputs
from flowrec.stages.learned_robot import learned_robot, place_on_chip
from flowrec.stages.other_robots import (
    OtherRobots,
    messages_of_others,
    observe_others,
)
from flowrec.stages.planning import Planner, SurveyPlanner
from flowrec.stages.refine import Refiner
from flowrec.stages.sight import find_robots
from flowrec.stages.vision import Stabiliser, Tracker

_RELEASE_S = 0.2  # from the moment at which a held robot may be let go until it is taken to be free


@dataclass(frozen=True, slots=True, eq=False)
class Pipeline:
    """All stages of a run with the chip, the camera's calibration and the robot they work on."""

    chip: Chip
    calibration: Calibration
    robot: Robot  # in proportion to the frequency, see physics.Robot
    response: Robot  # as the coils drive it
    clearance_um: Floats32  # (h, w) from each pixel centre to the nearest wall, negative in solid
    widths: ChannelWidths  # of the channels, for the drag of both side walls
    image_shape: tuple[int, int]  # (height, width) in pixels of the camera's images
    image_bits: int  # depth of their pixels
    stabiliser: Stabiliser
    tracker: Tracker
    observer: Observer
    health: HealthMonitor
    sampler: Sampler
    pump: PumpFollower
    inlets: Superposition | None  # of several pumps
    others: OtherRobots
    mission: MissionStateMachine
    controller: Controller
    coils: Coils
    # Slow stages: run/workers.py runs them when the mission orders it.
    solver: FlowSolver
    refiner: Refiner
    survey: SurveyPlanner
    planner: Planner
    # In a replay with smoothing: the observations up to a stamp, instead of the sampler's.
    hindsight: Callable[[int], Observations] | None = None
    topics: TopicTable = FIXED
    extra_stages: Mapping[str, ExtraStage] = field(default_factory=dict)  # by path of the topic


def assemble(config: ResolvedConfig, chip: Chip) -> Pipeline:
    """The stages of a resolved configuration on its chip."""
    config.tracker.refuse_unfit()
    config.pump.refuse_unfit(chip, config.streams, inertia=config.flow.convection, tracers=config.tracker.tracers)
    walls_um = clearance_um(chip.mask, chip.um_per_px)
    return Pipeline(
        chip=chip,
        calibration=calibration_of(config, chip),
        robot=config.robot.proportional(),
        response=config.robot,
        clearance_um=walls_um,
        widths=ChannelWidths.of(chip.mask, walls_um / chip.um_per_px),
        image_shape=config.camera.shape,
        image_bits=config.camera.bits,
        stabiliser=config.stabilise,
        tracker=config.tracker,
        observer=config.observer,
        health=config.health,
        sampler=config.sampler,
        pump=config.pump,
        inlets=Superposition.of(chip, config.flow) if config.pump.inlets else None,
        others=config.others,
        mission=config.mission,
        controller=config.control,
        coils=config.coils,
        solver=config.flow,
        refiner=config.refine,
        survey=config.survey,
        planner=config.plan,
        topics=topics_of(config),
        extra_stages={row.topic.path: row.settings for row in extra_rows(config) if row.topic.source is Source.STAGE},
    )


def _wall_um(p: Pipeline, point_um: Floats) -> float:
    """Distance from a point (2,) to the nearest wall, at the nearest pixel; 0 if the point is not finite."""
    if not np.isfinite(point_um).all():
        return 0.0
    x, y = (point_um / p.chip.um_per_px).tolist()
    return float(p.clearance_um[nearest_pixel(x, y, p.clearance_um.shape)])


def _goal_fault(p: Pipeline, inputs: Inputs) -> str:
    """Reason that the goal of the operator's event of this tick can be none; '' if a route may lead to it."""
    event = inputs.operator
    if event is None or event.stamp_ns != inputs.stamp_ns or event.goal_um.shape != (2,):
        return ""
    width_um, height_um = p.chip.size_um
    x_um, y_um = event.goal_um + 0.5 * p.chip.um_per_px  # from the edge; the centre of the first pixel is 0, 0
    if not (0.0 <= x_um <= width_um and 0.0 <= y_um <= height_um):
        return "it is outside the chip"
    return "" if _wall_um(p, event.goal_um) > 0.0 else "it is in a wall"


def _hand_share(inputs: Inputs) -> Floats | None:
    """Velocity (2,) over the speed limit by which a hand steers on this tick; None: none does."""
    hand = inputs.hand
    return hand.share if hand is not None and hand.held and hand.stamp_ns == inputs.stamp_ns else None


@functools.lru_cache(maxsize=2)
def _without_registration(flow: FlowField) -> FlowField:
    """A map for an observer that reads it where the image shows the robot, whatever a refinement found."""
    return flow if flow.registration is None else replace(flow, registration=None)


def _strength(coils: Coils, last: Tick) -> float:
    """Amplitude of the field in the tick before, relative to the full one; 1 before the first."""
    full_mt = coils.amplitude_mt
    return min(last.currents.amplitude_mt / full_mt, 1.0) if last.currents is not None and full_mt > 0.0 else 1.0


def _axes(p: Pipeline, last: Tick, tick: Tick, track: Track, rolled: Applied) -> tuple[AxesCheck | None, Floats | None]:
    """The check of the axes, and the velocity (2,) that it drives the robot with; None: the robot is controlled."""
    mission = last.mission
    checks = p.mission.check_axes and not p.mission.observes
    if not checks or (mission is not None and mission.phase != Phase.START) or tick.applied is None:
        return last.axes, None
    if last.axes is not None and last.axes.verdict:
        return last.axes, None
    start_um = np.asarray(p.mission.start, np.float64)
    hold_s = p.mission.hold_start_s or 0.0
    # A robot that is let go beside an outlet would be carried out. Elsewhere the flow carries it along its channel, and
    # to act against the flow of the map would drive it into a wall if the axes of the coils were exchanged.
    map_um_s = sample(tick.assumed, start_um) if hold_s and tick.assumed is not None else np.zeros(2)
    free_s = hold_s + p.coils.ramp_s + _RELEASE_S if hold_s else 0.0
    since_s = 0.0 if mission is None else seconds(track.stamp_ns - mission.since_ns)
    waits = mission is None or mission.held_since_ns is not None or mission.blind_since_ns is not None
    axes = last.axes
    if not waits and since_s >= free_s:
        wall_um = _wall_um(p, start_um)
        frame_s = p.planner.swift.frame_s or 0.0
        axes = watch(axes, track, rolled, p.robot, map_um_s, wall_um, frame_s, p.calibration, p.coils)
    if axes is not None and axes.verdict:
        return axes, None
    return axes, steady_velocity(axes, map_um_s) + (np.zeros(2) if waits else leg_velocity(axes))


def _follow_others(
    p: Pipeline,
    last: Tick,
    tracks: Sequence[Track],
    rolled: Applied,
    flow: FlowField | None,
    pump: PumpShare | None,
) -> tuple[RobotWalls, dict[str, Message]]:
    """The distances of the robots other than the first one from walls, and all messages of them, by path."""
    if p.others.observe_flow and p.sampler.without_map:
        flow = None
    estimates = observe_others(p.observer, last, tracks, rolled, p.robot, flow)
    radii_um = [each.radius_px * p.calibration.um_per_px for each in tracks]
    walls = p.others.watch(last, tracks, estimates, p.robot, radii_um, p.clearance_um, p.chip.um_per_px)

    def at_nominal(before: Observations | None, now: Observations | None) -> Observations | None:
        return now if pump is None else p.pump.at_nominal(before, now, pump, p.inlets)

    seen = p.others.collect(p.sampler, last, estimates, walls, p.robot, at_nominal)
    return walls, messages_of_others(tracks, estimates, walls) | seen


def _no_lap(_stage: str) -> None:
    """Ignore the end of a stage."""


def _with_extra_stages(p: Pipeline, last: Tick, tick: Tick) -> Tick:
    """The tick with the messages of the stages of other packages, each of which sees those before it."""
    for path, stage in p.extra_stages.items():
        message = stage.step(last, tick)
        if message is None or message is tick.extra.get(path):
            continue
        kind = p.topics.by_field[path].type
        if type(message) is not kind:
            raise UsageError(f"{path}: its stage returned a {type(message).__name__}, where a {kind.__name__} belongs")
        tick = replace(tick, extra=tick.extra.with_messages({path: message}))
    return tick


def step(pipeline: Pipeline, last: Tick, inputs: Inputs, lap: Callable[[str], None] = _no_lap) -> Tick:
    """The tick after `last`, given its inputs. `lap(stage)` is called as each stage ends, for timing only.

    Long because it is the list of all stages with the messages that each one reads; parts of it would have to hand on
    nearly all of these messages.
    """
    p = pipeline
    tick = with_inputs(last, inputs, p.topics)
    pump = p.pump.follow(last, tick, p.inlets, p.tracker.tracer.stretch_s if p.tracker.tracers else 0.0)
    flow, route = at_pump(tick.field, pump, p.inlets), tick.route
    sight = find_robots(p, last, inputs)
    track, appearance = sight.track, sight.appearance
    assert track is not None, "the tracker says of every image whether it shows the robot"
    lap("track")
    learned = learned_robot(p, last, tick.refined, flow)
    known, here = learned.known, learned.here
    seen = flow if p.refiner.correct_robot or flow is None else _without_registration(flow)
    rolled = p.response.proportional_turns(last.applied, inputs.applied)
    applied = learned.correct_turns(last.applied, rolled)
    estimate = p.observer.estimate(last.estimate, track, applied, here, seen, last.health)
    # Sessions recorded before step-out was monitored replay without it.
    looked = applied if applied.image_since_ns is not None else None
    # Observations, their predictions and the pictures keep to the registration as stated.
    placed = place_on_chip(estimate, tick.refined)
    wall_um = _wall_um(p, placed.position_um)
    health = last.health
    if health is None or not (inputs.applied.repeats_image and last.mission is not None and last.mission.input_ended):
        health = p.health.watch(health, last.estimate, estimate, seen, here, looked, wall_um)
    mapless, measured = last.mapless, estimate
    if p.sampler.without_map:
        # Observations are those of the robot as stated: what a refinement finds of it, the next one finds again.
        mapless = p.observer.without_map(
            last.mapless, last.estimate, estimate, track, rolled, p.robot, corrected=learned.is_other_than(p.robot)
        )
        measured = p.observer.measured_estimate(mapless, estimate)
    before = None if last.estimate is None else p.observer.measured_estimate(last.mapless, last.estimate)
    observations = p.sampler.collect(last.observations, before, measured, p.robot)
    if pump is not None:
        observations = p.pump.at_nominal(last.observations, observations, pump, p.inlets)
        tick = replace(tick, extra=tick.extra.with_messages({PUMP: pump}))
    walls = None
    if sight.others:
        walls, told = _follow_others(p, last, sight.others, rolled, seen, pump)
        tick = replace(tick, extra=tick.extra.with_messages(told))
    tracer_flow = None
    if p.tracker.tracers:
        at_nominal = None if pump is None else partial(p.pump.stretches_at_nominal, pump)
        tracer_flow = collect_stretches(last.tracer_flow, last.tracers, sight.tracers, at_nominal)
    if estimate.um_per_rev is not None:  # the observer estimates it
        known = here = replace(known, um_per_rev=estimate.um_per_rev)
    known, here = known.limited_to(health.limit_hz), here.limited_to(health.limit_hz)
    lap("observe")
    axes, driven_um_s = _axes(p, last, tick, track, rolled)
    hand_share = _hand_share(inputs)
    mission = p.mission.update(
        last.mission,
        track,
        placed,
        tick.assumed,
        tick.refined,
        route,
        inputs.operator,
        last.demand,
        known,
        inputs.applied,
        p.tracker.not_found_note(appearance),
        appearance is not None and bool(appearance.note),
        observations,
        _goal_fault(p, inputs),
        axes,
        driven_um_s is not None,
        hand_share is not None,
    )
    if mission.by_hand:
        driven_um_s = np.zeros(2) if hand_share is None else None
    robot = here.slowed_to(mission.speed_limit_um_s).slowed_to(None if walls is None else walls.limit_um_s)
    demand = p.controller.control(
        last.demand,
        mission,
        route,
        placed,
        flow,
        robot,
        p.clearance_um,
        p.chip.um_per_px,
        _strength(p.coils, last),
        p.observer.uses_map(estimate),
        driven_um_s,
        hand_share if mission.by_hand else None,
    )
    asked = inputs.operator
    cut = asked is not None and asked.stamp_ns == inputs.stamp_ns and asked.action == Action.ZERO
    cut = cut or mission.field_off or (mission.by_hand and hand_share is None)
    steered = driven_um_s is None and hand_share is None
    ordered_um_s = learned.heading_velocity(demand.velocity_um_s, robot.speed_limit_um_s, slips=steered)
    ordered = demand if ordered_um_s is demand.velocity_um_s else replace(demand, velocity_um_s=ordered_um_s)
    currents = p.coils.drive(last.currents, ordered, p.response.responding(robot), mission.finished, cut)
    lap("control")
    tick = replace(
        tick,
        track=track,
        appearance=appearance,
        background=sight.background,
        shift=sight.shift,
        estimate=estimate,
        health=health,
        observations=observations,
        mapless=mapless,
        mission=mission,
        demand=demand,
        currents=currents,
        axes=axes,
        tracers=sight.tracers,
        tracer_flow=tracer_flow,
    )
    if p.extra_stages:
        tick = _with_extra_stages(p, last, tick)
    event = event_of(last, tick, "time_to_go" in p.controller.needs)
    return replace(tick, event=event) if event is not None else tick
