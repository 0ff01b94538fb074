"""Table of topics, derived from the annotations of `Tick`. Writer, reader, viewer, compare and replay iterate it."""

import dataclasses
import types
from collections.abc import Iterable
from typing import get_args, get_type_hints

from flowrec.declarations import Message, Source, Topic, message_fields
from flowrec.enums import WorkOrder
from flowrec.messages import FlowField, Tick


def topics_of(tick_type: type) -> tuple[Topic, ...]:
    """The topics that the annotations of a tick's fields declare, in order.

    Raises
    ------
    TypeError : a declaration is missing, is used twice, or contradicts another one.
    """
    hints = get_type_hints(tick_type, include_extras=True)
    names = [each.name for each in dataclasses.fields(tick_type) if each.name != "stamp_ns"]
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
