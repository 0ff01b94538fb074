"""The mission on a frame with its inputs, the transitions to the mission after it, and what is done without sight.

A person sets goals and speed limits while a mission runs. One order is under way at a time, so the latest of several
goals is planned when the order before is answered, and no answer to an earlier one is taken for it. Until a route leads
to the new goal the mission remembers the former one, to which it returns where there is no way. None of these orders
counts against `orders_limit`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowrec.core import (
    Applied,
    Demand,
    Estimate,
    Floats,
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
from flowrec.stages.control.trajectory import position_at

IN_VIEW = "is it in view (camera.um_per_px), and of the size in robot.radius_um?"
_SWEPT_RADII, _RETURNED_RADII = 2.0, 1.0  # from its position, of a held robot


@dataclass(frozen=True, slots=True, eq=False)
class MissionFrame:
    """The mission before a frame, and the inputs of the state machine on it."""

    mission: Mission
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
    def taken_in_hand(self) -> Mission:
        """The mission that a hand steers on this frame: held, until the operator lets it go on."""
        since_ns = self.mission.held_since_ns
        since_ns = self.now_ns if since_ns is None else since_ns
        return self.with_changes(by_hand=True, held_since_ns=since_ns, swept=False)

    @property
    def now_ns(self) -> int:
        return self.track.stamp_ns

    @property
    def command(self) -> str:
        """Action of the operator on this frame, '' if none."""
        return self.operator.action if self.operator is not None and self.operator.stamp_ns == self.now_ns else ""

    def result(self) -> FlowField | Route | None:
        """The result that the mission waits for, once it has arrived."""
        results: dict[str, FlowField | Route | None] = {
            WorkOrder.SOLVE: self.assumed,
            WorkOrder.REFINE: self.refined,
            WorkOrder.SURVEY_ROUTE: self.route,
            WorkOrder.ROUTE: self.route,
        }
        result = results.get(self.mission.wanted)
        return result if result is not None and result.request == self.mission.request else None

    def elapsed_s(self) -> float:
        """Duration of the phase, without the time during which it was held."""
        held_ns = self.mission.held_ns
        if self.mission.held_since_ns is not None:
            held_ns += self.now_ns - self.mission.held_since_ns
        return seconds(self.now_ns - self.mission.since_ns - held_ns)

    def at_end(self, route: Route) -> bool:
        """True if the robot is at the end of a route, or the reference is and the robot as near as it comes."""
        demand, radius_um = self.demand, self.robot.radius_um
        if math.dist(self.estimate.position_um, route.waypoints_um[-1]) <= radius_um:
            return True
        return demand is not None and demand.progress_s >= route.arrival_s[-1] and demand.error_um < 2.0 * radius_um

    def left_s(self, route: Route) -> float:
        """Planned time until the reference is at the end of a route."""
        progress_s = self.demand.progress_s if self.demand is not None else 0.0
        return float(route.arrival_s[-1]) - progress_s

    def with_changes(self, **changes: Any) -> Mission:
        """The mission with other values from now on."""
        return replace(self.mission, stamp_ns=self.now_ns, **changes)

    def going_on(self, **changes: Any) -> MissionFrame:
        """The frame on which the mission has other values already."""
        return replace(self, mission=self.with_changes(**changes))

    def transition(self, phase: Phase, note: str = "", wanted: WorkOrder | None = None, **changes: Any) -> Mission:
        """The mission in a phase, which begins now unless it is the present one."""
        if phase != self.mission.phase:
            changes = {"since_ns": self.now_ns, "held_ns": 0, "goal_from_s": 0.0, "arrived_s": None} | changes
        return self.with_changes(
            phase=phase.value, wanted=wanted.value if wanted is not None else "", note=note, **changes
        )

    def order(self, phase: Phase, wanted: WorkOrder, note: str = "", **changes: Any) -> Mission:
        """The mission in a phase that waits for a new work order, whose route begins at the robot unless stated."""
        asked: dict[str, Any] = {
            "request": self.mission.request + 1,
            "requested_ns": self.now_ns,
            "start_um": self.estimate.position_um,
            "planned_um_s": self.robot.speed_limit_um_s,
        }
        return self.transition(phase, note, wanted, **asked | changes)

    def routine_order(
        self, phase: Phase, note: str = "", wanted: WorkOrder = WorkOrder.ROUTE, start_um: Floats | None = None
    ) -> Mission:
        """A new order that no disturbance has caused; its route begins at the robot unless stated."""
        changes = {} if start_um is None else {"start_um": start_um}
        return self.order(phase, wanted, note, routine_orders=self.mission.routine_orders + 1, **changes)

    def finish(self, outcome: Outcome, note: str = "") -> Mission:
        """The finished mission."""
        return self.transition(
            Phase.DONE,
            note,
            finished=True,
            outcome=outcome.value,
            held_since_ns=None,
            swept=False,
            blind_since_ns=None,
            blind="",
            field_off=False,
            by_hand=False,
        )

    def stop(self, outcome: Outcome) -> Mission:
        """The mission that the operator has finished."""
        assert self.operator is not None
        return self.finish(outcome, self.operator.text or f"operator: {self.command}")


def note_swept(now: MissionFrame) -> Mission:
    """Note in the mission that a held robot is swept away: beyond two radii, until it is back within one."""
    mission = now.mission
    if not now.track.seen or now.demand is None or not math.isfinite(now.demand.error_um):
        return mission
    limit_radii = _RETURNED_RADII if mission.swept else _SWEPT_RADII
    swept = now.demand.error_um > limit_radii * now.robot.radius_um
    return mission if swept == mission.swept else now.with_changes(swept=swept)


def end_if_lost(now: MissionFrame, find_limit_s: float, lost_limit_frames: int) -> Mission | None:
    """The end of a run whose robot was not found, or not seen for too many frames.

    A camera that was absent and is back has as much time to find the robot as in the beginning.
    """
    absent_ns = now.applied.absent_until_ns if now.applied is not None else None
    if now.track.seen or (absent_ns is not None and seconds(now.now_ns - absent_ns) <= find_limit_s):
        return None
    if now.mission.phase == Phase.START:
        if now.refused:
            return now.finish(Outcome.NOT_FOUND, now.not_found_note)
        seen_ns = now.track.seen_ns
        if seen_ns is not None and seconds(now.now_ns - seen_ns) <= find_limit_s:
            return None  # it was found, and this image does not show it
        if now.elapsed_s() > find_limit_s:
            note = f"no robot seen in the image for {find_limit_s:g} s; {IN_VIEW}"
            return now.finish(Outcome.NOT_FOUND, now.with_advice(note))
    elif now.track.lost_frames > lost_limit_frames:
        why = f"{now.mission.blind}, " if now.mission.blind else "robot not seen in "
        return now.finish(Outcome.LOST, f"{why}{now.track.lost_frames} frames")
    return None


def without_sight(now: MissionFrame, hold_after_s: float, zero_after_s: float, find_limit_s: float) -> Mission:
    """Without sight of the robot: hold it, then switch the field off, then end; continue when it is seen again.

    If it was carried too far off its route meanwhile, a new one is planned as after any other disturbance. While
    the camera is absent the field is off; the rig says when that has lasted too long.
    """
    mission, applied, seen_ns, blind_ns = now.mission, now.applied, now.track.seen_ns, now.mission.blind_since_ns
    if applied is None or seen_ns is None or applied.image_since_ns is None:  # never seen yet, or an older session
        return mission
    if now.track.seen:
        return mission if blind_ns is None else now.with_changes(blind_since_ns=None, blind="", field_off=False)
    absent_ns = applied.absent_until_ns
    unseen_s = seconds(now.now_ns - (seen_ns if absent_ns is None else max(seen_ns, absent_ns)))
    why = f"robot not seen since {seconds(seen_ns):.1f} s"
    if applied.without_image:
        why = f"no image since {seconds(applied.image_since_ns):.1f} s: the camera is absent"
    elif applied.repeats_image:
        why = f"the camera repeats one image since {seconds(applied.image_since_ns):.1f} s"
    if not applied.without_image and unseen_s >= zero_after_s + find_limit_s:
        return now.finish(Outcome.LOST, why)
    since_ns = now.now_ns if blind_ns is None else blind_ns
    if (applied.without_image or unseen_s >= zero_after_s) and not mission.field_off:
        return now.with_changes(blind_since_ns=since_ns, blind=why, field_off=True)
    if not applied.without_image and unseen_s >= hold_after_s and blind_ns is None:
        return now.with_changes(blind_since_ns=since_ns, blind=why)
    return mission


_NONE = np.zeros(0)


def is_asked(mission: Mission) -> bool:
    """True if the goal was set during the run, and no route leads to it yet."""
    return bool(len(mission.former_goal_um))


def with_goal(now: MissionFrame) -> Mission:
    """The mission with the goal of this frame's event; with the reason as its note where that can be none."""
    event, mission = now.operator, now.mission
    if event is None or event.goal_um.shape != (2,):
        return mission
    if now.goal_fault:
        return now.with_changes(note=f"goal {event.text} refused: {now.goal_fault}")
    former_um = mission.former_goal_um if is_asked(mission) else mission.goal_um
    return now.with_changes(
        goal_um=event.goal_um, former_goal_um=former_um, goal_set_ns=now.now_ns, arrived_s=None, note=""
    )


