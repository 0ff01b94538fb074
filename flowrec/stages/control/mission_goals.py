"""Goals and speed limits that a person sets while a mission runs.

One order is under way at a time, so the latest of several goals is planned when the order before is answered, and no
answer to an earlier one is taken for it. Until a route leads to the new goal the mission remembers the former one, to
which it returns where there is no way. None of these orders counts against `orders_limit`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Floats, FlowField, Mission, Phase, Route, WorkOrder
from flowrec.stages.control.mission_steps import MissionInputs, order, transition
from flowrec.stages.control.trajectory import position_at

_NONE = np.zeros(0)


def is_asked(mission: Mission) -> bool:
    """True if the goal was set during the run, and no route leads to it yet."""
    return bool(len(mission.former_goal_um))


def with_goal(mission: Mission, now: MissionInputs) -> Mission:
    """The mission with the goal of this frame's event; with the reason as its note where that can be none."""
    event = now.operator
    if event is None or event.goal_um.shape != (2,):
        return mission
    if now.goal_fault:
        return replace(mission, stamp_ns=now.now_ns, note=f"goal {event.text} refused: {now.goal_fault}")
    former_um = mission.former_goal_um if is_asked(mission) else mission.goal_um
    return replace(
        mission,
        stamp_ns=now.now_ns,
        goal_um=event.goal_um,
        former_goal_um=former_um,
        goal_set_ns=now.now_ns,
        arrived_s=None,
        note="",
    )


def with_speed_limit(mission: Mission, now: MissionInputs) -> Mission:
    """The mission with the speed limit of this frame's event."""
    assert now.operator is not None
    limit_um_s = now.operator.speed_limit_um_s
    return replace(mission, stamp_ns=now.now_ns, speed_limit_um_s=limit_um_s, speed_set_ns=now.now_ns)


def routine_order(
    previous: Mission, now: MissionInputs, phase: Phase, note: str, start_um: Floats | None = None
) -> Mission:
    """A new order of a route that no disturbance has caused; it begins at the robot unless stated."""
    changes = {} if start_um is None else {"start_um": start_um}
    return order(previous, now, phase, WorkOrder.ROUTE, note, routine_orders=previous.routine_orders + 1, **changes)


def is_current(mission: Mission) -> bool:
    """True if the latest order is for the present goal and speed limit, and not older than they are."""
    set_ns = [ns for ns in (mission.goal_set_ns, mission.speed_set_ns) if ns is not None]
    return mission.requested_ns >= max(set_ns, default=mission.requested_ns)


def confirm_goal(mission: Mission) -> Mission:
    """The mission whose route leads to its goal."""
    return replace(mission, former_goal_um=_NONE) if is_asked(mission) else mission


def refuse_goal(mission: Mission, reason: str) -> Mission:
    """The mission with its former goal, because no route leads to the present one."""
    x_um, y_um = mission.goal_um
    note = f"goal {x_um:.0f}, {y_um:.0f} um refused: {reason}"
    return replace(mission, goal_um=mission.former_goal_um, former_goal_um=_NONE, note=note)


def held_without_route(mission: Mission, now: MissionInputs, reason: str) -> Mission:
    """The mission that holds the robot, because its speed limit leaves no route: a person must change that."""
    note = f"no route at {mission.speed_limit_um_s:g} um/s: {reason}; set another speed limit or goal, then go on"
    return replace(mission, stamp_ns=now.now_ns, wanted="", held_since_ns=now.now_ns, note=note)


def on_the_way(
    previous: Mission, now: MissionInputs, route: Route, result: FlowField | Route | None, lead_s: float, slowed: str
) -> Mission:
    """On the way to the former goal: a route to the new one is ordered, which leaves the present one further on.

    The robot goes on meanwhile, because a flow in which it was to move may be too fast for it to stand still. The times
    of the present route stay, so the reference goes on; lateness is forgotten. With a route that comes after the robot
    has passed its beginning, or `slowed` (why the present one no longer suits the robot's speed), the way is planned
    anew from where the robot then is held.
    """
    if previous.wanted and result is None:
        return previous
    demand = now.demand
    assert demand is not None
    if isinstance(result, Route):
        is_kept = np.array_equal(result.goal_um, previous.former_goal_um)
        # The robot follows it from now on, be it to a goal that was set and is no longer asked for.
        previous = replace(previous, former_goal_um=result.goal_um)
        if not is_kept and demand.progress_s > previous.goal_from_s:
            note = "the robot has passed the place where its way to the goal begins: planning anew"
            return routine_order(previous, now, Phase.PLAN, note)
    if isinstance(result, Route) and is_current(previous):
        if not np.array_equal(result.goal_um, previous.goal_um):
            kept = refuse_goal(previous, result.reason)
            return transition(kept, now, Phase.NAVIGATE, kept.note)
        on_time_ns = now.now_ns - previous.since_ns - round(1e9 * demand.progress_s)
        adopted = transition(confirm_goal(previous), now, Phase.NAVIGATE, result.reason)
        return replace(adopted, held_ns=max(previous.held_ns, on_time_ns))
    if slowed:
        return routine_order(previous, now, Phase.PLAN, slowed)
    from_s = min(demand.progress_s + lead_s, float(route.arrival_s[-1]))
    asked = replace(previous, goal_from_s=from_s)
    return routine_order(asked, now, Phase.NAVIGATE, "a route to the new goal is ordered", position_at(route, from_s))
