"""The slow stages, done on order: solve, survey route, refine, route.

A work order is the Mission message of the tick that ordered it; all it needs is in that tick. So the same
order gives the same result, live in a worker process or again in a replay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.messages import FlowField, Observations, Route, Tick
from flowrec.pipeline import Pipeline
from flowrec.planning import warm_up as warm_up_planning


def no_observations(stamp_ns: int) -> Observations:
    """The empty set, for a run that refines before it has surveyed."""
    return Observations(stamp_ns, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def work(pipeline: Pipeline, order: Tick) -> FlowField | Route:
    """Do what `order.mission` wants with what was known in that tick; the stamp is the order's."""
    mission = order.mission
    assert mission is not None
    result: FlowField | Route
    if mission.wanted == "solve":
        result = pipeline.solver.solve(pipeline.chip)
    elif mission.wanted == "refine":
        assert order.assumed is not None
        if pipeline.hindsight is not None:
            observations = pipeline.hindsight(order.stamp_ns)
        else:
            observations = pipeline.sampler.treat(order.observations or no_observations(order.stamp_ns))
        result = pipeline.refiner.refine(order.assumed, observations, pipeline.chip, pipeline.solver)
    elif mission.wanted == "survey_route":
        assert order.field is not None
        result = pipeline.survey.plan(order.field, mission.start_um, pipeline.chip, pipeline.robot)
    else:
        assert mission.wanted == "route"
        assert order.field is not None
        robot = pipeline.robot.limited_to(order.health.limit_hz if order.health is not None else None)
        result = pipeline.planner.plan(order.field, mission.start_um, mission.goal_um, pipeline.chip, robot)
    return replace(result, stamp_ns=mission.requested_ns, request=mission.request)


def warm_up() -> None:
    """Pay for imports and compilation before the first order comes."""
    warm_up_planning()
