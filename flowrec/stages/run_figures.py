"""The figures of a run, from its ticks: those that its session states at the end, and a live view meanwhile."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flowrec.core import (
    FLOW_FIELDS,
    TRACERS,
    WALLS,
    Demand,
    Figures,
    FlowField,
    Mission,
    Observations,
    Outcome,
    Phase,
    RobotWalls,
    Route,
    Tick,
    Timing,
    Track,
    Truth,
    finite,
    seconds,
)
from flowrec.physics import Chip, Robot, relative_rmse
from flowrec.stages.estimation.tracer_stretches import SETTLED_FRAMES
from flowrec.stages.planning.planner import Planner
from flowrec.stages.planning.survey_ways import METHOD as SURVEY_ROUTE
from flowrec.stages.robot_topics import observations_topic, tracks_of_others

CHAIN = ("arrived", "tracked", "commanded", "on the wire", "field")  # stages of the latency, after the exposure


def chain_ms(timing: Timing) -> tuple[float, ...]:
    """Time in ms from the middle of the exposure to each stage of CHAIN; NaN: not known."""
    told = timing.arrival_ms, timing.wait_ms, timing.apply_ms, timing.field_ms
    arrived, waited, applied, field = (math.nan if each is None else each for each in told)
    tracked = arrived + waited + timing.track_ms
    wire = tracked + timing.observe_ms + timing.control_ms
    return arrived, tracked, wire - applied, wire, wire + field


class RobotStatistics:
    """Figures of a robot other than the first one, from all ticks."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._images = self._seen = self._alarms = self._observations = 0
        self._was_near = False
        self._nearest_um = math.inf
        self._true = ""  # path of the truth of this robot; '': not known
        self._contacts: int | None = None  # None: the truth is not known

    def write(self, tick: Tick, track: Track) -> None:
        """Take one tick, and the track of this robot in it."""
        if track.stamp_ns == tick.stamp_ns:
            self._images += 1
            self._seen += track.seen
        walls = tick.extra.of(WALLS, RobotWalls)
        if walls is not None and self._number <= len(walls.near):
            near = bool(walls.near[self._number - 1])
            self._alarms += near and not self._was_near
            self._was_near = near
            if track.seen:
                self._nearest_um = max(float(np.fmin(self._nearest_um, walls.wall_um[self._number - 1])), 0.0)
        if track.seen and not self._true:  # numbers of true robots are not those of the tracks
            truths = {path: each for path, each in tick.extra.items() if isinstance(each, Truth)}
            off_um = {path: math.dist(each.position_um, track.position_um) for path, each in truths.items()}
            self._true = min(off_um, key=lambda path: off_um[path], default="")
        if (truth := tick.extra.of(self._true, Truth)) is not None:
            self._contacts = truth.contacts
        observations = tick.extra.of(observations_topic(self._number), Observations)
        if observations is not None:
            self._observations = len(observations.std_um_s)

    @property
    def text(self) -> str:
        """In words: share of the images in which it was tracked, alarms, walls, observations."""
        words = [f"tracked in {self._seen / max(self._images, 1):.0%} of {self._images} images"]
        if math.isfinite(self._nearest_um):
            words.append(f"at least {self._nearest_um:.0f} um from walls")
        words.append(f"{_count_text(self._alarms, 'alarm')} near walls")
        if self._contacts is not None:
            words.append(_count_text(self._contacts, "wall contact"))
        if self._observations:
            words.append(_count_text(self._observations, "flow observation"))
        return ", ".join(words)


class TracerStatistics:
    """Figures of the tracers, from all ticks."""

    def __init__(self) -> None:
        self._images = self._shown = self._observations = 0

    def write(self, tick: Tick) -> None:
        """Take one tick."""
        if tick.tracers is not None and tick.tracers.stamp_ns == tick.stamp_ns:
            self._images += 1
            self._shown += int(((tick.tracers.age_frames > SETTLED_FRAMES) & (tick.tracers.lost_frames == 0)).sum())
        if tick.tracer_flow is not None:
            self._observations = len(tick.tracer_flow.std_um_s)

    @property
    def text(self) -> str:
        """In words: how many an image shows, observations; '' where they are not followed."""
        if not self._images:
            return ""
        if not self._shown:
            return "none was followed over three images; section tracker.tracer states their radius and look"
        return f"{self._shown / self._images:.1f} an image, {_count_text(self._observations, 'flow observation')}"


def _count_text(count: int, name: str) -> str:
    return f"{count} {name}{'' if count == 1 else 's'}"


