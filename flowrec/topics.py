"""The one table of what is recorded: field of Tick, topic path, type, role and tolerances.

Writer, reader, viewer, compare and replay iterate it; a new message is one row here and one dataclass.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum

from flowrec import messages as m


class Role(Enum):
    """What replay does with a topic."""

    INPUT = "input"  # fed back in: enough to replay
    OUTPUT = "output"  # what the stages said: recomputed and compared
    DIAGNOSTIC = "diagnostic"  # timings and drops: never compared
    TRUTH = "truth"  # known to a simulator only: kept for judging, seen by no stage


# Absolute tolerance of a field where nothing else is said, in its own unit: rounding of values up to 1e4.
_ATOL = 1e-8


@dataclass(frozen=True, slots=True)
class Topic:
    """One row. Two floats are the same when |recorded - replayed| <= atol + rtol |recorded|, element by element.

    The tolerances are for files made on another machine; on the same one a replay is exact. Everything but floats
    is compared exactly.

    Attributes
    ----------
    rtol : relative tolerance; 0: all of the topic is compared exactly.
    atols : absolute tolerances by field of the message, in the field's unit, where they are not `_ATOL`.
    """

    field: str
    path: str
    type: type[m.Message]
    role: Role
    rtol: float = 0.0
    atols: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def atol_of(self, name: str) -> float:
        """Absolute tolerance of a field of the message, in the field's unit."""
        return self.atols.get(name, _ATOL if self.rtol else 0.0)


_ASSUMED = {"velocity_um_s": 1e-4, "std_um_s": 1e-4, "pressure_pa": 1e-7}
_REFINED = {"velocity_um_s": 1e-3, "std_um_s": 1e-3, "pressure_pa": 1e-6}
_ROUTE = {"waypoints_um": 1e-4, "arrival_s": 1e-6, "time_to_go_s": 1e-6}

TOPICS: tuple[Topic, ...] = (
    Topic("frame", "/camera/frame", m.Frame, Role.INPUT),
    Topic("applied", "/coils/applied", m.Applied, Role.INPUT),
    Topic("operator", "/operator/events", m.OperatorEvent, Role.INPUT),
    # Results of the worker. They come late, so the tick that adopts them is an input of the replay;
    # their values are recomputed and compared by `replay --verify`.
    Topic("assumed", "/flow/assumed", m.FlowField, Role.INPUT, 1e-5, _ASSUMED),
    Topic("refined", "/flow/refined", m.FlowField, Role.INPUT, 1e-4, _REFINED),
    Topic("route", "/plan/route", m.Route, Role.INPUT, 1e-5, _ROUTE),
    Topic("track", "/robot/track", m.Track, Role.OUTPUT, 1e-6),
    Topic("estimate", "/robot/estimate", m.Estimate, Role.OUTPUT, 1e-6, {"covariance": 1e-6}),
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

_without_row = {each.name for each in fields(m.Tick)} - {"stamp_ns"} ^ BY_FIELD.keys()
if _without_row or len(BY_FIELD) != len(TOPICS) or len(BY_PATH) != len(TOPICS):
    raise TypeError(f"topics.py: each field of Tick needs one row of its own in TOPICS; see to {sorted(_without_row)}")
