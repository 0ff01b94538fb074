"""Events of a tick that a person should know: new results, phases, operator commands, alarms, loss of the robot.

The texts are part of recorded sessions and are compared exactly in a replay: they do not change.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flowrec.core import (
    BY_STREAM,
    EXPECTED,
    HEARD,
    SILENT,
    STREAMS,
    WALLS,
    Action,
    Alarm,
    AxesVerdict,
    Event,
    Floats,
    FlowField,
    Health,
    Level,
    Mission,
    OperatorEvent,
    Outcome,
    Phase,
    RobotWalls,
    StreamStates,
    Tick,
    seconds,
)
from flowrec.stages.run_figures import length_um

Line = tuple[str, Level | None]  # text and level; None leaves the level as it is
# The mission reports other commands.
_OPERATOR: dict[str, str] = {Action.MARK: "mark", Action.NOTE: "note", Action.ZERO: "field to zero at once"}
_STEERING = (Action.GOAL, Action.SPEED)


def event_of(last: Tick, tick: Tick, needs_time_to_go: bool = False) -> Event | None:
    """The event of a tick after the previous one, None if nothing happened.

    `needs_time_to_go` says whether the control method expects a time to go of each route.
    """
    lines = [
        *_results(last, tick, needs_time_to_go),
        *_visibility(last, tick),
        *_look(last, tick),
        *_health(last.health, tick.health),
        *_operator(last, tick),
        *_hand(last, tick),
        *_axes(last, tick),
        *_streams(last, tick),
        *_others(last, tick),
        *_mission(last, tick),
    ]
    if not lines:
        return None
    level = next((level for _, level in reversed(lines) if level is not None), Level.INFO)
    return Event(tick.stamp_ns, level.value, "; ".join(text for text, _ in lines))


def _results(last: Tick, tick: Tick, needs_time_to_go: bool) -> Iterator[Line]:
    """Fields and routes that are used from this tick on."""
    if tick.assumed is not None and tick.assumed is not last.assumed:
        peak = float(np.linalg.norm(tick.assumed.velocity_um_s, axis=-1).max())
        yield f"assumed flow adopted ({tick.assumed.method}), peak {peak:.0f} um/s", None
    if tick.refined is not None and tick.refined is not last.refined:
        yield _refinement_line(tick.refined)
    route = tick.route
    if route is None or route is last.route:
        return
    if not route.reachable:
        yield f"no route ({route.method}): {route.reason}", Level.WARNING
        return
    mission, before = tick.mission, last.mission
    if mission is not None and before is not None and mission.phase == before.phase:
        if mission.phase in (Phase.SURVEY, Phase.NAVIGATE):  # ordered on the way
            yield f"{mission.phase}: {route.reason}", Level.WARNING if route.refused else None
            return
        if mission.request != route.request:
            yield "the route to an earlier goal, or at an earlier speed limit, is not taken", None
            return
    yield f"route adopted ({route.method}): {length_um(route) / 1000:.2f} mm in {route.lasts_s:.1f} s", None
    if needs_time_to_go and route.method != "survey" and route.time_to_go_s is None:
        yield "no time to go is known from here: the route is followed as by control.method = vector", Level.WARNING


def _refinement_line(flow: FlowField) -> Line:
    """A refined flow that is adopted, or refused for the one in use; and how both predict what was held back."""
    scores = ""
    if flow.log_score is not None and flow.log_score_before is not None:
        scores = f" (log score {flow.log_score:.2f} against {flow.log_score_before:.2f})"
    if flow.refused:
        return f"refined flow refused, the map in use stays: {flow.refused}{scores}", Level.WARNING
    note = f": {flow.note}" if flow.note else ""
    if scores:
        assert flow.log_score is not None and flow.log_score_before is not None and flow.log_score_error is not None
        sure = flow.log_score - flow.log_score_before > 2.0 * flow.log_score_error
        note += f"; predicts held-back observations {'better' if sure else 'no worse'} than the map before{scores}"
    return f"refined flow adopted ({flow.method}){note}", None


def _visibility(last: Tick, tick: Tick) -> Iterator[Line]:
    """The robot found or lost, unless the camera repeats an image."""
    if tick.track is None or last.track is None or tick.track.seen == last.track.seen:
        return
    if any(each.applied is not None and each.applied.repeats_image for each in (last, tick)):
        return
    yield ("robot seen", Level.INFO) if tick.track.seen else ("robot lost from view", Level.WARNING)


def _look(last: Tick, tick: Tick) -> Iterator[Line]:
    """Lines on the robot's appearance, when the tracker has determined it, or the reason why it could not."""
    look = tick.appearance
    if look is None or last.appearance is not None:
        return
    if look.note:
        yield look.note, Level.ERROR
    else:
        learned = f", its look learned ({look.radius_px:.1f} px)" if len(look.views) else ""
        yield f"the robot is {look.polarity}{learned}", None


