"""The mission state machine: the phase of a run, the work order that it waits for, and the end of the run.

Notes and outcomes are part of recorded sessions and are compared exactly in a replay: their texts do not change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

import numpy as np

from flowrec.core import (
    Action,
    Applied,
    AxesCheck,
    AxesVerdict,
    Demand,
    Estimate,
    FlowField,
    Mission,
    Observations,
    OperatorEvent,
    Outcome,
    Phase,
    Range,
    Route,
    Share,
    Track,
    WorkOrder,
    seconds,
)
from flowrec.physics import Robot
from flowrec.stages.control.mission_goals import (
    confirm_goal,
    held_without_route,
    is_asked,
    is_current,
    on_the_way,
    refuse_goal,
    routine_order,
    with_goal,
    with_speed_limit,
)
from flowrec.stages.control.mission_sight import IN_VIEW, end_if_lost, without_sight
from flowrec.stages.control.mission_steps import (
    MissionInputs,
    at_end,
    elapsed_s,
    finish,
    left_s,
    note_swept,
    order,
    transition,
)
from flowrec.stages.control.trajectory import position_at

PhaseName = Literal[Phase.SURVEY, Phase.REFINE, Phase.PLAN, Phase.NAVIGATE, Phase.OBSERVE]
PHASES: tuple[PhaseName, ...] = get_args(PhaseName)[:4]  # of a robot that is driven, in order
Coordinate = Annotated[float, Range(-1e9, 1e9)]
Point = tuple[Coordinate, Coordinate]
Place = Point | str
_ON_THE_WAY = (Phase.SURVEY, Phase.NAVIGATE)  # the robot goes on while an order is under way
_STEERING = (Action.GOAL, Action.SPEED)
_SLOWER = 0.3  # of the planned time: a robot that steps out at 0.7 of its limit is later by about so much
_WAITING_RADII = 2.5  # off a reference that then has a fifth of its pace (Controller.lag_full_radii)
_EXTRA_S = 5.0  # on top of `patience` times the planned duration of a route


@dataclass(frozen=True, slots=True)
class MissionStateMachine:
    """Phases of the mission and the limits that end it.

    `phases` is any selection of survey, refine, plan, navigate; navigate always plans first. Or it is `observe` alone:
    the robot is watched and never driven, whether it is in sight or not, until the frames end or a person ends it; then
    the flow is refined with all observations. `start` and `goal`, which `observe` does not use, are points (x, y) in um
    on the chip, or `inlet`, `outlet` (the widest), `inlet:1` (counted along the border).
    """

    phases: tuple[PhaseName, ...] = PHASES
    start: Place = "inlet"
    goal: Place = "outlet"
    # Before anything is controlled, drive the robot a little along x and y, for at most 3 s, and refuse the run if it
    # does not move as the axes of camera and coils say; see control/axes_check.py. Record, import and doctor then also
    # compare the walls in the image with the stated orientation of the chip and the scale of the camera.
    check_axes: bool = True
    # time from the first frame for which a pipette, a magnet or a pump that stands still holds the robot; the field is
    # on and the flow solved before it is let go. None: 1 s in the simulated rig at an outlet that `start` names, else 0
    hold_start_s: Annotated[float, Range(0.0, 3600.0)] | None = None
    goal_tolerance_um: Annotated[float, Range(0.01, 1e5)] | None = None  # None: the robot's radius
    survey_limit_s: Annotated[float, Range(0.1, 1e6)] = 120.0
    # time by which a robot may be late on its route, on top of what is usual, before it counts as stuck: a survey ends,
    # and the way to the goal is planned anew; 0: never. As long as a robot at its speed limit needs for a few widths of
    # a channel.
    stuck_s: Annotated[float, Range(0.0, 1e6)] = 5.0
    navigate_limit_s: Annotated[float, Range(0.1, 1e6)] = 300.0
    # no route is followed for longer than this factor times its planned duration, plus 5 s
    patience: Annotated[float, Range(0.1, 1e3)] = 3.0
    # Time before the end of a stretch of the survey at which the next one is ordered; so far ahead of the robot a route
    # begins that is ordered on the way.
    lead_s: Annotated[float, Range(0.0, 600.0)] = 2.0
    # observations after which the map is refined again on the way to the goal, and another route taken if it is better
    # by more than the map is uncertain; 0: never
    reassimilate_observations: Annotated[int, Range(0, 1_000_000)] = 0
    # number of work orders after which a robot that is blown off its route once more gives up, but for routine ones
    orders_limit: Annotated[int, Range(1, 1_000_000)] = 20
    # to see the robot for the first time, or again after the field was switched off
    find_limit_s: Annotated[float, Range(0.01, 1e5)] = 3.0
    # consecutive frames without the robot after which the run ends
    lost_limit_frames: Annotated[int, Range(1, 1_000_000_000)] = 90
    # time without sight of the robot after which it is held
    hold_after_s: Annotated[float, Range(0.0, 60.0)] = 0.5
    # time without sight of the robot after which the field is switched off until it is seen again
    zero_after_s: Annotated[float, Range(0.0, 60.0)] = 1.4
    # fraction of the speed limit with which a route was planned, below which a new one is planned: the robot has
    # stepped out on the way; 0: never
    replan_slower: Share = 0.95
    # distance from the route beyond which a new one is planned; None: six radii
    replan_error_um: Annotated[float, Range(1.0, math.inf)] | None = None
    # time for which the robot is held at the goal, for the operator to set another one; 0: the run ends there
    wait_at_goal_s: Annotated[float, Range(0.0, 1e5)] = 0.0

    def update(
        self,
        previous: Mission | None,
        track: Track,
        estimate: Estimate,
        assumed: FlowField | None,
        refined: FlowField | None,
        route: Route | None,
        operator: OperatorEvent | None,
        demand: Demand | None,
        robot: Robot,
        applied: Applied | None = None,
        not_found_note: str = "",
        refused: bool = False,
        observations: Observations | None = None,
        goal_fault: str = "",
        axes: AxesCheck | None = None,
        checking: bool = False,
    ) -> Mission:
        """The mission after this frame; the previous object itself while nothing changes.

        `demand` is that of the frame before: its error is the distance of the robot from its route. Where `applied`
        does not say whether the image is new, `hold_after_s` and `zero_after_s` have no effect.

        `not_found_note` is the tracker's advice for a robot that is not found; `refused`: it can not be found.
        `goal_fault` says why the goal of `operator` can be none: it is in a wall, or outside the chip. `axes` is the
        check of the axes; while `checking` is under way or due the mission stays at its start.
        """
        now = MissionInputs(
            *(track, estimate, assumed, refined, route, operator, demand, robot, applied, not_found_note, refused),
            *(observations, goal_fault),
        )
        if self.observes:
            return self._observe(previous if previous is not None else self._first(now), now)
        if previous is None:
            return self._after_command(self._first(now), now)
        if previous.finished:
            return previous
        commanded = self._after_command(previous, now)
        if commanded.finished:
            return commanded
        if commanded.speed_limit_um_s is not None:
            now = replace(now, robot=robot.slowed_to(commanded.speed_limit_um_s))
        if now.command in _STEERING:
            previous = commanded  # and goes on: a person who drags the goal stops nothing
        ended = end_if_lost(previous, now, self.find_limit_s, self.lost_limit_frames)
        if ended is not None:
            return ended
        if commanded is not previous:
            return commanded
        unseen = without_sight(previous, now, self.hold_after_s, self.zero_after_s, self.find_limit_s)
        if unseen is not previous or previous.blind_since_ns is not None:
            return unseen
        if previous.held_since_ns is not None:
            return note_swept(previous, now)
        if checking:
            return previous
        refuted = axes is not None and axes.verdict in (AxesVerdict.CONTRADICTS, AxesVerdict.NO_MOTION)
        if axes is not None and refuted and previous.phase == Phase.START:
            return finish(previous, now, Outcome.REFUSED, axes.text)
        result = now.result(previous)
        waits = bool(previous.wanted) and result is None and previous.phase not in _ON_THE_WAY
        return previous if waits else self._advance(previous, now, result)

    @property
    def observes(self) -> bool:
        """True if the robot is only watched."""
        return Phase.OBSERVE in self.phases

    def _first(self, now: MissionInputs) -> Mission:
        has_field = now.assumed is not None  # of an earlier session
        nowhere = np.full(2, np.nan)
        return Mission(
            stamp_ns=now.now_ns,
            phase=Phase.OBSERVE.value if self.observes else Phase.START.value,
            since_ns=now.now_ns,
            request=0 if has_field else 1,
            wanted="" if has_field else WorkOrder.SOLVE.value,
            requested_ns=now.now_ns,
            start_um=nowhere if self.observes else np.asarray(self.start, np.float64),
            goal_um=nowhere if self.observes else np.asarray(self.goal, np.float64),
            finished=False,
            outcome="",
            note="",
        )

    def _observe(self, previous: Mission, now: MissionInputs) -> Mission:
        """Wait for the assumed flow and for the end of the frames, then for the refinement."""
        if previous.finished:
            return previous
        mission, operator = previous, now.operator
        if now.command in (Action.STOP, Action.ZERO):
            note = operator.text if operator is not None else ""
            return finish(mission, now, Outcome.STOPPED, note or f"operator: {now.command}")
        if now.command in _STEERING:
            mission = replace(mission, stamp_ns=now.now_ns, note=f"{now.command} refused: the robot is only observed")
        if now.command == Action.END and not mission.input_ended:
            mission = replace(mission, stamp_ns=now.now_ns, input_ended=True)
        if now.refused:
            return finish(mission, now, Outcome.NOT_FOUND, now.not_found_note)
        if mission.wanted and now.result(mission) is None:
            return mission
        if mission.wanted == WorkOrder.REFINE:
            return finish(mission, now, Outcome.OBSERVE_COMPLETE)
        if not mission.input_ended:
            return replace(mission, stamp_ns=now.now_ns, wanted="") if mission.wanted else mission
        if now.track.seen_ns is None:
            return finish(mission, now, Outcome.NOT_FOUND, now.with_advice(f"the robot was never seen; {IN_VIEW}"))
        return order(mission, now, Phase.OBSERVE, WorkOrder.REFINE)

    def _after_command(self, mission: Mission, now: MissionInputs) -> Mission:
        """The mission after the operator's command; the mission itself if there is none.

        A held mission does not advance, whatever it waits for, and its time limits are suspended.
        """
        command, since_ns = now.command, mission.held_since_ns
        if command in (Action.STOP, Action.ZERO):
            note = now.operator.text if now.operator is not None else ""
            arrived = command == Action.STOP and mission.arrived_s is not None
            outcome = Outcome.REACHED if arrived else Outcome.STOPPED
            return finish(mission, now, outcome, note or f"operator: {command}")
        if command == Action.GOAL:
            return with_goal(mission, now)
        if command == Action.SPEED:
            return with_speed_limit(mission, now)
        if command == Action.PAUSE and since_ns is None:
            return replace(mission, stamp_ns=now.now_ns, held_since_ns=now.now_ns)
        if command == Action.RESUME and since_ns is not None:
            held_ns = mission.held_ns + now.now_ns - since_ns
            return replace(mission, stamp_ns=now.now_ns, held_since_ns=None, held_ns=held_ns, swept=False)
        return mission

    def _advance(self, previous: Mission, now: MissionInputs, result: FlowField | Route | None) -> Mission:
        """The next state when no work is pending, or its result has just arrived."""
        phase, route = previous.phase, now.route
        if not now.track.seen and phase != Phase.START:
            return previous  # nothing begins while the robot is out of sight
        if phase == Phase.START:
            if isinstance(result, Route):  # of the survey
                if result.reachable:
                    return transition(previous, now, Phase.SURVEY, result.reason)
                return self._next_phase(Phase.SURVEY, previous, now, f"no survey: {result.reason}")
            if not now.track.seen:
                return replace(previous, stamp_ns=now.now_ns, wanted="") if previous.wanted else previous
            if self.hold_start_s is not None and elapsed_s(previous, now) < self.hold_start_s:
                return previous
            if Phase.SURVEY in self.phases:
                return order(previous, now, Phase.START, WorkOrder.SURVEY_ROUTE)
            return self._next_phase(Phase.SURVEY, previous, now)
        if phase == Phase.REFINE:
            return self._next_phase(Phase.REFINE, previous, now)
        if phase == Phase.PLAN:
            return self._plan(previous, now, result)
        assert route is not None
        if phase == Phase.SURVEY:
            return self._survey(previous, now, route, result)
        return self._navigate(previous, now, route, result)

    def _plan(self, previous: Mission, now: MissionInputs, result: FlowField | Route | None) -> Mission:
        """With a route on the way; where there is none to a new goal, back to the former one."""
        if not isinstance(result, Route) or not is_current(previous):
            return routine_order(previous, now, Phase.PLAN, previous.note)
        if result.reachable:
            return confirm_goal(self._next_phase(Phase.PLAN, previous, now, result.reason))
        if is_asked(previous):
            former = refuse_goal(previous, result.reason)
            return routine_order(former, now, Phase.PLAN, former.note)
        if previous.speed_limit_um_s is not None:
            return held_without_route(previous, now, result.reason)
        return finish(previous, now, Outcome.UNREACHABLE, result.reason)

    def _survey(self, previous: Mission, now: MissionInputs, route: Route, result: FlowField | Route | None) -> Mission:
        """On a stretch: the next one is ordered before its end; an order under way is waited for, at the end at rest.

        The phase ends with the last stretch, or with its time limit.
        """
        if result is not None:
            assert isinstance(result, Route)
            return transition(previous, now, Phase.SURVEY, result.reason)
        if previous.wanted:
            return previous
        slowed = previous.speed_set_ns is not None  # its times are those of another speed
        limit_s = self.survey_limit_s if slowed else self._time_limit_s(self.survey_limit_s, route)
        if elapsed_s(previous, now) > limit_s:
            return self._next_phase(Phase.SURVEY, previous, now, "survey cut short by its time limit")
        if not slowed and self._is_stuck(previous, now):
            return self._next_phase(Phase.SURVEY, previous, now, "survey cut short: something is in the way")
        near_end = left_s(now, route) <= self.lead_s
        if route.more:
            if not near_end:
                return previous
            return order(
                *(previous, now, Phase.SURVEY, WorkOrder.SURVEY_ROUTE),
                start_um=route.waypoints_um[-1],
                routine_orders=previous.routine_orders + 1,
            )
        # A survey of several stretches may pass its end on the way.
        if at_end(now, route) and (near_end or not previous.routine_orders):
            return self._next_phase(Phase.SURVEY, previous, now)
        return previous

    def _is_stuck(self, previous: Mission, now: MissionInputs, radii: float = 1.0) -> bool:
        """True if the robot is off its reference by more than some radii, and both are late.

        What may block a channel is not on the map. The reference waits for the robot.
        """
        if not self.stuck_s or now.demand is None or now.demand.error_um <= radii * now.robot.radius_um:
            return False
        late_s = elapsed_s(previous, now) - now.demand.progress_s
        return late_s > self.stuck_s + _SLOWER * now.demand.progress_s

    def _time_limit_s(self, limit_s: float, route: Route, from_s: float = 0.0) -> float:
        """Time limit of a route, `from_s` along it on: for a robot that is stuck, waiting does not help."""
        return from_s + min(limit_s, self.patience * (float(route.arrival_s[-1]) - from_s) + _EXTRA_S)

    def _other_speed(self, previous: Mission, now: MissionInputs) -> str:
        """Reason to plan for another speed: the robot has become slower, or a person lets it be faster; '' if none."""
        planned_um_s, able_um_s = previous.planned_um_s, now.robot.speed_limit_um_s
        if planned_um_s is None:
            return ""
        if able_um_s < self.replan_slower * planned_um_s:
            return f"the robot reaches {able_um_s:.0f} um/s and not {planned_um_s:.0f}: planning anew"
        set_since = previous.speed_set_ns is not None and previous.speed_set_ns > previous.requested_ns
        if set_since and planned_um_s < self.replan_slower * able_um_s:
            return f"the robot may reach {able_um_s:.0f} um/s and not only {planned_um_s:.0f}: planning anew"
        return ""

    def _navigate(
        self, previous: Mission, now: MissionInputs, route: Route, result: FlowField | Route | None
    ) -> Mission:
        """At the goal, too late, too far off the route, or still on the way."""
        other_speed = self._other_speed(previous, now)
        if is_asked(previous):
            return on_the_way(previous, now, route, result, self.lead_s, other_speed)
        tolerance_um = self.goal_tolerance_um if self.goal_tolerance_um is not None else now.robot.radius_um
        arrived_s = previous.arrived_s
        if arrived_s is None and math.dist(now.estimate.position_um, previous.goal_um) <= tolerance_um:
            if not self.wait_at_goal_s:
                return finish(previous, now, Outcome.REACHED)
            arrived_s = elapsed_s(previous, now)
            note = f"at the goal: waits {self.wait_at_goal_s:g} s for another one"
            return replace(previous, stamp_ns=now.now_ns, arrived_s=arrived_s, note=note)
        if arrived_s is not None and elapsed_s(previous, now) - arrived_s >= self.wait_at_goal_s:
            return finish(previous, now, Outcome.REACHED)
        limit_s = self._time_limit_s(self.navigate_limit_s, route, previous.goal_from_s)
        if arrived_s is None and elapsed_s(previous, now) > limit_s:
            note = f"goal not reached in {limit_s:.0f} s, where {route.arrival_s[-1]:.0f} s were planned"
            return finish(previous, now, Outcome.TIMEOUT, note)
        if previous.wanted and result is None:
            return previous  # one order at a time
        if other_speed and arrived_s is None:
            if previous.speed_set_ns is not None:
                return routine_order(previous, now, Phase.PLAN, other_speed)
            return order(previous, now, Phase.PLAN, WorkOrder.ROUTE, other_speed)
        limit_um = self.replan_error_um if self.replan_error_um is not None else 6.0 * now.robot.radius_um
        stuck = self._is_stuck(previous, now, _WAITING_RADII)
        if now.demand is None or not (stuck or now.demand.error_um > limit_um):
            return self._look_again(previous, now, route, result)
        if previous.request - previous.routine_orders >= self.orders_limit:
            note = f"blown off every one of {previous.request} routes and maps: the robot can not be held here"
            return finish(previous, now, Outcome.GAVE_UP, note)
        # Another route from here would be the same.
        if stuck and math.dist(now.estimate.position_um, previous.start_um) <= 2.0 * now.robot.radius_um:
            note = "stuck where its route begins: something that is not on the map is in the way"
            return finish(previous, now, Outcome.GAVE_UP, note)
        off = f"{now.demand.error_um:.0f} um off the route"
        note = f"stuck {off}" if stuck else f"blown {off}"
        return order(previous, now, Phase.PLAN, WorkOrder.ROUTE, f"{note}: planning anew")

    def _look_again(
        self, previous: Mission, now: MissionInputs, route: Route, result: FlowField | Route | None
    ) -> Mission:
        """On the way: after some observations refine the map again, then ask whether another route is better now."""
        wanted = None
        if isinstance(result, FlowField) and previous.arrived_s is None:
            wanted = WorkOrder.ROUTE
        elif result is not None:
            return transition(
                previous, now, Phase.NAVIGATE, result.reason if isinstance(result, Route) else previous.note
            )
        elif self._refines_again(now) and left_s(now, route) > 2.0 * self.lead_s:
            wanted = WorkOrder.REFINE
        if wanted is None:
            return previous
        assert now.demand is not None
        return order(
            *(previous, now, Phase.NAVIGATE, wanted),
            start_um=position_at(route, now.demand.progress_s + self.lead_s),
            routine_orders=previous.routine_orders + 1,
        )

    def _refines_again(self, now: MissionInputs) -> bool:
        """True if enough observations have been made since the map was refined."""
        observations, refined = now.observations, now.refined
        if not self.reassimilate_observations or Phase.REFINE not in self.phases:
            return False
        if observations is None or observations.time_s is None or refined is None:
            return False
        new = observations.time_s > seconds(refined.stamp_ns)
        return int(np.count_nonzero(new)) >= self.reassimilate_observations

    def _next_phase(self, done: Phase, previous: Mission, now: MissionInputs, note: str = "") -> Mission:
        """Enter the first selected phase after `done`, or end the run."""
        selected: set[str] = {*self.phases, Phase.PLAN} if Phase.NAVIGATE in self.phases else set(self.phases)
        name = next((name for name in PHASES[PHASES.index(done) + 1 :] if name in selected), None)
        if name is None:
            return finish(previous, now, Outcome(f"{done} complete"), note)
        phase, orders = Phase(name), {"refine": WorkOrder.REFINE, "plan": WorkOrder.ROUTE}
        if name in orders:
            return order(previous, now, phase, orders[name], note)
        return transition(previous, now, phase, note)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedMission(MissionStateMachine):
    """A mission whose start and goal are points on the chip."""

    start: Point
    goal: Point
    hold_start_s: float
