"""What a person should hear about a tick: phase changes, adopted results, the operator, loss of the robot."""

from __future__ import annotations

import numpy as np

from flowrec.messages import Event, Health, Mission, OperatorEvent, Tick
from flowrec.units import seconds


def narrate(last: Tick, tick: Tick, control: str = "") -> Event | None:
    """An event when something worth telling has happened between two ticks, else None. `control` is control.method."""
    lines: list[str] = []
    level = "info"
    mission, before = tick.mission, last.mission
    if tick.assumed is not None and tick.assumed is not last.assumed:
        peak = float(np.linalg.norm(tick.assumed.velocity_um_s, axis=-1).max())
        lines.append(f"assumed flow adopted ({tick.assumed.method}), peak {peak:.0f} um/s")
    if tick.refined is not None and tick.refined is not last.refined:
        note = f": {tick.refined.note}" if tick.refined.note else ""
        lines.append(f"refined flow adopted ({tick.refined.method}){note}")
    if tick.route is not None and tick.route is not last.route:
        if tick.route.reachable:
            length = float(np.linalg.norm(np.diff(tick.route.waypoints_um, axis=0), axis=1).sum())
            lines.append(
                f"route adopted ({tick.route.method}): {length / 1000:.2f} mm in {tick.route.arrival_s[-1]:.1f} s"
            )
            if control == "policy" and tick.route.method != "survey" and tick.route.time_to_go_s is None:
                level = "warning"
                lines.append("no time to go is known from here: the route is followed as by control.method = vector")
        else:
            level = "warning"
            lines.append(f"no route ({tick.route.method}): {tick.route.reason}")
    if (
        tick.track is not None
        and last.track is not None
        and tick.track.seen != last.track.seen
        and not any(each.applied is not None and each.applied.repeats_image for each in (last, tick))
    ):
        lines.append("robot seen" if tick.track.seen else "robot lost from view")
        level = "info" if tick.track.seen else "warning"
    if tick.health is not None and tick.health is not last.health:
        lines += _alarms(last.health, tick.health)
        if tick.health.alarm and (last.health is None or tick.health.alarm != last.health.alarm):
            level = "warning"
        limited = _limited(last.health, tick.health)
        lines += limited
        if limited:
            level = "warning"
    if tick.operator is not None and tick.operator is not last.operator:
        lines += _said(tick.operator)
    if mission is not None:
        held = _held(before, mission, tick)
        lines += held
        if held and mission.swept:
            level = "warning"
        if before is not None and not mission.finished and mission.blind_since_ns != before.blind_since_ns:
            if mission.blind_since_ns is None:
                lines.append("robot in sight again: the mission goes on")
            else:
                lines.append(f"{mission.blind}: the robot is held")
                level = "warning"
        if before is not None and mission.field_off and not before.field_off:
            lines.append(f"{mission.blind}: field off")
            level = "error"
    if mission is not None and (before is None or mission.phase != before.phase):
        said = f"{mission.outcome}" if mission.finished else mission.phase
        lines.append(f"mission: {said}" + (f" ({mission.note})" if mission.note else ""))
        if mission.finished and mission.outcome not in (
            "reached",
            "survey complete",
            "refine complete",
            "plan complete",
        ):
            level = "warning"
    if not lines:
        return None
    return Event(tick.stamp_ns, level, "; ".join(lines))


def _said(operator: OperatorEvent) -> list[str]:
    """What the operator did, where the mission does not tell it."""
    said = {"mark": "mark", "note": "note", "zero": "field to zero at once"}
    if operator.action not in said:
        return []
    text = f": {operator.text}" if operator.text and operator.action != "zero" else ""
    return [f"operator: {said[operator.action]}{text}"]


def _held(before: Mission | None, mission: Mission, tick: Tick) -> list[str]:
    """A hold that begins, ends, or fails."""
    since_ns = before.held_since_ns if before is not None else None
    if mission.held_since_ns is None:
        if since_ns is None or mission.finished:
            return []
        return [f"goes on after {seconds(tick.stamp_ns - since_ns):.1f} s"]
    lines = []
    if since_ns is None:
        wait = f" (the {mission.wanted.replace('_', ' ')} that it waits for goes on)" if mission.wanted else ""
        lines.append(f"held by the operator{wait}")
    if before is not None and mission.swept != before.swept:
        demand = tick.demand
        off = f" by {demand.error_um:.0f} um" if demand is not None else ""
        why = ": the flow is faster than the robot" if demand is not None and demand.saturated else ""
        lines.append(
            f"carried off the place where it is held{off}{why}" if mission.swept else "held in its place again"
        )
    return lines


def _limited(before: Health | None, health: Health) -> list[str]:
    """A frequency limit that was lowered because of step-out, or lifted."""
    was_hz = before.limit_hz if before is not None else None
    if health.limit_hz == was_hz:
        return []
    if health.limit_hz is None:
        return [f"no step-out: at {was_hz:.1f} Hz the robot rolls no better; the flow is not that of the map"]
    rolled, asked = health.rolled_before_um_s
    return [f"step-out: the robot rolls {rolled / asked:.0%} of what it should; limited to {health.limit_hz:.1f} Hz"]


def _alarms(before: Health | None, health: Health) -> list[str]:
    """What began and what ended."""
    was = set() if before is None else set(before.alarm.split("; ")) - {""}
    now = set(health.alarm.split("; ")) - {""}
    said = {
        "nis": f"the robot is moved by what the observer does not know (NIS {health.nis:.1f}, should be 2)",
        "pulsation": f"the flow pulsates at {health.pulsation_hz:.1f} Hz by {health.pulsation_share:.0%}",
        "tracking": f"the robot is out of sight on {health.lost_share:.0%} of the frames",
    }
    return [said[name] for name in sorted(now - was)] + [f"alarm over: {name}" for name in sorted(was - now)]