def _health(before: Health | None, health: Health | None) -> Iterator[Line]:
    """Alarms that began or ended, and a frequency limit that was lowered because of step-out, or lifted."""
    if health is None or health is before:
        return
    was = set() if before is None else set(before.alarms)
    now = set(health.alarms)
    texts: dict[str, str] = {}
    if now - was:
        texts = {
            Alarm.NIS: f"the robot is moved by what the observer does not know (NIS {health.nis:.1f}, should be 2)",
            Alarm.PULSATION: f"the flow pulsates at {health.pulsation_hz:.2g} Hz by {health.pulsation_share:.0%}",
            Alarm.TRACKING: f"the robot is out of sight on {health.lost_share:.0%} of the frames",
        }
    for text in [texts[name] for name in sorted(now - was)] + [f"alarm over: {name}" for name in sorted(was - now)]:
        yield text, Level.WARNING if now else None
    was_hz = before.limit_hz if before is not None else None
    if health.limit_hz is None and was_hz is not None:
        yield (
            f"no step-out: at {was_hz:.1f} Hz the robot rolls no better; the flow is not that of the map",
            Level.WARNING,
        )
    elif health.limit_hz is not None and health.limit_hz != was_hz:
        rolled, expected = health.rolled_before_um_s
        yield (
            f"step-out: the robot rolls {rolled / expected:.0%} of what it should; limited to {health.limit_hz:.1f} Hz",
            Level.WARNING,
        )


def _operator(last: Tick, tick: Tick) -> Iterator[Line]:
    """Lines on the operator's actions, and on a goal to which no route leads."""
    event, mission, before = tick.operator, tick.mission, last.mission
    if mission is not None and before is not None and _is_refused(before, mission):
        yield f"goal {_place(before.goal_um)} refused: it stays {_place(mission.goal_um)}", Level.WARNING
    if event is None or event is last.operator:
        return
    if event.action in _STEERING and mission is not None:
        yield _steering(event, mission)
    if event.action in _OPERATOR:
        text = f": {event.text}" if event.text and event.action != Action.ZERO else ""
        yield f"operator: {_OPERATOR[event.action]}{text}", None


def _hand(last: Tick, tick: Tick) -> Iterator[Line]:
    """A hand that takes the robot, and one that lets it go."""
    hand, before = tick.hand, last.hand
    if tick.mission is None or not tick.mission.by_hand or hand is None or hand is before:
        return
    steered = before is not None and before.held
    if hand.held and not steered:
        yield f"steered by hand ({hand.by})", None
    elif not hand.held and steered:
        yield f"the hand has let go ({hand.why}): the field is off, the robot is held", None


def _is_refused(before: Mission, mission: Mission) -> bool:
    """True if the mission has gone back to its former goal."""
    asked = len(before.former_goal_um) > len(mission.former_goal_um) and not mission.finished
    return asked and not np.array_equal(mission.goal_um, before.goal_um)


def _steering(event: OperatorEvent, mission: Mission) -> Line:
    """A goal or a speed limit, and why it is not taken."""
    if event.action == Action.SPEED:
        taken = mission.speed_set_ns == event.stamp_ns
        said = "speed limit taken away" if event.speed_limit_um_s is None else f"speed limited to {event.text}"
    else:
        taken, said = mission.goal_set_ns == event.stamp_ns, f"goal set to {event.text}"
    if taken:
        return f"operator: {said}", None
    why = f"{event.action} {event.text} refused: the mission is over" if mission.finished else mission.note
    return f"operator: {why}", Level.WARNING


def _place(point_um: Floats) -> str:
    return f"{point_um[0]:.0f}, {point_um[1]:.0f} um"


