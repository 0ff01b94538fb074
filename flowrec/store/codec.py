"""Message <-> bytes: one codec per message type, bit for bit.

Events travel in foxglove.Log, camera frames in foxglove's image schemas (frame_encodings.py), all other messages in the
schemas derived from their types (schema.py). The protobuf runtime serialises and parses. Only large byte fields bypass
it, because it copies them three times while it holds the interpreter lock: protobuf allows fields in any order, so a
large field follows the serialised rest as tag, length and bytes, and is cut out again before parsing.
https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

import functools
import json
import math
import operator
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from flowrec.core import (
    NS_PER_S,
    Event,
    Frame,
    Level,
    MessageField,
    OperatorEvent,
    RigError,
    SessionError,
    as_read,
    message_fields,
)
from flowrec.store.schema import ARRAY_DATA, Schema, array_schema, foxglove_schema, schema_of

Payload = tuple[bytes | memoryview, ...]


class Encoded(NamedTuple):
    """A message as it is stored: its stamp, the MCAP sequence that it must have, if any, and its payload."""

    stamp_ns: int
    sequence: int | None
    payload: Payload


_UNCOPIED_BYTES = 1 << 14  # a larger array bypasses protobuf when it is written
_LARGE_BYTES = 1 << 16  # in a larger message arrays bypass protobuf when it is read
_FIELDS_LIMIT = 64  # protobuf parses a message with more fields
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types

# Levels of foxglove.Log by Event.level; a level that is not listed is kept in the name.
_LEVELS: dict[str, int] = {"debug": 1, Level.INFO: 2, Level.WARNING: 3, Level.ERROR: 4, "fatal": 5}
_LEVEL_NAMES = {number: name for name, number in _LEVELS.items()}
_EVENT_NAME = "flowrec"
_OPERATOR_NAME = "operator."


@dataclass(frozen=True, slots=True)
class Codec:
    """Encoding of one message type."""

    schema: Schema  # protobuf schema of the payload
    encode: Callable[[Any], Payload]  # message -> parts of the payload, in order; large arrays are not copied
    decode: Callable[[bytes | memoryview, int], Any]  # payload, MCAP sequence -> message
    # the schema is one of foxglove's, whose `timestamp` is Unix time; flowrec's own have stamps
    has_unix_time: bool = False


_VECTOR = functools.partial(np.fromiter, dtype=np.float64)
_CODECS: dict[tuple[type[Any], str], Codec] = {}


def codec_of(message_type: type[Any], path: str = "") -> Codec:
    """The codec of a message type other than Frame, which has several (frame_encodings.py); `path`: as of schema_of."""
    codec = _CODECS.get((message_type, path))
    if codec is None:
        if message_type is Frame:
            raise TypeError("the codec of a Frame depends on its encoding")
        if message_type is Event:
            codec = _event_codec()
        elif message_type is OperatorEvent:
            codec = _operator_codec()
        else:
            schema = schema_of(message_type, path)
            codec = Codec(schema, _encoder(message_type, schema), _decoder(message_type, schema))
        _CODECS[message_type, path] = codec
    return codec


def encode_record(message: Any, codec: Codec, start_unix_ns: int = 0) -> Encoded:
    """A message as it is stored; large arrays are not copied.

    `start_unix_ns` is the Unix time at which the session clock is 0. Raises SessionError: a value does not fit the
    message's declaration, such as an int beyond 64 bit.
    """
    stamp_ns = message.stamp_ns
    if start_unix_ns and codec.has_unix_time:
        message = replace(message, stamp_ns=stamp_ns + start_unix_ns)
    try:
        sequence = message.index if isinstance(message, Frame) else None
        try:
            return Encoded(stamp_ns, sequence, codec.encode(message))
        except UnicodeEncodeError:
            # A lone surrogate from a terminal must not end a run: it is stored as an escape sequence.
            return Encoded(stamp_ns, sequence, codec.encode(_without_surrogates(message)))
    except (TypeError, ValueError, OverflowError) as error:
        raise SessionError(f"a {type(message).__name__} at {message.stamp_ns} ns can not be stored: {error}") from error


def decode(
    message_type: type[Any], codec: Codec, payload: bytes | memoryview, sequence: int = 0, start_unix_ns: int = 0
) -> Any:
    """One message from its payload. Raises SessionError: the payload is no such message.

    Parameters
    ----------
    codec : of the message type.
    sequence : of the MCAP message; it is the index of a Frame.
    start_unix_ns : as in `encode_record`.
    """
    try:
        with as_read():
            message = codec.decode(payload, sequence)
            if start_unix_ns and codec.has_unix_time:
                message = replace(message, stamp_ns=message.stamp_ns - start_unix_ns)
    except (DecodeError, ValueError, TypeError, OverflowError, RigError) as error:  # the last: a level of an image
        raise SessionError(f"damaged {message_type.__name__}: {error}") from error
    return message


def timestamp(stamp_ns: int) -> dict[str, int]:
    """A stamp in ns as the fields of google.protobuf.Timestamp."""
    seconds, nanos = divmod(stamp_ns, NS_PER_S)
    return {"seconds": seconds, "nanos": nanos}


def stamp_of(parsed: Any) -> int:
    """The stamp of a parsed message that has a `timestamp`, in ns."""
    return parsed.timestamp.seconds * NS_PER_S + parsed.timestamp.nanos


def byte_field_head(number: int, nbytes: int) -> bytes:
    """Tag and length of a byte field (or nested message) of `nbytes` bytes."""
    return _varint(number << 3 | _BYTES) + _varint(nbytes)


def cut_byte_fields(payload: memoryview, numbers: Container[int]) -> tuple[bytes | memoryview, dict[int, memoryview]]:
    """The message without some of its byte fields, and those fields by number.

    They are views of the payload, or copies where a view would keep a much larger buffer in memory. Raises ValueError:
    the payload is no message, or has one of the fields twice.
    """
    rest: list[memoryview] = []
    found: dict[int, memoryview] = {}
    for count, (number, kind, begin, value, end) in enumerate(_fields(payload)):
        if count == _FIELDS_LIMIT:
            return payload, {}
        if kind == _BYTES and number in numbers:
            if number in found:
                raise ValueError(f"field {number} is in it twice")
            found[number] = payload[value:end]
        else:
            rest.append(payload[begin:end])
    buffer = payload.obj
    if not isinstance(buffer, bytes | bytearray) or len(buffer) > 2 * sum(map(len, found.values())):
        found = {number: memoryview(bytes(view)) for number, view in found.items()}
    return b"".join(rest), found


def _without_surrogates(message: Any) -> Any:
    changes = {
        form.name: value.encode("utf-8", "backslashreplace").decode()
        for form in message_fields(type(message))
        if isinstance(value := getattr(message, form.name), str)
    }
    return replace(message, **changes)


def _encoder(message_type: type[Any], schema: Schema) -> Callable[[Any], Payload]:
    wire = schema.wire
    forms = list(enumerate(message_fields(message_type), 1))

    def encode(message: Any) -> Payload:
        values: dict[str, Any] = {}
        large: Payload = ()
        for number, form in forms:
            value = getattr(message, form.name)
            if value is None:
                if not form.optional:
                    raise ValueError(f"{form.name} is missing")
            elif form.kind == "vector":
                if value.ndim != 1:
                    raise ValueError(f"a vector of shape {value.shape}")
                values[form.name] = value.tolist()
            elif form.kind != "array":
                values[form.name] = value
            elif value.nbytes < _UNCOPIED_BYTES:
                values[form.name] = {"shape": value.shape, "dtype": value.dtype.str, "data": value.tobytes()}
            else:
                large += _large_array(number, value)
        return (wire(**values).SerializeToString(), *large)

    return encode


def _large_array(number: int, array: NDArray[Any]) -> Payload:
    """A field of type flowrec.Array whose values are not copied."""
    front = array_schema().wire(shape=array.shape, dtype=array.dtype.str).SerializeToString()
    front += byte_field_head(ARRAY_DATA, array.nbytes)
    return byte_field_head(number, len(front) + array.nbytes) + front, array.reshape(-1).view(np.uint8).data


def _decoder(message_type: type[Any], schema: Schema) -> Callable[[bytes | memoryview, int], Any]:
    parse = schema.wire.FromString
    unpack_all = unpackers(message_type)
    arrays = {number: form for number, form in enumerate(message_fields(message_type), 1) if form.kind == "array"}

    def decode(payload: bytes | memoryview, _sequence: int) -> Any:
        if len(payload) < _LARGE_BYTES or not arrays:
            parsed = parse(payload)
            return message_type(*[unpack(parsed) for unpack in unpack_all])
        rest, found = cut_byte_fields(memoryview(payload), arrays)
        parsed = parse(rest)
        return message_type(
            *[
                _cut_array(found[number], arrays[number].dtype) if number in found else unpack(parsed)
                for number, unpack in enumerate(unpack_all, 1)
            ]
        )

    return decode


def unpackers(message_type: type[Any], vector_of: Callable[[Any], Any] | None = None) -> list[Callable[[Any], Any]]:
    """Functions that take the fields out of a parsed message; `vector_of` is used for vectors in place of arrays."""
    return [_unpacker(form, vector_of or _VECTOR) for form in message_fields(message_type)]


def _unpacker(form: MessageField, vector_of: Callable[[Any], Any]) -> Callable[[Any], Any]:
    name, dtype = form.name, form.dtype
    present: Callable[[Any], Any] = operator.attrgetter(name)
    if form.kind == "vector":

        def present(parsed: Any) -> Any:
            return vector_of(getattr(parsed, name))

    elif form.kind == "array":

        def present(parsed: Any) -> Any:
            field = getattr(parsed, name)
            return array_of(field, field.data, dtype)

    if not form.optional:
        return present
    return lambda parsed: present(parsed) if parsed.HasField(name) else None


def _cut_array(field: memoryview, dtype: np.dtype[Any] | None) -> NDArray[Any]:
    rest, found = cut_byte_fields(field, (ARRAY_DATA,))
    parsed = array_schema().wire.FromString(rest)
    return array_of(parsed, found.get(ARRAY_DATA, parsed.data), dtype)


def array_of(parsed: Any, data: bytes | memoryview, dtype: np.dtype[Any] | None) -> NDArray[Any]:
    """The array in a parsed flowrec.Array and its data, read-only; ValueError if they do not fit each other."""
    assert dtype is not None  # schema.py gives one to each array
    if parsed.dtype != dtype.str:
        raise ValueError(f"an array of {parsed.dtype!r} where {dtype.str!r} belongs")
    shape = tuple(parsed.shape)
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of shape {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape)


def _event_codec() -> Codec:
    """Event <-> foxglove.Log."""
    schema = foxglove_schema("Log")

    def encode(event: Event) -> Payload:
        level = _LEVELS.get(event.level, 0)
        name = _EVENT_NAME if level else f"{_EVENT_NAME}.{event.level}"
        return _log(event.stamp_ns, level, event.text, name)

    def decode(payload: bytes | memoryview, _sequence: int) -> Event:
        parsed = schema.wire.FromString(payload)
        level = _LEVEL_NAMES.get(parsed.level)
        if level is None:
            level = parsed.name.removeprefix(f"{_EVENT_NAME}.")
        return Event(stamp_of(parsed), level, parsed.message)

    return Codec(schema, encode, decode, has_unix_time=True)


def _operator_codec() -> Codec:
    """OperatorEvent <-> foxglove.Log with the name `operator.ACTION` and the message `ACTION: TEXT`.

    Its numbers, where it has any, are JSON in `file`, because a Log has no field for them.
    """
    schema = foxglove_schema("Log")

    def encode(event: OperatorEvent) -> Payload:
        text, name = f"{event.action}: {event.text}", _OPERATOR_NAME + event.action
        numbers: dict[str, Any] = {"goal_um": event.goal_um.tolist(), "speed_limit_um_s": event.speed_limit_um_s}
        stated = {key: value for key, value in numbers.items() if value not in ([], None)}
        return _log(event.stamp_ns, _LEVELS[Level.INFO], text, name, json.dumps(stated) if stated else "")

    def decode(payload: bytes | memoryview, _sequence: int) -> OperatorEvent:
        parsed = schema.wire.FromString(payload)
        action = parsed.name.removeprefix(_OPERATOR_NAME)
        numbers = _operator_numbers(parsed.file) if parsed.file else {}
        return OperatorEvent(stamp_of(parsed), action, parsed.message.removeprefix(f"{action}: "), **numbers)

    return Codec(schema, encode, decode, has_unix_time=True)


def _operator_numbers(text: str) -> dict[str, Any]:
    """The numbers of an OperatorEvent; ValueError where the text is no JSON of them."""
    stated = json.loads(text)
    if not isinstance(stated, dict) or stated.keys() - {"goal_um", "speed_limit_um_s"}:
        raise ValueError(f"{text[:100]!r} are no numbers of an operator's event")
    numbers: dict[str, Any] = {}
    if "goal_um" in stated:
        numbers["goal_um"] = np.array(stated["goal_um"], np.float64)
        if numbers["goal_um"].ndim != 1:
            raise ValueError(f"goal_um = {text[:100]!r} is no point")
    if "speed_limit_um_s" in stated:
        numbers["speed_limit_um_s"] = float(stated["speed_limit_um_s"])
    return numbers


def _log(stamp_ns: int, level: int, text: str, name: str, file: str = "") -> Payload:
    log = foxglove_schema("Log").wire(timestamp=timestamp(stamp_ns), level=level, message=text, name=name, file=file)
    return (log.SerializeToString(),)


@functools.lru_cache(maxsize=1024)  # tags and lengths repeat
def _varint(number: int) -> bytes:
    """Protobuf's variable-length form of an unsigned number."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _fields(payload: memoryview) -> Iterator[tuple[int, int, int, int, int]]:
    """Number, wire type, begin, begin of the value and end of each field."""
    at, size = 0, len(payload)
    while at < size:
        begin = at
        tag, at = _read_varint(payload, at)
        kind = tag & 7
        if kind == _BYTES:
            length, at = _read_varint(payload, at)
            end = at + length
        elif kind == _VARINT:
            end = _read_varint(payload, at)[1]
        elif kind in (_FIXED64, _FIXED32):
            end = at + (8 if kind == _FIXED64 else 4)
        else:
            raise ValueError(f"a field of the unknown wire type {kind}")
        if end > size:
            raise ValueError("a field that reaches beyond its message")
        yield tag >> 3, kind, begin, at, end
        at = end


def _read_varint(payload: memoryview, at: int) -> tuple[int, int]:
    """A number and the place after it."""
    number = shift = 0
    while shift < 64 and at < len(payload):
        byte = payload[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
        shift += 7
    raise ValueError("a number without an end")
