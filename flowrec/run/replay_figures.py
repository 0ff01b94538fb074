"""Figures of a recorded run and its replay side by side."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeGuard

import numpy as np

from flowrec.core import Demand, FlowField, Observations, Route, Row, Tick, Value, finite, seconds
from flowrec.physics import sample_as_seen
from flowrec.run.route_orders import no_observations
from flowrec.stages import ResolvedConfig, flow_error, length_um, travel_time
from flowrec.store import Session

_SAME_COMMAND_UM_S = 1.0  # smaller differences of the demanded velocity are not visible


@dataclass(slots=True)
class CommandDifference:
    """Difference of the replayed demand from the recorded one.

    Attributes
    ----------
    compared, changed : number of ticks.
    first_ns : stamp of the first changed demand.
    rms_um_s : root mean square difference of the demanded velocity, um/s.
    """

    compared: int = 0
    changed: int = 0
    first_ns: int | None = None
    _square: float = 0.0

    def add(self, was: Demand | None, now: Demand | None) -> None:
        """Compare one pair of demands."""
        if was is None or now is None:
            return
        self.compared += 1
        difference = math.dist(was.velocity_um_s, now.velocity_um_s)
        self._square += difference**2
        if difference > _SAME_COMMAND_UM_S:
            self.changed += 1
            self.first_ns = now.stamp_ns if self.first_ns is None else self.first_ns

    @property
    def rms_um_s(self) -> float:
        """Root mean square difference of the demanded velocity."""
        return math.sqrt(self._square / self.compared) if self.compared else 0.0


class ReplayPair(Protocol):
    """Two runs of one recording to be compared: a `Replay`, or two session files.

    Attributes
    ----------
    session : what was replayed, with the recorded configuration.
    config : the configuration of the replay.
    recorded, replayed : the last tick of both.
    commands : the difference of the demands of both.
    """

    @property
    def session(self) -> Session: ...
    @property
    def config(self) -> ResolvedConfig: ...
    @property
    def recorded(self) -> Tick: ...
    @property
    def replayed(self) -> Tick: ...
    @property
    def commands(self) -> CommandDifference: ...


@dataclass(frozen=True, slots=True, eq=False)
class ReplayFiles:
    """A session and the file of a replay of it; implements ReplayPair.

    Attributes
    ----------
    replay : the session of the replay.
    recorded : the last tick of the session that the replay covers.
    """

    session: Session
    replay: Session
    recorded: Tick
    replayed: Tick
    commands: CommandDifference

    @classmethod
    def of(cls, session: Session, replay: Session) -> ReplayFiles:
        """Read both; SessionError where a message is damaged."""
        commands = CommandDifference()
        replayed = iter(replay.messages("demand"))
        now = next(replayed, None)
        for was in session.messages("demand"):
            while now is not None and now.stamp_ns < was.stamp_ns:
                now = next(replayed, None)
            if now is not None and now.stamp_ns == was.stamp_ns:
                commands.add(was, now)
        end_ns = min(session.run.last_ns, replay.run.last_ns)
        recorded = session.reader.tick_before(end_ns, with_frames=False)
        return cls(session, replay, recorded, replay.reader.tick_before(replay.run.last_ns), commands)

    @property
    def config(self) -> ResolvedConfig:
        """The configuration of the replay."""
        return self.replay.config


def before_after(done: ReplayPair) -> list[Row]:
    """Key, recorded and replayed value of every figure that a replay may change, both on the map of the replay.

    Flow errors are relative to the true flow, where it is known. A route that can not be followed on that map has no
    travel time.
    """
    was, now = done.recorded, done.replayed
    rows: list[Row] = []

    def add(key: str, value: Callable[[Tick], Value]) -> None:
        rows.append((key, value(was), value(now)))

    add("map", lambda tick: tick.field.method if tick.field is not None else "none")
    if was.true_field is not None:
        add("assumed_flow_error", lambda tick: flow_error(done.session.chip, tick.assumed, was.true_field))
        add("refined_flow_error", lambda tick: flow_error(done.session.chip, tick.refined, was.true_field))
    if any(tick.field is not None and tick.field.error_share is not None for tick in (was, now)):
        add("stated_flow_error", lambda tick: tick.field.error_share if tick.field is not None else None)
    observations = now.observations or was.observations or no_observations(0)
    if len(observations.position_um) and was.field is not None and now.field is not None:
        add("observations", lambda tick: 0 if tick.observations is None else len(tick.observations.position_um))
        add("residual_um_s", lambda tick: _residual_um_s(tick.field, observations))
    if was.route is not None or now.route is not None:
        add("planner", lambda tick: _planner(tick.route))
        add("route_length_um", lambda tick: length_um(tick.route) if _leads(tick.route) else None)
        limit_um_s = done.config.plan.speed_share * done.config.robot.speed_limit_um_s
        if (field := now.field) is not None:
            add("travel_time_on_replayed_map_s", lambda tick: _travel_time_s(tick.route, field, limit_um_s))
    controllers = done.session.config.control.method, done.config.control.method
    if controllers[0] != controllers[1]:
        rows.append(("controller", *controllers))
    commands = done.commands
    rows.append(("commands_compared", None, commands.compared))
    rows.append(("commands_changed", None, commands.changed))
    if commands.first_ns is not None:
        rows.append(("commands_difference_rms_um_s", None, commands.rms_um_s))
        rows.append(("first_changed_command_s", None, seconds(commands.first_ns)))
    return rows


def _residual_um_s(flow: FlowField | None, observations: Observations) -> float | None:
    """Root mean square of observed minus mapped flow, um/s, both components together."""
    if flow is None:
        return None
    miss = observations.flow_um_s - sample_as_seen(flow, observations.position_um)
    return finite(float(np.sqrt((miss**2).sum(axis=1).mean())))


def _planner(route: Route | None) -> str:
    return "none" if route is None else route.method if route.reachable else f"{route.method}: unreachable"


def _leads(route: Route | None) -> TypeGuard[Route]:
    return route is not None and route.reachable


def _travel_time_s(route: Route | None, flow: FlowField, limit_um_s: float) -> float | None:
    """None where there is no route, or it can not be followed."""
    if not _leads(route):
        return None
    arrival_s, feasible = travel_time(flow, route.waypoints_um, limit_um_s)
    return float(arrival_s[-1]) if feasible else None