def _axes(last: Tick, tick: Tick) -> Iterator[Line]:
    """The verdict of the check of the axes; the mission tells one that ends it."""
    axes, before = tick.axes, last.axes
    if axes is None or (before is not None and before.verdict == axes.verdict):
        return
    if axes.verdict == AxesVerdict.AGREES:
        yield axes.text, None
    elif axes.verdict == AxesVerdict.UNDECIDED:
        yield axes.text, Level.WARNING


def _streams(last: Tick, tick: Tick) -> Iterator[Line]:
    """Streams that have stopped or are back, and steps of their clocks."""
    states, before = (each.extra.of(STREAMS, StreamStates) for each in (tick, last))
    if states is None or states is before:
        return
    was = dict[str, tuple[int, int]]()
    if before is not None:
        was = {name: (int(before.state[n]), int(before.steps[n])) for n, name in enumerate(before.stream_names())}
    for number, name in enumerate(states.stream_names()):
        state, steps = int(states.state[number]), int(states.steps[number])
        state_before, steps_before = was.get(name, (EXPECTED, 0))
        if state == SILENT and state_before != SILENT:
            yield f"stream {name} is silent", Level.WARNING
        elif state == HEARD and state_before == SILENT:
            yield f"stream {name} is back", None
        if steps > steps_before:
            yield f"stream {name}: the sender's clock has stepped; its stamps are shifted", Level.WARNING


def _others(last: Tick, tick: Tick) -> Iterator[Line]:
    """Robots other than the mission's one that come near to a wall, or are off it again."""
    walls, before = (each.extra.of(WALLS, RobotWalls) for each in (tick, last))
    if walls is None or walls is before:
        return
    was = before.near if before is not None else np.zeros_like(walls.near)
    for number in np.flatnonzero(walls.near > was).tolist():
        yield f"robot {number + 1} is {max(walls.wall_um[number], 0.0):.0f} um from a wall", Level.WARNING
    for number in np.flatnonzero(walls.near < was).tolist():
        yield f"alarm over: robot {number + 1} near a wall", None


def _mission(last: Tick, tick: Tick) -> Iterator[Line]:
    """Holds, losses of sight and phases."""
    mission, before = tick.mission, last.mission
    if mission is None:
        return
    for text in _hold(last, tick):
        yield text, Level.WARNING if mission.swept else None
    if before is not None and not mission.finished and mission.blind_since_ns != before.blind_since_ns:
        if mission.blind_since_ns is None:
            yield "robot in sight again: the mission goes on", None
        else:
            yield f"{mission.blind}: the robot is held", Level.WARNING
    if before is not None and mission.field_off and not before.field_off:
        yield f"{mission.blind}: field off", Level.ERROR
    if before is None or mission.phase != before.phase:
        state = mission.outcome if mission.finished else mission.phase
        note = f" ({mission.note})" if mission.note else ""
        failed = mission.finished and not Outcome(mission.outcome).completes_mission
        yield f"mission: {state}{note}", Level.WARNING if failed else None


def _hold(last: Tick, tick: Tick) -> Iterator[str]:
    """A hold by the operator that begins or ends, and a held robot that is swept away or back."""
    mission, before, demand = tick.mission, last.mission, tick.demand
    assert mission is not None
    since_ns = before.held_since_ns if before is not None else None
    if mission.held_since_ns is None:
        if since_ns is not None and not mission.finished:
            yield f"goes on after {seconds(tick.stamp_ns - since_ns):.1f} s"
        return
    asked = tick.operator if tick.operator is not last.operator else None
    by_stream = asked is not None and asked.text.startswith(BY_STREAM)
    if since_ns is None:
        wait = f" (the {mission.wanted.replace('_', ' ')} that it waits for goes on)" if mission.wanted else ""
        no_route = mission.phase == Phase.PLAN and not mission.wanted
        by = f"held: {asked.text}" if asked is not None and by_stream else "held by the operator"
        if not mission.by_hand:
            yield f"held: {mission.note}" if no_route else f"{by}{wait}"
    elif asked is not None and asked.action == Action.PAUSE and not by_stream and not mission.by_hand:
        yield "held by the operator, too"
    if before is not None and mission.swept != before.swept:
        off = f" by {demand.error_um:.0f} um" if demand is not None else ""
        why = ": the flow is faster than the robot" if demand is not None and demand.saturated else ""
        yield f"carried off the place where it is held{off}{why}" if mission.swept else "held in its place again"
