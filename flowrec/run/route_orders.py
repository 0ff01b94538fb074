"""Work orders for routes: the inputs of a survey and of a plan, from what was known in the tick of the order."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flowrec.core import Mission, Observations, Phase, Route, Tick, seconds
from flowrec.physics import FlowUncertainty
from flowrec.stages import (
    Pipeline,
    Sampling,
    SurveyOrder,
    better_route,
    memory_s,
    observations_of_others,
    robot_at,
    route_elsewhere,
)

_RECENT = 20  # observations, of which the noise of the next ones is expected


def no_observations(stamp_ns: int) -> Observations:
    """The empty set, for a run that refines before it has surveyed."""
    return Observations(stamp_ns, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def observations_of(pipeline: Pipeline, order: Tick) -> Observations:
    """The observations that a refinement is given: of all robots, and of tracers where they are followed."""
    if pipeline.hindsight is not None:
        own = pipeline.hindsight(order.stamp_ns)
    else:
        own = pipeline.sampler.treat(order.observations or no_observations(order.stamp_ns))
    others = {number: pipeline.sampler.treat(each) for number, each in observations_of_others(order).items()}
    return own.with_robots(others).with_tracers(order.tracer_flow)


def survey_route(pipeline: Pipeline, order: Tick, mission: Mission) -> Route:
    """The survey as far as it is decided: the way that the robot is on, and the next stretch."""
    field = order.field
    assert field is not None
    under_way = mission.phase == Phase.SURVEY
    present = order.route if under_way else None
    progress_s, left_s = 0.0, pipeline.mission.survey_limit_s
    if present is not None:
        progress_s = order.demand.progress_s if order.demand is not None else 0.0
        spent_s = seconds(order.stamp_ns - mission.since_ns - mission.held_ns)
        left_s -= spent_s + present.lasts_s - progress_s
    return pipeline.survey.plan(
        SurveyOrder(
            field,
            mission.start_um,
            pipeline.chip,
            robot_at(order, mission, pipeline.robot),
            mission.goal_um,
            _uncertainty(pipeline, order) if pipeline.survey.needs_uncertainty else None,
            _sampling(pipeline, order),
            observations_of(pipeline, order),
            present,
            progress_s,
            left_s,
            pipeline.mission.lead_s,
        )
    )


def route(pipeline: Pipeline, order: Tick, mission: Mission) -> Route:
    """The route to the goal; under way the present one, unless another is better or the goal is new."""
    field = order.field
    assert field is not None
    robot, planner = robot_at(order, mission, pipeline.robot), pipeline.planner
    if mission.phase != Phase.NAVIGATE:
        planned = planner.plan(field, mission.start_um, mission.goal_um, pipeline.chip, robot)
        return replace(planned, goal_um=mission.goal_um)
    assert order.route is not None and order.demand is not None
    if len(mission.former_goal_um):
        from_s = mission.goal_from_s
        return route_elsewhere(planner, field, order.route, from_s, mission.goal_um, pipeline.chip, robot)
    better = better_route(
        planner,
        field,
        _uncertainty(pipeline, order),
        order.route,
        order.demand.progress_s + pipeline.mission.lead_s,
        mission.goal_um,
        pipeline.chip,
        robot,
    )
    return replace(better, goal_um=mission.goal_um)


def _uncertainty(pipeline: Pipeline, order: Tick) -> FlowUncertainty | None:
    assert order.assumed is not None
    observations = observations_of(pipeline, order)
    return pipeline.refiner.uncertainty(order.assumed, observations, pipeline.chip, pipeline.solver)


def _sampling(pipeline: Pipeline, order: Tick) -> Sampling:
    """The observations to expect: as near to each other as the sampler takes them, as noisy as the latest ones.

    Before the first, their noise follows from the present estimate, as in the sampler.
    """
    sampler, robot = pipeline.sampler, pipeline.robot
    assert order.estimate is not None
    covariance, made = order.estimate.covariance, order.observations
    if made is not None and len(made.std_um_s):
        noise = float(np.median(made.std_um_s[-_RECENT:]))
    else:
        settled = sampler.settled_share * robot.max_speed_um_s
        noise = max(min(math.sqrt(covariance[2, 2] + covariance[3, 3]), settled), sampler.floor_um_s)
    return Sampling(
        max(sampler.spacing_radii * robot.radius_um, 1e-6),
        sampler.memories * memory_s(covariance),
        noise,
        sampler.rolling_share,
    )
