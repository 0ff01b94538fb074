"""Event and OperatorEvent in foxglove's own schema, so that every MCAP viewer shows them; still lossless."""

from __future__ import annotations

from typing import Any

from flowrec.messages import Event, OperatorEvent
from flowrec.store.form import Codec, Payload
from flowrec.store.schema import foxglove_schema
from flowrec.units import NS_PER_S

# Levels of foxglove.Log by Event.level; one that is not listed travels in the name.
_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
_LEVEL_NAMES = {number: name for name, number in _LEVELS.items()}
_EVENT_NAME = "flowrec"
_OPERATOR_NAME = "operator."


def timestamp(stamp_ns: int) -> dict[str, int]:
    """google.protobuf.Timestamp of a stamp."""
    seconds, nanos = divmod(stamp_ns, NS_PER_S)
    return {"seconds": seconds, "nanos": nanos}


def stamp_of(parsed: Any) -> int:
    """The stamp of a message that has a `timestamp`, in ns."""
    stamp: int = parsed.timestamp.seconds * NS_PER_S + parsed.timestamp.nanos
    return stamp


def event_codec() -> Codec:
    """Event <-> foxglove.Log."""
    schema = foxglove_schema("Log")
    wire = schema.wire

    def encode(event: Event) -> Payload:
        level = _LEVELS.get(event.level, 0)
        name = _EVENT_NAME if level else f"{_EVENT_NAME}.{event.level}"
        log = wire(timestamp=timestamp(event.stamp_ns), level=level, message=event.text, name=name)
        return (log.SerializeToString(),)

    def decode(payload: bytes | memoryview, _sequence: int) -> Event:
        parsed = wire.FromString(payload)
        level = _LEVEL_NAMES.get(parsed.level)
        if level is None:
            level = parsed.name.removeprefix(f"{_EVENT_NAME}.")
        return Event(stamp_of(parsed), level, parsed.message)

    return Codec(schema, encode, decode)


def operator_codec() -> Codec:
    """OperatorEvent <-> foxglove.Log named `operator.ACTION`, whose message people read as `ACTION: TEXT`."""
    schema = foxglove_schema("Log")
    wire = schema.wire

    def encode(event: OperatorEvent) -> Payload:
        log = wire(
            timestamp=timestamp(event.stamp_ns),
            level=_LEVELS["info"],
            message=f"{event.action}: {event.text}",
            name=_OPERATOR_NAME + event.action,
        )
        return (log.SerializeToString(),)

    def decode(payload: bytes | memoryview, _sequence: int) -> OperatorEvent:
        parsed = wire.FromString(payload)
        action = parsed.name.removeprefix(_OPERATOR_NAME)
        return OperatorEvent(stamp_of(parsed), action, parsed.message.removeprefix(f"{action}: "))

    return Codec(schema, encode, decode)