class RunStatistics:
    """A sink that collects of all ticks what the figures need.

    Attributes
    ----------
    true_field : the true flow; None where it is not known.
    contacts : with walls so far, where the truth is known.
    navigating_ns : stamp at which the way to the goal began; None: not yet.
    """

    def __init__(self) -> None:
        self.true_field: FlowField | None = None
        self.contacts = 0
        self.navigating_ns: int | None = None
        self._chain_ms: list[tuple[float, ...]] = []
        self._square_um2 = 0.0
        self._count = 0
        self._last: Demand | None = None
        self._others: dict[int, RobotStatistics] = {}
        self._tracers = TracerStatistics()

    def write(self, tick: Tick) -> None:
        """Take one tick."""
        self.true_field = tick.true_field or self.true_field
        if tick.truth is not None:
            self.contacts = tick.truth.contacts
        if tick.timing is not None and tick.timing.arrival_ms is not None:
            self._chain_ms.append(chain_ms(tick.timing))
        for number, track in enumerate(tracks_of_others(tick), start=1):
            self._others.setdefault(number, RobotStatistics(number)).write(tick, track)
        self._tracers.write(tick)
        demand = tick.demand
        if tick.mission is None or tick.mission.phase != Phase.NAVIGATE:
            return
        if self.navigating_ns is None:
            self.navigating_ns = tick.stamp_ns
        if demand is None or demand is self._last:
            return
        self._last = demand
        if math.isfinite(demand.error_um):
            self._square_um2 += demand.error_um**2
            self._count += 1

    @property
    def others(self) -> Figures:
        """A line of text for each robot other than the first one, and one for the tracers."""
        lines: Figures = {f"robot_{number}": each.text for number, each in self._others.items()}
        return lines | ({TRACERS: text} if (text := self._tracers.text) else {})

    @property
    def latency(self) -> str | None:
        """The chain of latency as text: median and 95 % of each stage since the middle of the exposure."""
        if not self._chain_ms:
            return None
        columns = [(name, row[np.isfinite(row)]) for name, row in zip(CHAIN, np.array(self._chain_ms).T, strict=True)]
        known = [(name, *np.quantile(row, (0.5, 0.95)).tolist()) for name, row in columns if row.size]
        return ", ".join(f"{name} {middle:.1f} ({late:.1f})" for name, middle, late in known) + " ms after the exposure"

    @property
    def tracking_error_um(self) -> float | None:
        """Root mean square distance to the reference; None if nothing was navigated along one."""
        return finite(math.sqrt(self._square_um2 / self._count)) if self._count else None


def tells_flow(chip: Chip, tick: Tick) -> bool:
    """False where no flow was asked for, in an open field that nothing drives, and no refinement has found one."""
    return not chip.is_still or (tick.refined is not None and not tick.refined.refused)


def figures_of(
    chip: Chip, last: Tick, true_field: FlowField | None, contacts: int, navigating_ns: int | None
) -> Figures:
    """Figures of route, contacts and maps at a tick, in the order of the table. Errors are relative to the true flow.

    `contacts` and `navigating_ns` are those of RunStatistics.
    """
    figures: Figures = {"axes_check": last.axes.verdict} if last.axes is not None and last.axes.verdict else {}
    mission, route = last.mission, last.route
    flies = mission is not None and mission.phase in (Phase.NAVIGATE, Phase.DONE)
    # A run that ends in its survey has a route, which leads to no goal.
    if mission is not None and route is not None and route.reachable and flies and route.method != SURVEY_ROUTE:
        figures["planner"] = route.method
        figures["route_length_um"] = length_um(route)
        figures["planned_s"] = route.lasts_s
        if mission.outcome == Outcome.REACHED and navigating_ns is not None:
            figures["navigation_s"] = seconds(mission.since_ns - navigating_ns)
    if mission is not None and mission.goal_set_ns is not None:
        figures["latest_goal"] = f"{mission.goal_um[0]:.0f}, {mission.goal_um[1]:.0f} um"
    if mission is not None and mission.speed_limit_um_s is not None:
        figures["speed_limit_um_s"] = mission.speed_limit_um_s
    if last.currents is not None and last.currents.unmet_mt > 0.0:
        figures["unmet_mt"] = last.currents.unmet_mt
    if true_field is not None:
        figures["contacts"] = contacts
    if not tells_flow(chip, last):
        return figures
    for name in FLOW_FIELDS:
        flow: FlowField | None = getattr(last, name)
        if flow is not None and (true_field is not None or not flow.refused or flow.log_score is not None):
            figures[f"{name}_method"] = f"{flow.method}, another refused" if flow.refused else flow.method
        if flow is not None and true_field is not None:
            figures[f"{name}_flow_error"] = flow_error(chip, flow, true_field)
    if last.field is not None and last.field.error_share is not None:
        figures["stated_flow_error"] = finite(last.field.error_share)
    if last.observations is not None:
        figures["observations"] = len(last.observations.position_um)
    return figures


def robot_at(tick: Tick, mission: Mission, robot: Robot) -> Robot:
    """The robot as it is known in a tick: slower where it has stepped out, or a person limits its speed."""
    limit_hz = tick.health.limit_hz if tick.health is not None else None
    return robot.limited_to(limit_hz).slowed_to(mission.speed_limit_um_s)


def shortest_way(last: Tick, planner: Planner, chip: Chip, robot: Robot) -> Figures:
    """Length and duration of the shortest way from where the route of a tick begins to the goal: a null model.

    The duration is None where the flow on that way is too fast for the robot. Empty where nothing was navigated.
    """
    mission, route = last.mission, last.route
    if mission is None or route is None or last.field is None or mission.outcome != Outcome.REACHED:
        return {}
    if mission.phase != Phase.DONE or len(route.waypoints_um) == 0:
        return {}
    by_length = replace(planner, method="astar_length", cost="time")
    shortest = by_length.plan(last.field, route.waypoints_um[0], mission.goal_um, chip, robot_at(last, mission, robot))
    if not shortest.reachable:
        return {"shortest_way_s": None}
    return {"shortest_way_um": length_um(shortest), "shortest_way_s": shortest.lasts_s}


def length_um(route: Route) -> float:
    """Length of a route in um."""
    return float(np.linalg.norm(np.diff(route.waypoints_um, axis=0), axis=1).sum())


def flow_error(chip: Chip, flow: FlowField | None, true_field: FlowField | None) -> float | None:
    """Relative RMSE of a flow over the fluid pixels; None where one is not known, or not comparable."""
    if flow is None or true_field is None or (flow.wall_px is None) != (true_field.wall_px is None):
        return None  # means over pixels, of numerics 1, are not compared with values at their centres
    return finite(float(relative_rmse(flow, true_field, chip.mask).v))
