"""Tick: the latest message of each topic; and the table of topics, derived from the annotations of its fields.

Writer, reader, viewer, compare and replay iterate the table.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, TypeVar, get_args, get_type_hints

from flowrec.core.declarations import Message, SlowStage, Source, Topic, message_fields
from flowrec.core.diagnostics import CameraLosses, Clocks, Drops, Timing
from flowrec.core.enums import WorkOrder
from flowrec.core.messages import (
    Appearance,
    Applied,
    AxesCheck,
    Background,
    Currents,
    Demand,
    Estimate,
    Event,
    FlowField,
    Frame,
    Hand,
    Health,
    Measured,
    Mission,
    Observations,
    OperatorEvent,
    Route,
    Shift,
    Tracers,
    TracerTruth,
    Track,
    Truth,
)

_ASSUMED = {"velocity_um_s": 1e-4, "std_um_s": 1e-4, "pressure_pa": 1e-7}
_REFINED = {"velocity_um_s": 1e-3, "std_um_s": 1e-3, "pressure_pa": 1e-6}
_ROUTE = {"waypoints_um": 1e-4, "arrival_s": 1e-6, "time_to_go_s": 1e-6}
_UNCERTAINTY = ("sampler", "flow", "refine.assimilate")  # that of the flow after the observations so far
_SOLVE = SlowStage({WorkOrder.SOLVE: ("flow", "refine.assimilate")}, reads=(), settings=("flow",))
_REFINE = SlowStage(
    {WorkOrder.REFINE: ("sampler", "flow", "refine")},
    reads=("assumed", "refined", "observations", "tracer_flow"),
    settings=("stabilise", "tracker", "observer", "sampler", "others", "refine", "mission"),
)
_PLAN = SlowStage(
    {
        WorkOrder.SURVEY_ROUTE: ("robot", "survey", "mission.survey_limit_s", "mission.lead_s", *_UNCERTAINTY),
        WorkOrder.ROUTE: ("robot", "plan", "mission.lead_s", *_UNCERTAINTY),
    },
    reads=("assumed", "refined", "health", "route", "estimate", "observations", "tracer_flow", "demand"),
    settings=("robot", "survey", "plan"),
)


Kind = TypeVar("Kind", bound=Message)


class Extra(Mapping[str, Message]):
    """The latest message of each topic that is no field of `Tick`, by path; read-only."""

    __slots__ = ("_messages",)

    def __init__(self, messages: Mapping[str, Message] | None = None) -> None:
        self._messages = dict(messages or {})

    def __getitem__(self, path: str) -> Message:
        return self._messages[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._messages)

    def __len__(self) -> int:
        return len(self._messages)

    def __hash__(self) -> int:
        return hash(frozenset(self._messages.items()))

    def __repr__(self) -> str:
        return f"Extra({self._messages!r})"

    def of(self, path: str, kind: type[Kind]) -> Kind | None:
        """The message of a topic; None where there is none of this kind."""
        found = self._messages.get(path)
        return found if isinstance(found, kind) else None

    def with_messages(self, new: Mapping[str, Message]) -> Extra:
        """These messages and newer ones; itself if there is none."""
        return Extra({**self._messages, **new}) if new else self


NO_EXTRA = Extra()
_OF_IMAGES = (
    "applied",
    "operator",
    "track",
    "estimate",
    "health",
    "demand",
    "currents",
    "timing",
    "mapless",
    "tracers",
)


@dataclass(frozen=True, slots=True)
class Tick:
    """All that is known after one frame: the latest message of each topic, None before the first.

    Replay adopts a result of the worker at the tick that adopted it; `replay --verify` computes its value again.
    """

    stamp_ns: int = -1
    frame: Annotated[Frame | None, Topic("/camera/frame", Source.CAMERA)] = None
    applied: Annotated[Applied | None, Topic("/coils/applied", Source.RIG)] = None
    operator: Annotated[OperatorEvent | None, Topic("/operator/events", Source.OPERATOR)] = None
    assumed: Annotated[FlowField | None, Topic("/flow/assumed", Source.WORKER, 1e-5, _ASSUMED, _SOLVE)] = None
    refined: Annotated[FlowField | None, Topic("/flow/refined", Source.WORKER, 1e-4, _REFINED, _REFINE)] = None
    route: Annotated[Route | None, Topic("/plan/route", Source.WORKER, 1e-5, _ROUTE, _PLAN)] = None
    track: Annotated[Track | None, Topic("/robot/track", Source.STAGE, 1e-6)] = None
    estimate: Annotated[Estimate | None, Topic("/robot/estimate", Source.STAGE, 1e-6, {"covariance": 1e-6})] = None
    health: Annotated[Health | None, Topic("/run/health", Source.STAGE, 1e-6)] = None
    observations: Annotated[Observations | None, Topic("/flow/observations", Source.STAGE, 1e-6)] = None
    mission: Annotated[Mission | None, Topic("/run/mission", Source.STAGE, 1e-6)] = None
    demand: Annotated[Demand | None, Topic("/control/demand", Source.STAGE, 1e-6)] = None
    currents: Annotated[Currents | None, Topic("/coils/command", Source.STAGE, 1e-6)] = None
    event: Annotated[Event | None, Topic("/run/events", Source.STAGE)] = None
    timing: Annotated[Timing | None, Topic("/run/timing", Source.LOOP)] = None
    drops: Annotated[Drops | None, Topic("/run/drops", Source.LOOP)] = None
    truth: Annotated[Truth | None, Topic("/truth/robot", Source.SIMULATOR)] = None
    true_field: Annotated[FlowField | None, Topic("/truth/flow", Source.SIMULATOR)] = None
    appearance: Annotated[Appearance | None, Topic("/robot/appearance", Source.STAGE, 1e-4, {"views": 1e-3})] = None
    # The estimate of a filter that knows no map, while `estimate` corrects one: what observations are taken from.
    mapless: Annotated[
        Estimate | None, Topic("/robot/estimate_without_map", Source.STAGE, 1e-6, {"covariance": 1e-6})
    ] = None
    axes: Annotated[AxesCheck | None, Topic("/run/axes", Source.STAGE, 1e-6, {"normal": 1e-3, "moment": 1e-3})] = None
    clocks: Annotated[Clocks | None, Topic("/run/clocks", Source.LOOP)] = None
    losses: Annotated[CameraLosses | None, Topic("/camera/losses", Source.LOOP)] = None
    background: Annotated[Background | None, Topic("/camera/background", Source.STAGE, 1e-6)] = None
    shift: Annotated[Shift | None, Topic("/camera/shift", Source.STAGE, 1e-6)] = None
    measured: Annotated[Measured | None, Topic("/coils/measured", Source.RIG)] = None
    tracers: Annotated[Tracers | None, Topic("/tracers/tracks", Source.STAGE, 1e-6)] = None
    tracer_flow: Annotated[Observations | None, Topic("/tracers/observations", Source.STAGE, 1e-6)] = None
    true_tracers: Annotated[TracerTruth | None, Topic("/truth/tracers", Source.SIMULATOR)] = None
    hand: Annotated[Hand | None, Topic("/operator/hand", Source.OPERATOR)] = None
    extra: Extra = NO_EXTRA  # of the other topics that the run declares (declared_topics.py)

    @property
    def field(self) -> FlowField | None:
        """The best flow known: refined where there is one, else assumed."""
        return self.refined if self.refined is not None else self.assumed

    @property
    def is_afterwards(self) -> bool:
        """True after the last image, while an observation waits for its refinement."""
        ended = self.mission is not None and self.mission.input_ended
        return ended and self.applied is not None and self.applied.without_image

    def at_images(self, last: Tick) -> Tick:
        """The tick for people, to whom a session ends with its last image: that of `last`, the tick shown before.

        What comes afterwards is shown with that image: maps, mission and events; none of what tells of an image.
        """
        if not self.is_afterwards or last.stamp_ns < 0:
            return self
        assert self.mission is not None
        since_ns = min(self.mission.since_ns, last.stamp_ns)
        kept = {name: getattr(last, name) for name in _OF_IMAGES}
        mission = self.mission if self.mission is last.mission else dataclasses.replace(self.mission, since_ns=since_ns)
        return dataclasses.replace(self, stamp_ns=last.stamp_ns, mission=mission, **kept)

    def news(self, last: Tick, names: Iterable[str]) -> dict[str, Message]:
        """The messages in these fields that are new since another tick, by field."""
        known = ((name, getattr(self, name)) for name in names)
        return {name: each for name, each in known if each is not None and each is not getattr(last, name)}


def topics_of(tick_type: type) -> tuple[Topic, ...]:
    """The topics that the annotations of a tick's fields declare, in order.

    Raises TypeError: a declaration is missing, is used twice, or contradicts another one.
    """
    hints = get_type_hints(tick_type, include_extras=True)
    named = [each.name for each in dataclasses.fields(tick_type) if each.name != "stamp_ns"]
    names = [name for name in named if hints[name] is not Extra]
    topics = []
    for name in names:
        declared = next((note for note in get_args(hints[name])[1:] if isinstance(note, Topic)), None)
        options = get_args(get_args(hints[name])[0]) if declared is not None else ()
        kind = next((option for option in options if isinstance(option, type) and issubclass(option, Message)), None)
        if declared is None or kind is None or types.NoneType not in options:
            raise TypeError(f"Tick.{name}: declare it as Annotated[SomeMessage | None, Topic(path, source)] = None")
        if (declared.made_by is not None) != (declared.source is Source.WORKER):
            raise TypeError(f"Tick.{name}: made_by=SlowStage(...) belongs to Source.WORKER and to no other source")
        for each in message_fields(kind):
            if each.dtype is not None and each.shape is None:
                raise TypeError(f"{kind.__name__}.{each.name}: declare its shape, as in Annotated[Vector, Shape(2)]")
        unknown = declared.atols.keys() - {each.name for each in message_fields(kind)}
        unknown |= set(declared.made_by.reads) - set(names) if declared.made_by is not None else set()
        if unknown:
            raise TypeError(f"Tick.{name}: its declaration names fields that do not exist: {sorted(unknown)}")
        topics.append(dataclasses.replace(declared, field=name, type=kind))
    if len({topic.path for topic in topics}) != len(topics):
        raise TypeError("Tick: two fields are declared with the same topic path")
    answered = [order for topic in topics if topic.made_by is not None for order in topic.made_by.orders]
    if sorted(answered) != sorted(WorkOrder):
        raise TypeError(f"Tick: each work order needs one field that answers it; declared are {sorted(answered)}")
    return tuple(topics)


def stale_results(sections: Iterable[str]) -> frozenset[str]:
    """The results of the worker that depend on sections of the configuration, directly or through another result."""
    changed = frozenset(sections)
    stale: set[str] = set()
    for _ in WORKER_FIELDS:  # a result may depend on every other one
        for name, made_by in WORKER_FIELDS.items():
            if changed & set(made_by.settings) or stale & set(made_by.reads):
                stale.add(name)
    return frozenset(stale)


TOPICS = topics_of(Tick)
BY_FIELD = {topic.field: topic for topic in TOPICS}
BY_PATH = {topic.path: topic for topic in TOPICS}
WORKER_FIELDS = {topic.field: topic.made_by for topic in TOPICS if topic.made_by is not None}
FLOW_FIELDS = tuple(name for name in WORKER_FIELDS if BY_FIELD[name].type is FlowField)
ANSWERED_BY = {order: name for name, made_by in WORKER_FIELDS.items() for order in made_by.orders}
