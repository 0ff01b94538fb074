"""The one table of what is recorded: field of Tick, topic path, type, role and tolerance.

Writer, reader, viewer, compare and replay iterate it; a new message is one row here and one dataclass.
"""

from dataclasses import dataclass
from enum import Enum

from flowrec import messages as m


class Role(Enum):
    """What replay does with a topic."""

    INPUT = "input"  # fed back in: enough to replay
    OUTPUT = "output"  # what the stages said: recomputed and compared
    DIAGNOSTIC = "diagnostic"  # timings and drops: never compared
    TRUTH = "truth"  # known to a simulator only: kept for judging, seen by no stage


@dataclass(frozen=True, slots=True)
class Topic:
    """One row. `tolerance` is relative, for files made on another machine; on the same one replay is exact."""

    field: str
    path: str
    type: type[m.Message]
    role: Role
    tolerance: float = 0.0


TOPICS: tuple[Topic, ...] = (
    Topic("frame", "/camera/frame", m.Frame, Role.INPUT),
    Topic("applied", "/coils/applied", m.Applied, Role.INPUT),
    Topic("operator", "/operator/events", m.OperatorEvent, Role.INPUT),
    # Results of the worker. They come late, so the tick that adopts them is an input of the replay;
    # their values are recomputed and compared by `replay --verify`.
    Topic("assumed", "/flow/assumed", m.FlowField, Role.INPUT, 1e-5),
    Topic("refined", "/flow/refined", m.FlowField, Role.INPUT, 1e-4),
    Topic("route", "/plan/route", m.Route, Role.INPUT, 1e-4),
    Topic("track", "/robot/track", m.Track, Role.OUTPUT, 1e-6),
    Topic("estimate", "/robot/estimate", m.Estimate, Role.OUTPUT, 1e-6),
    Topic("health", "/run/health", m.Health, Role.OUTPUT, 1e-6),
    Topic("observations", "/flow/observations", m.Observations, Role.OUTPUT, 1e-6),
    Topic("mission", "/run/mission", m.Mission, Role.OUTPUT, 1e-6),
    Topic("demand", "/control/demand", m.Demand, Role.OUTPUT, 1e-6),
    Topic("currents", "/coils/command", m.Currents, Role.OUTPUT, 1e-6),
    Topic("event", "/run/events", m.Event, Role.OUTPUT),
    Topic("timing", "/run/timing", m.Timing, Role.DIAGNOSTIC),
    Topic("drops", "/run/drops", m.Drops, Role.DIAGNOSTIC),
    Topic("truth", "/truth/robot", m.Truth, Role.TRUTH),
    Topic("true_field", "/truth/flow", m.FlowField, Role.TRUTH),
    Topic("clocks", "/run/clocks", m.Clocks, Role.DIAGNOSTIC),
)

BY_FIELD = {topic.field: topic for topic in TOPICS}
BY_PATH = {topic.path: topic for topic in TOPICS}
