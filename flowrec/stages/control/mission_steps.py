"""Inputs of the mission's state machine on a frame, and the transitions from one state to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from flowrec.core import (
    Applied,
    Demand,
    Estimate,
    FlowField,
    Mission,
    Observations,
    OperatorEvent,
    Outcome,
    Phase,
    Route,
    Track,
    WorkOrder,
    seconds,
)
from flowrec.physics import Robot

_SWEPT_RADII, _RETURNED_RADII = 2.0, 1.0  # from its position, of a held robot


@dataclass(frozen=True, slots=True, eq=False)
class MissionInputs:
    """Inputs of the state machine on one frame."""

    track: Track
    estimate: Estimate
    assumed: FlowField | None
    refined: FlowField | None
    route: Route | None
    operator: OperatorEvent | None
    demand: Demand | None  # of the frame before; its error is the distance of the robot from its route
    robot: Robot
    applied: Applied | None
    not_found_note: str
    refused: bool
    observations: Observations | None
    goal_fault: str  # why the goal of the operator's event can be none

    def with_advice(self, note: str) -> str:
        """A note on a robot that was not found, with the tracker's advice."""
        return f"{note} {self.not_found_note}" if self.not_found_note else note

    @property
    def now_ns(self) -> int:
        return self.track.stamp_ns

    @property
    def command(self) -> str:
        """Action of the operator on this frame, '' if none."""
        return self.operator.action if self.operator is not None and self.operator.stamp_ns == self.now_ns else ""

    def result(self, mission: Mission) -> FlowField | Route | None:
        """The result that the mission waits for, once it has arrived."""
        results: dict[str, FlowField | Route | None] = {
            WorkOrder.SOLVE: self.assumed,
            WorkOrder.REFINE: self.refined,
            WorkOrder.SURVEY_ROUTE: self.route,
            WorkOrder.ROUTE: self.route,
        }
        result = results.get(mission.wanted)
        return result if result is not None and result.request == mission.request else None


def note_swept(previous: Mission, now: MissionInputs) -> Mission:
    """Note in the mission that a held robot is swept away: beyond two radii, until it is back within one."""
    if not now.track.seen or now.demand is None or not math.isfinite(now.demand.error_um):
        return previous
    limit_radii = _RETURNED_RADII if previous.swept else _SWEPT_RADII
    swept = now.demand.error_um > limit_radii * now.robot.radius_um
    return previous if swept == previous.swept else replace(previous, stamp_ns=now.now_ns, swept=swept)


def elapsed_s(mission: Mission, now: MissionInputs) -> float:
    """Duration of the phase, without the time during which it was held."""
    held_ns = mission.held_ns
    if mission.held_since_ns is not None:
        held_ns += now.now_ns - mission.held_since_ns
    return seconds(now.now_ns - mission.since_ns - held_ns)


def at_end(now: MissionInputs, route: Route) -> bool:
    """True if the robot is at the end of a route, or the reference is and the robot as near as it comes."""
    if math.dist(now.estimate.position_um, route.waypoints_um[-1]) <= now.robot.radius_um:
        return True
    demand = now.demand
    return (
        demand is not None and demand.progress_s >= route.arrival_s[-1] and demand.error_um < 2.0 * now.robot.radius_um
    )


def left_s(now: MissionInputs, route: Route) -> float:
    """Planned time until the reference is at the end of a route."""
    progress_s = now.demand.progress_s if now.demand is not None else 0.0
    return float(route.arrival_s[-1]) - progress_s


def transition(
    previous: Mission, now: MissionInputs, phase: Phase, note: str = "", wanted: WorkOrder | None = None, **changes: Any
) -> Mission:
    """The mission in a phase, which begins now unless it is the present one."""
    new = phase != previous.phase
    return replace(
        previous,
        stamp_ns=now.now_ns,
        phase=phase.value,
        since_ns=now.now_ns if new else previous.since_ns,
        held_ns=0 if new else previous.held_ns,
        goal_from_s=0.0 if new else previous.goal_from_s,
        arrived_s=None if new else previous.arrived_s,
        wanted=wanted.value if wanted is not None else "",
        note=note,
        **changes,
    )


def order(
    previous: Mission, now: MissionInputs, phase: Phase, wanted: WorkOrder, note: str = "", **changes: Any
) -> Mission:
    """The mission in a phase that waits for a new work order, whose route begins at the robot unless stated."""
    asked: dict[str, Any] = {
        "request": previous.request + 1,
        "requested_ns": now.now_ns,
        "start_um": now.estimate.position_um,
        "planned_um_s": now.robot.speed_limit_um_s,
    }
    return transition(previous, now, phase, note, wanted, **asked | changes)


def finish(previous: Mission, now: MissionInputs, outcome: Outcome, note: str = "") -> Mission:
    """The finished mission."""
    return transition(
        previous,
        now,
        Phase.DONE,
        note,
        finished=True,
        outcome=outcome.value,
        held_since_ns=None,
        swept=False,
        blind_since_ns=None,
        blind="",
        field_off=False,
    )
