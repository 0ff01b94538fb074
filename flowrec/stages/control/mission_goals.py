"""Goals and speed limits that a person sets while a mission runs.

One order is under way at a time, so the latest of several goals is planned when the order before is answered, and no
answer to an earlier one is taken for it. Until a route leads to the new goal the mission remembers the former one, to
which it returns where there is no way. None of these orders counts against `orders_limit`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Mission, Phase, Route
from flowrec.stages.control.mission_steps import MissionFrame
from flowrec.stages.control.trajectory import position_at

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