def is_current(mission: Mission) -> bool:
    """True if the latest order is for the present goal and speed limit, and not older than they are."""
    set_ns = [ns for ns in (mission.goal_set_ns, mission.speed_set_ns) if ns is not None]
    return mission.requested_ns >= max(set_ns, default=mission.requested_ns)


def confirm_goal(mission: Mission) -> Mission:
    """The mission whose route leads to its goal."""
    return replace(mission, former_goal_um=_NONE) if is_asked(mission) else mission


def refuse_goal(now: MissionFrame, reason: str) -> MissionFrame:
    """The frame with the former goal of the mission, because no route leads to the present one."""
    x_um, y_um = now.mission.goal_um
    note = f"goal {x_um:.0f}, {y_um:.0f} um refused: {reason}"
    return now.going_on(goal_um=now.mission.former_goal_um, former_goal_um=_NONE, note=note)


def on_the_way(now: MissionFrame, route: Route, lead_s: float, slowed: str) -> Mission:
    """On the way to the former goal: a route to the new one is ordered, which leaves the present one further on.

    The robot goes on meanwhile, because a flow in which it was to move may be too fast for it to stand still. The times
    of the present route stay, so the reference goes on; lateness is forgotten. With a route that comes after the robot
    has passed its beginning, or `slowed` (why the present one no longer suits the robot's speed), the way is planned
    anew from where the robot then is held.
    """
    result, demand, mission = now.result(), now.demand, now.mission
    if mission.wanted and result is None:
        return mission
    assert demand is not None
    if isinstance(result, Route):
        is_kept = np.array_equal(result.goal_um, mission.former_goal_um)
        # The robot follows it from now on, be it to a goal that was set and is no longer asked for.
        now = now.going_on(former_goal_um=result.goal_um)
        if not is_kept and demand.progress_s > mission.goal_from_s:
            note = "the robot has passed the place where its way to the goal begins: planning anew"
            return now.routine_order(Phase.PLAN, note)
        if is_current(mission):
            if not np.array_equal(result.goal_um, mission.goal_um):
                now = refuse_goal(now, result.reason)
                return now.transition(Phase.NAVIGATE, now.mission.note)
            on_time_ns = now.now_ns - mission.since_ns - round(1e9 * demand.progress_s)
            adopted = confirm_goal(now.transition(Phase.NAVIGATE, result.reason))
            return replace(adopted, held_ns=max(mission.held_ns, on_time_ns))
    if slowed:
        return now.routine_order(Phase.PLAN, slowed)
    from_s = min(demand.progress_s + lead_s, float(route.arrival_s[-1]))
    asked = now.going_on(goal_from_s=from_s)
    return asked.routine_order(
        Phase.NAVIGATE, "a route to the new goal is ordered", start_um=position_at(route, from_s)
    )
