"""The slow stages (solve, refine, plan a route): what a work order does, and workers that adopt the results.

A work order is the Mission message of the tick that ordered it; all that it needs is in that tick. So the same order
gives the same result, live in a worker process or again in a replay.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np

from flowrec.enums import WorkOrder
from flowrec.messages import FlowField, Mission, Observations, Route, Tick
from flowrec.pipeline import Pipeline
from flowrec.topics import ANSWERED_BY, WORKER_FIELDS
from flowrec.units import nanoseconds

Result = FlowField | Route
Results = Mapping[str, Result]  # by field of Tick


def no_observations(stamp_ns: int) -> Observations:
    """The empty set, for a run that refines before it has surveyed."""
    return Observations(stamp_ns, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def ordered(tick: Tick) -> tuple[Mission, str]:
    """The work order of a tick, and the field of Tick that its result goes to."""
    assert tick.mission is not None and tick.mission.wanted, "only a tick with a pending order is submitted"
    return tick.mission, ANSWERED_BY[WorkOrder(tick.mission.wanted)]


def work(pipeline: Pipeline, order: Tick) -> Result:
    """Do what `order.mission` wants with what was known in that tick; the result has the order's stamp and number."""
    mission, _ = ordered(order)
    result: Result
    if mission.wanted == WorkOrder.SOLVE:
        result = pipeline.solver.solve(pipeline.chip)
    elif mission.wanted == WorkOrder.REFINE:
        assert order.assumed is not None
        if pipeline.hindsight is not None:
            observations = pipeline.hindsight(order.stamp_ns)
        else:
            observations = pipeline.sampler.treat(order.observations or no_observations(order.stamp_ns))
        result = pipeline.refiner.refine(order.assumed, observations, pipeline.chip, pipeline.solver)
    else:
        assert order.field is not None
        if mission.wanted == WorkOrder.SURVEY_ROUTE:
            result = pipeline.survey.plan(order.field, mission.start_um, pipeline.chip, pipeline.robot)
        else:
            robot = pipeline.robot.limited_to(order.health.limit_hz if order.health is not None else None)
            result = pipeline.planner.plan(order.field, mission.start_um, mission.goal_um, pipeline.chip, robot)
    return replace(result, stamp_ns=mission.requested_ns, request=mission.request)


class Worker(Protocol):
    """Does the slow stages beside the loop."""

    def submit(self, order: Tick) -> None:
        """Start on `order.mission`."""

    def due(self, stamp_ns: int) -> Results:
        """Results to be adopted on the tick of this stamp."""

    def close(self) -> None:
        """Release processes."""


class LockstepWorker:
    """Adopts each result a fixed time after its order: same seed, same session, however fast the machine is.

    `schedule` (request number to stamp) overrides the time: a replay adopts where the recording did. Orders whose
    result goes to a field outside `fills` are ignored (in a replay: their results are recorded).
    """

    def __init__(
        self,
        pipeline: Pipeline,
        adopt_after_s: float,
        schedule: Mapping[int, int] | None = None,
        fills: Iterable[str] = WORKER_FIELDS,
    ) -> None:
        self._pipeline = pipeline
        self._after_ns = nanoseconds(adopt_after_s)
        self._schedule = dict(schedule or {})
        self._fills = frozenset(fills)
        self._order: Tick | None = None

    def submit(self, order: Tick) -> None:
        if ordered(order)[1] in self._fills:
            self._order = order

    def due(self, stamp_ns: int) -> Results:
        if self._order is None:
            return {}
        mission, name = ordered(self._order)
        if stamp_ns < self._schedule.get(mission.request, mission.requested_ns + self._after_ns):
            return {}
        order, self._order = self._order, None
        return {name: replace(work(self._pipeline, order), stamp_ns=stamp_ns)}

    def close(self) -> None:
        """Nothing is held."""


class Preloaded:
    """A worker whose first results are fields of an earlier session, adopted on the first tick."""

    def __init__(self, worker: Worker, fields: Mapping[str, FlowField]) -> None:
        self._worker = worker
        self._fields = fields

    def submit(self, order: Tick) -> None:
        self._worker.submit(order)

    def due(self, stamp_ns: int) -> Results:
        """The fields on the first tick, then what the worker gives."""
        fields, self._fields = self._fields, {}
        known = {name: replace(field, stamp_ns=stamp_ns, request=0) for name, field in fields.items()}
        return known | dict(self._worker.due(stamp_ns))

    def close(self) -> None:
        self._worker.close()
