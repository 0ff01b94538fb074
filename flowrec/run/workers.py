"""The slow stages (solve, refine, plan a route): what a work order does, and workers that adopt the results.

A work order is the Mission message of the tick that ordered it; all that it needs is in that tick. So the same order
gives the same result, live in a worker process or again in a replay.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np

from flowrec.core import (
    ANSWERED_BY,
    WORKER_FIELDS,
    FlowError,
    FlowField,
    Message,
    Mission,
    NotFiniteError,
    Observations,
    Phase,
    PumpShare,
    Route,
    Tick,
    WorkOrder,
    nanoseconds,
    one_blas_thread,
)
from flowrec.run.route_orders import observations_of, route, survey_route
from flowrec.stages import Pipeline, as_planned, keep_flow, no_route

Result = FlowField | Route
Results = Mapping[str, Result]  # by field of Tick


def order_of(tick: Tick) -> tuple[Mission, str]:
    """The work order of a tick, and the field of Tick that its result goes to."""
    assert tick.mission is not None and tick.mission.wanted, "only a tick with a pending order is submitted"
    return tick.mission, ANSWERED_BY[WorkOrder(tick.mission.wanted)]


def messages_read(order: Tick, name: str) -> dict[str, Message | None]:
    """The messages of the ordering tick, besides the mission, of which a result is made, by field or path."""
    read = WORKER_FIELDS[name].reads
    extra = {path: each for path, each in order.extra.items() if isinstance(each, PumpShare | Observations)}
    return {each: getattr(order, each) for each in read} | (extra if read else {})


@one_blas_thread()
def work(pipeline: Pipeline, order: Tick) -> Result:
    """Do what `order.mission` wants with what was known in that tick; the result has the order's stamp and number.

    A result that is not finite, is made from what is not, or that the numerics can not give, is refused: what is in use
    stays, and the result says why (`refused`). Where nothing is in use yet the run ends with the error. Raises
    FlowrecError: bad settings; nothing is in use that could stay.
    """
    mission, name = order_of(order)
    try:
        for message in (mission, *messages_read(order, name).values()):
            if message is not None and not isinstance(message, Observations):  # of those the finite ones count
                message.refuse_not_finite()  # the numerics would raise anything, or return what is of no worth
        result = _compute(pipeline, order, mission)
        return replace(result, stamp_ns=mission.requested_ns, request=mission.request)
    except (NotFiniteError, np.linalg.LinAlgError) as error:
        if mission.wanted == WorkOrder.SOLVE:
            raise
        result = _in_use(pipeline, order, mission, str(error))
    return replace(result, stamp_ns=mission.requested_ns, request=mission.request)


def _compute(pipeline: Pipeline, order: Tick, mission: Mission) -> Result:
    if mission.wanted == WorkOrder.SOLVE:
        solved = pipeline.solver.solve(pipeline.chip)
        return replace(solved, error_share=pipeline.refiner.prior_error_share(pipeline.chip, pipeline.solver))
    if mission.wanted == WorkOrder.REFINE:
        return _refine(pipeline, order, mission)
    order = as_planned(order, pipeline.inlets)
    if mission.wanted == WorkOrder.SURVEY_ROUTE:
        return survey_route(pipeline, order, mission)
    return route(pipeline, order, mission)


def _refine(pipeline: Pipeline, order: Tick, mission: Mission) -> FlowField:
    """The refined flow; on the way to the goal the one before, where the new one can not be computed."""
    assert order.assumed is not None and order.field is not None
    observations = observations_of(pipeline, order)
    refiner = pipeline.refiner
    try:
        found = refiner.refine(order.assumed, observations, pipeline.chip, pipeline.solver, order.refined)
    except FlowError as error:
        if mission.phase != Phase.NAVIGATE or order.refined is None:
            raise
        if refiner.adopt == "always":  # as sessions have it that were recorded before maps were tested
            return replace(order.refined, note=f"not refined again: {error}")
        return keep_flow(order.refined, str(error))
    return refiner.choose(found, order.field)


def _in_use(pipeline: Pipeline, order: Tick, mission: Mission, why: str) -> Result:
    """Result that stays in use at an order whose new one is refused; no route where the robot is not on one."""
    if mission.wanted == WorkOrder.REFINE:
        assert order.field is not None
        return keep_flow(order.field, why)
    if order.route is not None and mission.phase in (Phase.SURVEY, Phase.NAVIGATE):
        # A survey ends with this stretch: the next one would be refused as well.
        return replace(order.route, reason=f"route kept: {why}", more=False, refused=why)
    method = "survey" if mission.wanted == WorkOrder.SURVEY_ROUTE else pipeline.planner.method
    return replace(no_route(method, why), goal_um=mission.goal_um, refused=why)


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
    result goes to a field outside `fills` are ignored (in a replay: their results are recorded). `announce`: takes what
    is computed, and '' after it.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        adopt_after_s: float,
        schedule: Mapping[int, int] | None = None,
        fills: Iterable[str] = WORKER_FIELDS,
    ) -> None:
        self._pipeline = pipeline
        self.announce: Callable[[str], None] = lambda _what: None
        self._after_ns = nanoseconds(adopt_after_s)
        self._schedule = dict(schedule or {})
        self._fills = frozenset(fills)
        self._order: Tick | None = None

    def submit(self, order: Tick) -> None:
        if order_of(order)[1] in self._fills:
            self._order = order

    def due(self, stamp_ns: int) -> Results:
        if self._order is None:
            return {}
        mission, name = order_of(self._order)
        if stamp_ns < self._schedule.get(mission.request, mission.requested_ns + self._after_ns):
            return {}
        order, self._order = self._order, None
        return {name: replace(self._result(order), stamp_ns=stamp_ns)}

    def close(self) -> None:
        """Nothing is held."""

    def _result(self, order: Tick) -> Result:
        self.announce(order_of(order)[0].wanted.replace("_", " "))
        result = work(self._pipeline, order)
        self.announce("")
        return result


class ReplayWorker(LockstepWorker):
    """Takes over the recorded result of an order where nothing has changed that its computation reads.

    Parameters
    ----------
    recorded : the recorded tick of the inputs that the loop has taken last.
    same : work orders for which all settings are as recorded that their computation reads.
    others : of LockstepWorker.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        adopt_after_s: float,
        schedule: Mapping[int, int],
        fills: Iterable[str],
        recorded: Callable[[], Tick],
        same: Collection[WorkOrder],
    ) -> None:
        super().__init__(pipeline, adopt_after_s, schedule, fills)
        self._recorded = recorded
        self._same = same
        self._unchanged = False

    def submit(self, order: Tick) -> None:
        super().submit(order)
        if self._order is order:
            mission, name = order_of(order)
            recorded = self._recorded()
            one, other = messages_read(order, name), messages_read(recorded, name)
            self._unchanged = (
                mission.wanted in self._same
                and _alike(mission, recorded.mission)
                and one.keys() == other.keys()
                and all(_alike(message, other[each]) for each, message in one.items())
            )

    def _result(self, order: Tick) -> Result:
        mission, name = order_of(order)
        found: Result | None = getattr(self._recorded(), name)
        if self._unchanged and found is not None and found.request == mission.request:
            return found
        return super()._result(order)


def _alike(one: Message | None, other: Message | None) -> bool:
    return one is other or (one is not None and one.same_as(other))


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
