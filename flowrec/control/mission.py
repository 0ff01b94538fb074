"""The commander: which phase a run is in, what work it waits for, and when it is over."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

import numpy as np

from flowrec.messages import Applied, Demand, Estimate, FlowField, Mission, OperatorEvent, Route, Track
from flowrec.ranges import Range
from flowrec.robot import Robot
from flowrec.units import seconds

Phase = Literal["survey", "refine", "plan", "navigate"]
PHASES: tuple[Phase, ...] = get_args(Phase)
Coordinate = Annotated[float, Range(-1e9, 1e9)]
Place = tuple[Coordinate, Coordinate] | str


@dataclass(frozen=True, slots=True)
class Commander:
    """Phases of the mission and the limits that end it.

    `phases` is any selection of survey, refine, plan, navigate; navigate always plans first. `start` and `goal`
    are points (x, y) in um on the chip, or `inlet`, `outlet` (the widest), `inlet:1` (counted along the border).
    """

    phases: tuple[Phase, ...] = PHASES
    start: Place = "inlet"
    goal: Place = "outlet"
    goal_tolerance_um: Annotated[float, Range(0.01, 1e5)] | None = None  # None: the robot's radius
    survey_limit_s: Annotated[float, Range(0.1, 1e6)] = 120.0
    navigate_limit_s: Annotated[float, Range(0.1, 1e6)] = 300.0
    # no route is followed for longer than this many times its planned time, and 5 s
    patience: Annotated[float, Range(0.1, 1e3)] = 3.0
    # solved, refined and planned so often and still blown off: it is no use
    orders_limit: Annotated[int, Range(1, 1_000_000)] = 20
    find_limit_s: Annotated[float, Range(0.01, 1e5)] = (
        3.0  # to see the robot for the first time, or again after the field was switched off
    )
    # in a row without seeing it before the run gives up
    lost_limit_frames: Annotated[int, Range(1, 1_000_000_000)] = 90
    # without sight of the robot: it stays where it is ...
    hold_after_s: Annotated[float, Range(0.0, 60.0)] = 0.5
    # ... and the field is switched off until it is seen again
    zero_after_s: Annotated[float, Range(0.0, 60.0)] = 1.4
    # None: six radii; blown this far off the route, plan anew
    replan_error_um: Annotated[float, Range(1.0, math.inf)] | None = None

    def decide(
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
    ) -> Mission:
        """The mission after this frame; the previous object itself while nothing changes.

        `demand` is the one of the frame before: it tells how far the robot is from its route. Where `applied` does
        not say whether the image is new, `hold_after_s` and `zero_after_s` have no effect.
        """
        now_ns = track.stamp_ns
        asked = operator.action if operator is not None and operator.stamp_ns == now_ns else ""
        if previous is None:
            first = self._first(now_ns, assumed)
            return self._told(first, now_ns, operator, asked) if asked else first
        if previous.finished:
            return previous
        if (told := self._told(previous, now_ns, operator, asked)).finished:
            return told
        if (verdict := self._lost(previous, track, now_ns)) is not None:
            return verdict
        if told is not previous:
            return told
        if applied is not None and (sight := self._blinded(previous, track, applied)) is not previous:
            return sight
        if previous.blind_since_ns is not None:
            return previous
        if previous.held_since_ns is not None:
            return self._swept(previous, now_ns, track, demand, robot)
        answer = self._answer(previous, assumed, refined, route)
        if previous.wanted and answer is None:
            return previous
        return self._advance(previous, now_ns, track, estimate, answer, route, demand, robot)

    def _first(self, now_ns: int, assumed: FlowField | None) -> Mission:
        goal = np.asarray(self.goal, np.float64)
        known = assumed is not None  # a field of an earlier session was handed in
        return Mission(
            stamp_ns=now_ns,
            phase="start",
            since_ns=now_ns,
            request=0 if known else 1,
            wanted="" if known else "solve",
            requested_ns=now_ns,
            start_um=np.asarray(self.start, np.float64),
            goal_um=goal,
            finished=False,
            outcome="",
            note="",
        )

    def _told(self, mission: Mission, now_ns: int, operator: OperatorEvent | None, asked: str) -> Mission:
        """What the operator's word makes of the mission; the mission itself where it makes no difference.

        A held mission does not go on, whatever it waits for, and its limits of time wait with it.
        """
        if asked in ("stop", "zero"):
            note = operator.text if operator is not None else ""
            return self._finish(mission, now_ns, "stopped", note or f"operator: {asked}")
        since_ns = mission.held_since_ns
        if asked == "pause" and since_ns is None:
            return replace(mission, stamp_ns=now_ns, held_since_ns=now_ns)
        if asked == "resume" and since_ns is not None:
            held_ns = mission.held_ns + now_ns - since_ns
            return replace(mission, stamp_ns=now_ns, held_since_ns=None, held_ns=held_ns, swept=False)
        return mission

    @staticmethod
    def _swept(held: Mission, now_ns: int, track: Track, demand: Demand | None, robot: Robot) -> Mission:
        """Whether a held robot is carried off its place: said from two radii on, taken back within one."""
        if not track.seen or demand is None or not math.isfinite(demand.error_um):
            return held
        swept = demand.error_um > (1.0 if held.swept else 2.0) * robot.radius
        return held if swept == held.swept else replace(held, stamp_ns=now_ns, swept=swept)

    @staticmethod
    def _passed_s(mission: Mission, now_ns: int) -> float:
        """How long the phase has lasted, the time under a hold left out."""
        held_ns = mission.held_ns if mission.held_since_ns is None else mission.held_ns + now_ns - mission.held_since_ns
        return seconds(now_ns - mission.since_ns - held_ns)

    def _lost(self, previous: Mission, track: Track, now_ns: int) -> Mission | None:
        if track.seen:
            return None
        if previous.phase == "start":
            if self._passed_s(previous, now_ns) > self.find_limit_s:
                return self._finish(
                    previous,
                    now_ns,
                    "not found",
                    f"no robot seen in the image for {self.find_limit_s:g} s; is it in view (camera.um_per_px), "
                    "and of the size in robot.radius_um?",
                )
        elif track.lost_frames > self.lost_limit_frames:
            why = f"{previous.blind}, " if previous.blind else "robot not seen in "
            return self._finish(previous, now_ns, "lost", f"{why}{track.lost_frames} frames")
        return None

    def _blinded(self, previous: Mission, track: Track, applied: Applied) -> Mission:
        """Hold, then no field, then the end for a robot that is out of sight; on its way again when it is seen.

        Where it was carried meanwhile, a route that is too far off is planned anew, as after any other disturbance.
        """
        now_ns, seen_ns, image_ns = track.stamp_ns, track.seen_ns, applied.image_since_ns
        if seen_ns is None or image_ns is None:  # never seen, so nothing is driven yet; or an older file
            return previous
        if track.seen:
            if previous.blind_since_ns is None:
                return previous
            return replace(previous, stamp_ns=now_ns, blind_since_ns=None, blind="", field_off=False)
        unseen_s = seconds(now_ns - seen_ns)
        why = f"robot not seen since {seconds(seen_ns):.1f} s"
        if applied.repeats_image:
            why = f"the camera repeats one image since {seconds(image_ns):.1f} s"
        if unseen_s >= self.zero_after_s + self.find_limit_s:
            return self._finish(previous, now_ns, "lost", why)
        if unseen_s >= self.zero_after_s and not previous.field_off:
            since_ns = now_ns if previous.blind_since_ns is None else previous.blind_since_ns
            return replace(previous, stamp_ns=now_ns, blind_since_ns=since_ns, blind=why, field_off=True)
        if unseen_s >= self.hold_after_s and previous.blind_since_ns is None:
            return replace(previous, stamp_ns=now_ns, blind_since_ns=now_ns, blind=why)
        return previous

    @staticmethod
    def _answer(
        mission: Mission, assumed: FlowField | None, refined: FlowField | None, route: Route | None
    ) -> FlowField | Route | None:
        """The result that the mission waits for, once it is there."""
        answers = {"solve": assumed, "refine": refined, "survey_route": route, "route": route}
        result = answers.get(mission.wanted)
        return result if result is not None and result.request == mission.request else None

    def _advance(
        self,
        previous: Mission,
        now_ns: int,
        track: Track,
        estimate: Estimate,
        answer: FlowField | Route | None,
        route: Route | None,
        demand: Demand | None,
        robot: Robot,
    ) -> Mission:
        """What follows when no work is pending, or it has just been answered."""
        if not track.seen and previous.phase != "start":
            return previous  # nothing is begun with a robot that is out of sight
        if previous.phase == "start":
            if isinstance(answer, Route):  # the survey's
                if answer.reachable:
                    return self._enter(previous, now_ns, "survey", answer.reason)
                return self._next_after("survey", previous, now_ns, estimate, f"no survey: {answer.reason}")
            if not track.seen:
                return replace(previous, stamp_ns=now_ns, wanted="") if previous.wanted else previous
            if "survey" in self.phases:
                return self._order(previous, now_ns, "start", "survey_route", estimate)
            return self._next_after("survey", previous, now_ns, estimate, "")
        if previous.phase == "survey":
            assert route is not None
            late = self._passed_s(previous, now_ns) > self._limit_s(self.survey_limit_s, route)
            if late or self._at_end(estimate, route, demand, robot):
                note = "survey cut short by its time limit" if late else ""
                return self._next_after("survey", previous, now_ns, estimate, note)
            return previous
        if previous.phase == "refine":
            return self._next_after("refine", previous, now_ns, estimate, "")
        if previous.phase == "plan":
            assert isinstance(answer, Route)
            if not answer.reachable:
                return self._finish(previous, now_ns, "unreachable", answer.reason)
            return self._next_after("plan", previous, now_ns, estimate, answer.reason)
        assert route is not None
        return self._navigate(previous, now_ns, track, estimate, route, demand, robot)

    def _limit_s(self, limit_s: float, route: Route) -> float:
        """How long a route may be followed: a robot that is stuck will not get there by waiting."""
        return min(limit_s, self.patience * float(route.arrival_s[-1]) + 5.0)

    def _navigate(
        self,
        previous: Mission,
        now_ns: int,
        track: Track,
        estimate: Estimate,
        route: Route,
        demand: Demand | None,
        robot: Robot,
    ) -> Mission:
        tolerance_um = self.goal_tolerance_um if self.goal_tolerance_um is not None else robot.radius
        if track.seen and math.dist(estimate.position_um, previous.goal_um) <= tolerance_um:
            return self._finish(previous, now_ns, "reached", "")
        limit_s = self._limit_s(self.navigate_limit_s, route)
        if self._passed_s(previous, now_ns) > limit_s:
            note = f"goal not reached in {limit_s:.0f} s, where {route.arrival_s[-1]:.0f} s were planned"
            return self._finish(previous, now_ns, "timeout", note)
        limit_um = self.replan_error_um if self.replan_error_um is not None else 6.0 * robot.radius
        if track.seen and demand is not None and demand.error_um > limit_um:
            if previous.request >= self.orders_limit:
                note = f"blown off every one of {previous.request} routes and maps: the robot can not be held here"
                return self._finish(previous, now_ns, "gave up", note)
            note = f"blown {demand.error_um:.0f} um off the route: planning anew"
            return self._order(previous, now_ns, "plan", "route", estimate, note)
        return previous

    def _next_after(self, done: str, previous: Mission, now_ns: int, estimate: Estimate, note: str) -> Mission:
        """Enter the first chosen phase behind `done`, or end the run."""
        chosen = [*self.phases, "plan"] if "navigate" in self.phases else list(self.phases)
        for phase in PHASES[PHASES.index(done) + 1 :]:
            if phase not in chosen:
                continue
            if phase == "refine":
                return self._order(previous, now_ns, "refine", "refine", estimate, note)
            if phase == "plan":
                return self._order(previous, now_ns, "plan", "route", estimate, note)
            return self._enter(previous, now_ns, "navigate", note)
        return self._finish(previous, now_ns, f"{done} complete", note)

    @staticmethod
    def _at_end(estimate: Estimate, route: Route, demand: Demand | None, robot: Robot) -> bool:
        """Reached, or the reference has arrived and the robot is as near as it will come."""
        close = math.dist(estimate.position_um, route.waypoints_um[-1]) <= robot.radius
        arrived = demand is not None and demand.progress_s >= route.arrival_s[-1] and demand.error_um < 2 * robot.radius
        return close or arrived

    @staticmethod
    def _enter(previous: Mission, now_ns: int, phase: str, note: str) -> Mission:
        return replace(previous, stamp_ns=now_ns, phase=phase, since_ns=now_ns, wanted="", note=note, held_ns=0)

    @staticmethod
    def _order(previous: Mission, now_ns: int, phase: str, wanted: str, estimate: Estimate, note: str = "") -> Mission:
        return replace(
            previous,
            stamp_ns=now_ns,
            phase=phase,
            since_ns=previous.since_ns if phase == previous.phase else now_ns,
            held_ns=previous.held_ns if phase == previous.phase else 0,
            request=previous.request + 1,
            wanted=wanted,
            requested_ns=now_ns,
            start_um=estimate.position_um,
            note=note,
        )

    @staticmethod
    def _finish(previous: Mission, now_ns: int, outcome: str, note: str) -> Mission:
        return replace(
            previous,
            stamp_ns=now_ns,
            phase="done",
            since_ns=now_ns,
            wanted="",
            finished=True,
            outcome=outcome,
            note=note,
            held_since_ns=None,
            held_ns=0,
            swept=False,
            blind_since_ns=None,
            blind="",
            field_off=False,
        )
