"""Frame, Event and OperatorEvent in foxglove's own schemas, so that every MCAP viewer shows them; still lossless."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowrec.messages import Event, Frame, OperatorEvent
from flowrec.store.form import Codec, Payload
from flowrec.store.schemas import foxglove_schema
from flowrec.units import NS_PER_S

_SEQUENCE_LIMIT = 2**32  # MCAP keeps the sequence in 32 bit
_RAW_IMAGE_DATA = b"\x32"  # tag of RawImage.data: field 6, length-delimited

# Levels of foxglove.Log by Event.level; one that is not listed travels in the name.
_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
_LEVEL_NAMES = {number: name for name, number in _LEVELS.items()}
_EVENT_NAME = "flowrec"
_OPERATOR_NAME = "operator."


def timestamp(stamp_ns: int) -> dict[str, int]:
    """google.protobuf.Timestamp of a stamp."""
    seconds, nanos = divmod(stamp_ns, NS_PER_S)
    return {"seconds": seconds, "nanos": nanos}


def _stamp_ns(parsed: Any) -> int:
    stamp: int = parsed.timestamp.seconds * NS_PER_S + parsed.timestamp.nanos
    return stamp


def frame_codec() -> Codec:
    """Frame <-> foxglove.RawImage, mono8; Frame.index is the MCAP sequence (32 bit)."""
    schema = foxglove_schema("RawImage")
    wire = schema.wire

    def encode(frame: Frame) -> Payload:
        if frame.image.ndim != 2:
            raise ValueError(f"an image of shape {frame.image.shape}")
        height, width = frame.image.shape
        head = wire(timestamp=timestamp(frame.stamp_ns), width=width, height=height, encoding="mono8", step=width)
        # The image goes to the compressor as it lies in memory: protobuf would copy it three times, holding the GIL.
        prefix = head.SerializeToString() + _RAW_IMAGE_DATA + _varint(frame.image.nbytes)
        return (prefix, frame.image.reshape(-1).data)

    def decode(payload: bytes | memoryview, sequence: int) -> Frame:
        parsed = wire.FromString(payload)
        shape, data = (parsed.height, parsed.width), parsed.data
        if parsed.encoding != "mono8" or parsed.step != shape[1] or len(data) != shape[0] * shape[1]:
            raise ValueError(f"an image of {shape[1]} x {shape[0]} {parsed.encoding!r} in {len(data)} bytes")
        return Frame(_stamp_ns(parsed), sequence, np.frombuffer(data, np.uint8).reshape(shape))

    def sequence(frame: Frame) -> int:
        if not 0 <= frame.index < _SEQUENCE_LIMIT:
            raise ValueError(f"frame index {frame.index} is not in 32 bit")
        return frame.index

    return Codec(schema, encode, decode, sequence)


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
        return Event(_stamp_ns(parsed), level, parsed.message)

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
        return OperatorEvent(_stamp_ns(parsed), action, parsed.message.removeprefix(f"{action}: "))

    return Codec(schema, encode, decode)


def _varint(number: int) -> bytes:
    """Protobuf's variable-length form of a size."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)
