"""The mission state machine: the phase of a run, the work order that it waits for, and the end of the run.

Notes and outcomes are part of recorded sessions and are compared exactly in a replay: their texts do not change.

Long because each phase stands beside the settings that it reads; what no setting changes is in mission_steps.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

import numpy as np

from flowrec.core import (
    BY_STREAM,
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
from flowrec.stages.control.mission_steps import (
    IN_VIEW,
    MissionFrame,
    confirm_goal,
    end_if_lost,
    is_asked,
    is_current,
    note_swept,
    on_the_way,
    refuse_goal,
    with_goal,
    without_sight,
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
    Without a `goal` the robot comes back to its start after a survey, and goes to the outlet without one.
    """

    phases: tuple[PhaseName, ...] = PHASES  # phases in their order; observe is alone
    # where the robot is at the beginning; on a lab's rig it is seen, and this is where it is looked for
    start: Place = "inlet"
    # where the mission ends; None: at its start after a survey, so that the robot comes back; without one at the widest
    # outlet
    goal: Place | None = None
    # Before anything is controlled, drive the robot a little along x and y, for at most 3 s, and refuse the run if it
    # does not move as the axes of camera and coils say; see control/axes_check.py. Record, import and doctor then also
    # compare the walls in the image with the stated orientation of the chip and the scale of the camera.
    check_axes: bool = True
    # time from the first frame for which a pipette, a magnet or a pump that stands still holds the robot; the field is
    # on and the flow solved before it is let go. None: 1 s in the simulated rig at an outlet that `start` names, else 0
    hold_start_s: Annotated[float, Range(0.0, 3600.0)] | None = None
    # distance from the goal that counts as reached; None: the robot's radius
    goal_tolerance_um: Annotated[float, Range(0.01, 1e5)] | None = None
    survey_limit_s: Annotated[float, Range(0.1, 1e6)] = 120.0  # time after which a survey ends, wherever it is
    # time by which a robot may be late on its route, on top of what is usual, before it counts as stuck: a survey ends,
    # and the way to the goal is planned anew; 0: never. As long as a robot at its speed limit needs for a few widths of
    # a channel.
    stuck_s: Annotated[float, Range(0.0, 1e6)] = 5.0
    # time after which a mission that has not reached its goal ends
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
    # longest time to see the robot for the first time, or again after the field was switched off
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
        steered: bool = False,
    ) -> Mission:
        """The mission after this frame; the previous object itself while nothing changes.

        `demand` is that of the frame before: its error is the distance of the robot from its route. Where `applied`
        does not say whether the image is new, `hold_after_s` and `zero_after_s` have no effect.

        `not_found_note` is the tracker's advice for a robot that is not found; `refused`: it can not be found.
        `goal_fault` says why the goal of `operator` can be none: it is in a wall, or outside the chip. `axes` is the
        check of the axes; while `checking` is under way or due the mission stays at its start. `steered`: a hand steers
        the robot on this frame, which then is held, also when the hand has let go, until the operator lets it go on.
        """
        now = MissionFrame(
            self._first(track.stamp_ns, assumed) if previous is None else previous,
            *(track, estimate, assumed, refined, route, operator, demand, robot, applied, not_found_note, refused),
            *(observations, goal_fault),
        )
        if self.observes:
            return self._observe(now)
        commanded = now.mission if now.mission.finished else self._after_command(now)
        if steered and not (checking or commanded.finished or commanded.by_hand):
            commanded = replace(now, mission=commanded).taken_in_hand
        if previous is None or commanded.finished:
            return commanded
        if commanded.speed_limit_um_s is not None:
            now = replace(now, robot=robot.slowed_to(commanded.speed_limit_um_s))
        if now.command in _STEERING:
            now = replace(now, mission=commanded)  # and goes on: a person who drags the goal stops nothing
        mission = now.mission
        ended = end_if_lost(now, self.find_limit_s, self.lost_limit_frames)
        if ended is not None:
            return ended
        if commanded is not mission:
            return commanded
        unseen = without_sight(now, self.hold_after_s, self.zero_after_s, self.find_limit_s)
        if unseen is not mission or mission.blind_since_ns is not None:
            return unseen
        if mission.held_since_ns is not None:
            return mission if mission.by_hand else note_swept(now)
        if checking:
            return mission
        refuted = axes is not None and axes.verdict in (AxesVerdict.CONTRADICTS, AxesVerdict.NO_MOTION)
        if axes is not None and refuted and mission.phase == Phase.START:
            return now.finish(Outcome.REFUSED, axes.text)
        waits = mission.wanted and mission.phase not in _ON_THE_WAY and now.result() is None
        return mission if waits else self._advance(now)

    @property
    def observes(self) -> bool:
        """True if the robot is only watched."""
        return Phase.OBSERVE in self.phases

    def _first(self, now_ns: int, assumed: FlowField | None) -> Mission:
        has_field = assumed is not None  # of an earlier session
        nowhere = np.full(2, np.nan)
        return Mission(
            stamp_ns=now_ns,
            phase=Phase.OBSERVE.value if self.observes else Phase.START.value,
            since_ns=now_ns,
            request=0 if has_field else 1,
            wanted="" if has_field else WorkOrder.SOLVE.value,
            requested_ns=now_ns,
            start_um=nowhere if self.observes else np.asarray(self.start, np.float64),
            goal_um=nowhere if self.observes else np.asarray(self.goal, np.float64),
            finished=False,
            outcome="",
            note="",
        )

    def _observe(self, now: MissionFrame) -> Mission:
        """Wait for the assumed flow and for the end of the frames, then for the refinement."""
        if now.mission.finished:
            return now.mission
        if now.command in (Action.STOP, Action.ZERO):
            return now.stop(Outcome.STOPPED)
        if now.command in _STEERING:
            now = now.going_on(note=f"{now.command} refused: the robot is only observed")
        if now.command == Action.END and not now.mission.input_ended:
            now = now.going_on(input_ended=True)
        mission = now.mission
        if now.refused:
            return now.finish(Outcome.NOT_FOUND, now.not_found_note)
        if mission.wanted and now.result() is None:
            return mission
        if mission.wanted == WorkOrder.REFINE:
            return now.finish(Outcome.OBSERVE_COMPLETE)
        if not mission.input_ended:
            return now.with_changes(wanted="") if mission.wanted else mission
        if now.track.seen_ns is None:
            return now.finish(Outcome.NOT_FOUND, now.with_advice(f"the robot was never seen; {IN_VIEW}"))
        return now.order(Phase.OBSERVE, WorkOrder.REFINE)

    def _after_command(self, now: MissionFrame) -> Mission:
        """The mission after the operator's command; the mission itself if there is none.

        A held mission does not advance, whatever it waits for, and its time limits are suspended. One that a hand has
        taken goes on by a person's command alone.
        """
        command, mission = now.command, now.mission
        since_ns = mission.held_since_ns
        if command in (Action.STOP, Action.ZERO):
            arrived = command == Action.STOP and mission.arrived_s is not None
            return now.stop(Outcome.REACHED if arrived else Outcome.STOPPED)
        if command == Action.GOAL:
            return with_goal(now)
        if command == Action.SPEED:
            assert now.operator is not None
            return now.with_changes(speed_limit_um_s=now.operator.speed_limit_um_s, speed_set_ns=now.now_ns)
        if command == Action.PAUSE and since_ns is None:
            return now.with_changes(held_since_ns=now.now_ns)
        if command == Action.RESUME and since_ns is not None:
            assert now.operator is not None
            if mission.by_hand and now.operator.text.startswith(BY_STREAM):
                return mission
            held_ns = mission.held_ns + now.now_ns - since_ns
            return now.with_changes(held_since_ns=None, held_ns=held_ns, swept=False, by_hand=False)
        return mission

    def _advance(self, now: MissionFrame) -> Mission:
        """The next state when no work is pending, or its result has just arrived."""
        mission, route = now.mission, now.route
        if mission.phase == Phase.START:
            return self._start(now)
        if not now.track.seen:
            return mission  # nothing begins while the robot is out of sight
        if mission.phase == Phase.REFINE:
            return self._next_phase(Phase.REFINE, now)
        if mission.phase == Phase.PLAN:
            return self._plan(now)
        assert route is not None
        return self._survey(now, route) if mission.phase == Phase.SURVEY else self._navigate(now, route)

    def _start(self, now: MissionFrame) -> Mission:
        """With a stretch of the survey on the way; else once the robot is seen, and no longer held by other means."""
        result = now.result()
        if isinstance(result, Route):  # of the survey
            if result.reachable:
                return now.transition(Phase.SURVEY, result.reason)
            return self._next_phase(Phase.SURVEY, now, f"no survey: {result.reason}")
        if not now.track.seen:
            return now.with_changes(wanted="") if now.mission.wanted else now.mission
        if self.hold_start_s is not None and now.elapsed_s() < self.hold_start_s:
            return now.mission
        if Phase.SURVEY in self.phases:
            return now.order(Phase.START, WorkOrder.SURVEY_ROUTE)
        return self._next_phase(Phase.SURVEY, now)

    def _plan(self, now: MissionFrame) -> Mission:
        """With a route on the way; where there is none to a new goal, back to the former one."""
        mission, result = now.mission, now.result()
        if not isinstance(result, Route) or not is_current(mission):
            return now.routine_order(Phase.PLAN, mission.note)
        if result.reachable:
            return confirm_goal(self._next_phase(Phase.PLAN, now, result.reason))
        if is_asked(mission):
            now = refuse_goal(now, result.reason)
            return now.routine_order(Phase.PLAN, now.mission.note)
        if mission.speed_limit_um_s is not None:  # a person must change that
            note = f"no route at {mission.speed_limit_um_s:g} um/s: {result.reason}; set another speed limit or goal"
            return now.with_changes(wanted="", held_since_ns=now.now_ns, note=f"{note}, then go on")
        return now.finish(Outcome.UNREACHABLE, result.reason)

    def _survey(self, now: MissionFrame, route: Route) -> Mission:
        """On a stretch: the next one is ordered before its end; an order under way is waited for, at the end at rest.

        The phase ends with the last stretch, or with its time limit.
        """
        mission, result = now.mission, now.result()
        if result is not None:
            assert isinstance(result, Route)
            return now.transition(Phase.SURVEY, result.reason)
        if mission.wanted:
            return mission
        slowed = mission.speed_set_ns is not None  # its times are those of another speed
        limit_s = self.survey_limit_s if slowed else self._time_limit_s(self.survey_limit_s, route)
        if now.elapsed_s() > limit_s:
            return self._next_phase(Phase.SURVEY, now, "survey cut short by its time limit")
        if not slowed and self._is_stuck(now):
            return self._next_phase(Phase.SURVEY, now, "survey cut short: something is in the way")
        near_end = now.left_s(route) <= self.lead_s
        if route.more:
            if not near_end:
                return mission
            return now.routine_order(Phase.SURVEY, wanted=WorkOrder.SURVEY_ROUTE, start_um=route.waypoints_um[-1])
        # A survey of several stretches may pass its end on the way.
        if now.at_end(route) and (near_end or not mission.routine_orders):
            return self._next_phase(Phase.SURVEY, now)
        return mission

    def _is_stuck(self, now: MissionFrame, radii: float = 1.0) -> bool:
        """True if the robot is off its reference by more than some radii, and both are late.

        What may block a channel is not on the map. The reference waits for the robot.
        """
        if not self.stuck_s or now.demand is None or now.demand.error_um <= radii * now.robot.radius_um:
            return False
        late_s = now.elapsed_s() - now.demand.progress_s
        return late_s > self.stuck_s + _SLOWER * now.demand.progress_s

    def _time_limit_s(self, limit_s: float, route: Route, from_s: float = 0.0) -> float:
        """Time limit of a route, `from_s` along it on: for a robot that is stuck, waiting does not help."""
        return from_s + min(limit_s, self.patience * (float(route.arrival_s[-1]) - from_s) + _EXTRA_S)

    def _other_speed(self, now: MissionFrame) -> str:
        """Reason to plan for another speed: the robot has become slower, or a person lets it be faster; '' if none."""
        mission, planned_um_s, able_um_s = now.mission, now.mission.planned_um_s, now.robot.speed_limit_um_s
        if planned_um_s is None:
            return ""
        if able_um_s < self.replan_slower * planned_um_s:
            return f"the robot reaches {able_um_s:.0f} um/s and not {planned_um_s:.0f}: planning anew"
        set_since = mission.speed_set_ns is not None and mission.speed_set_ns > mission.requested_ns
        if set_since and planned_um_s < self.replan_slower * able_um_s:
            return f"the robot may reach {able_um_s:.0f} um/s and not only {planned_um_s:.0f}: planning anew"
        return ""

    def _navigate(self, now: MissionFrame, route: Route) -> Mission:
        """At the goal, too late, too far off the route, or still on the way."""
        mission, other_speed = now.mission, self._other_speed(now)
        if is_asked(mission):
            return on_the_way(now, route, self.lead_s, other_speed)
        place_um, radius_um = now.estimate.position_um, now.robot.radius_um
        tolerance_um = self.goal_tolerance_um if self.goal_tolerance_um is not None else radius_um
        arrived_s = mission.arrived_s
        if arrived_s is None and math.dist(place_um, mission.goal_um) <= tolerance_um:
            if not self.wait_at_goal_s:
                return now.finish(Outcome.REACHED)
            note = f"at the goal: waits {self.wait_at_goal_s:g} s for another one"
            return now.with_changes(arrived_s=now.elapsed_s(), note=note)
        if arrived_s is not None and now.elapsed_s() - arrived_s >= self.wait_at_goal_s:
            return now.finish(Outcome.REACHED)
        limit_s = self._time_limit_s(self.navigate_limit_s, route, mission.goal_from_s)
        if arrived_s is None and now.elapsed_s() > limit_s:
            note = f"goal not reached in {limit_s:.0f} s, where {route.arrival_s[-1]:.0f} s were planned"
            return now.finish(Outcome.TIMEOUT, note)
        if mission.wanted and now.result() is None:
            return mission  # one order at a time
        if other_speed and arrived_s is None:
            if mission.speed_set_ns is not None:
                return now.routine_order(Phase.PLAN, other_speed)
            return now.order(Phase.PLAN, WorkOrder.ROUTE, other_speed)
        limit_um = self.replan_error_um if self.replan_error_um is not None else 6.0 * radius_um
        stuck = self._is_stuck(now, _WAITING_RADII)
        if now.demand is None or not (stuck or now.demand.error_um > limit_um):
            return self._look_again(now, route)
        if mission.request - mission.routine_orders >= self.orders_limit:
            note = f"blown off every one of {mission.request} routes and maps: the robot can not be held here"
            return now.finish(Outcome.GAVE_UP, note)
        # Another route from here would be the same.
        if stuck and math.dist(place_um, mission.start_um) <= 2.0 * radius_um:
            note = "stuck where its route begins: something that is not on the map is in the way"
            return now.finish(Outcome.GAVE_UP, note)
        off = f"{'stuck' if stuck else 'blown'} {now.demand.error_um:.0f} um off the route"
        return now.order(Phase.PLAN, WorkOrder.ROUTE, f"{off}: planning anew")

    def _look_again(self, now: MissionFrame, route: Route) -> Mission:
        """On the way: after some observations refine the map again, then ask whether another route is better now."""
        mission, result = now.mission, now.result()
        if isinstance(result, FlowField) and mission.arrived_s is None:
            wanted = WorkOrder.ROUTE
        elif result is not None:
            return now.transition(Phase.NAVIGATE, result.reason if isinstance(result, Route) else mission.note)
        elif self._refines_again(now) and now.left_s(route) > 2.0 * self.lead_s:
            wanted = WorkOrder.REFINE
        else:
            return mission
        assert now.demand is not None
        start_um = position_at(route, now.demand.progress_s + self.lead_s)
        return now.routine_order(Phase.NAVIGATE, wanted=wanted, start_um=start_um)

    def _refines_again(self, now: MissionFrame) -> bool:
        """True if enough observations have been made since the map was refined."""
        observations, refined = now.observations, now.refined
        if not self.reassimilate_observations or Phase.REFINE not in self.phases:
            return False
        if observations is None or observations.time_s is None or refined is None:
            return False
        new = observations.time_s > seconds(refined.stamp_ns)
        return int(np.count_nonzero(new)) >= self.reassimilate_observations

    def _next_phase(self, done: Phase, now: MissionFrame, note: str = "") -> Mission:
        """Enter the first selected phase after `done`, or end the run."""
        selected: set[str] = {*self.phases, Phase.PLAN} if Phase.NAVIGATE in self.phases else set(self.phases)
        name = next((name for name in PHASES[PHASES.index(done) + 1 :] if name in selected), None)
        if name is None:
            return now.finish(Outcome(f"{done} complete"), note)
        phase, orders = Phase(name), {"refine": WorkOrder.REFINE, "plan": WorkOrder.ROUTE}
        return now.order(phase, orders[name], note) if name in orders else now.transition(phase, note)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedMission(MissionStateMachine):
    """A mission whose start and goal are points on the chip."""

    start: Point
    goal: Point
    hold_start_s: float
